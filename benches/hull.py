"""Depth from silhouettes against truth, and against the settings of the hull.

    python -m benches.hull --data DIR --output DIR [--stereo DIR]

DATA is the output of `python -m fourd.demo`, or an event laid out like it: cameras.json, frames/CAM/,
truth/depth/CAM/FRAME.npz and truth/labels/CAM/FRAME.png. Silhouettes are the true ones, so that the rows
show the hull alone; targets are the held-out cameras. STEREO holds foreground/CAM/*.npz of a run, whose
consensus is measured on the same pixels. Writes hull.csv; `error` is the share of covered dynamic pixels
whose depth is off by more than 1 %.
"""

import argparse
import dataclasses
import resource
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fourd import io
from fourd.camera import CameraTrack, tracks_from_dict
from fourd.fuse.hull import HullOptions, carve_view

SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "front": {},
    "half the cameras": {},
    "min_silhouettes 2": {"min_silhouettes": 2},
    "min_silhouettes 4": {"min_silhouettes": 4},
    "max_dissent 1": {"max_dissent": 1},
    "max_angle 30": {"max_angle_deg": 30.0},
    "max_angle 70": {"max_angle_deg": 70.0},
    "rough": {"small_penalty": 0.1, "large_penalty": 0.8},
    "smooth": {"small_penalty": 0.4, "large_penalty": 5.0},
    "behind_cost 0": {"behind_cost": 0.0},
    "behind_cost 2": {"behind_cost": 2.0},
    "behind_cost 10": {"behind_cost": 10.0},
}
COLUMNS = (
    "setting", "error", "covered", "excess", "within_1_percent", "within_2_percent", "within_5_percent",
    "sigma_ratio", "seconds", "cpu_seconds", "peak_rss_mb",
)  # fmt: skip
DEPTH_RANGE = (1.5, 40.0)


@dataclasses.dataclass(frozen=True)
class Event:
    """An event with truth on disk."""

    data: Path
    tracks: dict[str, CameraTrack]
    heldout: tuple[str, ...]

    def image(self, name: str, frame: int) -> np.ndarray:
        return io.read_image(self.data / "frames" / name / f"{frame:06d}.png")

    def moves(self, name: str, frame: int) -> np.ndarray:
        return io.read_image(self.data / "truth" / "labels" / name / f"{frame:06d}.png")[..., 0] > 0

    def depth(self, name: str, frame: int) -> np.ndarray:
        archive = np.load(self.data / "truth" / "depth" / name / f"{frame:06d}.npz")
        key = next(key for key in archive.files if key != "meta")
        return archive[key].astype(np.float32)


def compare(depth: np.ndarray, truth: np.ndarray, moves: np.ndarray) -> dict[str, float]:
    """Shares of the dynamic pixels, and of depth where nothing moves (in units of what moves)."""
    known = np.isfinite(depth)
    error = np.abs(depth / truth - 1)[known & moves]
    return {
        "covered": (known & moves).sum() / moves.sum(),
        "excess": (known & ~moves).sum() / moves.sum(),
        "within_1_percent": (error < 0.01).mean(),
        "within_2_percent": (error < 0.02).mean(),
        "within_5_percent": (error < 0.05).mean(),
    }


def measure_hull(event: Event, target: str, frame: int, setting: str) -> dict[str, float]:
    names = [name for name in event.tracks if name not in event.heldout]
    if setting == "half the cameras":
        names = names[::2]
    cameras = {name: event.tracks[name].at(frame) for name in names}
    masks = {name: event.moves(name, frame).astype(np.uint8) * np.uint8(255) for name in names}
    images = {} if setting == "front" else {name: event.image(name, frame) for name in names}
    camera = event.tracks[target].at(frame).without_distortion()
    truth, moves = event.depth(target, frame), event.moves(target, frame)
    start, cpu_start = time.monotonic(), time.process_time()
    hull = carve_view(camera, cameras, masks, images, None, DEPTH_RANGE, HullOptions(**SETTINGS[setting]))
    seconds, cpu_seconds = time.monotonic() - start, time.process_time() - cpu_start
    both = np.isfinite(hull.depth) & moves
    off = np.abs(1 / hull.depth - 1 / truth)[both] / hull.sigma[both]
    # The median of a normal distribution's absolute value is 0.6745 sigma.
    ratio = float(np.median(off)) / 0.6745
    return compare(hull.depth, truth, moves) | {
        "sigma_ratio": ratio, "seconds": seconds, "cpu_seconds": cpu_seconds
    }  # fmt: skip


def measure_stereo(event: Event, run: Path, target: str, frame: int) -> dict[str, float]:
    for path in sorted((run / "foreground" / target).glob("*.npz")):
        archive = io.Archive(path)
        if frame in archive.frames():
            found = archive[f"{frame:06d}/depth"]
            return compare(found, event.depth(target, frame), event.moves(target, frame))
    raise SystemExit(f"error: no frame {frame} of {target} below {run / 'foreground'}")


def summarise(setting: str, rows: Sequence[dict[str, float]]) -> dict[str, Any]:
    means = {key: f"{np.mean([row[key] for row in rows]):.4f}" for key in rows[0]}
    wrong = 1 - np.mean([row["within_1_percent"] for row in rows])
    rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"setting": setting, "error": f"{wrong:.4f}", **means, "peak_rss_mb": f"{rss:.0f}"}


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--stereo", type=Path, help="results of a run, for the row `stereo`")
    parser.add_argument("--heldout", nargs="+", default=["cam02", "cam05"])
    parser.add_argument("--frames", type=int, nargs="+", default=[0, 15, 29])
    args = parser.parse_args(argv)
    cv2.setNumThreads(1)
    document = io.read_json(args.data / "cameras.json")
    tracks = tracks_from_dict(document["cameras"], str(args.data / "cameras.json"))
    event = Event(args.data, tracks, tuple(args.heldout))
    views = [(target, frame) for target in args.heldout for frame in args.frames]
    # Compiles.
    measure_hull(event, *views[0], "default")
    rows = []
    for setting in SETTINGS:
        rows.append(summarise(setting, [measure_hull(event, *view, setting) for view in views]))
        print(rows[-1], flush=True)
    if args.stereo is not None:
        rows.append(summarise("stereo", [measure_stereo(event, args.stereo, *view) for view in views]))
        print(rows[-1])
    io.write_csv(args.output / "hull.csv", COLUMNS, rows)


if __name__ == "__main__":
    main()
