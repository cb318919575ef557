"""Probe each source: when every frame was taken, how large it is, whether it is what it was."""


rule probe_camera:
    input:
        source=lambda wildcards: SCENE.cameras[wildcards.cam].source,
    output:
        "<results>/{scene}/ingest/{cam}.json",
    log:
        "<logs>/{scene}/probe_camera/{cam}.log",
    benchmark:
        "<benchmarks>/{scene}/probe_camera/{cam}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        fps=SCENE.fps,
        num_frames=SCENE.num_frames,
        offset_s=lambda wildcards: SCENE.cameras[wildcards.cam].offset_s,
        options=options("ingest"),
        version=fourd_config.stage_version("ingest"),
    shell:
        "python -m fourd.ingest --camera {wildcards.cam} --source {input.source:q}"
        " --fps {params.fps} --num-frames {params.num_frames} --offset-s {params.offset_s}"
        " {params.options} --output {output} 2> {log}"
