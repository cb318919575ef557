"""The network's settings at equal training time: error on held-out cameras against processor seconds.

    python -m benches.composition --scene results/SCENE --output DIR [--labels DIR] [--variants NAME ...]

The scene is a finished run with held-out cameras. Every variant is trained in one thread, and measured
whenever its training has taken one of the marks; what measuring takes is not counted. --labels is the
folder of the held-out cameras' true masks; without them the workflow's own say where something moves.

Writes composition.csv (one row per variant, mark and camera, means over frames; mse_share is the mean squared
error over that of the better one of `inst`, the consensus, and `paste`, the consensus over the background),
composition.png (RMS error over all cameras against time) and, per camera, composition_CAMERA.png: what each
variant makes of the middle frame. Peak memory is the process': compare it between runs of one variant each.
`paper` is the preset of that name with this bench's filters and crop. LPIPS (AlexNet) is measured, and
`perceptual` can be trained, where --lpips-weights says where its weights are.
"""

import argparse
import dataclasses
import math
import resource
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benches.pareto import plot_curves
from fourd import cli, io, metrics
from fourd.composition import CascadeOptions, CompositionOptions, data
from fourd.composition.__main__ import Sources, target_reader
from fourd.composition.infer import CONSENSUS, STATIC, compose_frame, paste_images
from fourd.composition.model import CompositionNet, resolve_precision
from fourd.composition.train import Trainer, train_step
from fourd.config import SCHEMA_FOLDER, load_yaml, spread_frames
from fourd.evaluate import EvaluateOptions
from fourd.evaluate.regions import StillPicture, find_dynamic_pixels, read_dynamic_mask
from fourd.image import label_image, tile_images, undistort
from fourd.ingest import open_camera
from fourd.metrics_lpips import lpips
from fourd.sfm import SceneCameras, read_cameras
from fourd.views import LEFT_OUT, read_view

