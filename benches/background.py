"""Static background against truth: error against every setting, time, and movers that stand still.

    python -m benches.background --scene results/SCENE --truth DIR --output DIR [--first-frame N]

The scene is a finished run with true cameras and held-out views; --first-frame is the frame of the truth
that is its frame 0. DIR holds depth/VIEW/FFFFFF.npz (`z`, metres), labels/VIEW/FFFFFF.png (0 = static) and
pictures in heldout/VIEW or ../frames/VIEW. Scored are static pixels inside the hull: those whose true
point at least two input cameras have in their picture.

A mover that stands still is made by sampling one frame several times: what it hides then is hidden for
that share of the clip. Writes background_error.csv, background_still.csv, background_pareto.png (RMS error
over all views against processor seconds a pose) and pictures.
"""

import argparse
import dataclasses
import functools
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benches.pareto import plot_front
from fourd import io
from fourd.background.__main__ import read_samples
from fourd.background.estimate import Samples, estimate_backgrounds
from fourd.background.options import BackgroundOptions
from fourd.camera import Camera
from fourd.fuse.files import DisparityFiles, Pictures, Progress
from fourd.fuse.options import FuseOptions
from fourd.metrics import psnr_from_mse, squared_error
from fourd.sfm.cameras import SceneCameras, read_cameras
from fourd.views import spread

NUM_STILL = 7
COLUMNS = (
    "view", "frame", "setting", "value", "error", "covered", "filled", "within_1_percent",
    "within_3_percent", "too_far", "too_near", "right_db", "seconds", "cpu_seconds", "peak_rss_mb",
)  # fmt: skip
STILL_COLUMNS = ("view", "frame", "hidden_share", "num_pixels", "ghosts", "error")
SWEEP: Mapping[str, Sequence[Any]] = {
    "num_samples": (1, 2, 3, 4, 5, 6, 7),
    "persistence": (0.5, 0.65, 0.9, 1.0),
    "fill_px": (0, 5, 20, 40),
}


@dataclasses.dataclass(frozen=True, eq=False)
class Truth:
    """What a held-out camera saw. depth: (H, W) world units, infinite in the sky.

    region: (H, W) bool, static and inside the hull
    """

    view: str
    frame: int
    target: Camera
    rgb: np.ndarray
    depth: np.ndarray
    region: np.ndarray


def find_folder(parents: Sequence[Path], name: str) -> Path:
    for parent in parents:
        for path in parent.iterdir() if parent.is_dir() else ():
            if path.name.lower() == name.lower():
                return path
    raise SystemExit(f"expected a folder {name} below {', '.join(map(str, parents))}, found none")


def read_truth(scene: SceneCameras, scale: float, view: str, folder: Path, first_frame: int) -> list[Truth]:
    """All frames of a view whose true depth is known."""
    pictures = find_folder([folder / "heldout", folder.parent / "frames"], view)
    labels = find_folder([folder / "labels"], view)
    found = []
    for path in sorted(find_folder([folder / "depth"], view).glob("*.npz")):
        frame = int(path.stem) - first_frame
        if not 0 <= frame < scene.num_frames:
            continue
        depth = np.load(path)["z"].astype(np.float64) / scale
        target = scene.tracks[view].at(frame).without_distortion()
        static = cv2.imread(str(labels / f"{path.stem}.png"), cv2.IMREAD_UNCHANGED) == 0
        region = static & is_inside(target, depth, [scene.tracks[n].at(frame) for n in scene.inputs])
        rgb = io.read_image(pictures / f"{path.stem}.png")
        found.append(Truth(view, frame, target, rgb, depth, region))
    return found


def is_inside(target: Camera, depth: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """(H, W) bool: at least two cameras have the true point in their picture."""
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]].astype(np.float64)
    far = 1e6 * np.nanmax(depth[np.isfinite(depth)])
    points = target.unproject(np.stack([x, y], -1), np.where(np.isfinite(depth), depth, far))
    count = np.zeros(depth.shape, int)
    for camera in cameras:
        pixels, _ = camera.project(points)
        with np.errstate(invalid="ignore"):
            count += ((pixels >= -0.5) & (pixels <= np.array(camera.size) - 0.5)).all(axis=-1)
    return count >= 2


