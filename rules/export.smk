"""The scene in the formats of other programs: `snakemake export --config format=NAME,NAME`."""

from fourd import export as fourd_export

try:
    EXPORT_FORMATS = fourd_export.chosen_formats(config["format"])
except InputError as error:
    raise WorkflowError(str(error)) from None


rule export_pictures:
    input:
        film="<results>/<scene>/frames/cameras/{cam}.npz",
        cameras="<results>/<scene>/sfm/cameras.json",
    output:
        directory("<results>/<scene>/export/pictures/{cam}"),
    log:
        "<logs>/<scene>/export_pictures/{cam}.log",
    benchmark:
        "<benchmarks>/<scene>/export_pictures/{cam}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        options=options("export"),
        version=fourd_config.stage_version("export"),
    shell:
        "python -m fourd.export pictures --film {input.film} --cameras {input.cameras} {params.options}"
        " --output {output} 2> {log}"


rule export_depth:
    input:
        cameras="<results>/<scene>/sfm/cameras.json",
        disparity=lambda wildcards: expand(
            "<results>/<scene>/disparity/{pair}/{chunk}.npz",
            pair=[pair for pair in pairs_without("") if wildcards.cam in pair.split("-")],
            chunk=CHUNKS,
        ),
    output:
        "<results>/<scene>/export/depth/{cam}.npz",
    log:
        "<logs>/<scene>/export_depth/{cam}.log",
    benchmark:
        "<benchmarks>/<scene>/export_depth/{cam}.tsv"
    wildcard_constraints:
        cam="|".join(SCENE.inputs),
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        options=options("export"),
        version=fourd_config.stage_version("export"),
    shell:
        "python -m fourd.export depth --camera {wildcards.cam} --disparity {input.disparity}"
        " --cameras {input.cameras} {params.options} --output {output} 2> {log}"


rule export_event:
    input:
        cameras="<results>/<scene>/sfm/cameras.json",
        pictures=expand("<results>/<scene>/export/pictures/{cam}", cam=SCENE.cameras),
        depth=expand("<results>/<scene>/export/depth/{cam}.npz", cam=SCENE.inputs),
    output:
        directory("<results>/<scene>/export/{format}"),
    log:
        "<logs>/<scene>/export_event/{format}.log",
    benchmark:
        "<benchmarks>/<scene>/export_event/{format}.tsv"
    wildcard_constraints:
        format="|".join(fourd_export.EVENT_FORMATS),
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        options=options("export"),
        version=fourd_config.stage_version("export"),
    shell:
        "python -m fourd.export write --format {wildcards.format} --cameras {input.cameras}"
        " --pictures $(dirname {input.pictures[0]}) --depth $(dirname {input.depth[0]}) {params.options}"
        " --output {output} 2> {log}"


rule export_film:
    input:
        view="<results>/<scene>/views/{trajectory}.json",
        cameras="<results>/<scene>/sfm/cameras.json",
        rendered=lambda wildcards: expand(
            "<results>/<scene>/render/{view}/{chunk}",
            view=wildcards.trajectory,
            chunk=chunks_of_view(wildcards.trajectory),
        ),
        estimates=lambda wildcards: expand(
            "<results>/<scene>/{kind}/{view}/{chunk}.npz",
            kind=["foreground", "background"],
            view=wildcards.trajectory,
            chunk=chunks_of_view(wildcards.trajectory),
        ),
    output:
        directory("<results>/<scene>/export/{format}/{trajectory}"),
    log:
        "<logs>/<scene>/export_film/{format}/{trajectory}.log",
    benchmark:
        "<benchmarks>/<scene>/export_film/{format}/{trajectory}.tsv"
    wildcard_constraints:
        format="|".join(fourd_export.FILM_FORMATS),
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        options=options("export"),
        version=fourd_config.stage_version("export"),
    shell:
        "python -m fourd.export frames --view-file {input.view} --format {wildcards.format}"
        " --frames-dir {input.rendered} --estimates {input.estimates} --cameras {input.cameras}"
        " {params.options} --output {output} 2> {log}"


rule export:
    input:
        expand(
            "<results>/<scene>/export/{format}",
            format=[name for name in EXPORT_FORMATS if name in fourd_export.EVENT_FORMATS],
        ),
        expand(
            "<results>/<scene>/export/{format}/{trajectory}",
            format=[name for name in EXPORT_FORMATS if name in fourd_export.FILM_FORMATS],
            trajectory=TRAJECTORIES,
        ),
    localrule: True
