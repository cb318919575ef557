"""Not part of any film: extreme cases, and error against run time on the embedded event."""

DEMO_TRUTH = [
    "data/demo/truth/depth",
    "data/demo/cameras.json",
    *expand("data/demo/frames/{cam}", cam=SCENE.cameras),
    *expand("data/demo/truth/labels/{cam}", cam=SCENE.heldout),
]


rule stability:
    output:
        table="<results>/stability/stability.csv",
        document="<results>/stability/stability.json",
    log:
        "<logs>/stability.log",
    benchmark:
        "<benchmarks>/stability.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        version=fourd_config.stage_version("stability"),
    shell:
        "python -m fourd.stability --output $(dirname {output.table}) 2> {log}"


rule bench_stereo:
    output:
        "<results>/bench/stereo/stereo.csv",
    log:
        "<logs>/bench_stereo.log",
    benchmark:
        "<benchmarks>/bench_stereo.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        root=workflow.basedir,
        pairs=flags_from_mapping({"data": config["bench_pairs"]}),
        version=fourd_config.stage_version("stereo"),
    shell:
        "PYTHONPATH={params.root} python -m benches.stereo {params.pairs}"
        " --output $(dirname {output}) > {log} 2>&1"


# Against truth, with the true cameras of the event.
if SCENE.name == "demo_known":

    rule bench_fuse:
        input:
            DEMO_TRUTH,
        output:
            "<results>/bench/fuse/fused_depth.csv",
        log:
            "<logs>/bench_fuse.log",
        benchmark:
            "<benchmarks>/bench_fuse.tsv"
        conda:
            "../envs/torch.yaml"
        threads: 1
        params:
            # Disparities of an earlier matcher would be taken again.
            version=fourd_config.stage_version("stereo"),
            heldout=flags_from_mapping({"heldout": SCENE.heldout}),
        shell:
            "folder=$(dirname {output}); rm -rf $folder;"
            " PYTHONPATH={workflow.basedir} python -m benches.fused_depth --event data/demo"
            " {params.heldout} --sweep --pictures --output $folder > {log} 2>&1"

    rule bench_background:
        input:
            DEMO_TRUTH,
            cameras=f"{RESULTS}/sfm/cameras.json",
            films=expand(f"{RESULTS}/frames/cameras/{{cam}}.npz", cam=SCENE.cameras),
            views=expand(f"{RESULTS}/views/{{cam}}.json", cam=SCENE.heldout),
            disparity=lambda wildcards: expand(
                f"{RESULTS}/disparity/{{pair}}/samples.npz", pair=pairs_without("")
            ),
        output:
            "<results>/bench/background/background_error.csv",
        log:
            "<logs>/bench_background.log",
        benchmark:
            "<benchmarks>/bench_background.tsv"
        conda:
            "../envs/torch.yaml"
        threads: 1
        params:
            scene=RESULTS,
            version=fourd_config.stage_version("background"),
        shell:
            "PYTHONPATH={workflow.basedir} python -m benches.background --scene {params.scene}"
            " --truth data/demo/truth --output $(dirname {output}) > {log} 2>&1"
