"""The jobs of a scene, one by one, as the rules will make them, with the amount of work in each."""

import collections
import dataclasses
import itertools
import math
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from fourd.config import Scene, chunk_names, frames_of_chunk, num_levels, spread_frames
from fourd.plan.work import OK, PairFacts, Survey, Work

SAMPLES = "samples"
SWEEP_FACTOR = 12.0
"""Work of a pair swept by planes over that of a planar one (docs/performance.md: ten to twenty times)."""
WIDE_SEARCH = 320.0
"""Million pixels times disparities beyond which the matcher starts at a quarter of the size."""
TRAINING_KEYS = ("num_filters", "crop", "epochs", "min_scale", "max_scale")
NETWORKS_WORK = 0.2
"""Work on a frame that networks score, in units of evaluate_camera, whatever the frame's size."""
NUM_SCALES = 32
"""Places at which the size of a training sample is averaged."""
# Bytes per pixel of what is written (docs/formats.md): a pair's disparities and confidences, an estimate
# with its mask and what goes with all of them, a background's arrays, a PNG.
PAIR_BYTES, ESTIMATE_BYTES, DEPTH_BYTES, BACKGROUND_BYTES, PNG_BYTES = 6, 4, 8, 14, 1.7


@dataclasses.dataclass(frozen=True)
class Job:
    """One job of the graph. words: what it is of, as in its log file (`cam00-cam01`, `000000-000029`).

    amount: work beyond the start of the process, in the rule's own unit (`fourd.plan.cost`)
    num_bytes: size of what it writes;  is_kept: whether that stays on the disk to the end
    """

    rule: str
    words: tuple[str, ...] = ()
    amount: float = 0.0
    num_bytes: float = 0.0
    is_kept: bool = True


