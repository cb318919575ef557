"""Probe each source: when every frame was taken, how large it is, whether it is what it was."""


rule fetch_pose2sim:
    output:
        films=expand("data/pose2sim/cam{number:02d}.mp4", number=range(1, 5)),
        calibration="data/pose2sim/cameras.json",
    log:
        "<logs>/fetch_pose2sim.log",
    benchmark:
        "<benchmarks>/fetch_pose2sim.tsv"
    localrule: True
    conda:
        "../envs/vision.yaml"
    params:
        version=fourd_config.stage_version("fetch"),
    shell:
        "python -m fourd.fetch pose2sim --output data/pose2sim 2> {log}"


rule probe_background:
    input:
        source=lambda wildcards: SCENE.cameras[wildcards.cam].background,
    output:
        facts="<results>/<scene>/ingest/background/{cam}.json",
        table="<results>/<scene>/ingest/background/{cam}.csv",
    log:
        "<logs>/<scene>/probe_background/{cam}.log",
    benchmark:
        "<benchmarks>/<scene>/probe_background/{cam}.tsv"
    wildcard_constraints:
        cam="|".join(c for c, s in SCENE.cameras.items() if s.background) or "none",
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        fps=SCENE.fps,
        stamp=lambda wildcards: source_stamp(SCENE.cameras[wildcards.cam].background, MADE_BY_RULES),
        options=options("ingest"),
        version=fourd_config.stage_version("ingest"),
    shell:
        "python -m fourd.ingest --camera {wildcards.cam} --source {input.source:q} --fps {params.fps}"
        " {params.options} --output-json {output.facts} --output-table {output.table} 2> {log}"


rule probe_camera:
    input:
        source=lambda wildcards: SCENE.cameras[wildcards.cam].source,
    output:
        facts="<results>/<scene>/ingest/{cam}.json",
        table="<results>/<scene>/ingest/{cam}.csv",
    log:
        "<logs>/<scene>/probe_camera/{cam}.log",
    benchmark:
        "<benchmarks>/<scene>/probe_camera/{cam}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        # Of folders of images, which have no times of their own.
        fps=SCENE.fps,
        # The engine compares times with those of the outputs only: an older film would not be noticed.
        stamp=lambda wildcards: source_stamp(SCENE.cameras[wildcards.cam].source, MADE_BY_RULES),
        options=options("ingest"),
        version=fourd_config.stage_version("ingest"),
    shell:
        "python -m fourd.ingest --camera {wildcards.cam} --source {input.source:q} --fps {params.fps}"
        " {params.options} --output-json {output.facts} --output-table {output.table} 2> {log}"
