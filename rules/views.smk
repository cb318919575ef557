"""Where and when every film and every training target is taken from."""


rule place_view:
    input:
        cameras="<results>/<scene>/sfm/cameras.json",
    output:
        "<results>/<scene>/views/{view}.json",
    log:
        "<logs>/<scene>/place_view/{view}.log",
    benchmark:
        "<benchmarks>/<scene>/place_view/{view}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        view=view_flags,
        version=fourd_config.stage_version("views"),
    shell:
        "python -m fourd.views --cameras {input.cameras} --view {wildcards.view} {params.view}"
        " --output {output} 2> {log}"
