"""Pictures of all cameras in common colours, at the moments of the common clock."""


rule match_colours:
    input:
        cameras="<results>/<scene>/sfm/cameras.json",
        films=expand("<results>/<scene>/align/cameras/{cam}.json", cam=SCENE.cameras),
    output:
        "<results>/<scene>/frames/colour.json",
    log:
        "<logs>/<scene>/match_colours.log",
    benchmark:
        "<benchmarks>/<scene>/match_colours.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        options=options("frames"),
        version=fourd_config.stage_version("frames"),
    shell:
        "python -m fourd.frames colour --cameras {input.cameras} --films {input.films}"
        " {params.options} --output {output} 2> {log}"


rule prepare_camera:
    input:
        film="<results>/<scene>/align/cameras/{cam}.json",
        colour="<results>/<scene>/frames/colour.json",
    output:
        "<results>/<scene>/frames/cameras/{cam}.npz",
    log:
        "<logs>/<scene>/prepare_camera/{cam}.log",
    benchmark:
        "<benchmarks>/<scene>/prepare_camera/{cam}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        options=options("frames"),
        version=fourd_config.stage_version("frames"),
    shell:
        "python -m fourd.frames prepare --film {input.film} --colour {input.colour}"
        " {params.options} --output {output} 2> {log}"
