"""Bodies fitted from other cameras against what a held-out camera shows of the person.

python -m benches.humans --footage data/pose2sim --models data/humans --output DIR
Each camera of the footage is held out in turn, with every pair and all of the others as inputs. Error:
median distance of the fitted body's landmarks, projected into the held-out picture, from those that the
network finds there, as a share of the person's extent in the picture: the network's own error is in it.
"""

import argparse
import itertools
import math
import resource
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fourd.baselines.humans import HumanModels, load_models
from fourd.baselines.humans.fit import fit_parameters, is_plausible
from fourd.baselines.humans.people import find_people
from fourd.baselines.humans.pose import Pose
from fourd.camera import Camera, tracks_from_dict
from fourd.image import undistort
from fourd.io import read_json, write_csv
from fourd.video.reader import read_video_frames

COLUMNS = ("heldout", "inputs", "frame", "error", "height", "seconds", "cpu_seconds", "peak_rss_mb")
WIDTH_PX = 360


def read_pictures(footage: Path, frame: int) -> dict[str, tuple[np.ndarray, Camera]]:
    """Undistorted pictures of one moment, 360 px wide, and their pinholes, by camera."""
    pictures = {}
    for name, track in tracks_from_dict(read_json(footage / "cameras.json")["cameras"], str(footage)).items():
        camera = track.at(0)
        size = (WIDTH_PX, round(WIDTH_PX * camera.size[1] / camera.size[0]))
        target = camera.without_distortion().resized(size)
        _, image = next(iter(read_video_frames(footage / f"{name}.mp4", [frame])))
        pictures[name] = (undistort(image, camera, target)[0], target)
    return pictures


def measure_frame(
    models: HumanModels, pictures: dict[str, tuple[np.ndarray, Camera]], frame: int
) -> list[dict[str, Any]]:
    """A row per held-out camera and set of inputs."""
    start = time.process_time()
    poses = {name: models.network.find(image) for name, (image, _) in pictures.items()}
    find_s = (time.process_time() - start) / len(pictures)
    rows = []
    for heldout in pictures:
        others = [name for name in pictures if name != heldout]
        for inputs in (*itertools.combinations(others, 2), tuple(others)):
            begin, cpu = time.perf_counter(), time.process_time()
            marks, height = fit_first(models, poses, {name: pictures[name][1] for name in inputs})
            seconds, cpu_seconds = time.perf_counter() - begin, time.process_time() - cpu
            rows.append(
                {
                    "heldout": heldout,
                    "inputs": len(inputs),
                    "frame": frame,
                    "error": miss_of(marks, poses[heldout], pictures[heldout][1], models.body.landmarks),
                    "height": height,
                    "seconds": seconds + len(inputs) * find_s,
                    "cpu_seconds": cpu_seconds + len(inputs) * find_s,
                    "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
                }
            )
    return rows


def fit_first(
    models: HumanModels, poses: dict[str, list[Pose]], cameras: dict[str, Camera]
) -> tuple[np.ndarray | None, float]:
    """Landmarks and height, world units, of the person that most inputs share; None if none is fitted."""
    people = find_people({name: poses[name] for name in cameras}, cameras)
    if not people:
        return None, math.nan
    fit = fit_parameters(models.body, people[0])
    if not is_plausible(models.body, people[0], fit, fit):
        return None, math.nan
    return models.body.place_marks(fit[None])[0], float(np.ptp(models.body.vertices[:, 1]) * np.exp(fit[6]))


def miss_of(marks: np.ndarray | None, found: list[Pose], camera: Camera, landmarks: np.ndarray) -> float:
    """Median distance from the nearest person of a picture, as a share of its extent; NaN without either."""
    if marks is None or not found:
        return math.nan
    pixels = camera.project(marks)[0]
    return min(
        float(np.median(np.linalg.norm(pixels - pose.pixels[landmarks], axis=1))) / pose.extent_px
        for pose in found
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--footage", type=Path, default=Path("data/pose2sim"))
    parser.add_argument("--models", type=Path, default=Path("data/humans"))
    parser.add_argument("--frames", type=int, nargs="+", default=[10, 30, 50, 70, 90])
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args()
    cv2.setNumThreads(1)
    models, rows = load_models(str(args.models)), []
    for frame in args.frames:
        rows += measure_frame(models, read_pictures(args.footage, frame), frame)
    write_csv(args.output / "humans.csv", COLUMNS, rows)
    for count in sorted({row["inputs"] for row in rows}):
        own = [row for row in rows if row["inputs"] == count]
        errors = [row["error"] for row in own if math.isfinite(row["error"])]
        heights = [row["height"] for row in own if math.isfinite(row["error"])]
        print(
            f"{count} inputs: fitted {len(errors)} of {len(own)}, median error {np.median(errors):.1%}, "
            f"90 % {np.quantile(errors, 0.9):.1%}, height {np.mean(heights):.2f} +- {np.std(heights):.2f}"
        )


if __name__ == "__main__":
    main()
