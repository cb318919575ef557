"""How well colour corrections are recovered: `python -m benches.tone --output DIR [--data data/demo]`.

DATA is the demo event with true cameras (cameras.json, frames/CAM/000000.png). Gains of 0.7 to 1.4
and gammas of 0.8 to 1.25 per channel, with a drift of up to 10 % over the clip, are put on two of
three cameras, and what the stage finds is compared with what was done, in grey levels over levels
24 to 232: first relative to the reference that it chose, then the colours themselves are compared
between neighbouring cameras. Writes tone.csv.
"""

import argparse
import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from fourd.camera import tracks_from_dict
from fourd.frames.colour import LEVELS, CameraColour, match_colours
from fourd.frames.options import FramesOptions
from fourd.io import read_image, read_json, write_csv
from fourd.sfm import SceneCameras

COLUMNS = (
    "disturbed", "num_frames", "seed", "num_matches", "before_levels", "error", "max_error_levels",
    "identities", "seconds",
)  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class Disturbance:
    """Level v in 0..1 becomes gain(frame) * v ** gamma, per channel."""

    gain: np.ndarray
    gamma: np.ndarray
    drift: float
    num_frames: int

    def gain_at(self, frame: int) -> np.ndarray:
        return self.gain * np.exp(self.drift * (frame / max(1, self.num_frames - 1) - 0.5))

    def apply(self, image: np.ndarray, frame: int) -> np.ndarray:
        changed = 255 * self.gain_at(frame) * (image / 255.0) ** self.gamma
        return np.clip(np.rint(changed), 0, 255).astype(np.uint8)


def make_disturbance(index: int, seed: int | None, num_frames: int) -> Disturbance:
    """The same for the same camera and seed; None and every third camera get none."""
    if seed is None or index % 3 == 1:
        return Disturbance(np.ones(3), np.ones(3), 0.0, num_frames)
    rng = np.random.default_rng([seed, index])
    gain = np.exp(rng.uniform(np.log(0.7), np.log(1.4), 3))
    return Disturbance(gain, rng.uniform(0.8, 1.25, 3), rng.uniform(-0.1, 0.1), num_frames)


def load_scene(data: Path) -> SceneCameras:
    document = read_json(data / "cameras.json")
    tracks = tracks_from_dict(document["cameras"], str(data))
    return SceneCameras(
        fps=30.0,
        num_frames=max(len(track.cameras) for track in tracks.values()),
        inputs=tuple(tracks),
        heldout=(),
        tracks=tracks,
        origin=np.zeros(3),
        scale=1.0,
        up=np.array([0.0, 0.0, 1.0]),
        depth_range_from={},
    )


def errors_of(
    colour: CameraColour, own: Disturbance, reference: Disturbance, frames: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Levels by which the tables are wrong, and by which doing nothing would be, where nothing clipped."""
    wrong, before = [], []
    for index, frame in enumerate(frames):
        original = (LEVELS / 255 / own.gain_at(frame)[:, None]) ** (1 / own.gamma[:, None])
        wanted = 255 * reference.gain_at(frame)[:, None] * original ** reference.gamma[:, None]
        known = (original <= 1) & (wanted <= 255)
        found = colour.tables()[index][:, LEVELS.astype(int)] if colour.is_needed else np.tile(LEVELS, (3, 1))
        wrong.append((found - wanted)[known])
        before.append((LEVELS - wanted)[known])
    return np.concatenate(wrong), np.concatenate(before)


def measure(data: Path, scene: SceneCameras, seed: int | None, options: FramesOptions) -> dict:
    names = list(scene.inputs)
    by_camera = {n: make_disturbance(i, seed, scene.num_frames) for i, n in enumerate(names)}

    def read(name: str, frame: int) -> np.ndarray:
        return by_camera[name].apply(read_image(data / "frames" / name / f"{frame:06d}.png"), frame)

    start = time.process_time()
    frames, reference, colours = match_colours(scene, names, read, options)
    seconds = time.process_time() - start
    if reference is None:
        raise SystemExit("error: no reference was found")
    pairs = [
        errors_of(colours[n], by_camera[n], by_camera[reference], frames) for n in names if n != reference
    ]
    rms = [[float(np.sqrt((values**2).mean())) for values in pair] for pair in pairs]
    return {
        "disturbed": seed is not None,
        "num_frames": len(frames),
        "seed": -1 if seed is None else seed,
        "num_matches": sum(colour.num_matches for colour in colours.values()) // 2,
        "before_levels": float(np.mean([row[1] for row in rms])),
        "error": float(np.mean([row[0] for row in rms])),
        "max_error_levels": float(np.max([row[0] for row in rms])),
        "identities": sum(not colour.is_needed for colour in colours.values()),
        "seconds": seconds,
    }


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("data/demo"))
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--frames", type=int, nargs="+", default=[1, 2, 4, 8])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    args = parser.parse_args(argv)
    cv2.setNumThreads(1)
    scene = load_scene(args.data)
    rows = []
    for count in args.frames:
        options = FramesOptions(num_colour_frames=count)
        for seed in (None, *args.seeds):
            rows.append(measure(args.data, scene, seed, options))
            print(
                "  ".join(f"{k} {v:.2f}" if isinstance(v, float) else f"{k} {v}" for k, v in rows[-1].items())
            )
    write_csv(args.output / "tone.csv", COLUMNS, rows)


if __name__ == "__main__":
    main()
