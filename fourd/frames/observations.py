"""Colours of the same static point in two cameras, sampled at a few scene frames."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.geometry import triangulate
from fourd.image import resize_area
from fourd.sfm import SfmOptions
from fourd.sfm.sparse import detect_features, epipolar_error_px, match_descriptors

# Colours are compared at this width; it averages noise and aliasing away.
MAX_WIDTH_PX = 960
# OpenCV resamples at most this many rows at once.
_MAX_ROWS = 30000
# A point's colour is the mean of so many by so many samples, one pixel apart in the coarser picture.
_PATCH_SIDE = 9
# A patch that comes nearer to black or white than this was clipped, or nearly so; levels.
_MIN_LEVEL, _MAX_LEVEL = 6, 249
# Change between two frames, natural logarithm of level, above which a point is not static.
_MAX_CHANGE = 0.15


@dataclasses.dataclass(frozen=True, eq=False)
class ColourPairs:
    """Colours of points that two cameras see at one scene frame.

    left_levels, right_levels: (N, 3) float64 levels 0-255, NaN in a channel that was clipped
    """

    left: str
    right: str
    frame: int
    left_levels: np.ndarray
    right_levels: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Sample:
    """One camera at one scene frame.

    image: (H, W, 3) uint8 RGB;  pixels: (N, 2) px, descriptors: (N, 128) features
    """

    camera: Camera
    image: np.ndarray
    pixels: np.ndarray
    descriptors: np.ndarray

    def scale(self, points: np.ndarray) -> np.ndarray:
        """(N,) px per world unit at (N, 3) world points."""
        depth = (points @ self.camera.R.T + self.camera.t)[:, 2]
        return self.camera.focal_px / np.maximum(depth, 1e-12)

    def colours(self, pixels: np.ndarray, step_px: np.ndarray) -> np.ndarray:
        """(N, 3) float64 mean levels of patches around (N, 2) px, of samples (N,) step_px apart.

        NaN where the patch leaves the picture, and in a channel in which it was clipped.
        """
        if len(pixels) == 0:
            return np.zeros((0, 3))
        height, width = self.image.shape[:2]
        offsets = np.arange(_PATCH_SIDE) - (_PATCH_SIDE - 1) / 2
        grid = np.stack(np.meshgrid(offsets, offsets), axis=-1).reshape(-1, 2)
        at = pixels[:, None] + step_px[:, None, None] * grid
        with np.errstate(invalid="ignore"):
            inside = np.all((at >= 0) & (at <= (width - 1, height - 1)), axis=(1, 2))
        safe = np.where(inside[:, None, None], at, 0.0).astype(np.float32)
        seen = np.concatenate(
            [
                cv2.remap(self.image, part, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
                for part in np.array_split(safe, len(safe) // _MAX_ROWS + 1)
            ]
        )
        clipped = (seen < _MIN_LEVEL).any(axis=1) | (seen > _MAX_LEVEL).any(axis=1) | ~inside[:, None]
        return np.where(clipped, np.nan, seen.astype(np.float64).mean(axis=1))


def make_sample(image: np.ndarray, camera: Camera, max_features: int) -> Sample:
    """Features of a picture (H, W, 3) uint8 RGB taken by `camera`, at most MAX_WIDTH_PX wide."""
    width, height = camera.size
    if width > MAX_WIDTH_PX:
        size = (MAX_WIDTH_PX, max(1, round(height * MAX_WIDTH_PX / width)))
        image, camera = resize_area(image, size), camera.resized(size)
    return Sample(camera, image, *detect_features(image, max_features))


def observe_colours(
    pairs: Sequence[tuple[str, str]],
    frames: Sequence[int],
    camera_at: Callable[[str, int], Camera],
    read_frame: Callable[[str, int], np.ndarray],
    options: SfmOptions,
) -> list[ColourPairs]:
    """Colours of static points, per pair of cameras and frame; pairs without matches are left out.

    camera_at, read_frame: (name, frame) -> camera, (H, W, 3) uint8 RGB
    A point counts when its match lies on the epipolar line and it looks the same in both cameras at
    another of the frames, a change of the whole picture apart.
    """
    names = sorted({name for pair in pairs for name in pair})
    samples = {
        (name, frame): make_sample(read_frame(name, frame), camera_at(name, frame), options.max_features)
        for name in names
        for frame in frames
    }
    found = []
    for index, frame in enumerate(frames):
        other_frame = frames[index + 1] if index + 1 < len(frames) else frames[index - 1]
        for left, right in pairs:
            both = (samples[left, frame], samples[right, frame])
            later = (
                None if other_frame == frame else (samples[left, other_frame], samples[right, other_frame])
            )
            colours = _colours_of_pair(both, later, options)
            known = np.any(np.isfinite(colours).all(axis=0), axis=1)
            if known.any():
                found.append(ColourPairs(left, right, frame, colours[0][known], colours[1][known]))
    return found


def _colours_of_pair(
    both: tuple[Sample, Sample], later: tuple[Sample, Sample] | None, options: SfmOptions
) -> np.ndarray:
    """(2, N, 3) levels of matched points in both pictures; of those that stand still, where `later` tells."""
    points, pixels = _match(both, options)
    # Patches of one size in the world: the picture with more pixels per metre is sampled more widely.
    scales = np.stack([sample.scale(points) for sample in both])
    steps = scales / np.minimum(*scales)
    colours = np.stack([s.colours(p, step) for s, p, step in zip(both, pixels, steps, strict=True)])
    if later is None:
        return colours
    keep = np.ones(len(points), bool)
    for now, then, step in zip(colours, later, steps, strict=True):
        projected, _ = then.camera.project(points)
        keep &= _stays(now, then.colours(projected, step))
    return colours[:, keep]


def _match(both: tuple[Sample, Sample], options: SfmOptions) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) world points and their (2, N, 2) px: features that match, near their epipolar lines."""
    left, right = both
    matches = match_descriptors(left.descriptors, right.descriptors, options.match_ratio)
    pixels = np.stack([left.pixels[matches[:, 0]], right.pixels[matches[:, 1]]])
    error = epipolar_error_px(left.camera, right.camera, pixels[0], pixels[1])
    pixels = pixels[:, np.isfinite(error) & (error <= options.max_epipolar_error_px)]
    if pixels.shape[1] == 0:
        return np.zeros((0, 3)), pixels
    points = triangulate([left.camera, right.camera], pixels)
    in_front = np.all(np.isfinite(points), axis=1)
    for camera in (left.camera, right.camera):
        in_front &= camera.project(np.where(in_front[:, None], points, 0.0))[1] > 0
    return points[in_front], pixels[:, in_front]


def _stays(now: np.ndarray, then: np.ndarray) -> np.ndarray:
    """(N,) bool: a camera sees (N, 3) levels again at another frame, as far as it can tell.

    A change that all points share is the camera's own.
    """
    change = np.log(then / now)
    stays = np.ones(len(change), bool)
    for channel in change.T:
        known = np.isfinite(channel)
        if known.any():
            stays[known] &= np.abs(channel[known] - np.median(channel[known])) <= _MAX_CHANGE
    return stays


def count_matches(observed: Sequence[ColourPairs], names: Sequence[str]) -> Mapping[str, int]:
    """Number of observations that each camera takes part in."""
    return {
        name: sum(len(pairs.left_levels) for pairs in observed if name in (pairs.left, pairs.right))
        for name in names
    }
