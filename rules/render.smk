"""Films: generators applied frame by frame, then one video per trajectory and where it was filmed from."""


rule render_frames:
    input:
        view="<results>/<scene>/views/{view}.json",
        models=expand("<results>/<scene>/composition/{level}/model.pt", level=LEVELS),
        foreground="<results>/<scene>/foreground/{view}/{chunk}.npz",
        background="<results>/<scene>/background/{view}/{chunk}.npz",
    output:
        directory("<results>/<scene>/render/{view}/{chunk}"),
    log:
        "<logs>/<scene>/render_frames/{view}/{chunk}.log",
    benchmark:
        "<benchmarks>/<scene>/render_frames/{view}/{chunk}.tsv"
    priority: 20
    conda:
        "../envs/torch.yaml"
    threads: 1
    resources:
        gpu=1,
    params:
        frames=lambda wildcards: frames_of_view(wildcards.view, wildcards.chunk),
        options=options("render"),
        version=fourd_config.stage_version("render"),
    shell:
        "python -m fourd.render frames --view-file {input.view} --models {input.models}"
        " --foreground {input.foreground} --background {input.background}"
        " --frames {params.frames} {params.options} --threads {threads} --output {output} 2> {log}"


rule encode_film:
    input:
        unpack(folders_of_film),
        view="<results>/<scene>/views/{trajectory}.json",
        cameras="<results>/<scene>/sfm/cameras.json",
    output:
        film="<results>/<scene>/render/{trajectory}.mp4",
        path="<results>/<scene>/render/{trajectory}.json",
    log:
        "<logs>/<scene>/encode_film/{trajectory}.log",
    benchmark:
        "<benchmarks>/<scene>/encode_film/{trajectory}.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        options=film_flags(config["film"]["codec"]),
        version=fourd_config.stage_version("render"),
    shell:
        "(python -m fourd.render video --frames-dir {input.frames} --right-frames-dir {input.right}"
        " {params.options} --output {output.film}"
        " && python -m fourd.paths describe --view-file {input.view} --cameras {input.cameras}"
        " --output {output.path}) 2> {log}"


# A second film that loses nothing, or little, to cut and to grade.
rule encode_master:
    input:
        unpack(folders_of_film),
    output:
        "<results>/<scene>/render/{trajectory}.{suffix}",
    log:
        "<logs>/<scene>/encode_master/{trajectory}.{suffix}.log",
    benchmark:
        "<benchmarks>/<scene>/encode_master/{trajectory}.{suffix}.tsv"
    wildcard_constraints:
        suffix="mov|mkv",
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        options=lambda wildcards: film_flags({"mov": "prores", "mkv": "ffv1"}[wildcards.suffix]),
        version=fourd_config.stage_version("render"),
    shell:
        "python -m fourd.render video --frames-dir {input.frames} --right-frames-dir {input.right}"
        " {params.options} --output {output} 2> {log}"


if config["film"]["master"] != "none":
    FILMS += [
        film.replace(".mp4", {"prores": ".mov", "ffv1": ".mkv"}[config["film"]["master"]])
        for film in list(FILMS)
    ]
