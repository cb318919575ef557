"""The embedded event: frames, cameras and truth, made by seeded code."""

# The scene file says how much of the event is filmed, the section `demo` how the event looks.
DEMO_FLAGS = flags_from_mapping(
    {
        **config["demo"],
        "num_cameras": len(SCENE.cameras),
        "num_frames": SCENE.num_frames,
        "fps": SCENE.fps,
        "width": SCENE.size[0],
        "height": SCENE.size[1],
    }
)


# Sources of a scene below data/demo are made here: what is no camera's name is no source.
wildcard_constraints:
    demo_cam=r"cam\d+",


rule demo_frames:
    output:
        directory("data/demo/frames/{demo_cam}"),
    log:
        "<logs>/demo/demo_frames/{demo_cam}.log",
    benchmark:
        "<benchmarks>/demo/demo_frames/{demo_cam}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        options=DEMO_FLAGS,
        version=fourd_config.stage_version("demo"),
    shell:
        "python -m fourd.demo camera --name {wildcards.demo_cam} --output {output} {params.options} 2> {log}"


rule demo_cameras:
    output:
        "data/demo/cameras.json",
    log:
        "<logs>/demo/demo_cameras.log",
    benchmark:
        "<benchmarks>/demo/demo_cameras.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        options=DEMO_FLAGS,
        version=fourd_config.stage_version("demo"),
    shell:
        "python -m fourd.demo cameras --output {output} {params.options} 2> {log}"


rule demo_labels:
    output:
        directory("data/demo/truth/labels/{demo_cam}"),
    log:
        "<logs>/demo/demo_labels/{demo_cam}.log",
    benchmark:
        "<benchmarks>/demo/demo_labels/{demo_cam}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        options=DEMO_FLAGS,
        version=fourd_config.stage_version("demo"),
    shell:
        "python -m fourd.demo labels --name {wildcards.demo_cam} --output {output} {params.options} 2> {log}"


rule demo_phone_labels:
    output:
        directory("data/demo/truth/phone_labels/{demo_cam}"),
    log:
        "<logs>/demo/demo_phone_labels/{demo_cam}.log",
    benchmark:
        "<benchmarks>/demo/demo_phone_labels/{demo_cam}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        options=DEMO_FLAGS,
        version=fourd_config.stage_version("demo"),
    shell:
        "python -m fourd.demo labels --of-phone --name {wildcards.demo_cam} --output {output}"
        " {params.options} 2> {log}"


rule demo_phone_depths:
    output:
        directory("data/demo/truth/phone_depths/{demo_cam}"),
    log:
        "<logs>/demo/demo_phone_depths/{demo_cam}.log",
    benchmark:
        "<benchmarks>/demo/demo_phone_depths/{demo_cam}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        options=DEMO_FLAGS,
        version=fourd_config.stage_version("demo"),
    shell:
        "python -m fourd.demo depths --of-phone --name {wildcards.demo_cam} --output {output}"
        " {params.options} 2> {log}"


rule demo_phone:
    output:
        "data/demo/phones/{demo_cam}.mp4",
    log:
        "<logs>/demo/demo_phone/{demo_cam}.log",
    benchmark:
        "<benchmarks>/demo/demo_phone/{demo_cam}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        options=DEMO_FLAGS,
        version=fourd_config.stage_version("demo"),
    shell:
        "python -m fourd.demo phones --name {wildcards.demo_cam} --output {output} {params.options} 2> {log}"


rule demo_truth:
    output:
        files=multiext("data/demo/truth/", "phones.json", "scene.json", "orbit_cameras.json"),
        folders=directory(["data/demo/truth/depth", "data/demo/truth/orbit"]),
    log:
        "<logs>/demo/demo_truth.log",
    benchmark:
        "<benchmarks>/demo/demo_truth.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        frames=sorted({0, SCENE.num_frames // 2, SCENE.num_frames - 1}),
        options=DEMO_FLAGS,
        version=fourd_config.stage_version("demo"),
    shell:
        "python -m fourd.demo truth --only phones scene depth orbit --frames {params.frames}"
        " --output data/demo/truth {params.options} 2> {log}"


# Everything that the demo can give, for measurements: the main job needs frames and cameras only.
rule demo_all:
    input:
        expand(
            "data/demo/{kind}/{cam}",
            kind=["frames", "truth/labels", "truth/phone_labels"],
            cam=SCENE.cameras,
        ),
        expand("data/demo/phones/{cam}.mp4", cam=SCENE.cameras),
        rules.demo_cameras.output,
        rules.demo_truth.output,
    localrule: True
