"""Where and when every film and every training target is taken from."""

import json


def view_flags(wildcards):
    """Flags that are the same for every job of one view."""
    flags = {"size": SCENE.size}
    if wildcards.view in TRAJECTORIES:
        flags["trajectory"] = json.dumps(TRAJECTORIES[wildcards.view], sort_keys=True)
    else:
        flags["frames"] = sorted(VIEW_FRAMES[wildcards.view])
    return flags_from_mapping(flags)


rule place_view:
    input:
        cameras="<results>/{scene}/sfm/cameras.json",
    output:
        "<results>/{scene}/views/{view}.json",
    log:
        "<logs>/{scene}/place_view/{view}.log",
    benchmark:
        "<benchmarks>/{scene}/place_view/{view}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        view=view_flags,
        version=fourd_config.stage_version("views"),
    shell:
        "python -m fourd.views --cameras {input.cameras} --view {wildcards.view} {params.view}"
        " --output {output} 2> {log}"
