"""Checked configuration, the lists that span the job graph, and helper functions of the rules."""

import functools
import json
import os
import sys
from pathlib import Path

from snakemake.exceptions import WorkflowError

sys.path.insert(0, workflow.basedir)

from fourd import config as fourd_config
from fourd.cli import flags_from_mapping
from fourd.errors import InputError
from fourd.plan.budget import describe_budget, fixed_keys, reduce_config
from fourd.plan.files import read_survey
from fourd.plan.marks import marked_outputs
from fourd.plan.options import options_from_section
from fourd.plan.outline import describe_scene
from fourd.plan.work import OK, choose_work
from fourd.sources import check_sources, source_stamp
from fourd.trajectory import resolve_trajectories

MADE_BY_RULES = ("data/demo/", "data/pose2sim/")

# Numbers that a person has given are not lowered by a budget.
FIXED_KEYS = fixed_keys(config)

try:
    SCENE, _scene_settings = fourd_config.load_scene(config.get("scene", "demo"))
    config = fourd_config.load_config(config, _scene_settings, SCENE.name)
    config["trajectories"] = resolve_trajectories(config["trajectories"])
    CHUNK_FRAMES = fourd_config.fit_chunk_frames(config, SCENE)
    # What rules make or fetch need not be there yet.
    check_sources(SCENE, made_by_rules=MADE_BY_RULES)
    # Output frame -> scene frame, for every place that is filmed from.
    VIEW_FRAMES = fourd_config.view_frames(SCENE, config)
    KEPT = fourd_config.kept_intermediates(SCENE, config, VIEW_FRAMES)
    # For its checks: the engine takes an error in an input function for a file that nothing makes.
    choose_work(None, SCENE.pairs, options_from_section(config["plan"]))
except InputError as error:
    raise WorkflowError(str(error)) from None

# Where results lie, for flags that name files: pathvars are filled in for inputs and outputs only.
RESULTS = f"{config['pathvars'].get('results', 'results')}/{SCENE.name}"
ASKED, ASKED_KEPT = config, KEPT


pathvars:
    scene=SCENE.name,


# Left by an earlier run. A job's own process would see the marks of the run that it belongs to.
UNFINISHED = marked_outputs(Path(".snakemake")) if workflow.is_main_process else set()


def within_budget():
    """The configuration within its budget, and what that took: None without one, or before it is planned."""
    survey = Path(RESULTS) / "plan" / "survey.json"
    machine = Path(RESULTS).parent / "machine" / "speed.json"
    try:
        outline = describe_scene(SCENE, ASKED, VIEW_FRAMES, ASKED_KEPT)
        return reduce_config(ASKED, outline, survey, machine, FIXED_KEYS)
    except InputError as error:
        raise WorkflowError(str(error)) from None


HAS_BUDGET = ASKED["minutes"] is not None or ASKED["disk_gb"] is not None
REDUCTION = None
if HAS_BUDGET:
    config, REDUCTION = within_budget()
    KEPT = frozenset(REDUCTION.kept) if REDUCTION else KEPT
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


def work_to_do():
    """What is made and what is left out; all that might be needed while the cameras are not known."""
    is_run = workflow.executor_plugin is not None and not workflow.dryrun
    path = Path(RESULTS) / "plan" / "survey.json"
    if is_run:
        path = checkpoints.survey.get().output[0]
        # The engine looks for unfinished outputs before it knows the jobs that depend on the checkpoint.
        workflow.dag.forcefiles.update(UNFINISHED)
    return read_work(str(path), Path(path).stat().st_mtime_ns if Path(path).is_file() else None)


def check_budget(targets):
    """Refuse a run whose budget cannot be kept yet. targets: names of the rules that are asked for."""
    if HAS_BUDGET and REDUCTION is None and set(targets) != {"plan"}:
        raise WorkflowError(
            "a budget (minutes, disk_gb) can be kept once the cameras and the speed of this machine are known: "
            "run the target `plan` with the same budget first, nothing that it makes is made again"
        )


