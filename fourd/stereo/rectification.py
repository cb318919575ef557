"""A pair of cameras in one frame for matching: what `fourd.stereo.rectify` makes and files hold."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from fourd.camera import Camera, check_camera
from fourd.errors import InputError
from fourd.stereo.guard import Guard

STATUS_OK = "ok"
PLANAR = "planar"
SWEEP = "sweep"
_NAN = float("nan")


@dataclasses.dataclass(frozen=True, eq=False)
class SweptSides:
    """What the sides of a swept pair do not share.

    R_right: (3, 3) right_from_world;  size_right: (width, height), px
    disparity_range_right: px of the right side;  obstacle: why one plane cannot hold both images
    inverse_depth_per_px: of the left and the right map; disparity 0 is at infinity
    """

    R_right: np.ndarray
    size_right: tuple[int, int]
    disparity_range_right: tuple[float, float]
    inverse_depth_per_px: tuple[float, float]
    obstacle: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class Rectification:
    """Two ideal pinholes in whose pixels disparities are given, at one instant.

    K_left, K_right: (3, 3) px;  R: (3, 3) rectified_from_world
    center_left, center_right: (3,) world units;  size: (width, height), px
    disparity_range: (lowest, highest) disparity of the common visible volume, px
    guard: what was measured of the pair;  swept: None for a planar pair

    Planar: rows correspond; both sides share R, size and K but for cx; disparity is x_left - x_right.
    Swept: R, size and range are those of the left side, and `swept` has the right one's; disparity is
    inverse depth in units that move the other image by about 1 px where it moves most.
    """

    K_left: np.ndarray
    K_right: np.ndarray
    R: np.ndarray
    center_left: np.ndarray
    center_right: np.ndarray
    size: tuple[int, int]
    disparity_range: tuple[float, float]
    guard: Guard | None = None
    swept: SweptSides | None = None

    @property
    def kind(self) -> str:
        return PLANAR if self.swept is None else SWEEP

    @property
    def baseline(self) -> float:
        """Distance between the centres, world units."""
        return float(np.linalg.norm(self.center_right - self.center_left))

    @property
    def focal_px(self) -> float:
        return float(self.K_left[0, 0])

    @property
    def R_left(self) -> np.ndarray:
        return self.R

    @property
    def R_right(self) -> np.ndarray:
        return self.R if self.swept is None else self.swept.R_right

    @property
    def size_right(self) -> tuple[int, int]:
        return self.size if self.swept is None else self.swept.size_right

    @property
    def disparity_at_infinity(self) -> tuple[float, float]:
        """Of the left and the right map, px."""
        if self.swept is not None:
            return 0.0, 0.0
        both = float(self.K_left[0, 2] - self.K_right[0, 2])
        return both, both

    @property
    def inverse_depth_per_px(self) -> tuple[float, float]:
        """Of the left and the right map: 1 / depth is (disparity - disparity_at_infinity) times this."""
        if self.swept is not None:
            return self.swept.inverse_depth_per_px
        both = 1 / (self.focal_px * self.baseline)
        return both, both

    def camera(self, side: str) -> Camera:
        """The ideal pinhole of one image; side is `left` or `right`."""
        if side == "left":
            return Camera(self.K_left, self.R, -self.R @ self.center_left, self.size)
        return Camera(self.K_right, self.R_right, -self.R_right @ self.center_right, self.size_right)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The arrays of docs/formats.md, rectification; sizes are kept in meta."""
        arrays = {
            "K_left": self.K_left,
            "K_right": self.K_right,
            "R_left": self.R_left,
            "R_right": self.R_right,
            "center_left": self.center_left,
            "center_right": self.center_right,
            "baseline": np.array(self.baseline),
            "disparity_range": np.array(self.disparity_range),
            "disparity_at_infinity": np.array(self.disparity_at_infinity),
            "inverse_depth_per_px": np.array(self.inverse_depth_per_px),
        }
        if self.swept is not None:
            arrays["disparity_range_right"] = np.array(self.swept.disparity_range_right)
        return arrays

    @staticmethod
    def from_arrays(
        arrays: Mapping[str, np.ndarray],
        size: tuple[int, int],
        size_right: tuple[int, int],
        where: str,
        obstacle: str = "",
    ) -> "Rectification":
        """Inverse of `to_arrays`; the guard, which is kept in meta per pair, is not there.

        where: file and frame for the error message
        Raises LookupError, ValueError or InputError for arrays that describe no pair of cameras.
        """
        swept = None
        if "disparity_range_right" in arrays:
            swept = SweptSides(
                _numbers(arrays, "R_right", (3, 3)),
                size_right,
                _pair_of_floats(arrays["disparity_range_right"]),
                _pair_of_floats(arrays["inverse_depth_per_px"]),
                obstacle,
            )
        rectification = Rectification(
            _numbers(arrays, "K_left", (3, 3)),
            _numbers(arrays, "K_right", (3, 3)),
            _numbers(arrays, "R_left", (3, 3)),
            _numbers(arrays, "center_left", (3,)),
            _numbers(arrays, "center_right", (3,)),
            size,
            _pair_of_floats(arrays["disparity_range"]),
            swept=swept,
        )
        for side in ("left", "right"):
            check_camera(rectification.camera(side), f"{where}, {side} side")
        if rectification.baseline == 0:
            raise ValueError("both sides at one place")
        return rectification


