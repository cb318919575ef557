"""Held-out cameras: what was rendered against what was filmed."""


# Bodies for the row SfM+humans: the held-out cameras are scored at the same moments.
rule find_people:
    input:
        views=expand("<results>/<scene>/views/{cam}.json", cam=SCENE.heldout),
        cameras="<results>/<scene>/sfm/cameras.json",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.inputs),
    output:
        "<results>/<scene>/evaluate/people.npz",
    log:
        "<logs>/<scene>/find_people.log",
    benchmark:
        "<benchmarks>/<scene>/find_people.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        humans=flags_from_mapping({"humans": config["evaluate"]["humans"]}),
        version=fourd_config.stage_version("evaluate"),
    shell:
        "python -m fourd.evaluate people --view-files {input.views} --cameras {input.cameras}"
        " --films {input.films} {params.humans} --output {output} 2> {log}"


rule evaluate_camera:
    input:
        view="<results>/<scene>/views/{cam}.json",
        cameras="<results>/<scene>/sfm/cameras.json",
        points="<results>/<scene>/sfm/points.npz",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.cameras),
        labels=labels_of,
        depths=[f"{config['evaluate']['depths']}/{{cam}}"] if config["evaluate"]["depths"] else [],
        people="<results>/<scene>/evaluate/people.npz" if config["evaluate"]["humans"] else [],
        rendered=evaluated("render"),
        foreground=evaluated("foreground", ".npz"),
        background=evaluated("background", ".npz"),
        others=lambda wildcards: [
            f"{word.partition('=')[2]}/{wildcards.cam}" for word in config["evaluate"]["other"]
        ],
    output:
        table="<results>/<scene>/evaluate/{cam}.csv",
        sheet="<results>/<scene>/evaluate/{cam}.png",
    log:
        "<logs>/<scene>/evaluate_camera/{cam}.log",
    benchmark:
        "<benchmarks>/<scene>/evaluate_camera/{cam}.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        labels=label_flags,
        people="--people" if config["evaluate"]["humans"] else "",
        recovered="" if SCENE.calibration else "--recovered",
        options=options("evaluate"),
        version=fourd_config.stage_version("evaluate"),
    shell:
        "python -m fourd.evaluate camera --view-file {input.view} --cameras {input.cameras}"
        " --points {input.points} --films {input.films} {params.labels} {params.recovered}"
        " {params.people} {input.people} --rendered {input.rendered} --foreground {input.foreground}"
        " --background {input.background} {params.options}"
        " --output {output.table} --output-sheet {output.sheet} 2> {log}"


rule collect_metrics:
    input:
        tables=expand("<results>/<scene>/evaluate/{cam}.csv", cam=SCENE.heldout),
        sheets=expand("<results>/<scene>/evaluate/{cam}.png", cam=SCENE.heldout),
    output:
        metrics="<results>/<scene>/evaluate/metrics.csv",
        summary="<results>/<scene>/evaluate/summary.csv",
        table="<results>/<scene>/evaluate/table.md",
        sheet="<results>/<scene>/evaluate/contact_sheet.png",
    log:
        "<logs>/<scene>/collect_metrics.log",
    benchmark:
        "<benchmarks>/<scene>/collect_metrics.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        version=fourd_config.stage_version("evaluate"),
    shell:
        "python -m fourd.evaluate collect --inputs {input.tables} --sheets {input.sheets}"
        " --output {output.metrics} --output-summary {output.summary} --output-table {output.table}"
        " --output-sheet {output.sheet} 2> {log}"
