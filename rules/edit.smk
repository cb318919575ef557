"""Edits: one mark on one frame, carried through space and time, and the films without (or with) the thing."""


include: "edit_common.smk"


rule edit_depths:
    input:
        cameras="<results>/<scene>/sfm/cameras.json",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.inputs),
        disparity=disparities_of_depths,
    output:
        intermediate("foreground", "<results>/<scene>/edit/depth/{chunk}.npz"),
    log:
        "<logs>/<scene>/edit_depths/{chunk}.log",
    benchmark:
        "<benchmarks>/<scene>/edit_depths/{chunk}.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        frames=lambda wildcards: list(fourd_config.frames_of_chunk(wildcards.chunk)),
        options=options("fuse"),
        version=fourd_config.stage_version("edit"),
    shell:
        "python -m fourd.edit depths --cameras {input.cameras} --films {input.films}"
        " --frames {params.frames} --disparity {input.disparity} {params.options}"
        " --output {output} 2> {log}"


# A physical camera is edited at all frames; its view for training has a few.
rule edit_place:
    input:
        cameras="<results>/<scene>/sfm/cameras.json",
    output:
        "<results>/<scene>/edit/views/{cam}.json",
    log:
        "<logs>/<scene>/edit_place/{cam}.log",
    benchmark:
        "<benchmarks>/<scene>/edit_place/{cam}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        view=flags_from_mapping({"size": SCENE.size, "frames": list(range(SCENE.num_frames))}),
        version=fourd_config.stage_version("views"),
    shell:
        "python -m fourd.views --cameras {input.cameras} --view {wildcards.cam} {params.view}"
        " --output {output} 2> {log}"


rule edit_background:
    input:
        view="<results>/<scene>/edit/views/{cam}.json",
        cameras="<results>/<scene>/sfm/cameras.json",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.inputs),
        disparity=lambda wildcards: expand(
            "<results>/<scene>/disparity/{pair}/samples.npz",
            pair=pairs_without(wildcards.cam),
        ),
    output:
        intermediate("foreground", "<results>/<scene>/edit/background/{cam}/{chunk}.npz"),
    log:
        "<logs>/<scene>/edit_background/{cam}/{chunk}.log",
    benchmark:
        "<benchmarks>/<scene>/edit_background/{cam}/{chunk}.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        frames=lambda wildcards: list(fourd_config.frames_of_chunk(wildcards.chunk)),
        options=" ".join([options("fuse"), options("background")]),
        version=fourd_config.stage_version("background"),
    shell:
        "python -m fourd.background --view-file {input.view} --cameras {input.cameras}"
        " --frames {params.frames} --disparity {input.disparity} --films {input.films}"
        " {params.options} --output {output} 2> {log}"


rule edit_masks:
    input:
        files_of_edit,
        edit="config/edits/{edit}.yaml",
        cameras="<results>/<scene>/sfm/cameras.json",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.inputs),
        depths=expand("<results>/<scene>/edit/depth/{chunk}.npz", chunk=CHUNKS),
        views=views_of_marks,
    output:
        "<results>/<scene>/edits/{edit}/masks.npz",
    log:
        "<logs>/<scene>/edit_masks/{edit}.log",
    benchmark:
        "<benchmarks>/<scene>/edit_masks/{edit}.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        # Soft edges are of the views alone.
        options=flags_from_mapping({key: config["edit"][key] for key in ("num_times", "network")}),
        version=fourd_config.stage_version("edit"),
    shell:
        "python -m fourd.edit masks --edit {input.edit} --cameras {input.cameras}"
        " --films {input.films} --depths {input.depths} --mark-views {input.views}"
        " {params.options} --output {output} 2> {log}"


rule edit_view:
    input:
        unpack(base_of_edit),
        edit="config/edits/{edit}.yaml",
        masks="<results>/<scene>/edits/{edit}/masks.npz",
        cameras="<results>/<scene>/sfm/cameras.json",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.inputs),
        depths=expand("<results>/<scene>/edit/depth/{chunk}.npz", chunk=CHUNKS),
        disparity=disparities_of_edit,
        marks=views_of_marks,
        models=expand("<results>/<scene>/composition/{level}/model.pt", level=LEVELS),
    output:
        directory("<results>/<scene>/edits/{edit}/{view}/{chunk}"),
    log:
        "<logs>/<scene>/edit_view/{edit}/{view}/{chunk}.log",
    benchmark:
        "<benchmarks>/<scene>/edit_view/{edit}/{view}/{chunk}.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        frames=edited_frames,
        base=base_flag,
        options=" ".join([options("edit"), options("fuse"), options("render")]),
        version=fourd_config.stage_version("edit"),
    shell:
        "python -m fourd.edit view --edit {input.edit} --masks {input.masks} --view-file {input.view}"
        " --cameras {input.cameras} --films {input.films} --depths {input.depths}"
        " --disparity {input.disparity} --background {input.background} --models {input.models}"
        " {params.base} {input.base} --mark-views {input.marks} --frames {params.frames}"
        " {params.options} --output {output} 2> {log}"


rule edit_film:
    input:
        lambda wildcards: expand(
            "<results>/<scene>/edits/{edit}/{view}/{chunk}",
            edit=wildcards.edit,
            view=wildcards.view,
            chunk=edited_chunks(wildcards.view),
        ),
    output:
        "<results>/<scene>/edits/{edit}/{view}.mp4",
    log:
        "<logs>/<scene>/edit_film/{edit}/{view}.log",
    benchmark:
        "<benchmarks>/<scene>/edit_film/{edit}/{view}.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        fps=SCENE.fps,
        version=fourd_config.stage_version("render"),
    shell:
        "python -m fourd.render video --frames-dir {input} --fps {params.fps} --output {output} 2> {log}"


rule edit_all:
    input:
        [
            f"<results>/<scene>/edits/{name}/{view}.mp4"
            for name, edit in EDITS.items()
            for view in edit.views
        ],
    localrule: True