def _numbers(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    array = arrays[name]
    if array.dtype != np.float64 or array.shape != shape:
        raise ValueError(f"{name} of {array.dtype} {array.shape}")
    return array


def _pair_of_floats(array: np.ndarray) -> tuple[float, float]:
    first, second = map(float, array)
    if first != first or second != second:
        raise ValueError(f"{array.tolist()} for two numbers")
    return first, second


@dataclasses.dataclass(frozen=True, eq=False)
class PairRectification:
    """A pair over the clip: one rectification if both cameras stand still, else one per frame.

    status: `ok`, or the reason why the pair is refused; then `frames` is empty
    num_frames: how many frames were judged
    measures: field of `Guard` -> (lowest, highest) over the frames, where it was measured
    """

    left: str
    right: str
    status: str
    num_frames: int
    frames: tuple[Rectification, ...] = ()
    measures: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)

    @property
    def kind(self) -> str | None:
        """`planar` or `sweep`; None if refused."""
        return self.frames[0].kind if self.frames else None

    @property
    def obstacle(self) -> str | None:
        """Why a swept pair is not rectified to one plane; None for other pairs."""
        swept = self.frames[0].swept if self.frames else None
        return None if swept is None else swept.obstacle

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the left images, and of the right ones of a planar pair; (0, 0) if refused."""
        return self.frames[0].size if self.frames else (0, 0)

    @property
    def size_right(self) -> tuple[int, int]:
        return self.frames[0].size_right if self.frames else (0, 0)

    @property
    def angle_deg(self) -> float:
        """Largest angle at the scene's centre of all frames, NaN if none was measured."""
        return self.measures.get("angle_deg", (_NAN, _NAN))[1]

    def at(self, frame: int) -> Rectification:
        """The rectification at a frame of the common clock. Raises InputError past the end."""
        if len(self.frames) == 1:
            return self.frames[0]
        if not 0 <= frame < len(self.frames):
            raise InputError(
                f"pair {self.left}-{self.right}: expected a frame in 0..{len(self.frames) - 1}, got "
                f"{frame}: rectify the pair again with cameras that cover the clip"
            )
        return self.frames[frame]


def with_one_size(frames: Sequence[Rectification]) -> tuple[Rectification, ...]:
    """The frames of a pair, all as large as the largest of each side."""
    size = _largest(r.size for r in frames)
    size_right = _largest(r.size_right for r in frames)
    return tuple(
        dataclasses.replace(
            r, size=size, swept=r.swept and dataclasses.replace(r.swept, size_right=size_right)
        )
        for r in frames
    )


def _largest(sizes: Iterable[tuple[int, int]]) -> tuple[int, int]:
    widths, heights = zip(*sizes, strict=True)
    return max(widths), max(heights)
