"""What moves in one film: tracks of moving points with descriptors, given the camera of every frame.

The camera's own turning is taken out first; what then differs from the median over neighbouring times
moves. Points are found there, followed from frame to frame and kept if they leave their place.
"""

import dataclasses
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from fourd.align.vision_options import VisionOptions
from fourd.camera import Camera
from fourd.errors import explain_faults
from fourd.film_cameras import FilmCamera
from fourd.io import Archive, ArchiveWriter

# Motion is looked for in pictures of this width: movers are large, and noise averages out.
MAP_PX = 240
BLOCK_S = 1.0
# A median over this many pictures, this far around, shows what is behind a walking person.
MEDIAN_PICTURES, MEDIAN_SPAN_S = 15, 4.0
SEED_STEP = 2
MAX_SEEDS = 800
# Grey levels; shares of the local contrast, for what the camera's own path displaces.
NOISE_FLOOR, CONTRAST_SHARE = 3.0, 0.5
MAX_RETURN_PX = 0.4
NEW_SEED_PX, SAME_SEED_PX = 3.0, 1.5
# A tracked point moves if it leaves its place by this share of the picture's longer side.
MIN_TRAVEL = 0.0125
_FLOW = {"winSize": (13, 13), "maxLevel": 2}


class Pictures(Protocol):
    """What is needed of `fourd.ingest.SourceReader`."""

    pts_s: np.ndarray
    size: tuple[int, int]

    def read(self, source_frame: int) -> np.ndarray: ...


@dataclasses.dataclass(frozen=True, eq=False)
class MovingTracks:
    """Tracks of moving points in one film.

    track, frame: (N,) int64 of every observation, grouped by track, frames rising within it
    own_s: (N,) float64 its time on the camera's own clock;  pixels: (N, 2) float64 px
    descriptors: (D, 128) float32 of unit length;  descriptor_track: (D,) int64
    span_s: first and last time of the film's frames whose camera is known
    status: `ok`, or the reason why there is nothing
    """

    name: str
    status: str
    span_s: tuple[float, float]
    track: np.ndarray
    frame: np.ndarray
    own_s: np.ndarray
    pixels: np.ndarray
    descriptors: np.ndarray
    descriptor_track: np.ndarray

    @property
    def num_tracks(self) -> int:
        return int(self.track[-1]) + 1 if len(self.track) else 0


def no_tracks(name: str, status: str) -> MovingTracks:
    """A film that says nothing, and why."""
    empty = np.zeros(0, np.int64)
    return MovingTracks(
        name, status, (0.0, 0.0), empty, empty, np.zeros(0), np.zeros((0, 2)),
        np.zeros((0, 128), np.float32), empty,
    )  # fmt: skip


def track_motion(reader: Pictures, film: FilmCamera, options: VisionOptions) -> MovingTracks:
    """Track the moving points of a film over the frames whose camera is known.

    A film without cameras, of a single frame, or in which nothing moves gives an empty result with a
    status.
    """
    if film.status != "ok":
        return no_tracks(film.name, f"its cameras are not known: {film.status}")
    frames = np.arange(len(reader.pts_s)) if film.is_static else film.source_frames
    if len(frames) < options.min_track_frames:
        return no_tracks(film.name, f"{len(frames)} frames with a known camera are too few to see motion")
    tracker = _Tracker(film, options, min(1.0, options.work_px / max(film.size)))
    for block in _blocks(reader.pts_s, frames):
        still, reference = _median_picture(reader, film, block, frames)
        for frame in block:
            picture = cv2.cvtColor(reader.read(int(frame)), cv2.COLOR_RGB2GRAY)
            camera = _camera(film, int(frame))
            tracker.step(int(frame), picture, _moving_mask(picture, camera, still, reference))
    tracks = tracker.finish()
    if not tracks:
        return no_tracks(film.name, "nothing in it moves by itself, as far as can be seen")
    pts_s = np.asarray(reader.pts_s)
    span_s = float(pts_s[frames[0]]), float(pts_s[frames[-1]])
    return _join_tracks(film.name, tracks, tracker, pts_s, span_s, options)


def _camera(film: FilmCamera, frame: int) -> Camera:
    camera = film.at(frame)
    assert camera is not None, "frames are those of the film's cameras"
    return camera


def _blocks(pts_s: np.ndarray, frames: np.ndarray) -> list[np.ndarray]:
    """Consecutive frames in pieces of BLOCK_S."""
    number = np.floor((pts_s[frames] - pts_s[frames[0]]) / BLOCK_S).astype(int)
    return [frames[number == i] for i in np.unique(number)]


def _map_size(size: tuple[int, int]) -> tuple[int, int]:
    scale = min(1.0, MAP_PX / max(size))
    return max(1, round(size[0] * scale)), max(1, round(size[1] * scale))


