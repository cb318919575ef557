"""One clock for all cameras: what is heard, what is seen to move, and every film on that clock."""

INGEST_OF_ALL = expand("<results>/<scene>/ingest/{cam}.json", cam=SCENE.cameras)
# Which cameras there are, which of them are held out, and what is to be filmed of the common clock.
CLOCK_FLAGS = flags_from_mapping(
    {
        "names": list(SCENE.cameras),
        "heldout": SCENE.heldout,
        "fps": SCENE.fps,
        "num_frames": SCENE.num_frames,
        "start_s": SCENE.start_s,
    }
)


rule listen:
    input:
        ingest=INGEST_OF_ALL,
    output:
        offsets="<results>/<scene>/align/audio.json",
        evidence="<results>/<scene>/align/audio.png",
    log:
        "<logs>/<scene>/listen.log",
    benchmark:
        "<benchmarks>/<scene>/listen.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        scene=CLOCK_FLAGS,
        options=options("align"),
        version=fourd_config.stage_version("align"),
    shell:
        "python -m fourd.align listen --ingest {input.ingest:q} {params.scene} {params.options}"
        " --output {output.offsets} --output-evidence {output.evidence} 2> {log}"


rule track_motion:
    input:
        ingest="<results>/<scene>/ingest/{cam}.json",
        audio="<results>/<scene>/align/audio.json",
        cameras="<results>/<scene>/sfm/film_cameras.json",
    output:
        tracks="<results>/<scene>/align/tracks/{cam}.npz",
        maps="<results>/<scene>/align/maps/{cam}.npz",
    log:
        "<logs>/<scene>/track_motion/{cam}.log",
    benchmark:
        "<benchmarks>/<scene>/track_motion/{cam}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        scene=CLOCK_FLAGS,
        options=options("align_vision"),
        version=fourd_config.stage_version("align"),
    shell:
        "python -m fourd.align track --ingest {input.ingest} --audio {input.audio}"
        " --cameras {input.cameras} {params.scene} {params.options} --output {output.tracks}"
        " --output-maps {output.maps} 2> {log}"


rule align_cameras:
    input:
        ingest=INGEST_OF_ALL,
        audio="<results>/<scene>/align/audio.json",
        cameras="<results>/<scene>/sfm/film_cameras.json",
        tracks=expand("<results>/<scene>/align/tracks/{cam}.npz", cam=SCENE.cameras),
        maps=expand("<results>/<scene>/align/maps/{cam}.npz", cam=SCENE.cameras),
    output:
        offsets="<results>/<scene>/align/offsets.json",
        evidence="<results>/<scene>/align/offsets.png",
    log:
        "<logs>/<scene>/align_cameras.log",
    benchmark:
        "<benchmarks>/<scene>/align_cameras.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        scene=CLOCK_FLAGS,
        options=" ".join(map(options, ("align_vision", "align_spatiotemporal"))),
        version=fourd_config.stage_version("align"),
    shell:
        "python -m fourd.align solve --ingest {input.ingest} --audio {input.audio}"
        " --cameras {input.cameras} --tracks {input.tracks} --maps {input.maps} {params.scene} {params.options}"
        " --output {output.offsets} --output-evidence {output.evidence} 2> {log}"


rule sample_camera:
    input:
        ingest="<results>/<scene>/ingest/{cam}.json",
        offsets=[] if SCENE.clock_is_given else "<results>/<scene>/align/offsets.json",
    output:
        "<results>/<scene>/align/cameras/{cam}.json",
    log:
        "<logs>/<scene>/sample_camera/{cam}.log",
    benchmark:
        "<benchmarks>/<scene>/sample_camera/{cam}.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        clock=clock_of_camera,
        options=options("sample"),
        version=fourd_config.stage_version("align"),
    shell:
        "python -m fourd.align sample --ingest {input.ingest} {params.clock} {params.options}"
        " --output {output} 2> {log}"
