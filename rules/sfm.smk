"""Cameras of the whole scene in one well-scaled world."""

CALIBRATION_NAMES = [f"{cam}={source.calibration_name}" for cam, source in SCENE.cameras.items()]


rule import_cameras:
    input:
        calibration=SCENE.calibration,
        ingest=expand("<results>/{{scene}}/ingest/{cam}.json", cam=SCENE.cameras),
    output:
        cameras="<results>/{scene}/sfm/cameras.json",
        points="<results>/{scene}/sfm/points.npz",
    log:
        "<logs>/{scene}/import_cameras.log",
    benchmark:
        "<benchmarks>/{scene}/import_cameras.tsv"
    conda:
        "../envs/sfm.yaml"
    threads: 1
    params:
        cameras=CALIBRATION_NAMES,
        heldout=flags_from_mapping({"heldout": SCENE.heldout}),
        depth_range=(
            flags_from_mapping({"depth_range": SCENE.depth_range}) if SCENE.depth_range else ""
        ),
        format=SCENE.calibration_format,
        fps=SCENE.fps,
        num_frames=SCENE.num_frames,
        options=options("sfm"),
        version=fourd_config.stage_version("sfm"),
    shell:
        "python -m fourd.sfm import --calibration {input.calibration:q}"
        " --calibration-format {params.format} --camera {params.cameras:q} {params.heldout}"
        " --num-frames {params.num_frames} --fps {params.fps} --ingest {input.ingest:q}"
        " {params.depth_range} {params.options} --output-cameras {output.cameras}"
        " --output-points {output.points} 2> {log}"
