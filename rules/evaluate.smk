"""Held-out cameras: what was rendered against what was filmed."""


rule evaluate_camera:
    input:
        view="<results>/{scene}/views/{cam}.json",
        cameras="<results>/{scene}/sfm/cameras.json",
        points="<results>/{scene}/sfm/points.npz",
        films=expand("<results>/{{scene}}/frames/cameras/{cam}.npz", cam=SCENE.cameras),
        labels=labels_of,
        rendered=evaluated("render"),
        foreground=evaluated("foreground", ".npz"),
        background=evaluated("background", ".npz"),
        others=lambda wildcards: [
            f"{word.partition('=')[2]}/{wildcards.cam}" for word in config["evaluate"]["other"]
        ],
    output:
        table="<results>/{scene}/evaluate/{cam}.csv",
        sheet="<results>/{scene}/evaluate/{cam}.png",
    log:
        "<logs>/{scene}/evaluate_camera/{cam}.log",
    benchmark:
        "<benchmarks>/{scene}/evaluate_camera/{cam}.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        labels=label_flags,
        options=options("evaluate"),
        version=fourd_config.stage_version("evaluate"),
    shell:
        "python -m fourd.evaluate camera --view-file {input.view} --cameras {input.cameras}"
        " --points {input.points} --films {input.films} {params.labels} --rendered {input.rendered}"
        " --foreground {input.foreground} --background {input.background} {params.options}"
        " --output {output.table} --output-sheet {output.sheet} 2> {log}"


rule collect_metrics:
    input:
        tables=expand("<results>/{{scene}}/evaluate/{cam}.csv", cam=SCENE.heldout),
        sheets=expand("<results>/{{scene}}/evaluate/{cam}.png", cam=SCENE.heldout),
    output:
        metrics="<results>/{scene}/evaluate/metrics.csv",
        summary="<results>/{scene}/evaluate/summary.csv",
        table="<results>/{scene}/evaluate/table.md",
        sheet="<results>/{scene}/evaluate/contact_sheet.png",
    log:
        "<logs>/{scene}/collect_metrics.log",
    benchmark:
        "<benchmarks>/{scene}/collect_metrics.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        version=fourd_config.stage_version("evaluate"),
    shell:
        "python -m fourd.evaluate collect --inputs {input.tables} --sheets {input.sheets}"
        " --output {output.metrics} --output-summary {output.summary} --output-table {output.table}"
        " --output-sheet {output.sheet} 2> {log}"