def score(truth: Truth, arrays: Mapping[str, np.ndarray], region: np.ndarray) -> dict[str, Any]:
    """Errors over a region. Depths are compared as inverse depths, relative; the sky by its angle."""
    known = arrays["farthest_valid"] & region
    scale = np.where(np.isfinite(truth.depth), truth.depth, np.median(truth.depth))
    true_inverse = np.where(np.isfinite(truth.depth), 1 / truth.depth, 0)
    difference = ((1 / arrays["depth"] - true_inverse) * scale)[known]
    squared = squared_error(arrays["farthest_rgb"], truth.rgb)[known]
    right = np.abs(difference) < 0.03
    return {
        "error": f"{psnr_from_mse(float(squared.mean())):.2f}",
        "covered": f"{known.sum() / region.sum():.4f}",
        "filled": f"{(arrays['filled'] & region).sum() / region.sum():.4f}",
        "within_1_percent": f"{(np.abs(difference) < 0.01).mean():.4f}",
        "within_3_percent": f"{right.mean():.4f}",
        "too_far": f"{(difference < -0.1).mean():.4f}",
        "too_near": f"{(difference > 0.1).mean():.4f}",
        "right_db": f"{psnr_from_mse(float(squared[right].mean())):.2f}",
    }


def save_sheet(path: Path, truth: Truth, arrays: Mapping[str, np.ndarray]) -> None:
    """Truth, background, error outside movers, depth error (red too near, blue too far, black unknown)."""
    known = arrays["farthest_valid"]
    error = np.abs(arrays["farthest_rgb"].astype(int) - truth.rgb).max(axis=-1).clip(0, 85) * 3
    true_inverse = np.where(np.isfinite(truth.depth), 1 / truth.depth, 0)
    scale = np.where(np.isfinite(truth.depth), truth.depth, np.median(truth.depth))
    near = np.clip((np.where(known, 1 / arrays["depth"], 0) - true_inverse) * scale * 5, -1, 1)
    colours = np.stack([1 - np.clip(-near, 0, 1), 1 - np.abs(near), 1 - np.clip(near, 0, 1)], axis=-1)
    picture = np.repeat(np.where(truth.region, error, 0)[..., None], 3, axis=-1)
    below = np.concatenate([picture, 255 * colours * known[..., None]], axis=1)
    above = np.concatenate([truth.rgb, arrays["farthest_rgb"]], axis=1)
    io.write_png(path, np.concatenate([above, below]).astype(np.uint8))


def estimate(
    truths: Sequence[Truth], samples: Samples, options: BackgroundOptions, memory_mb: int = 512
) -> tuple[list[dict[str, np.ndarray]], dict[str, str]]:
    """Backgrounds of all true frames of a view, and the cost of one."""
    start, cpu_start = time.monotonic(), time.process_time()
    targets = [truth.target for truth in truths]
    progress = Progress("image", len(targets) * len(samples.frames), time.monotonic)
    found = estimate_backgrounds(targets, samples, FuseOptions(memory_mb=memory_mb), options, progress)
    cost = {
        "seconds": f"{(time.monotonic() - start) / len(truths):.3f}",
        "cpu_seconds": f"{(time.process_time() - cpu_start) / len(truths):.3f}",
        "peak_rss_mb": f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f}",
    }
    return found, cost


