"""Static background: the temporal median of what lies farthest, for every pose of a view."""


rule estimate_background:
    input:
        view="<results>/<scene>/views/{view}.json",
        cameras="<results>/<scene>/sfm/cameras.json",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.inputs),
        disparity=sample_disparities,
        survey=ancient("<results>/<scene>/plan/survey.json"),
    output:
        intermediate("foreground", "<results>/<scene>/background/{view}/{chunk}.npz"),
    log:
        "<logs>/<scene>/estimate_background/{view}/{chunk}.log",
    benchmark:
        "<benchmarks>/<scene>/estimate_background/{view}/{chunk}.tsv"
    priority: 10
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        frames=lambda wildcards: frames_of_view(wildcards.view, wildcards.chunk),
        options=" ".join([options("fuse"), options("background")]),
        version=fourd_config.stage_version("background"),
    shell:
        "python -m fourd.background --view-file {input.view} --cameras {input.cameras}"
        " --frames {params.frames} --disparity {input.disparity} --films {input.films}"
        " {params.options} --output {output} 2> {log}"
