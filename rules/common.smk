"""Checked configuration, the lists that span the job graph, and helper functions of the rules."""

import json
import sys
from pathlib import Path

from snakemake.exceptions import WorkflowError

sys.path.insert(0, workflow.basedir)

from fourd import config as fourd_config
from fourd.cli import flags_from_mapping
from fourd.errors import InputError

try:
    SCENE, _scene_settings = fourd_config.load_scene(config.get("scene", "demo"))
    config = fourd_config.load_config(config, _scene_settings, SCENE.name)
    CHUNK_FRAMES = fourd_config.fit_chunk_frames(config, SCENE)
    # What rules make or fetch need not be there yet.
    fourd_config.check_sources(SCENE, made_by_rules=("data/demo/", "data/pose2sim/"))
    # Output frame -> scene frame, for every place that is filmed from.
    VIEW_FRAMES = fourd_config.view_frames(SCENE, config)
    KEPT = fourd_config.kept_intermediates(SCENE, config, VIEW_FRAMES)
except InputError as error:
    raise WorkflowError(str(error)) from None

# Where results lie, for flags that name files: pathvars are filled in for inputs and outputs only.
RESULTS = f"{config['pathvars'].get('results', 'results')}/{SCENE.name}"
TRAJECTORIES = config["trajectories"]
CHUNKS = fourd_config.chunk_names(SCENE.num_frames, CHUNK_FRAMES)
LEVELS = range(fourd_config.num_levels(SCENE, config))
SAMPLE_FRAMES = fourd_config.spread_frames(SCENE.num_frames, config["background"]["num_samples"])


def chunks_of_view(view):
    """Chunks of output frames in which a view has any."""
    num_frames = len(VIEW_FRAMES[view]) if view in TRAJECTORIES else SCENE.num_frames
    names = fourd_config.chunk_names(num_frames, CHUNK_FRAMES)
    return [c for c in names if frames_of_view(view, c)]


def frames_of_view(view, chunk):
    """Output frames of a view in a chunk."""
    return [f for f in fourd_config.frames_of_chunk(chunk) if f in VIEW_FRAMES[view]]


