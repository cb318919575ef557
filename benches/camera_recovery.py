"""Errors against CPU time of the recovery of cameras, on films and pictures with true cameras.

    python -m benches.camera_recovery --output DIR [--setting NAME ...] [--data NAME ...]

`demo` is data/demo/phones; `studio` and `fountain` are measured where that footage lies beside the
project, and skipped with a message where not. `fountain_shared` are the same stills with one lens for all.
Every setting differs from the default by the values in SETTINGS, or leaves out a step of SKIPPED.
Prints a table and writes camera_recovery.csv.
"""

import argparse
import contextlib
import json
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import pycolmap

from fourd import io
from fourd.camera import Camera
from fourd.film_cameras import FilmCamera
from fourd.sfm.compare import align_similarity
from fourd.sfm.recover import recover
from fourd.sfm.recover.films import Film, focal_guess_px
from fourd.sfm.recover.options import RecoverOptions
from fourd.video import VideoReader, probe_video

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED = REPOSITORY.parent / "shared" / "data"
FILMS = {
    "demo": (REPOSITORY / "data/demo/phones", REPOSITORY / "data/demo/truth/phones.json", ("cam03", "cam06")),
    "studio": (SHARED / "studio/inputs_phones", SHARED / "studio/truth/phones.json", ()),
}
FOUNTAIN = SHARED / "strecha_fountain" / "fountain-P11"
SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "keyframes_1": {"num_keyframes": 1},
    "keyframes_2": {"num_keyframes": 2},
    "keyframes_8": {"num_keyframes": 8},
    "features_500": {"max_features": 500},
    "features_1000": {"max_features": 1000},
    "features_2000": {"max_features": 2000},
    "landmarks_100": {"max_landmarks": 100},
    "landmarks_200": {"max_landmarks": 200},
    "landmarks_600": {"max_landmarks": 600},
    "patch_5": {"patch_radius_px": 5},
    "patch_10": {"patch_radius_px": 10},
    "score_0.75": {"min_patch_score": 0.75},
    "score_0.92": {"min_patch_score": 0.92},
    "loss_0.1": {"loss_scale_px": 0.1},
    "loss_1": {"loss_scale_px": 1.0},
    "joint_30_frames": {"max_adjusted_frames": 30},
    "joint_100_frames": {"max_adjusted_frames": 100},
    "without_patches": {},
    "without_adjustment": {},
}
# What takes the place of a step of fourd.sfm.recover.recover: keyframes keep the detector's corners;
# the frames between keyframes keep the poses that they were tracked with.
SKIPPED = {
    "without_patches": ("observe", lambda model, *_: model),
    "without_adjustment": ("adjust_films", lambda model, options: model),
}
DATA_OPTIONS: dict[str, dict[str, Any]] = {"fountain_shared": {"shared_lens": True}}
COLUMNS = (
    "data",
    "setting",
    "role",
    "error",
    "rotation_median_deg",
    "rotation_p95_deg",
    "center_median_percent",
    "center_p95_percent",
    "focal_max_percent",
    "num_frames",
    "num_points",
    "seconds",
)
DATA = (*FILMS, "fountain", *DATA_OPTIONS)
TrueCameras = Mapping[str, Sequence[Camera]]


class VideoSource:
    """A video as a source of pictures."""

    def __init__(self, path: Path) -> None:
        info = probe_video(path)
        self.size, self.pts_s = info.size, info.pts_s - info.pts_s[0]
        self._reader = VideoReader(path, info)

    def read(self, source_frame: int) -> np.ndarray:
        return self._reader.read(source_frame)

    def close(self) -> None:
        self._reader.close()


class StillSource:
    """One picture as a source."""

    def __init__(self, path: Path) -> None:
        self._image = io.read_image(path)
        self.size = (self._image.shape[1], self._image.shape[0])
        self.pts_s = np.zeros(1)

    def read(self, source_frame: int) -> np.ndarray:
        return self._image


def film_from(name: str, source: VideoSource | StillSource) -> Film:
    return Film(name, source, np.arange(len(source.pts_s)), focal_guess_px(source.size, None))


@contextlib.contextmanager
def open_films(data: str) -> Iterator[tuple[dict[str, Film], TrueCameras, tuple[str, ...]]]:
    """Films, their true cameras and the names of the held-out ones."""
    folder, truth_path, heldout = FILMS[data]
    phones = json.loads(truth_path.read_text())["phones"]
    with contextlib.ExitStack() as stack:
        films, truth = {}, {}
        for name in sorted(phones):
            source = VideoSource(folder / f"{name}.mp4")
            stack.callback(source.close)
            films[name] = film_from(name, source)
            truth[name] = [
                Camera(np.array(f["K"]), np.array(f["R"]), np.array(f["t"]), source.size)
                for f in phones[name]["frames"]
            ]
        yield films, truth, heldout


