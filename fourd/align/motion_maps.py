"""Where a film moves, without tracks: one small map per frame, the camera's own motion taken out.

A pixel moves if it differs from a picture shortly before and from one as long after, both turned to the
frame's own view. The smaller of both differences counts: uncovered background differs from only one of them,
and the map is that of the frame's own time, not of a time between two frames.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from fourd.align.moving_tracks import Pictures
from fourd.camera import Camera
from fourd.errors import explain_faults
from fourd.film_cameras import FilmCamera
from fourd.io import Archive, ArchiveWriter

# Differences are taken in pictures of this width, and kept in maps of a part of it.
WORK_PX, SHRINK = 240, 2
BLUR_PX = 0.8
# Time between the pictures that are compared, as near as whole frames come to it, s. A camera that stands
# still can wait for slow motion; for one that is held the parallax grows.
HELD_GAP_S, STATIC_GAP_S = 1 / 30, 1 / 8
# What the path of a hand-held camera displaces by parallax between two frames, px of the working picture.
PARALLAX_PX = 0.3
# Differences are counted in multiples of noise and parallax, from 1 (nothing) to 3 (moves for sure).
NOISE_SIGMAS, FULL_MOTION = 2.0, 2.0
MIN_NOISE = 0.5
MIN_FRAMES = 8
# Share of the picture, in the mean over all frames, that must move.
MIN_SHARE = 1e-5


@dataclasses.dataclass(frozen=True, eq=False)
class MotionMaps:
    """How much each place of a film moves.

    own_s: (F,) float64 times on the camera's own clock;  maps: (F, h, w) uint8, 255 moves for sure
    cameras: F cameras of the maps' size;  status: `ok`, or the reason why there is nothing (F = 0)
    """

    name: str
    status: str
    own_s: np.ndarray
    maps: np.ndarray
    cameras: tuple[Camera, ...]


def map_motion(reader: Pictures, film: FilmCamera) -> MotionMaps:
    """Motion maps of all frames whose camera, and that of the frames around it, is known.

    A film without cameras, of too few frames, or in which nothing moves gives no maps and a reason.
    """
    if film.status != "ok":
        return no_maps(film.name, f"its cameras are not known: {film.status}")
    frames = np.arange(len(reader.pts_s)) if film.is_static else film.source_frames
    if len(frames) < MIN_FRAMES:
        return no_maps(film.name, f"{len(frames)} frames with a known camera are too few to see motion")
    size = _scaled(film.size, WORK_PX)
    gap_s, parallax_px = (STATIC_GAP_S, 0.0) if film.is_static else (HELD_GAP_S, PARALLAX_PX)
    gap = max(1, round(gap_s / float(np.median(np.diff(reader.pts_s)))))
    known = set(frames.tolist())
    kept, maps = [], []
    noise = None
    pictures: dict[int, tuple[np.ndarray, Camera]] = {}
    for frame in frames.tolist():
        around = (frame - gap, frame, frame + gap)
        if not known.issuperset(around):
            continue
        window = [i for i in range(frame - gap, frame + gap + 1) if i in known]
        pictures = {i: pictures.get(i) or _small_picture(reader, film, i, size) for i in window}
        differences = [_difference(pictures[frame], pictures[i]) for i in (around[0], around[2])]
        if noise is None:
            noise = 1.4826 * float(np.median(differences[0])) + MIN_NOISE
        maps.append(_motion(pictures[frame][0], np.minimum(*differences), noise, parallax_px))
        kept.append(frame)
    if not maps or np.mean(maps) < MIN_SHARE * 255:
        return no_maps(film.name, "nothing in it moves by itself, as far as can be seen")
    small = _scaled(size, max(size) // SHRINK)
    # One object for a camera that stands still: what depends on it is computed once.
    resized = {id(c): c.resized(small) for c in (_camera(film, frame) for frame in kept)}
    cameras = tuple(resized[id(_camera(film, frame))] for frame in kept)
    return MotionMaps(film.name, "ok", np.asarray(reader.pts_s)[kept], np.stack(maps), cameras)


def no_maps(name: str, status: str) -> MotionMaps:
    """A film that says nothing, and why."""
    return MotionMaps(name, status, np.zeros(0), np.zeros((0, 1, 1), np.uint8), ())


def _scaled(size: tuple[int, int], longer: int) -> tuple[int, int]:
    scale = min(1.0, longer / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def _camera(film: FilmCamera, frame: int) -> Camera:
    camera = film.at(frame)
    assert camera is not None, "frames are those of the film's cameras"
    return camera


def _small_picture(
    reader: Pictures, film: FilmCamera, frame: int, size: tuple[int, int]
) -> tuple[np.ndarray, Camera]:
    """(h, w) float32 grey levels, a little blurred, and the camera that sees them."""
    grey = cv2.cvtColor(reader.read(frame), cv2.COLOR_RGB2GRAY)
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
    return cv2.GaussianBlur(small, (0, 0), BLUR_PX), _camera(film, frame).resized(size)


def _difference(here: tuple[np.ndarray, Camera], other: tuple[np.ndarray, Camera]) -> np.ndarray:
    """Absolute difference from another frame's picture, turned to this one's view; 0 outside it."""
    (picture, camera), (there, turned) = here, other
    homography = camera.K @ camera.R @ turned.R.T @ np.linalg.inv(turned.K)
    seen = cv2.warpPerspective(
        there, homography, camera.size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),
    )  # fmt: skip
    return np.nan_to_num(np.abs(picture - seen), nan=0.0)


def _motion(picture: np.ndarray, difference: np.ndarray, noise: float, parallax_px: float) -> np.ndarray:
    """(h, w) uint8 map of the part SHRINK of the size of the difference."""
    gradient = np.hypot(
        cv2.Sobel(picture, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(picture, cv2.CV_32F, 0, 1, scale=1 / 8)
    )
    excess = difference / (NOISE_SIGMAS * noise + parallax_px * gradient) - 1
    moves = np.clip(excess / FULL_MOTION, 0, 1).astype(np.float32)
    size = _scaled((picture.shape[1], picture.shape[0]), max(picture.shape) // SHRINK)
    return (255 * cv2.resize(moves, size, interpolation=cv2.INTER_AREA)).round().astype(np.uint8)


def write_motion_maps(path: Path | str, motion: MotionMaps) -> None:
    """Write motion maps, one frame at a time."""
    meta = {
        "name": motion.name,
        "status": motion.status,
        "size": list(motion.cameras[0].size) if motion.cameras else [1, 1],
    }
    with ArchiveWriter(path, meta) as writer:
        writer.add("own_s", motion.own_s)
        lenses = [(c.K, c.R, c.t, c.distortion) for c in motion.cameras]
        for key, values in zip(("K", "R", "t", "distortion"), zip(*lenses, strict=True), strict=False):
            writer.add(key, np.stack(values))
        for index, values in enumerate(motion.maps):
            writer.add_frame(index, motion=values)


def read_motion_maps(path: Path | str) -> MotionMaps:
    """Inverse of `write_motion_maps`. Raises InputError, naming the file."""
    with Archive(path) as archive, explain_faults(f"the motion maps of a film in {path}"):
        meta, own_s = archive.meta, archive["own_s"]
        if len(own_s) == 0:
            return no_maps(meta["name"], meta["status"])
        size = (int(meta["size"][0]), int(meta["size"][1]))
        lenses: Sequence[np.ndarray] = [archive[key] for key in ("K", "R", "t", "distortion")]
        cameras = tuple(
            Camera(K, R, t, size, distortion) for K, R, t, distortion in zip(*lenses, strict=True)
        )
        maps = np.stack([archive[f"{index:06d}/motion"] for index in range(len(own_s))])
        return MotionMaps(meta["name"], meta["status"], own_s, maps, cameras)
