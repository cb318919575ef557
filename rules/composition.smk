"""Three independent generators, from coarse to fine."""


rule train_level:
    input:
        views=expand("<results>/<scene>/views/{cam}.json", cam=SCENE.inputs),
        cameras="<results>/<scene>/sfm/cameras.json",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.inputs),
        foreground=training_foregrounds(),
        background=training_backgrounds(),
    output:
        model="<results>/<scene>/composition/{level}/model.pt",
        table="<results>/<scene>/composition/{level}/train.csv",
        picture="<results>/<scene>/composition/{level}/validation.png",
    log:
        "<logs>/<scene>/train_level/{level}.log",
    benchmark:
        "<benchmarks>/<scene>/train_level/{level}.tsv"
    conda:
        "../envs/torch.yaml"
    threads: config["composition"]["num_threads"]
    resources:
        gpu=1,
    params:
        num_levels=len(LEVELS),
        options=options("composition"),
        version=fourd_config.stage_version("composition"),
    shell:
        "python -m fourd.composition train --level {wildcards.level}"
        " --num-levels {params.num_levels} --views {input.views} --cameras {input.cameras}"
        " --films {input.films} --foreground {input.foreground} --background {input.background}"
        " {params.options} --output-model {output.model}"
        " --output-log {output.table} --output-picture {output.picture} 2> >(tee {log} >&2)"
