"""What each part of the composition is worth on the scene at hand: `snakemake ablations`."""

ABLATIONS = [
    "default",
    "paper",
    "l1",
    "l1_adversarial",
    "l1_adversarial_frequency",
    "cascade",
    "one_stream",
    "streams_paper",
    "input_closest",
    "input_median",
    "not_resized",
    "enlarged",
]


rule ablations:
    input:
        cameras="<results>/<scene>/sfm/cameras.json",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.cameras),
        views=expand("<results>/<scene>/views/{cam}.json", cam=SCENE.cameras),
        foreground=training_foregrounds(),
        background=training_backgrounds(),
        heldout=[
            f"<results>/<scene>/{kind}/{cam}/{chunk}.npz"
            for kind in ("foreground", "background")
            for cam in SCENE.heldout
            for chunk in chunks_of_view(cam)
        ],
        labels=[f"{SCENE.labels}/{cam}" for cam in SCENE.heldout] if SCENE.labels else [],
    output:
        table="<results>/<scene>/ablations/composition.csv",
        picture="<results>/<scene>/ablations/composition.png",
    log:
        "<logs>/<scene>/ablations.log",
    benchmark:
        "<benchmarks>/<scene>/ablations.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        root=workflow.basedir,
        labels=flags_from_mapping({"labels": SCENE.labels}) if SCENE.labels else "",
        variants=ABLATIONS,
        version=fourd_config.stage_version("composition"),
    shell:
        "PYTHONPATH={params.root} python -m benches.composition --scene $(dirname $(dirname {input.cameras}))"
        " {params.labels} --variants {params.variants} --marks 20 60"
        " --output $(dirname {output.table}) > {log} 2>&1"
