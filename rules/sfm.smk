"""Cameras of the whole scene in one well-scaled world: recovered from the films, or imported."""

CALIBRATION_NAMES = [f"{cam}={source.calibration_name}" for cam, source in SCENE.cameras.items()]


rule film_cameras:
    input:
        ingest=INGEST_OF_ALL,
        calibration=SCENE.calibration,
        audio=[] if SCENE.clock_is_given else "<results>/<scene>/align/audio.json",
    output:
        "<results>/<scene>/sfm/film_cameras.json",
    log:
        "<logs>/<scene>/film_cameras.log",
    benchmark:
        "<benchmarks>/<scene>/film_cameras.tsv"
    conda:
        "../envs/sfm.yaml"
    threads: 2
    params:
        command=film_cameras_command(),
        heldout=flags_from_mapping({"heldout": SCENE.heldout}),
        version=fourd_config.stage_version("sfm"),
    shell:
        "python -m fourd.sfm {params.command} --ingest {input.ingest} {params.heldout}"
        " --num-threads {threads} --output {output} 2> {log}"


rule import_cameras:
    input:
        calibration=SCENE.calibration or "<results>/<scene>/sfm/film_cameras.json",
        films=expand("<results>/<scene>/align/cameras/{cam}.json", cam=SCENE.cameras),
    output:
        cameras="<results>/<scene>/sfm/cameras.json",
        points="<results>/<scene>/sfm/points.npz",
    log:
        "<logs>/<scene>/import_cameras.log",
    benchmark:
        "<benchmarks>/<scene>/import_cameras.tsv"
    conda:
        "../envs/sfm.yaml"
    threads: 1
    params:
        cameras=CALIBRATION_NAMES if SCENE.calibration else list(SCENE.cameras),
        heldout=flags_from_mapping({"heldout": SCENE.heldout}),
        depth_range=(
            flags_from_mapping({"depth_range": SCENE.depth_range}) if SCENE.depth_range else ""
        ),
        format=SCENE.calibration_format if SCENE.calibration else "fourd",
        fps=SCENE.fps,
        num_frames=SCENE.num_frames,
        options=options("sfm"),
        version=fourd_config.stage_version("sfm"),
    shell:
        "python -m fourd.sfm import --calibration {input.calibration:q}"
        " --calibration-format {params.format} --camera {params.cameras:q} {params.heldout}"
        " --num-frames {params.num_frames} --fps {params.fps} --films {input.films:q}"
        " {params.depth_range} {params.options} --output-cameras {output.cameras}"
        " --output-points {output.points} 2> {log}"