def scene_chunks(view, chunk):
    """Chunks of the scene's clock that show up in a chunk of output frames."""
    frames = [VIEW_FRAMES[view][f] for f in frames_of_view(view, chunk)]
    return sorted({CHUNKS[f // CHUNK_FRAMES] for f in frames})


def pairs_without(view):
    """Pairs that may serve a view: a camera never helps to predict itself."""
    return [p for p in SCENE.pairs if view not in p.split("-")]


def options(section):
    """A section of the configuration as command-line flags."""
    return flags_from_mapping(config[section])


def intermediate(kind, path):
    """A file that is removed after its last use unless the disk budget keeps its kind."""
    return path if kind in KEPT else temp(path)


def chunk_priority(wildcards):
    """Earlier chunks first, so that temporary files of few chunks are alive at a time."""
    return (
        0 if wildcards.chunk == "samples" else -(int(wildcards.chunk.split("-")[0]) // CHUNK_FRAMES)
    )


def view_flags(wildcards):
    """Flags that are the same for every job of one view."""
    flags = {"size": SCENE.size}
    if wildcards.view in TRAJECTORIES:
        flags["trajectory"] = json.dumps(TRAJECTORIES[wildcards.view], sort_keys=True)
    else:
        flags["frames"] = sorted(VIEW_FRAMES[wildcards.view])
    return flags_from_mapping(flags)


def clock_of_camera(wildcards):
    """Flags that say how a film stands to the common clock: given by the scene file, or from a file."""
    flags = {"fps": SCENE.fps, "num_frames": SCENE.num_frames}
    if SCENE.clock_is_given:
        flags |= {"offset_s": SCENE.cameras[wildcards.cam].offset_s, "start_s": SCENE.start_s}
    else:
        flags |= {"offsets": f"{RESULTS}/align/offsets.json"}
    return flags_from_mapping(flags)


def film_cameras_command():
    """Recover the cameras from the films, or put given ones on the films' own frames."""
    if SCENE.calibration:
        names = [f"{cam}={source.calibration_name}" for cam, source in SCENE.cameras.items()]
        given = {"calibration": SCENE.calibration, "calibration_format": SCENE.calibration_format}
        return f"films {flags_from_mapping({'camera': names, **given})}"
    flags = {"camera": list(SCENE.cameras), "fps": SCENE.fps, "num_frames": SCENE.num_frames}
    flags |= {"start_s": SCENE.start_s, "scale_hint": SCENE.scale_hint}
    if not SCENE.clock_is_given:
        flags |= {"audio": f"{RESULTS}/align/audio.json"}
    return f"recover {flags_from_mapping(flags)} {options('recover')}"


def films_of_pair(wildcards):
    left, right = wildcards.pair.split("-")
    return {
        "left": f"<results>/{wildcards.scene}/frames/cameras/{left}.npz",
        "right": f"<results>/{wildcards.scene}/frames/cameras/{right}.npz",
    }


def disparity_frames(wildcards):
    if wildcards.chunk == "samples":
        return SAMPLE_FRAMES
    return list(fourd_config.frames_of_chunk(wildcards.chunk))


def disparities_of_view(wildcards):
    return expand(
        "<results>/{scene}/disparity/{pair}/{chunk}.npz",
        scene=wildcards.scene,
        pair=pairs_without(wildcards.view),
        chunk=scene_chunks(wildcards.view, wildcards.chunk),
    )


def silhouettes_of_view(wildcards):
    return expand(
        "<results>/{scene}/silhouettes/{chunk}.npz",
        scene=wildcards.scene,
        chunk=scene_chunks(wildcards.view, wildcards.chunk),
    )


def empty_scene_of(wildcards):
    """The facts of a camera's film of the empty scene, where there is one."""
    has_one = SCENE.cameras[wildcards.cam].background
    return (
        [f"<results>/{wildcards.scene}/ingest/background/{wildcards.cam}.json"] if has_one else []
    )


def empty_scene_flags(wildcards):
    if not SCENE.cameras[wildcards.cam].background:
        return ""
    return flags_from_mapping(
        {"background_film": f"{RESULTS}/ingest/background/{wildcards.cam}.json"}
    )


def estimates_of_view(wildcards):
    """Physical cameras are trained on and scored with all four; films may need the consensus only."""
    if wildcards.view in TRAJECTORIES and config["composition"]["streams"] == "paper":
        return "consensus"
    return "consensus closest median farthest"


def sample_disparities(wildcards):
    return expand(
        "<results>/{scene}/disparity/{pair}/samples.npz",
        scene=wildcards.scene,
        pair=pairs_without(wildcards.view),
    )


def training_foregrounds():
    return [
        f"<results>/{SCENE.name}/foreground/{cam}/{chunk}.npz"
        for cam in SCENE.inputs
        for chunk in chunks_of_view(cam)
    ]


def training_backgrounds():
    """In groups of as many poses as a chunk has frames: a background needs no other frames than its own."""
    groups = []
    for cam in SCENE.inputs:
        frames = sorted(VIEW_FRAMES[cam])
        for first in range(0, len(frames), CHUNK_FRAMES):
            last = frames[min(first + CHUNK_FRAMES, len(frames)) - 1]
            groups.append(
                f"<results>/{SCENE.name}/background/{cam}/{frames[first]:06d}-{last:06d}.npz"
            )
    return groups


def evaluated(stage, suffix=""):
    return lambda wildcards: [
        f"<results>/{wildcards.scene}/{stage}/{wildcards.cam}/{chunk}{suffix}"
        for chunk in chunks_of_view(wildcards.cam)
    ]


def labels_of(wildcards):
    return [f"{SCENE.labels}/{wildcards.cam}"] if SCENE.labels else []


def label_flags(wildcards):
    return "".join(flags_from_mapping({"labels": path}) for path in labels_of(wildcards))


FILMS = expand(
    "<results>/{scene}/render/{trajectory}.mp4", scene=SCENE.name, trajectory=TRAJECTORIES
)
EVALUATION = (
    expand(
        "<results>/{scene}/evaluate/{file}",
        scene=SCENE.name,
        file=["metrics.csv", "table.md", "contact_sheet.png"],
    )
    if SCENE.heldout
    else []
)


def print_finished():
    """Where to look, and what was left out, when everything is done."""
    # Imported here: it loads OpenCV, which a dry run does not need.
    from fourd.io import read_json
    from fourd.stereo.files import refused_pairs

    folder = Path(RESULTS)
    films = [p for p in (folder / "render" / f"{name}.mp4" for name in TRAJECTORIES) if p.is_file()]
    if films:
        print(f"\nFilms of {SCENE.name}:", *(f"  {film}" for film in films), sep="\n")
    cameras = folder / "sfm" / "cameras.json"
    left_out = read_json(cameras)["left_out"] if cameras.is_file() else {}
    if left_out:
        print(f"\n{len(left_out)} of {len(SCENE.cameras)} cameras were left out:")
        print(*(f"  {cam}: {reason}" for cam, reason in left_out.items()), sep="\n")
    refused = refused_pairs([folder / "rectification" / f"{pair}.npz" for pair in SCENE.pairs])
    # A camera that was left out has been named already.
    refused = {p: r for p, r in refused.items() if not left_out.keys() & set(p.split("-"))}
    if refused:
        print(f"\n{len(refused)} of {len(SCENE.pairs)} pairs of cameras were left out:")
        print(*(f"  {pair}: {reason}" for pair, reason in refused.items()), sep="\n")
    table = folder / "evaluate" / "table.md"
    if SCENE.heldout and table.is_file():
        print(f"\n{table.read_text()}\nPictures: {folder / 'evaluate' / 'contact_sheet.png'}")


wildcard_constraints:
    scene=SCENE.name,
    cam="|".join(SCENE.cameras),
    view="|".join([*SCENE.cameras, *TRAJECTORIES]),
    trajectory="|".join(TRAJECTORIES) or "none",
    pair="|".join(SCENE.pairs),
    chunk=r"\d{6}-\d{6}|samples",
    level=r"[012]",
