"""Instantaneous foreground: all pairs of a chunk projected into a view and reduced."""


# All training targets of a chunk in one job: they read the same disparities, and with a job for
# each of them the graph would have as many edges as pairs times cameras times chunks.
rule fuse_training:
    input:
        view=expand("<results>/<scene>/views/{cam}.json", cam=SCENE.inputs),
        cameras="<results>/<scene>/sfm/cameras.json",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.inputs),
        disparity=lambda wildcards: disparities_at("", wildcards.chunk),
        silhouettes=lambda wildcards: silhouettes_at(wildcards.chunk),
        survey=ancient("<results>/<scene>/plan/survey.json"),
    output:
        [
            intermediate("foreground", f"<results>/<scene>/foreground/{cam}/{{chunk}}.npz")
            for cam in SCENE.inputs
        ],
    log:
        "<logs>/<scene>/fuse_training/{chunk}.log",
    benchmark:
        "<benchmarks>/<scene>/fuse_training/{chunk}.tsv"
    priority: 10
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        frames=lambda wildcards: frames_of_view(SCENE.inputs[0], wildcards.chunk),
        options=" ".join([options("fuse"), options("hull")]),
        version=fourd_config.stage_version("fuse"),
    shell:
        "python -m fourd.fuse foreground --view-file {input.view} --cameras {input.cameras}"
        " --frames {params.frames} --disparity {input.disparity} --films {input.films}"
        " --silhouettes {input.silhouettes} {params.options} --output {output} 2> {log}"


rule fuse_foreground:
    input:
        view="<results>/<scene>/views/{view}.json",
        cameras="<results>/<scene>/sfm/cameras.json",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.inputs),
        disparity=disparities_of_view,
        silhouettes=silhouettes_of_view,
        survey=ancient("<results>/<scene>/plan/survey.json"),
    output:
        intermediate("foreground", "<results>/<scene>/foreground/{view}/{chunk}.npz"),
    log:
        "<logs>/<scene>/fuse_foreground/{view}/{chunk}.log",
    benchmark:
        "<benchmarks>/<scene>/fuse_foreground/{view}/{chunk}.tsv"
    wildcard_constraints:
        view="|".join([*SCENE.heldout, *TRAJECTORIES]),
    priority: 10
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        frames=lambda wildcards: frames_of_view(wildcards.view, wildcards.chunk),
        estimates=estimates_of_view,
        options=" ".join([options("fuse"), options("hull")]),
        version=fourd_config.stage_version("fuse"),
    shell:
        "python -m fourd.fuse foreground --view-file {input.view} --cameras {input.cameras}"
        " --frames {params.frames} --disparity {input.disparity} --films {input.films}"
        " --silhouettes {input.silhouettes} --estimates {params.estimates} {params.options} --output {output} 2> {log}"
