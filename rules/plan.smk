"""What the scene needs: the one point at which the job graph learns from a result, and a forecast."""

import time


# A checkpoint, so that a run from nothing, a run after `snakemake plan` and a run of a finished scene give
# every job the same inputs: no job is made again because more was known the second time. It holds facts
# only; settings are applied to them when the graph is built, so that a changed setting does not open it again.
checkpoint survey:
    input:
        cameras="<results>/<scene>/sfm/cameras.json",
        rectification=expand("<results>/<scene>/rectification/{pair}.npz", pair=SCENE.pairs),
        need="<results>/<scene>/silhouettes/need.json",
        # Where clocks are found from motion, every film has been looked at for it.
        maps=(
            []
            if SCENE.clock_is_given
            else expand("<results>/<scene>/align/maps/{cam}.npz", cam=SCENE.inputs)
        ),
    output:
        "<results>/<scene>/plan/survey.json",
    log:
        "<logs>/<scene>/survey.log",
    benchmark:
        "<benchmarks>/<scene>/survey.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        silhouettes=config["silhouettes"]["use"],
        version=fourd_config.stage_version("plan"),
    shell:
        "python -m fourd.plan survey --cameras {input.cameras} --rectification {input.rectification}"
        " --need {input.need} --maps {input.maps}"
        " --silhouettes-use {params.silhouettes} --output {output} 2> {log}"


# How fast the machine is does not change: measured once for all scenes of a results folder.
rule probe_machine:
    output:
        "<results>/machine/speed.json",
    log:
        "<logs>/probe_machine.log",
    benchmark:
        "<benchmarks>/probe_machine.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        version=fourd_config.stage_version("plan"),
    shell:
        "python -m fourd.plan probe --output {output} 2> {log}"


rule forecast:
    input:
        survey="<results>/<scene>/plan/survey.json",
        cameras="<results>/<scene>/sfm/cameras.json",
        machine=ancient("<results>/machine/speed.json"),
    output:
        # Not removed before: it keeps the first forecast, that of before the run.
        update("<results>/<scene>/plan/plan.json"),
    log:
        "<logs>/<scene>/forecast.log",
    benchmark:
        "<benchmarks>/<scene>/forecast.tsv"
    localrule: True
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        scene=lambda wildcards: plan_flags(),
        benchmarks=f"{config['pathvars'].get('benchmarks', 'benchmarks')}/{SCENE.name}",
        version=fourd_config.stage_version("plan"),
        # Never the same, so that every `snakemake plan` looks anew at what is done and says it.
        asked_ns=time.time_ns(),
    shell:
        "python -m fourd.plan show {params.scene} --survey {input.survey} --cameras {input.cameras}"
        " --machine {input.machine} --benchmarks {params.benchmarks} --output {output}"
        " 2> {log}"


rule plan:
    input:
        "<results>/<scene>/plan/plan.json",
    localrule: True