PRESETS = load_yaml(SCHEMA_FOLDER / "composition.schema.yaml")["presets"]
Streams = tuple[int, int, int, int, int, int]
CLOSEST, MEDIAN, ONE = (1, 1, 1, 3, 3, 3), (2, 2, 2, 3, 3, 3), (0, 0, 0, 3, 3, 3)
STILL_FRAMES = 15
CAPTION_PX = 18
COLUMNS = (
    "variant", "mark_s", "steps", "view", "psnr_db", "dynamic_psnr_db", "ssim", "lpips", "mse", "mse_share",
    "seconds", "cpu_seconds", "peak_rss_mb",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Variant:
    """Options that differ from the bench's, which estimates feed the six streams, and the number of levels.

    test_streams: None = as the options say
    num_levels: of two, which are trained in turns, the coarser fills every hole of the finer one's inputs
    """

    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    training_streams: Streams = data.TRAINING_STREAMS
    test_streams: Streams | None = None
    num_levels: int = 1


VARIANTS = {
    "default": Variant(),
    "paper": Variant(PRESETS["paper"]),
    "streams_paper": Variant({"streams": "paper"}),
    "cascade": Variant(num_levels=2),
    "one_stream": Variant({}, ONE, ONE),
    "input_closest": Variant({}, test_streams=CLOSEST),
    "input_median": Variant({}, test_streams=MEDIAN),
    "head_direct": Variant({"head": "direct"}),
    "filters_16": Variant({"num_filters": (16,) * 3}),
    "filters_28": Variant({"num_filters": (28,) * 3}),
    "whole_picture": Variant({"crop": None}),
    "l1": Variant({"adversarial_weight": 0.0, "frequency_weight": 0.0}),
    "l1_adversarial": Variant({"adversarial_weight": 1.0, "frequency_weight": 0.0}),
    "l1_adversarial_frequency": Variant({"adversarial_weight": 1.0, "frequency_weight": 100.0}),
    "rate_0.0002": Variant({"learning_rate": 2e-4, "warmup_steps": 0}),
    "rate_0.0005": Variant({"learning_rate": 5e-4, "warmup_steps": 0}),
    "no_warmup": Variant({"warmup_steps": 0}),
    "not_averaged": Variant({"average_weights": False}),
    "not_resized": Variant({"min_scale": 1.0}),
    "enlarged": Variant({"min_scale": 1.0, "max_scale": 1.5}),
    "perceptual": Variant({"perceptual_weight": 20.0}),
}


@dataclasses.dataclass(frozen=True, eq=False)
class HeldOutFrame:
    """What a held-out camera filmed. images: (7, H, W, 4) uint8, see `fourd.composition.data`.

    valid, dynamic: (H, W) bool, where there is truth, and where of it something moves
    """

    images: np.ndarray
    valid: np.ndarray
    dynamic: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Event:
    """All samples of a scene: those to train on, also at half the size, and held-out frames by camera."""

    samples: data.SampleSet
    coarse: data.SampleSet
    heldout: dict[str, list[HeldOutFrame]]


def list_archives(scene: Path, kind: str, view: str) -> tuple[Path, ...]:
    paths = tuple(sorted((scene / kind / view).glob("*.npz")))
    if not paths:
        raise SystemExit(f"error: expected archives of {kind} of {view} below {scene}, found none: run it")
    return paths


def read_event(folder: Path, labels: Path | None) -> Event:
    scene = read_cameras(folder / "sfm" / "cameras.json")
    sources = Sources(
        tuple(folder / "views" / f"{cam}.json" for cam in scene.inputs),
        tuple(path for cam in scene.inputs for path in list_archives(folder, "foreground", cam)),
        tuple(path for cam in scene.inputs for path in list_archives(folder, "background", cam)),
        {cam: folder / "frames" / "cameras" / f"{cam}.npz" for cam in scene.inputs},
        folder / "sfm" / "cameras.json",
    )
    cache_mb, read_target = CompositionOptions().cache_mb, target_reader(sources)
    samples, coarse = (
        data.SampleSet(sources.foreground, sources.background, read_target, factor, cache_mb)
        for factor in (1, 2)
    )
    samples.fill_cache()
    heldout = {cam: list(read_heldout(folder, scene, cam, labels)) for cam in scene.heldout}
    return Event(samples, coarse, {cam: frames for cam, frames in heldout.items() if frames})


def read_heldout(folder: Path, scene: SceneCameras, cam: str, labels: Path | None) -> Iterator[HeldOutFrame]:
    """Frames of a held-out camera, as the stage evaluate sees them; none of one that was left out."""
    view = read_view(folder / "views" / f"{cam}.json")
    if view.role == LEFT_OUT:
        return
    film, track = open_camera(folder / "frames" / "cameras" / f"{cam}.npz"), scene.tracks[cam]

    def read_target(_: str, frame: int) -> tuple[np.ndarray, np.ndarray]:
        shown = view.at(frame)
        # The truth is what was filmed: nothing in it is moved to the common time.
        image = film.read(shown.scene_frame, is_compensated=False)
        return undistort(image, track.at(shown.scene_frame), shown.camera)

    foreground, background = (list_archives(folder, kind, cam) for kind in ("foreground", "background"))
    samples = data.SampleSet(foreground, background, read_target, 1, 0)
    stills = spread_frames(scene.num_frames, STILL_FRAMES)
    still = None if labels else StillPicture([(film.read(f), track.at(f)) for f in stills])
    for sample in samples.ids:
        images, shown = samples.images(sample), view.at(sample.frame)
        valid = images[data.TARGET, ..., 3] > 0
        if labels:
            number = film.source_frame(shown.scene_frame)
            moves = read_dynamic_mask(labels / cam, number, track.at(shown.scene_frame), shown.camera)
        else:
            pictures = [(images[STATIC, ..., :3], images[STATIC, ..., 3] > 0)]
            pictures += [still.seen_from(shown.camera)] if still else []
            moves = find_dynamic_pixels(images[data.TARGET, ..., :3], pictures, EvaluateOptions())
        yield HeldOutFrame(images, valid, moves & valid)
    film.close()


def measure_image(image: np.ndarray, frame: HeldOutFrame, lpips_weights: str = "") -> dict[str, float]:
    """psnr_db, dynamic_psnr_db, ssim, lpips and mse; pixels that the truth does not have do not count.

    lpips_weights: folder of the weights; without one there is no lpips, NaN
    """
    truth = frame.images[data.TARGET, ..., :3]
    shown = np.where(frame.valid[..., None], image, np.uint8(0))
    mse = metrics.mse(shown, truth, frame.valid)
    return {
        "psnr_db": metrics.psnr_from_mse(mse),
        "dynamic_psnr_db": metrics.psnr(shown, truth, frame.dynamic),
        "ssim": metrics.ssim(shown, truth),
        "lpips": lpips(shown, truth, lpips_weights) if lpips_weights else math.nan,
        "mse": mse,
    }


def average_frames(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Means over the frames that have a value; NaN if none has one, as where nothing moves."""
    columns = {key: [row[key] for row in rows if not math.isnan(row[key])] for key in rows[0]}
    return {key: float(np.mean(values)) if values else math.nan for key, values in columns.items()}


def measure_baselines(
    frames: Sequence[HeldOutFrame], lpips_weights: str = ""
) -> dict[str, tuple[dict[str, float], np.ndarray]]:
    """Inst and Inst over background, as `measure_networks`."""
    images = {
        "inst": [frame.images[CONSENSUS, ..., :3] for frame in frames],
        "paste": [paste_images(frame.images) for frame in frames],
    }
    return {name: summarize(found, frames, lpips_weights) for name, found in images.items()}


def compose_images(networks: Sequence[CompositionNet], images: np.ndarray) -> np.ndarray:
    """What the levels make of the estimates in (7, H, W, 4) uint8, every hole filled by the coarser one."""
    arrays: dict[str, dict[str, np.ndarray]] = {"foreground": {}, "background": {}}
    for (kind, key), image in zip(data.ESTIMATES, images[: data.TARGET], strict=True):
        arrays[kind] |= {f"{key}_rgb": image[..., :3], f"{key}_valid": image[..., 3] > 0}
    return compose_frame(networks, 0, arrays["foreground"], arrays["background"], CascadeOptions(0, 0))[0]


def measure_networks(
    networks: Sequence[CompositionNet], frames: Sequence[HeldOutFrame], lpips_weights: str = ""
) -> tuple[dict[str, float], np.ndarray]:
    """Means over frames, and the picture of the middle one."""
    return summarize([compose_images(networks, frame.images) for frame in frames], frames, lpips_weights)


def summarize(
    found: Sequence[np.ndarray], frames: Sequence[HeldOutFrame], lpips_weights: str
) -> tuple[dict[str, float], np.ndarray]:
    rows = [measure_image(image, frame, lpips_weights) for image, frame in zip(found, frames, strict=True)]
    return average_frames(rows), found[len(found) // 2]


def train_variant(
    event: Event, variant: Variant, options: CompositionOptions, marks: Sequence[float]
) -> Iterator[tuple[dict[str, Any], list[CompositionNet]]]:
    """What one variant's training has taken and its networks, at every mark (s of processor time)."""
    options = dataclasses.replace(options, **variant.changes)
    options = dataclasses.replace(options, precision=resolve_precision(options.precision, "cpu"))
    sets = (event.coarse, event.samples)[-variant.num_levels :]
    levels = [(samples, Trainer(level, options, "cpu")) for level, samples in enumerate(sets)]
    networks = [trainer.network for _, trainer in levels]
    for network in networks:
        network.test_streams = variant.test_streams or network.test_streams
    spent = {"seconds": 0.0, "cpu_seconds": 0.0}
    for mark in sorted(marks):
        start, cpu_start = time.monotonic() - spent["seconds"], time.process_time() - spent["cpu_seconds"]
        while time.process_time() - cpu_start < mark:
            for samples, trainer in levels:
                train_step(trainer, samples, samples.ids, options, variant.training_streams)
        spent = {"seconds": time.monotonic() - start, "cpu_seconds": time.process_time() - cpu_start}
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        yield (
            {"mark_s": mark, "steps": levels[-1][1].counters["step"], **spent, "peak_rss_mb": peak},
            networks,
        )


def measure_variants(
    event: Event, names: Sequence[str], options: CompositionOptions, marks: Sequence[float]
) -> tuple[list[dict[str, Any]], dict[tuple[str, str], np.ndarray]]:
    """Rows of the table, those without training first, and a picture by camera and variant."""
    rows, pictures = [], {}
    baselines = {
        view: measure_baselines(frames, options.lpips_weights) for view, frames in event.heldout.items()
    }
    best = {view: min(row["mse"] for row, _ in found.values()) for view, found in baselines.items()}

    def keep(name: str, view: str, facts: dict[str, Any], picture: np.ndarray) -> None:
        rows.append({"variant": name, "view": view, **facts, "mse_share": facts["mse"] / best[view]})
        pictures[view, name] = picture
        print(
            "  ".join(f"{v:.4g}" if isinstance(v, float) else str(v) for v in rows[-1].values()), flush=True
        )

    for view, found in baselines.items():
        for name, (scores, picture) in found.items():
            keep(name, view, {"mark_s": 0, "steps": 0, **scores}, picture)
    for name in names:
        for cost, networks in train_variant(event, VARIANTS[name], options, marks):
            for view, frames in event.heldout.items():
                scores, picture = measure_networks(networks, frames, options.lpips_weights)
                keep(name, view, cost | scores, picture)
    return rows, pictures


def average_views(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """A row per variant and mark: RMS error in grey levels over all cameras."""
    groups: dict[tuple[str, float], list[float]] = {}
    for row in rows:
        groups.setdefault((row["variant"], float(row["mark_s"])), []).append(float(row["mse"]))
    return [
        {"variant": variant, "cpu_seconds": mark, "rms_error": float(np.sqrt(np.mean(errors)))}
        for (variant, mark), errors in groups.items()
    ]


def draw_sheet(pictures: Mapping[str, np.ndarray]) -> np.ndarray:
    """Pictures of one size with their names, three in a row."""
    width = next(iter(pictures.values())).shape[1]
    tiles = [
        tile_images([[label_image(name, (width, CAPTION_PX))], [image]], 0)
        for name, image in pictures.items()
    ]
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % 3)
    return tile_images([tiles[i : i + 3] for i in range(0, len(tiles), 3)], 2)


def needs_lpips(variant: Variant) -> bool:
    return variant.changes.get("perceptual_weight", 0) > 0


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--labels", type=Path, help="folder of the true masks, one folder per camera")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, metavar="NAME",
                        help=", ".join(VARIANTS))  # fmt: skip
    parser.add_argument("--lpips-weights", default="", metavar="DIR", help="folder of `fourd.fetch lpips`")
    parser.add_argument("--marks", type=float, nargs="+", default=[60, 180], help="s of processor time")
    parser.add_argument("--num-filters", type=int, default=8)
    parser.add_argument("--crop", type=int, default=192)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args(argv)
    cli.set_num_threads(1)
    event = read_event(args.scene, args.labels)
    options = CompositionOptions(
        num_filters=(args.num_filters,) * 3,
        crop=args.crop,
        seed=args.seed,
        lpips_weights=args.lpips_weights,
    )
    names = args.variants or [
        name for name, variant in VARIANTS.items() if args.lpips_weights or not needs_lpips(variant)
    ]
    rows, pictures = measure_variants(event, names, options, args.marks)
    io.write_csv(args.output / "composition.csv", COLUMNS, rows)
    trained = average_views([row for row in rows if row["steps"]])
    plot_curves(args.output / "composition.png", trained, "variant", "default", "rms_error")
    for view, frames in event.heldout.items():
        shown = {"truth": frames[len(frames) // 2].images[data.TARGET, ..., :3]}
        shown |= {name: picture for (seen, name), picture in pictures.items() if seen == view}
        io.write_png(args.output / f"composition_{view}.png", draw_sheet(shown))


if __name__ == "__main__":
    main()
