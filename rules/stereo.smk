"""The N-choose-2 fan-out: rectification per pair, disparity per pair and chunk."""


rule rectify_pair:
    input:
        cameras="<results>/<scene>/sfm/cameras.json",
    output:
        "<results>/<scene>/rectification/{pair}.npz",
    log:
        "<logs>/<scene>/rectify_pair/{pair}.log",
    benchmark:
        "<benchmarks>/<scene>/rectify_pair/{pair}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        cams=lambda wildcards: "--left {} --right {}".format(*wildcards.pair.split("-")),
        options=options("rectify"),
        version=fourd_config.stage_version("stereo"),
    shell:
        "python -m fourd.stereo rectify --cameras {input.cameras} {params.cams} {params.options}"
        " --output {output} 2> {log}"


rule disparity:
    input:
        unpack(films_of_pair),
        cameras="<results>/<scene>/sfm/cameras.json",
        rectification="<results>/<scene>/rectification/{pair}.npz",
    output:
        intermediate("disparity", "<results>/<scene>/disparity/{pair}/{chunk}.npz"),
    log:
        "<logs>/<scene>/disparity/{pair}/{chunk}.log",
    benchmark:
        "<benchmarks>/<scene>/disparity/{pair}/{chunk}.tsv"
    priority: chunk_priority
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        frames=disparity_frames,
        options=options("stereo"),
        version=fourd_config.stage_version("stereo"),
    shell:
        "python -m fourd.stereo disparity --rectification {input.rectification}"
        " --left-film {input.left} --right-film {input.right} --cameras {input.cameras}"
        " --frames {params.frames} {params.options} --threads {threads} --output {output} 2> {log}"
