"""What moves in front of each camera's background: depth for captures too wide for stereo."""


rule judge_need:
    input:
        cameras="<results>/<scene>/sfm/cameras.json",
        rectification=expand("<results>/<scene>/rectification/{pair}.npz", pair=SCENE.pairs),
    output:
        "<results>/<scene>/silhouettes/need.json",
    log:
        "<logs>/<scene>/judge_need.log",
    benchmark:
        "<benchmarks>/<scene>/judge_need.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        options=options("silhouettes"),
        version=fourd_config.stage_version("silhouettes"),
    shell:
        "python -m fourd.silhouettes need --cameras {input.cameras}"
        " --rectification {input.rectification} {params.options} --output {output} 2> {log}"


rule background_plate:
    input:
        film="<results>/<scene>/frames/cameras/{cam}.npz",
        cameras="<results>/<scene>/sfm/cameras.json",
        need="<results>/<scene>/silhouettes/need.json",
        background=empty_scene_of,
    output:
        "<results>/<scene>/silhouettes/{cam}/plate.npz",
    log:
        "<logs>/<scene>/background_plate/{cam}.log",
    benchmark:
        "<benchmarks>/<scene>/background_plate/{cam}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        background=empty_scene_flags,
        options=options("silhouettes"),
        version=fourd_config.stage_version("silhouettes"),
    shell:
        "python -m fourd.silhouettes plate --film {input.film} --cameras {input.cameras}"
        " --need {input.need} {params.background} {params.options} --output {output} 2> {log}"


# All cameras of a chunk in one job: most scenes need no silhouettes, and then a job says no more than so.
rule silhouettes:
    input:
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.inputs),
        plates=expand("<results>/<scene>/silhouettes/{cam}/plate.npz", cam=SCENE.inputs),
        cameras="<results>/<scene>/sfm/cameras.json",
    output:
        "<results>/<scene>/silhouettes/{chunk}.npz",
    log:
        "<logs>/<scene>/silhouettes/{chunk}.log",
    benchmark:
        "<benchmarks>/<scene>/silhouettes/{chunk}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        frames=lambda wildcards: list(fourd_config.frames_of_chunk(wildcards.chunk)),
        options=options("silhouettes"),
        version=fourd_config.stage_version("silhouettes"),
    shell:
        "python -m fourd.silhouettes segment --film {input.films} --plate {input.plates}"
        " --cameras {input.cameras} --frames {params.frames} {params.options}"
        " --output {output} 2> {log}"
