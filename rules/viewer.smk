"""A page that plays the event in a browser: `snakemake viewer`."""

from fourd.viewer import ViewerOptions
from fourd.viewer.lattice import choose_lattice

try:
    LATTICE = choose_lattice(
        SCENE.size,
        SCENE.num_frames,
        len(SCENE.inputs),
        len(SCENE.cameras),
        ViewerOptions(**config["viewer"]),
    )
except InputError as error:
    raise WorkflowError(str(error)) from None

LATTICE_CHUNKS = fourd_config.chunk_names(len(LATTICE.frames), CHUNK_FRAMES)
LATTICE_VIEWS = "|".join(LATTICE.views)


# The steps of a film, under a folder of their own: these places are neither films nor scored.
use rule place_view as place_lattice with:
    output:
        "<results>/<scene>/lattice/views/{view}.json",
    log:
        "<logs>/<scene>/place_lattice/{view}.log",
    benchmark:
        "<benchmarks>/<scene>/place_lattice/{view}.tsv"
    wildcard_constraints:
        view=LATTICE_VIEWS,
    params:
        view=lambda wildcards: flags_from_mapping(
            {"size": LATTICE.size, "trajectory": json.dumps(LATTICE.views[wildcards.view])}
        ),


use rule fuse_foreground as fuse_lattice with:
    input:
        view="<results>/<scene>/lattice/views/{view}.json",
        cameras="<results>/<scene>/sfm/cameras.json",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.inputs),
        disparity=lambda wildcards: disparities_at(
            wildcards.view, chunks_shown(LATTICE.frames, wildcards.chunk)
        ),
        silhouettes=lambda wildcards: silhouettes_at(chunks_shown(LATTICE.frames, wildcards.chunk)),
        survey=ancient("<results>/<scene>/plan/survey.json"),
    output:
        temp("<results>/<scene>/lattice/foreground/{view}/{chunk}.npz"),
    log:
        "<logs>/<scene>/fuse_lattice/{view}/{chunk}.log",
    benchmark:
        "<benchmarks>/<scene>/fuse_lattice/{view}/{chunk}.tsv"
    wildcard_constraints:
        view=LATTICE_VIEWS,
    params:
        frames=lambda wildcards: list(fourd_config.frames_of_chunk(wildcards.chunk)),


use rule estimate_background as estimate_lattice_background with:
    input:
        view="<results>/<scene>/lattice/views/{view}.json",
        cameras="<results>/<scene>/sfm/cameras.json",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.inputs),
        disparity=sample_disparities,
        survey=ancient("<results>/<scene>/plan/survey.json"),
    output:
        temp("<results>/<scene>/lattice/background/{view}/{chunk}.npz"),
    log:
        "<logs>/<scene>/estimate_lattice_background/{view}/{chunk}.log",
    benchmark:
        "<benchmarks>/<scene>/estimate_lattice_background/{view}/{chunk}.tsv"
    wildcard_constraints:
        view=LATTICE_VIEWS,
    params:
        frames=lambda wildcards: list(fourd_config.frames_of_chunk(wildcards.chunk)),


use rule render_frames as render_lattice with:
    input:
        view="<results>/<scene>/lattice/views/{view}.json",
        models=expand("<results>/<scene>/composition/{level}/model.pt", level=LEVELS),
        foreground="<results>/<scene>/lattice/foreground/{view}/{chunk}.npz",
        background="<results>/<scene>/lattice/background/{view}/{chunk}.npz",
    output:
        directory("<results>/<scene>/lattice/render/{view}/{chunk}"),
    log:
        "<logs>/<scene>/render_lattice/{view}/{chunk}.log",
    benchmark:
        "<benchmarks>/<scene>/render_lattice/{view}/{chunk}.tsv"
    wildcard_constraints:
        view=LATTICE_VIEWS,
    params:
        frames=lambda wildcards: list(fourd_config.frames_of_chunk(wildcards.chunk)),


rule map_lattice:
    input:
        foreground="<results>/<scene>/lattice/foreground/{view}/{chunk}.npz",
        background="<results>/<scene>/lattice/background/{view}/{chunk}.npz",
    output:
        "<results>/<scene>/lattice/maps/{view}/{chunk}.npz",
    log:
        "<logs>/<scene>/map_lattice/{view}/{chunk}.log",
    benchmark:
        "<benchmarks>/<scene>/map_lattice/{view}/{chunk}.tsv"
    wildcard_constraints:
        view=LATTICE_VIEWS,
    priority: 20
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        version=fourd_config.stage_version("viewer"),
    shell:
        "python -m fourd.viewer maps --foreground {input.foreground} --background {input.background}"
        " --output {output} 2> {log}"


rule viewer_page:
    input:
        cameras="<results>/<scene>/sfm/cameras.json",
        points="<results>/<scene>/sfm/points.npz",
        films=expand("<results>/<scene>/frames/cameras/{cam}.npz", cam=SCENE.cameras),
        views=expand("<results>/<scene>/lattice/views/{view}.json", view=LATTICE.views),
        render=expand(
            "<results>/<scene>/lattice/render/{view}/{chunk}",
            view=LATTICE.views,
            chunk=LATTICE_CHUNKS,
        ),
        maps=expand(
            "<results>/<scene>/lattice/maps/{view}/{chunk}.npz",
            view=LATTICE.views,
            chunk=LATTICE_CHUNKS,
        ),
    output:
        page="<results>/<scene>/viewer/index.html",
        data=directory("<results>/<scene>/viewer/data"),
    log:
        "<logs>/<scene>/viewer_page.log",
    benchmark:
        "<benchmarks>/<scene>/viewer_page.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        options=options("viewer"),
        forecast=LATTICE.forecast_mb,
        version=fourd_config.stage_version("viewer"),
    shell:
        "python -m fourd.viewer page --cameras {input.cameras} --points {input.points} --films {input.films}"
        " --views {input.views} --render {input.render} --maps {input.maps} {params.options}"
        " --forecast-mb {params.forecast} --output $(dirname {output.page}) 2> {log}"


rule viewer:
    input:
        "<results>/<scene>/viewer/index.html",
    localrule: True