def measure_settings(
    truths: Sequence[Truth],
    samples_of: Callable[[int], Samples],
    output: Path,
    sweep: Mapping[str, Sequence[Any]],
) -> list[dict[str, Any]]:
    default = BackgroundOptions()
    settings: list[tuple[str, Any]] = [("default", "")]
    settings += [(key, value) for key, values in sweep.items() for value in values]
    rows = []
    for key, value in settings:
        options = default if key == "default" else dataclasses.replace(default, **{key: value})
        found, cost = estimate(truths, samples_of(options.num_samples), options)
        for truth, arrays in zip(truths, found, strict=True):
            row = {"view": truth.view, "frame": truth.frame, "setting": key, "value": value}
            rows.append(row | score(truth, arrays, truth.region) | cost)
            print(rows[-1], flush=True)
            if key == "default":
                save_sheet(output / f"background_{truth.view}_{truth.frame:06d}.png", truth, arrays)
    return rows


def average_settings(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row per setting: RMS error in grey levels and processor seconds a pose, over all frames."""
    settings: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        settings.setdefault(f"{row['setting']} {row['value']}".strip(), []).append(row)
    return [
        {
            "name": name,
            "rms_error": 255 * np.sqrt(np.mean([10 ** (-float(row["error"]) / 10) for row in found])),
            "cpu_seconds": np.mean([float(row["cpu_seconds"]) for row in found]),
        }
        for name, found in settings.items()
    ]


def measure_still(truths: Sequence[Truth], samples: Samples, labels: Path) -> list[dict[str, Any]]:
    """Ghosts where a mover of the middle sample hides the background for a growing share of the clip."""
    middle = len(samples.frames) // 2
    hidden = cv2.imread(str(labels / f"{samples.frames[middle]:06d}.png"), cv2.IMREAD_UNCHANGED) != 0
    inside = cv2.erode(hidden.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    rows = []
    for repeats in range(1, NUM_STILL + 1):
        others = [i for i in range(len(samples.frames)) if i != middle]
        order = sorted([middle] * repeats + spread(others, NUM_STILL - repeats) * (repeats < NUM_STILL))
        repeated = dataclasses.replace(
            samples,
            frames=tuple(samples.frames[i] for i in order),
            cameras=tuple(samples.cameras[i] for i in order),
        )
        found, _ = estimate(truths, repeated, BackgroundOptions())
        for truth, arrays in zip(truths, found, strict=True):
            region = truth.region & inside
            if region.sum() < 100:
                continue
            errors = score(truth, arrays, region)
            rows.append(
                {
                    "view": truth.view, "frame": truth.frame, "hidden_share": f"{repeats / len(order):.2f}",
                    "num_pixels": int(region.sum()), "ghosts": errors["too_near"], "error": errors["error"],
                }
            )  # fmt: skip
            print(rows[-1], flush=True)
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--first-frame", type=int, default=0)
    parser.add_argument("--default-only", action="store_true", help="no sweep")
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args(argv)
    cv2.setNumThreads(1)
    scene = read_cameras(args.scene / "sfm" / "cameras.json")
    scale = io.read_json(args.scene / "sfm" / "cameras.json")["world"]["scale"]
    rows, still = [], []
    for view in scene.heldout:
        disparities = DisparityFiles(sorted((args.scene / "disparity").glob("*/samples.npz")), view)
        films = [str(args.scene / "frames" / "cameras" / f"{name}.npz") for name in scene.inputs]
        pictures = Pictures(films, scene, view)
        samples_of = functools.partial(read_samples, disparities, pictures, scene)
        truths = read_truth(scene, scale, view, args.truth, args.first_frame)
        estimate(truths[:1], samples_of(1), BackgroundOptions())
        rows += measure_settings(truths, samples_of, args.output, {} if args.default_only else SWEEP)
        if not args.default_only:
            labels = find_folder([args.truth / "labels"], view)
            still += measure_still(truths, samples_of(NUM_STILL), labels)
    io.write_csv(args.output / "background_error.csv", COLUMNS, rows)
    averages = average_settings(rows)
    plot_front(args.output / "background_pareto.png", averages, "name", "default", error="rms_error")
    io.write_csv(args.output / "background_still.csv", STILL_COLUMNS, still)


if __name__ == "__main__":
    main()