def read_fountain() -> tuple[dict[str, Film], TrueCameras, tuple[str, ...]]:
    """Eleven stills, each a camera of its own. The truth states K for pictures of twice the size."""
    films, truth = {}, {}
    for path in sorted((FOUNTAIN / "images").glob("*.jpg")):
        rows = (FOUNTAIN / "gt_dense_cameras" / f"{path.name}.camera").read_text().split("\n")
        numbers = [np.array(row.split(), dtype=np.float64) for row in rows if row.strip()]
        world_from_cam = np.stack(numbers[4:7])
        films[path.stem] = film_from(path.stem, StillSource(path))
        size = tuple(int(n) for n in numbers[8])
        R = world_from_cam.T
        camera = Camera(np.stack(numbers[:3]), R, -R @ numbers[7], (size[0], size[1]))
        truth[path.stem] = [camera.resized(films[path.stem].size)]
    return films, truth, ()


def cameras_of(film: FilmCamera, num_frames: int) -> list[Camera]:
    """One camera per frame of the film. Raises ValueError where one is missing."""
    cameras = [film.at(frame) for frame in range(num_frames)] if film.status == "ok" else [None]
    if any(camera is None for camera in cameras):
        raise ValueError(f"{film.name}: {film.status}, or a frame without a pose")
    return [camera for camera in cameras if camera is not None]


def measure(
    data: str,
    setting: str,
    films: dict[str, Film],
    truth: TrueCameras,
    heldout: tuple[str, ...],
) -> list[dict[str, Any]]:
    """Rows for the input cameras and, aligned by the same similarity, for the held-out ones."""
    options = RecoverOptions(**SETTINGS[setting], **DATA_OPTIONS.get(data, {}))
    with contextlib.ExitStack() as stack:
        if setting in SKIPPED:
            stack.enter_context(mock.patch.object(recover, *SKIPPED[setting]))
        start = time.process_time()
        found = recover.recover_cameras(films, heldout, None, options)
        seconds = time.process_time() - start
    names = [name for name in films if name not in heldout] + list(heldout)
    estimated = {name: cameras_of(found.cameras[name], len(truth[name])) for name in names}
    errors = align_similarity(
        [c for name in names for c in estimated[name]], [c for name in names for c in truth[name]]
    )
    is_heldout = np.array([name in heldout for name in names for _ in truth[name]])
    unit = errors.distance if data in FILMS else errors.extent
    center = 100 * errors.center / unit
    rows = []
    for role, chosen in (("input", ~is_heldout), ("heldout", is_heldout)):
        if chosen.any():
            rotation = errors.rotation_deg[chosen]
            rows.append(
                {
                    "data": data,
                    "setting": setting,
                    "role": role,
                    "error": np.median(center[chosen]),
                    "rotation_median_deg": np.median(rotation),
                    "rotation_p95_deg": np.percentile(rotation, 95),
                    "center_median_percent": np.median(center[chosen]),
                    "center_p95_percent": np.percentile(center[chosen], 95),
                    "focal_max_percent": 100 * np.abs(errors.focal[chosen]).max(),
                    "num_frames": int(chosen.sum()),
                    "num_points": len(found.points),
                    "seconds": seconds,
                }
            )
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--setting", nargs="*", default=list(SETTINGS), choices=list(SETTINGS))
    parser.add_argument("--data", nargs="*", default=list(DATA), choices=list(DATA))
    args = parser.parse_args(argv)
    cv2.setNumThreads(1)
    pycolmap.logging.minloglevel = 3
    rows: list[dict[str, Any]] = []
    for data in args.data:
        is_there = FILMS[data][1].is_file() if data in FILMS else FOUNTAIN.is_dir()
        if not is_there:
            print(f"{data}: skipped, its files are not on this machine", file=sys.stderr)
            continue
        for setting in args.setting:
            try:
                if data in FILMS:
                    with open_films(data) as opened:
                        found = measure(data, setting, *opened)
                else:
                    found = measure(data, setting, *read_fountain())
            except ValueError as error:
                print(f"{data} {setting}: {error}", file=sys.stderr)
                continue
            rows += found
            for row in found:
                print(
                    "  ".join(f"{v:.4f}" if isinstance(v, float) else str(v) for v in row.values()),
                    flush=True,
                )
            io.write_csv(args.output / "camera_recovery.csv", COLUMNS, rows)


if __name__ == "__main__":
    main()