def _turned(picture: np.ndarray, camera: Camera, to: Camera) -> np.ndarray:
    """A small grey picture as `to` would see it from the same place, NaN outside."""
    small = cv2.resize(picture, to.size, interpolation=cv2.INTER_AREA).astype(np.float32)
    homography = to.K @ to.R @ camera.R.T @ np.linalg.inv(camera.resized(to.size).K)
    return cv2.warpPerspective(
        small, homography, to.size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT,
        borderValue=float("nan"),
    )  # fmt: skip


def _median_picture(
    reader: Pictures, film: FilmCamera, block: np.ndarray, frames: np.ndarray
) -> tuple[np.ndarray, Camera]:
    """What stands still around a block of frames, and the small camera that sees it."""
    middle = int(block[len(block) // 2])
    reference = _camera(film, middle).resized(_map_size(film.size))
    near = frames[np.abs(reader.pts_s[frames] - reader.pts_s[middle]) <= MEDIAN_SPAN_S / 2]
    chosen = near[np.unique(np.linspace(0, len(near) - 1, MEDIAN_PICTURES).round().astype(int))]
    stack = []
    for frame in chosen:
        picture = cv2.cvtColor(reader.read(int(frame)), cv2.COLOR_RGB2GRAY)
        stack.append(_turned(picture, _camera(film, int(frame)), reference))
    pictures = np.stack(stack)
    known = np.isfinite(pictures).any(axis=0)
    pictures[:, ~known] = 0
    still = np.nanmedian(pictures, axis=0)
    still[~known] = np.nan
    return still.astype(np.float32), reference


def _moving_mask(picture: np.ndarray, camera: Camera, still: np.ndarray, reference: Camera) -> np.ndarray:
    """(H, W) uint8, 1 where the picture differs from what stands still."""
    difference = np.abs(_turned(picture, camera, reference) - still)
    known = np.isfinite(difference)
    noise = NOISE_FLOOR + 3 * float(np.median(difference[known])) if known.any() else 0.0
    filled = np.where(np.isfinite(still), still, 0).astype(np.float32)
    window = np.ones((5, 5), np.uint8)
    contrast = cv2.dilate(filled, window) - cv2.erode(filled, window)
    moves = np.where(known, np.clip((difference - CONTRAST_SHARE * contrast - noise) / 30, 0, 1), 0)
    moves = cv2.GaussianBlur(moves.astype(np.float32), (0, 0), 1.5)
    size = (picture.shape[1], picture.shape[0])
    back = camera.K @ camera.R @ reference.R.T @ np.linalg.inv(reference.K)
    grown = cv2.dilate((moves > 0.2).astype(np.uint8), np.ones((3, 3), np.uint8))
    return cv2.warpPerspective(grown, back, size, flags=cv2.INTER_NEAREST)


@dataclasses.dataclass
class _Track:
    frames: list[int]
    points: list[np.ndarray]
    descriptors: list[np.ndarray]


class _Tracker:
    """Follows points through the frames in order; positions are those of the full pictures."""

    def __init__(self, film: FilmCamera, options: VisionOptions, scale: float) -> None:
        self._film, self._options, self._scale = film, options, scale
        self._done: list[_Track] = []
        self._live: list[_Track] = []
        self._previous: np.ndarray | None = None
        self._steps = 0
        self._sift = cv2.SIFT.create(nfeatures=MAX_SEEDS, contrastThreshold=0.02, enable_precise_upscale=True)  # type: ignore[call-overload]

    def step(self, frame: int, picture: np.ndarray, mask: np.ndarray) -> None:
        """The next frame: (H, W) uint8 grey and where it moves."""
        if self._scale < 1:
            picture = cv2.resize(picture, None, fx=self._scale, fy=self._scale, interpolation=cv2.INTER_AREA)
            mask = cv2.resize(mask, picture.shape[::-1], interpolation=cv2.INTER_NEAREST)
        if self._previous is not None and self._live:
            self._follow(frame, picture, mask)
        if self._steps % SEED_STEP == 0:
            self._add_seeds(frame, picture, mask)
        self._previous, self._steps = picture, self._steps + 1

    def finish(self) -> list[_Track]:
        """All tracks that are long enough and move."""
        self._done += self._live
        self._live = []
        return [t for t in self._done if len(t.frames) >= self._options.min_track_frames and self._moves(t)]

    def _follow(self, frame: int, picture: np.ndarray, mask: np.ndarray) -> None:
        assert self._previous is not None
        before = np.array([t.points[-1] for t in self._live], np.float32)[:, None]
        after, found, _ = cv2.calcOpticalFlowPyrLK(self._previous, picture, before, None, **_FLOW)  # type: ignore[call-overload]
        back, returned, _ = cv2.calcOpticalFlowPyrLK(picture, self._previous, after, None, **_FLOW)  # type: ignore[call-overload]
        off = np.linalg.norm((back - before)[:, 0], axis=1)
        height, width = picture.shape
        column, row = np.floor(after[:, 0]).astype(int).T
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        moving = mask[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)] > 0
        good = (found.ravel() > 0) & (returned.ravel() > 0) & (off < MAX_RETURN_PX) & inside & moving
        kept = []
        for track, point, goes_on in zip(self._live, after[:, 0], good, strict=True):
            if goes_on:
                track.frames.append(frame)
                track.points.append(point.astype(np.float64))
                kept.append(track)
            else:
                self._done.append(track)
        self._live = kept

    def _add_seeds(self, frame: int, picture: np.ndarray, mask: np.ndarray) -> None:
        keypoints, descriptors = self._sift.detectAndCompute(picture, mask)
        if descriptors is None:
            return
        # The detector's order depends on its threads; the results must not.
        order = np.lexsort(np.array([(k.pt[1], k.pt[0], k.size, k.angle) for k in keypoints]).T)
        places = np.array([keypoints[i].pt for i in order])
        tracks = list(self._live)
        at = np.array([t.points[-1] for t in tracks]).reshape(-1, 2)
        for i, place in zip(order, places, strict=True):
            distance = np.linalg.norm(at - place, axis=1)
            nearest = int(distance.argmin()) if len(distance) else -1
            if nearest >= 0 and distance[nearest] < SAME_SEED_PX:
                tracks[nearest].descriptors.append(descriptors[i])
            elif nearest < 0 or distance[nearest] > NEW_SEED_PX:
                tracks.append(_Track([frame], [place], [descriptors[i]]))
                at = np.vstack([at, place])
        self._live = tracks

    def _moves(self, track: _Track) -> bool:
        """Whether the point leaves its place once the camera's turning is taken out."""
        first = _camera(self._film, track.frames[0])
        places = []
        for frame, point in zip(track.frames, np.array(track.points), strict=True):
            camera = _camera(self._film, frame)
            ray = camera.rays(self._to_full(point)) @ camera.R @ first.R.T
            places.append(ray[:2] / ray[2])
        travel = np.ptp(np.array(places), axis=0).max() * first.focal_px
        return bool(travel > MIN_TRAVEL * max(self._film.size))

    def _to_full(self, points: np.ndarray) -> np.ndarray:
        return (points + 0.5) / self._scale - 0.5

    def positions(self, track: _Track) -> np.ndarray:
        """(n, 2) px in the full picture."""
        return self._to_full(np.array(track.points))


def _join_tracks(
    name: str,
    tracks: list[_Track],
    tracker: _Tracker,
    pts_s: np.ndarray,
    span_s: tuple[float, float],
    options: VisionOptions,
) -> MovingTracks:
    frame = np.concatenate([t.frames for t in tracks])
    # Descriptors of one track from different times tell it from different sides; few are enough.
    share = max(1, options.max_descriptors // len(tracks))
    chosen = [
        [
            t.descriptors[i]
            for i in np.unique(np.linspace(0, len(t.descriptors) - 1, share).round().astype(int))
        ]
        for t in tracks
    ]
    raw = np.concatenate([np.stack(c) for c in chosen]).astype(np.float32)
    # Square roots of shares compare histograms as Hellinger does (Arandjelovic and Zisserman 2012).
    descriptors = np.sqrt(raw / np.maximum(raw.sum(axis=1, keepdims=True), 1))
    return MovingTracks(
        name=name,
        status="ok",
        span_s=span_s,
        track=np.repeat(np.arange(len(tracks)), [len(t.frames) for t in tracks]),
        frame=frame.astype(np.int64),
        own_s=pts_s[frame],
        pixels=np.concatenate([tracker.positions(t) for t in tracks]),
        descriptors=descriptors,
        descriptor_track=np.repeat(np.arange(len(tracks)), [len(c) for c in chosen]),
    )


_ARRAYS = ("track", "frame", "own_s", "pixels", "descriptors", "descriptor_track")


def write_tracks(path: Path | str, motion: MovingTracks) -> None:
    """Write align/tracks/{cam}.npz."""
    meta = {"name": motion.name, "status": motion.status, "span_s": list(motion.span_s)}
    with ArchiveWriter(path, meta) as writer:
        for key in _ARRAYS:
            writer.add(key, getattr(motion, key))


def read_tracks(path: Path | str) -> MovingTracks:
    """Inverse of `write_tracks`. Raises InputError, naming the file."""
    with Archive(path) as archive, explain_faults(f"the motion of a film in {path}"):
        meta = archive.meta
        arrays = {key: archive[key] for key in _ARRAYS}
        return MovingTracks(meta["name"], meta["status"], (meta["span_s"][0], meta["span_s"][1]), **arrays)
