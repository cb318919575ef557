"""Instantaneous foreground: all pairs of a chunk projected into a view and reduced."""


rule fuse_foreground:
    input:
        view="<results>/{scene}/views/{view}.json",
        cameras="<results>/{scene}/sfm/cameras.json",
        ingest=expand("<results>/{{scene}}/ingest/{cam}.json", cam=SCENE.inputs),
        disparity=disparities_of_view,
    output:
        intermediate("foreground", "<results>/{scene}/foreground/{view}/{chunk}.npz"),
    log:
        "<logs>/{scene}/fuse_foreground/{view}/{chunk}.log",
    benchmark:
        "<benchmarks>/{scene}/fuse_foreground/{view}/{chunk}.tsv"
    priority: 10
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        frames=lambda wildcards: frames_of_view(wildcards.view, wildcards.chunk),
        estimates=estimates_of_view,
        cameras=" ".join(SCENE.inputs),
        options=options("fuse"),
        version=fourd_config.stage_version("fuse"),
    shell:
        "python -m fourd.fuse foreground --view-file {input.view} --cameras {input.cameras}"
        " --frames {params.frames} --disparity {input.disparity} --ingest {input.ingest}"
        " --estimates {params.estimates} {params.options} --output {output} 2> {log}"