@functools.cache
def read_work(path, changed_ns):
    """What is made according to a survey of the scene, None if there is none yet."""
    if changed_ns is None:
        print(
            "The cameras are not known yet: this is an upper bound with every pair of cameras. Pairs that "
            "cannot be matched will be left out (`snakemake --cores 2 plan` finds out which).",
            file=sys.stderr,
        )
    try:
        survey = None if changed_ns is None else read_survey(path)
        return choose_work(survey, SCENE.pairs, options_from_section(config["plan"]))
    except InputError as error:
        raise WorkflowError(str(error)) from None


def plan_flags():
    """Within the budget as it is once the survey is there, which may be later than the start of this run."""
    settings, reduction = within_budget()
    kept = reduction.kept if reduction else KEPT
    outline = describe_scene(SCENE, settings, VIEW_FRAMES, kept)
    lattice = {"views": list(LATTICE.views), "num_moments": len(LATTICE.frames)}
    lattice |= {"size": LATTICE.size, "size_mb": LATTICE.forecast_mb}
    flags = {"outline": outline, "lattice": lattice, "budget": describe_budget(ASKED, reduction)}
    words = {flag: json.dumps(value, sort_keys=True) for flag, value in flags.items()}
    return flags_from_mapping(words | settings["plan"])


def pairs_without(view):
    """Pairs that serve a view: a camera never helps to predict itself."""
    return [p for p in work_to_do().matched if view not in p.split("-")]


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
        flags["size"] = TRAJECTORIES[wildcards.view].get("size") or SCENE.size
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
        "left": f"<results>/<scene>/frames/cameras/{left}.npz",
        "right": f"<results>/<scene>/frames/cameras/{right}.npz",
    }


@functools.cache
def words(numbers):
    """One word for the engine, which formats lists number by number, three times for every job."""
    return " ".join(map(str, numbers))


def disparity_frames(wildcards):
    if wildcards.chunk == "samples":
        return words(SAMPLE_FRAMES)
    return words(fourd_config.frames_of_chunk(wildcards.chunk))


def disparities_at(view, chunks):
    """Disparities that the foreground of a view is made from, none where nothing moves."""
    return expand(
        "<results>/<scene>/disparity/{pair}/{chunk}.npz",
        pair=pairs_without(view) if work_to_do().foreground == OK else [],
        chunk=chunks,
    )


def silhouettes_at(chunks):
    work = work_to_do()
    is_made = work.foreground == OK and work.silhouettes == OK
    return expand(
        "<results>/<scene>/silhouettes/{chunk}.npz",
        chunk=chunks if is_made else [],
    )


def disparities_of_view(wildcards):
    return disparities_at(wildcards.view, scene_chunks(wildcards.view, wildcards.chunk))


def silhouettes_of_view(wildcards):
    return silhouettes_at(scene_chunks(wildcards.view, wildcards.chunk))


def empty_scene_of(wildcards):
    """The facts of a camera's film of the empty scene, where there is one."""
    has_one = SCENE.cameras[wildcards.cam].background
    return [f"<results>/<scene>/ingest/background/{wildcards.cam}.json"] if has_one else []


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
        "<results>/<scene>/disparity/{pair}/samples.npz",
        pair=pairs_without(wildcards.view),
    )


