"""What time compensation gains: `python -m benches.time_compensation --output DIR`.

The demo event is rendered at the very moments that are wanted: a picture, its neighbour one frame of
30 per second later (two for a whole frame), and the truth in between, seen from where the camera was
for the picture. Pixels that move are those of the figures and the ball in picture or truth, 3 px
around included; the rest holds what stands still, and shadows. Writes time_compensation.csv and
pictures (picture, truth, compensated, remaining error times 3).
"""

import argparse
import dataclasses
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from fourd.demo import DemoOptions, FrozenScene, camera_at
from fourd.flow import CompensationOptions, compensate_motion
from fourd.image import tile_images
from fourd.io import write_csv, write_png

FRAME_S = 1 / 30
SHARES = (0.1, 0.25, 0.5, 1.0)
VIEWS = (("cam01", 0.2), ("cam04", 0.55), ("cam07", 0.8))
WITHOUT = "uncompensated"
SETTINGS = {
    WITHOUT: {},
    "default": {},
    "min_motion_px 0.4": {"min_motion_px": 0.4},
    "min_motion_px 1": {"min_motion_px": 1.0},
    "min_motion_px 2": {"min_motion_px": 2.0},
    "max_flow_width_px 240": {"max_flow_width_px": 240},
    "max_flow_width_px 480": {"max_flow_width_px": 480},
    "max_flow_width_px 1920": {"max_flow_width_px": 1920},
}
COLUMNS = (
    "setting",
    "width",
    "dt_frames",
    "error",
    "moving_psnr_db",
    "rest_psnr_db",
    "changed_share",
    "seconds",
)


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """image, neighbour, truth: (H, W, 3) uint8;  moving: (H, W) bool;  times in seconds"""

    image: np.ndarray
    neighbour: np.ndarray
    truth: np.ndarray
    moving: np.ndarray
    dt_frames: float
    gap_s: float


def make_cases(options: DemoOptions) -> Iterator[Case]:
    for name, time_s in VIEWS:
        camera = camera_at(name, time_s, options)
        image, _, label = FrozenScene(time_s, options).render(camera)
        neighbours = [
            FrozenScene(time_s + n * FRAME_S, options).render(camera_at(name, time_s + n * FRAME_S, options))[
                0
            ]
            for n in (1, 2)
        ]
        for share in SHARES:
            truth, _, true_label = FrozenScene(time_s + share * FRAME_S, options).render(camera)
            labels = ((label > 0) | (true_label > 0)).astype(np.uint8)
            moving = cv2.dilate(labels, np.ones((7, 7), np.uint8)) > 0
            is_whole = share == 1
            gap_s = FRAME_S * (2 if is_whole else 1)
            yield Case(image, neighbours[is_whole], truth, moving, share, gap_s)


def psnr_db(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(1e-9, np.mean((a.astype(float) - b)[mask] ** 2))))


def compensate(case: Case, setting: str) -> tuple[np.ndarray, float]:
    """The picture under a setting and the CPU seconds it took."""
    if setting == WITHOUT:
        return case.image, 0.0
    options = CompensationOptions(**{"min_dt_s": 0.0, **SETTINGS[setting]})
    start = time.process_time()
    out = compensate_motion(case.image, case.neighbour, -case.dt_frames * FRAME_S, case.gap_s, options)
    return out, time.process_time() - start


def measure(cases: Sequence[Case], setting: str) -> Iterator[dict]:
    """Means over the views, one row per time error."""
    for share in SHARES:
        rows = []
        for case in (case for case in cases if case.dt_frames == share):
            out, seconds = compensate(case, setting)
            changed = (out != case.image).any(axis=2)
            rows.append(
                (
                    psnr_db(out, case.truth, case.moving),
                    psnr_db(out, case.truth, ~case.moving),
                    changed.mean(),
                    seconds,
                    np.abs(out.astype(float) - case.truth)[case.moving].mean(),
                )
            )
        moving, rest, changed, seconds, error = np.mean(rows, axis=0)
        yield {
            "setting": setting, "width": cases[0].image.shape[1], "dt_frames": share, "error": error,
            "moving_psnr_db": moving, "rest_psnr_db": rest, "changed_share": changed, "seconds": seconds,
        }  # fmt: skip


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--widths", type=int, nargs="+", default=[480, 1920])
    args = parser.parse_args(argv)
    cv2.setNumThreads(1)
    rows = []
    for width in args.widths:
        cases = list(make_cases(DemoOptions(width=width, height=width * 9 // 16)))
        for setting in SETTINGS:
            for row in measure(cases, setting):
                rows.append(row)
                print(
                    "  ".join(f"{k} {v:.3f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
                )
        for index, case in enumerate(cases):
            out, _ = compensate(case, "default")
            error = np.minimum(255, 3 * np.abs(case.truth.astype(int) - out)).astype(np.uint8)
            sheet = tile_images([[case.image, case.truth], [out, error]])
            write_png(args.output / f"{width}_{index:02d}_{case.dt_frames:g}.png", sheet)
    write_csv(args.output / "time_compensation.csv", COLUMNS, rows)


if __name__ == "__main__":
    main()