def describe_scene(
    scene: Scene, config: Mapping[str, Any], frames: Mapping[str, Mapping[int, int]], kept: Collection[str]
) -> dict[str, Any]:
    """What the jobs of a scene follow from, as JSON can hold it.

    frames: view -> output frame -> scene frame;  kept: kinds of intermediate files that stay on the disk
    """
    chunk_frames = config["chunk_frames"]
    views = {}
    for name, shown in frames.items():
        film = config["trajectories"].get(name)
        views[name] = {
            "role": "film" if film else "heldout" if name in scene.heldout else "input",
            "has_one_pose": bool(film) and film["kind"] == "hold",
            "num_frames": len(shown),
        }
    shown_chunks = {frame // chunk_frames for shown in frames.values() for frame in shown.values()}
    return {
        "scene": scene.name,
        "num_frames": scene.num_frames,
        "size": list(scene.size),
        "chunk_frames": chunk_frames,
        "cameras": list(scene.cameras),
        "inputs": list(scene.inputs),
        "heldout": list(scene.heldout),
        "pairs": list(scene.pairs),
        "clock_is_given": scene.clock_is_given,
        "cameras_are_given": bool(scene.calibration),
        "num_levels": num_levels(scene, config),
        "num_samples": min(config["background"]["num_samples"], scene.num_frames),
        "training": {key: config["composition"][key] for key in TRAINING_KEYS},
        "scores": {key: bool(config["evaluate"][key]) for key in ("humans", "lpips_weights")},
        "num_estimates": 1 if config["composition"]["streams"] == "paper" else 4,
        "views": views,
        # Numbers of the scene's chunks that any view shows.
        "shown_chunks": sorted(shown_chunks),
        "kept": sorted(kept),
    }


def list_jobs(outline: Mapping[str, Any], survey: Survey | None, work: Work) -> list[Job]:
    """All jobs of a run from nothing, footage of the embedded event apart.

    outline: of `describe_scene`;  survey: what is known of the pairs, if anything
    """
    is_foreground = work.foreground == OK
    facts = survey.pairs if survey else {}
    return [
        *_list_cameras(outline),
        *_list_pairs(outline, facts, work.matched, is_foreground),
        *_list_silhouettes(outline, is_foreground and work.silhouettes == OK),
        *_list_fusion(outline, work.matched if is_foreground else []),
        *_list_backgrounds(outline, work.matched),
        *list_training(outline),
        *list_rendering(outline),
        *_list_films(outline),
    ]


def _list_cameras(outline: Mapping[str, Any]) -> Iterator[Job]:
    """From films to cameras: ingest, align, sfm, frames, views."""
    num_frames, mpx = outline["num_frames"], _mpx(outline)
    cameras = outline["cameras"]
    for cam in cameras:
        yield Job("probe_camera", (cam,))
        yield Job("sample_camera", (cam,), num_frames * mpx)
        yield Job("prepare_camera", (cam,), 0.0 if outline["clock_is_given"] else num_frames * mpx)
    if not outline["clock_is_given"]:
        num_pairs = len(cameras) * (len(cameras) - 1) / 2
        yield Job("listen", (), num_pairs)
        yield Job(
            "film_cameras", (), 0.0 if outline["cameras_are_given"] else len(cameras) * num_frames * mpx
        )
        for cam in cameras:
            yield Job("track_motion", (cam,), num_frames * mpx)
        yield Job("align_cameras", (), num_pairs * num_frames)
    elif not outline["cameras_are_given"]:
        yield Job("film_cameras", (), len(cameras) * num_frames * mpx)
    yield Job("import_cameras")
    yield Job("match_colours", (), len(cameras))
    for view in outline["views"]:
        yield Job("place_view", (view,))


def _list_pairs(
    outline: Mapping[str, Any], facts: Mapping[str, PairFacts], matched: Collection[str], is_foreground: bool
) -> Iterator[Job]:
    """Rectification of all pairs, disparities of those that are matched."""
    names = chunk_names(outline["num_frames"], outline["chunk_frames"])
    shown = [names[n] for n in outline["shown_chunks"]] if is_foreground else []
    lengths = {chunk: len(frames_of_chunk(chunk)) for chunk in shown}
    lengths[SAMPLES] = outline["num_samples"]
    for pair in outline["pairs"]:
        yield Job("rectify_pair", (pair,))
    for pair in matched:
        fact = facts.get(pair)
        mpx = fact.size[0] * fact.size[1] / 1e6 if fact and fact.size[0] else 1.25 * _mpx(outline)
        work = _matching_work(fact, mpx)
        for chunk, count in lengths.items():
            yield Job(
                "disparity", (pair, chunk), count * work, count * mpx * 1e6 * PAIR_BYTES,
                "disparity" in outline["kept"],
            )  # fmt: skip
    yield Job("judge_need")
    yield Job("survey")


def _matching_work(fact: PairFacts | None, mpx: float) -> float:
    """Work of a frame of a pair: pixels, and the disparities searched in units of 600 px beside them."""
    # A typical pair searches about four fifths of its width.
    searched = fact.num_disparities if fact and fact.num_disparities is not None else 800 * mpx**0.5
    if mpx * searched > WIDE_SEARCH:
        searched = min(searched, 300.0)
    work = mpx * (1 + searched / 600)
    return work * SWEEP_FACTOR if fact and fact.kind == "sweep" else work


def _list_silhouettes(outline: Mapping[str, Any], is_made: bool) -> Iterator[Job]:
    if not is_made:
        return
    mpx, size = _mpx(outline), len(outline["inputs"])
    for cam in outline["inputs"]:
        yield Job("background_plate", (cam,), mpx)
    for chunk in chunk_names(outline["num_frames"], outline["chunk_frames"]):
        count = len(frames_of_chunk(chunk))
        yield Job("silhouettes", (chunk,), size * count * mpx, size * count * mpx * 1e6)


def _list_fusion(outline: Mapping[str, Any], matched: Collection[str]) -> Iterator[Job]:
    """Foregrounds; training targets of a chunk are one job, whose files belong to the inputs."""
    mpx, is_kept = _mpx(outline), "foreground" in outline["kept"]
    views, inputs = outline["views"], outline["inputs"]
    per_estimate = mpx * 1e6 * ESTIMATE_BYTES
    for chunk, count in count_frames(outline, inputs[0]).items():
        amount = sum(mpx * _num_pairs(matched, cam) for cam in inputs)
        num_bytes = count * len(inputs) * (4 * per_estimate + mpx * 1e6 * DEPTH_BYTES)
        yield Job("fuse_training", (chunk,), count * amount, num_bytes, is_kept)
    for name, view in views.items():
        if view["role"] == "input":
            continue
        estimates = outline["num_estimates"] if view["role"] == "film" else 4
        for chunk, count in count_frames(outline, name).items():
            num_bytes = count * (estimates * per_estimate + mpx * 1e6 * DEPTH_BYTES)
            amount = count * mpx * _num_pairs(matched, name)
            yield Job("fuse_foreground", (name, chunk), amount, num_bytes, is_kept)


def _list_backgrounds(outline: Mapping[str, Any], matched: Collection[str]) -> Iterator[Job]:
    mpx, is_kept = _mpx(outline), "foreground" in outline["kept"]
    for name, view in outline["views"].items():
        groups = count_frames(outline, name)
        if view["role"] == "input":
            frames, step = spread_frames(outline["num_frames"], view["num_frames"]), outline["chunk_frames"]
            parts = [frames[i : i + step] for i in range(0, len(frames), step)]
            groups = {f"{part[0]:06d}-{part[-1]:06d}": len(part) for part in parts}
        for chunk, count in groups.items():
            poses = 1 if view["has_one_pose"] else count
            # What the pixels cost alone weighs as much as four pairs.
            amount = poses * outline["num_samples"] * mpx * (4 + _num_pairs(matched, name))
            num_bytes = poses * mpx * 1e6 * BACKGROUND_BYTES
            yield Job("estimate_background", (name, chunk), amount, num_bytes, is_kept)


def list_training(outline: Mapping[str, Any]) -> list[Job]:
    """The jobs that train, one per level."""
    jobs: list[Job] = []
    steps = outline["training"]["epochs"] * steps_per_epoch(outline)
    for mpx, width in _levels(outline):
        work = steps * network_work(_mean_sample(outline, mpx), width)
        jobs.append(Job("train_level", (str(len(jobs)),), work, 1e6 * width**2 / 6))
    return jobs


def _mean_sample(outline: Mapping[str, Any], mpx: float) -> float:
    """Millions of pixels of a training sample at a level of `mpx`: made smaller by chance, then cropped."""
    training = outline["training"]
    shrink = (1e6 * mpx / (outline["size"][0] * outline["size"][1])) ** 0.5
    low, high = training["min_scale"], training["max_scale"]
    crop = math.inf if training["crop"] is None else training["crop"]
    scales = (min(1.0, low + (i + 0.5) / NUM_SCALES * (high - low)) for i in range(NUM_SCALES))
    areas = (math.prod(min(crop, scale * shrink * side) for side in outline["size"]) for scale in scales)
    return sum(areas) / NUM_SCALES / 1e6


def _levels(outline: Mapping[str, Any]) -> list[tuple[float, int]]:
    """Millions of pixels and filters of every level, coarsest first."""
    num_levels, filters = outline["num_levels"], outline["training"]["num_filters"]
    return [
        (_mpx(outline) / 4 ** (num_levels - 1 - level), filters[min(level, len(filters) - 1)])
        for level in range(num_levels)
    ]


def list_rendering(outline: Mapping[str, Any]) -> list[Job]:
    """The jobs that apply the network, one per film or held-out camera and chunk."""
    num_bytes, per_frame = _mpx(outline) * 1e6 * PNG_BYTES, _rendering_work(outline, 1.0)
    return [
        Job("render_frames", (name, chunk), count * per_frame, count * num_bytes)
        for name, view in outline["views"].items()
        if view["role"] != "input"
        for chunk, count in count_frames(outline, name).items()
    ]


def _rendering_work(outline: Mapping[str, Any], share: float) -> float:
    """Work of a picture with that share of the films' pixels.

    Coarser levels only fill holes: they run on few frames, and are counted as if on all.
    """
    return sum(network_work(share * mpx, width) for mpx, width in _levels(outline))


def list_viewer(outline: Mapping[str, Any], lattice: Mapping[str, Any], work: Work) -> list[Job]:
    """The jobs of the viewer's page beyond those of the films.

    lattice: `views`, `num_moments` and `size` of its pictures, (width, height) px, as the viewer chose them
    """
    matched = work.matched if work.foreground == OK else []
    mpx, moments = math.prod(lattice["size"]) / 1e6, lattice["num_moments"]
    per_frame = _rendering_work(outline, mpx / _mpx(outline))
    jobs = []
    for view in lattice["views"]:
        jobs.append(Job("place_lattice", (view,)))
        for chunk in chunk_names(moments, outline["chunk_frames"]):
            words, count = (view, chunk), len(frames_of_chunk(chunk))
            background = outline["num_samples"] * mpx * (4 + len(work.matched))
            num_bytes = count * mpx * 1e6 * (4 * ESTIMATE_BYTES + DEPTH_BYTES)
            jobs += [
                Job("fuse_lattice", words, count * mpx * len(matched), num_bytes, False),
                Job("estimate_lattice_background", words, background, mpx * 1e6 * BACKGROUND_BYTES, False),
                Job("render_lattice", words, count * per_frame, count * mpx * 1e6 * PNG_BYTES),
                Job("map_lattice", words, count * mpx),
            ]
    pictures = moments * (len(lattice["views"]) + len(outline["cameras"]))
    return [*jobs, Job("viewer_page", (), pictures * mpx, lattice["size_mb"] * 1e6)]


def _list_films(outline: Mapping[str, Any]) -> Iterator[Job]:
    """Films and scores."""
    full = _mpx(outline)
    for name, view in outline["views"].items():
        if view["role"] == "input":
            continue
        count = view["num_frames"]
        if view["role"] == "film":
            yield Job("encode_film", (name,), count * full, count * full * 1e5)
        else:
            amount = full + (NETWORKS_WORK if outline["scores"]["lpips_weights"] else 0.0)
            yield Job("evaluate_camera", (name,), count * amount)
    if outline["heldout"]:
        yield Job("collect_metrics")
        if outline["scores"]["humans"]:
            moments = max(outline["views"][cam]["num_frames"] for cam in outline["heldout"])
            yield Job("find_people", (), moments * len(outline["inputs"]))


def count_frames(outline: Mapping[str, Any], view: str) -> dict[str, int]:
    """Chunk of output frames -> number of frames of a view in it, where there are any."""
    entry, step = outline["views"][view], outline["chunk_frames"]
    if entry["role"] == "film":
        return {chunk: len(frames_of_chunk(chunk)) for chunk in chunk_names(entry["num_frames"], step)}
    names = chunk_names(outline["num_frames"], step)
    shown = collections.Counter(f // step for f in spread_frames(outline["num_frames"], entry["num_frames"]))
    return {names[number]: count for number, count in sorted(shown.items())}


def steps_per_epoch(outline: Mapping[str, Any]) -> int:
    """Training samples: all frames of all input cameras that are targets."""
    return sum(view["num_frames"] for view in outline["views"].values() if view["role"] == "input")


def network_work(mpx: float, num_filters: int) -> float:
    """Work of the network on an image: a third of it, at 8 filters, grows with their square."""
    return mpx * (2 + (num_filters / 8) ** 2) / 3


def _mpx(outline: Mapping[str, Any]) -> float:
    return outline["size"][0] * outline["size"][1] / 1e6


def _num_pairs(matched: Collection[str], view: str) -> int:
    """Pairs that serve a view: a camera never helps to predict itself."""
    return sum(view not in pair.split("-") for pair in matched)


def count_by_rule(jobs: Collection[Job]) -> dict[str, int]:
    """Rule -> number of jobs, in the order of the flow."""
    ordered = sorted(jobs, key=lambda job: job.rule)
    return {rule: len(list(own)) for rule, own in itertools.groupby(ordered, key=lambda job: job.rule)}