def training_foregrounds():
    return [
        f"<results>/<scene>/foreground/{cam}/{chunk}.npz"
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
            groups.append(f"<results>/<scene>/background/{cam}/{frames[first]:06d}-{last:06d}.npz")
    return groups


def evaluated(stage, suffix=""):
    return lambda wildcards: [
        f"<results>/<scene>/{stage}/{wildcards.cam}/{chunk}{suffix}"
        for chunk in chunks_of_view(wildcards.cam)
    ]


def labels_of(wildcards):
    return [f"{SCENE.labels}/{wildcards.cam}"] if SCENE.labels else []


def label_flags(wildcards):
    return "".join(flags_from_mapping({"labels": path}) for path in labels_of(wildcards))


def folders_of_film(wildcards):
    """Rendered frames of a film, and of its right eye where it is stereo."""
    name = wildcards.trajectory
    is_stereo = TRAJECTORIES[name].get("eye") == "left" and f"{name}_right" in TRAJECTORIES
    views = {"frames": [name], "right": [f"{name}_right"] if is_stereo else []}
    folder = "<results>/<scene>/render/{view}/{chunk}"
    return {
        key: [
            path for view in names for path in expand(folder, view=view, chunk=chunks_of_view(view))
        ]
        for key, names in views.items()
    }


def film_flags(codec):
    return flags_from_mapping({"fps": config["film"]["fps"] or SCENE.fps, "codec": codec})


def chunks_shown(frames, chunk):
    """Chunks of the scene's clock that a chunk of output frames shows. frames: scene frame of each of these."""
    shown = [frames[i] for i in fourd_config.frames_of_chunk(chunk)]
    return sorted({CHUNKS[frame // CHUNK_FRAMES] for frame in shown})


FILMS = expand("<results>/<scene>/render/{trajectory}.mp4", trajectory=TRAJECTORIES)
EVALUATION = (
    expand(
        "<results>/<scene>/evaluate/{file}",
        file=["metrics.csv", "table.md", "contact_sheet.png"],
    )
    if SCENE.heldout
    else []
)


def check_folders():
    """Stop before the first job if one of the folders cannot be written."""
    for kind in ("results", "logs", "benchmarks"):
        folder = Path(config["pathvars"].get(kind, kind)).absolute()
        there = next(
            path for path in (folder / SCENE.name, folder, *folder.parents) if path.exists()
        )
        if not os.access(there, os.W_OK):
            raise WorkflowError(
                f"expected a folder for {kind} that can be written, got {there}: give the right to write "
                f"there, or another folder with --config 'pathvars={{{kind}: FOLDER}}'"
            )


def print_finished():
    """Where to look, and what was left out, when everything is done."""
    folder = Path(RESULTS)
    films = [p for p in (folder / "render" / f"{name}.mp4" for name in TRAJECTORIES) if p.is_file()]
    if films:
        print(f"\nFilms of {SCENE.name}:", *(f"  {film}" for film in films), sep="\n")
    if (folder / "viewer" / "index.html").is_file():
        print(f"\nTo browse: {folder / 'viewer' / 'index.html'}")
    cameras = folder / "sfm" / "cameras.json"
    left_out = json.loads(cameras.read_text())["left_out"] if cameras.is_file() else {}
    if left_out:
        print(f"\n{len(left_out)} of {len(SCENE.cameras)} cameras were left out:")
        print(*(f"  {cam}: {reason}" for cam, reason in left_out.items()), sep="\n")
    survey = folder / "plan" / "survey.json"
    facts = read_survey(survey).pairs if survey.is_file() else {}
    # A camera that was left out has been named already.
    known = {p: fact.status for p, fact in facts.items() if not left_out.keys() & set(p.split("-"))}
    refused = {pair: status for pair, status in known.items() if status != OK}
    if refused:
        print(f"\n{len(refused)} of {len(SCENE.pairs)} pairs of cameras were left out:")
        print(*(f"  {pair}: {reason}" for pair, reason in refused.items()), sep="\n")
    table = folder / "evaluate" / "table.md"
    if SCENE.heldout and table.is_file():
        print(f"\n{table.read_text()}\nPictures: {folder / 'evaluate' / 'contact_sheet.png'}")


wildcard_constraints:
    cam="|".join(SCENE.cameras),
    view="|".join([*SCENE.cameras, *TRAJECTORIES]),
    trajectory="|".join(TRAJECTORIES) or "none",
    pair="|".join(SCENE.pairs),
    chunk=r"\d{6}-\d{6}|samples",
    level=r"[012]",
