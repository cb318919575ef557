"""The films that cameras are recovered from: their pictures, and the frames that are wanted."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Protocol

import cv2
import numpy as np

from fourd.align.clock import Offsets

# 35 mm equivalents are stated for the diagonal of a 36 mm x 24 mm picture.
FULL_FRAME_DIAGONAL_MM = 43.267
# What a phone's main camera has, where nothing is known.
DEFAULT_FOCAL_PER_LONG_SIDE = 0.85
MAX_WORKING_PX = 1920
NUM_KEPT = 64


class PictureSource(Protocol):
    """What is needed of a reader of films: pictures by source frame, and their times."""

    @property
    def size(self) -> tuple[int, int]: ...

    @property
    def pts_s(self) -> np.ndarray: ...

    def read(self, source_frame: int) -> np.ndarray: ...


@dataclasses.dataclass(frozen=True, eq=False)
class Film:
    """One phone's film.

    frames: (N,) int64 source frames that are looked at, rising
    wanted: first and last source frame that the scene shows, None where nobody knows
    focal_px: start of the estimate at full size
    """

    name: str
    source: PictureSource
    frames: np.ndarray
    focal_px: float
    wanted: tuple[int, int] | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) px as displayed."""
        return (int(self.source.size[0]), int(self.source.size[1]))

    @property
    def working_size(self) -> tuple[int, int]:
        """(width, height) px at which the film is measured: the longer side is bounded."""
        scale = min(1.0, MAX_WORKING_PX / max(self.size))
        return (round(self.size[0] * scale), round(self.size[1] * scale))

    def read_rgb(self, frame: int) -> np.ndarray:
        """(H, W, 3) uint8 RGB at working size."""
        image = self.source.read(frame)
        if self.working_size == self.size:
            return image
        return cv2.resize(image, self.working_size, interpolation=cv2.INTER_AREA)

    def read_gray(self, frame: int) -> np.ndarray:
        """(H, W) uint8 at working size."""
        return cv2.cvtColor(self.read_rgb(frame), cv2.COLOR_RGB2GRAY)

    def keyframes(self, count: int) -> list[int]:
        """Frames at the middles of `count` equal parts, each once."""
        total = len(self.frames)
        picked = [int((i + 0.5) * total / count) for i in range(min(count, total))]
        return [int(self.frames[i]) for i in dict.fromkeys(picked)]


def focal_guess_px(size: tuple[int, int], focal_35mm_mm: float | None) -> float:
    """Focal length to start from, px: from the 35 mm equivalent if the film states it."""
    if focal_35mm_mm is None or not focal_35mm_mm > 0:
        return DEFAULT_FOCAL_PER_LONG_SIDE * max(size)
    return float(focal_35mm_mm / FULL_FRAME_DIAGONAL_MM * np.hypot(*size))


def select_frames(
    name: str,
    pts_s: np.ndarray,
    clocks: Offsets | None,
    start_s: float | None,
    duration_s: float,
    margin_s: float,
) -> tuple[np.ndarray, tuple[int, int] | None]:
    """Source frames to look at, (N,) rising, and the first and last that the scene shows.

    clocks: from sound;  start_s: common time of the scene's start, None to take that of the clocks
    Without a clock for this camera every frame is looked at; a film that does not overlap the scene's
    time keeps none.
    """
    everything = np.arange(len(pts_s), dtype=np.int64)
    clock = None if clocks is None else clocks.clocks.get(name)
    if start_s is None and clocks is not None:
        start_s = clocks.start_s
    if clock is None or clock.status != "ok" or start_s is None:
        return everything, None
    common_s = clock.common_time(pts_s)
    near = (common_s >= start_s - margin_s) & (common_s <= start_s + duration_s + margin_s)
    inside = np.flatnonzero((common_s >= start_s) & (common_s <= start_s + duration_s))
    return everything[near], (int(inside[0]), int(inside[-1])) if len(inside) else None


ReadFilm = Callable[[str, int], np.ndarray]


def gray_reader(films: Mapping[str, Film]) -> ReadFilm:
    """(name, frame) -> (H, W) uint8; the last pictures are kept, since keyframes are asked for again."""
    return functools.lru_cache(maxsize=NUM_KEPT)(lambda name, frame: films[name].read_gray(frame))
