"""Planar rectification of a pair of cameras.

The rectified frame has its origin at a camera's centre, x along the baseline from left to right,
z as near as possible to the mean of the optical axes and y = z x x. Both images share rotation,
focal length and rows; each has its own cx, so that it frames what its own camera sees. Rows,
columns and disparities are those of the common visible volume (`fourd.stereo.volume`).

Source: A. Fusiello, E. Trucco, A. Verri, "A compact algorithm for rectification of stereo pairs",
Machine Vision and Applications 12, 2000.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np

from fourd.camera import Camera, CameraTrack
from fourd.errors import InputError
from fourd.stereo.volume import (
    RectifyOptions,
    Refusal,
    angle_at_scene_deg,
    common_volume,
    field_of_view,
    refuse_by_field_of_view,
    refuse_by_poses,
    refuse_by_volume,
)

STATUS_OK = "ok"
MAX_DISPARITY_PX = 1000
"""Files hold disparities in 16 bits at 1/32 px, which ends at 1023 px."""

_OUTSIDE = -1e4


@dataclasses.dataclass(frozen=True, eq=False)
class Rectification:
    """Two images whose rows correspond, at one instant.

    K_left, K_right: (3, 3) px, equal but for cx;  R: (3, 3) rectified_from_world of both
    center_left, center_right: (3,) world units;  size: (width, height) of both images, px
    disparity_range: (lowest, highest) x_left - x_right of the common visible volume, px
    angle_deg: angle at the scene's centre between the rays to both cameras
    """

    K_left: np.ndarray
    K_right: np.ndarray
    R: np.ndarray
    center_left: np.ndarray
    center_right: np.ndarray
    size: tuple[int, int]
    disparity_range: tuple[float, float]
    angle_deg: float = float("nan")

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
        return self.R

    @property
    def disparity_at_infinity(self) -> tuple[float, float]:
        """Of the left and the right map, px."""
        both = float(self.K_left[0, 2] - self.K_right[0, 2])
        return both, both

    @property
    def inverse_depth_per_px(self) -> tuple[float, float]:
        """Of the left and the right map: 1 / depth is (disparity - disparity_at_infinity) times this."""
        both = 1 / (self.focal_px * self.baseline)
        return both, both

    def camera(self, side: str) -> Camera:
        """The ideal pinhole of one rectified image; side is `left` or `right`."""
        K, center = (self.K_left, self.center_left) if side == "left" else (self.K_right, self.center_right)
        return Camera(K, self.R, -self.R @ center, self.size)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The arrays of docs/formats.md, rectification; the size is kept in meta."""
        return {
            "K_left": self.K_left,
            "K_right": self.K_right,
            "R_left": self.R,
            "R_right": self.R,
            "center_left": self.center_left,
            "center_right": self.center_right,
            "baseline": np.array(self.baseline),
            "disparity_range": np.array(self.disparity_range),
        }

    @staticmethod
    def from_arrays(arrays: Mapping[str, np.ndarray], size: tuple[int, int]) -> "Rectification":
        """Inverse of `to_arrays`; the angle, which is kept in meta per pair, stays NaN."""
        low, high = arrays["disparity_range"]
        return Rectification(
            arrays["K_left"],
            arrays["K_right"],
            arrays["R_left"],
            arrays["center_left"],
            arrays["center_right"],
            size,
            (float(low), float(high)),
        )


@dataclasses.dataclass(frozen=True, eq=False)
class PairRectification:
    """A pair over the clip: one rectification if both cameras stand still, else one per frame.

    status: `ok`, or the reason why the pair is refused; then `frames` is empty
    size: (width, height) of all rectified images;  angle_deg: the largest of all frames
    num_frames: how many frames were judged
    """

    left: str
    right: str
    status: str
    size: tuple[int, int]
    angle_deg: float
    num_frames: int
    frames: tuple[Rectification, ...] = ()

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


def inverse_depth_from_disparity(rectification: Rectification, disparity: np.ndarray) -> np.ndarray:
    """1 / depth (world units, z of the rectified frame) of disparities (...,) px; <= 0 is at infinity."""
    scale = rectification.focal_px * rectification.baseline
    return (disparity - rectification.disparity_at_infinity[0]) / scale


def disparity_from_depth(rectification: Rectification, depth: np.ndarray) -> np.ndarray:
    """Disparity (...,) px of depths (...,) > 0, world units, possibly infinite."""
    scale = rectification.focal_px * rectification.baseline
    return scale / np.asarray(depth) + rectification.disparity_at_infinity[0]


def rectifying_rotation(left: Camera, right: Camera) -> np.ndarray:
    """(3, 3) rectified_from_world: x along the baseline, z nearest to the mean optical axis.

    Raises ValueError if the centres coincide or the mean axis lies along the baseline.
    """
    baseline = right.center - left.center
    length = np.linalg.norm(baseline)
    if length == 0:
        raise ValueError("two cameras with one centre have no baseline to rectify along")
    x = baseline / length
    mean_axis = left.forward + right.forward
    z = mean_axis - x * (x @ mean_axis)
    if np.linalg.norm(z) < 1e-6:
        raise ValueError("the optical axes cancel or lie along the baseline: no plane faces both images")
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])


def common_focal_px(left: Camera, right: Camera, R: np.ndarray) -> float:
    """Focal length that keeps the pixel area at the image centres, in the geometric mean.

    A plane tilted by an angle a against the image magnifies areas at the image's centre by
    (f_rectified / f)^2 / cos(a)^3, which is 1 for f_rectified = f cos(a)^1.5.
    """
    kept = [camera.focal_px * max(camera.forward @ R[2], 0.0) ** 1.5 for camera in (left, right)]
    return float(np.sqrt(kept[0] * kept[1]))


def rectify_pair(
    left: Camera,
    right: Camera,
    range_left: tuple[float, float],
    range_right: tuple[float, float],
    options: RectifyOptions,
) -> Rectification | Refusal:
    """Rectify one pair at one instant, or say why it should not be matched.

    range_left, range_right: near > 0 and far (may be infinite) depth of what each camera films,
    z in its own frame, world units
    Returns a Rectification whose images hold exactly the rows and columns that can correspond
    """
    refusal = refuse_by_poses(left, right, min(range_left[0], range_right[0]), options)
    if refusal is not None:
        return refusal
    R = rectifying_rotation(left, right)
    refusal = refuse_by_field_of_view(left, right, R)
    if refusal is not None:
        return refusal
    margin = 1 + options.depth_margin
    (near_left, far_left), (near_right, far_right) = range_left, range_right
    range_left, range_right = (
        (near_left / margin, far_left * margin),
        (near_right / margin, far_right * margin),
    )
    vertices = common_volume(left, right, R, range_left, range_right)
    if len(vertices) == 0:
        return Refusal("no overlap: no point lies in both fields of view within both depth ranges")
    angle = angle_at_scene_deg(left, right, R, vertices, range_left, range_right)
    focal_px = common_focal_px(left, right, R) * options.scale
    refusal = refuse_by_volume(left, right, R, vertices, focal_px, angle, options)
    return _frame_volume(left, right, R, vertices, focal_px, angle) if refusal is None else refusal


def rectify_tracks(left: CameraTrack, right: CameraTrack, options: RectifyOptions) -> PairRectification:
    """Rectify a pair over the clip; all frames get one image size, the largest any frame needs.

    One refused frame refuses the pair: a pair that comes and goes would make depth flicker.
    Raises InputError if a depth range is not 0 < near < far or the tracks differ in length.
    """
    for track in (left, right):
        if not 0 < track.near < track.far:
            raise InputError(
                f"camera {track.name}: expected depths 0 < near < far, got near {track.near:g} and far "
                f"{track.far:g} in the cameras file: give the depth range of the scene"
            )
    num_frames = max(len(left.cameras), len(right.cameras))
    results = [
        rectify_pair(left.at(frame), right.at(frame), (left.near, left.far), (right.near, right.far), options)
        for frame in range(num_frames)
    ]
    refused = [(frame, r) for frame, r in enumerate(results) if isinstance(r, Refusal)]
    angles = [r.angle_deg for r in results if np.isfinite(r.angle_deg)]
    angle = max(angles, default=float("nan"))
    if refused:
        frame, first = refused[0]
        where = "" if num_frames == 1 else f" (frame {frame}; {len(refused)} of {num_frames} frames refused)"
        return PairRectification(left.name, right.name, first.reason + where, (0, 0), angle, num_frames)
    kept = [r for r in results if isinstance(r, Rectification)]
    size = (max(r.size[0] for r in kept), max(r.size[1] for r in kept))
    frames = tuple(dataclasses.replace(r, size=size) for r in kept)
    return PairRectification(left.name, right.name, STATUS_OK, size, angle, num_frames, frames)


def sampling_maps(
    rectification: Rectification, camera: Camera, side: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where each rectified pixel lies in a source image: lens and rotation in one resampling.

    side: `left` or `right`;  camera: the source view
    Returns map_x, map_y (H, W) float32 px of the source, for cv2.remap, and valid (H, W) bool:
    the place is inside the source image, so that interpolation invents nothing
    """
    K = rectification.K_left if side == "left" else rectification.K_right
    width, height = rectification.size
    x = (np.arange(width) - K[0, 2]) / K[0, 0]
    y = (np.arange(height)[:, None] - K[1, 2]) / K[1, 1]
    in_camera = camera.R @ rectification.R.T
    if not camera.is_distorted:
        in_camera = camera.K @ in_camera
    u, v, z = (row[0] * x + (row[1] * y + row[2]) for row in in_camera)
    seen = z > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        np.reciprocal(z, out=z)
        u *= z
        v *= z
    if camera.is_distorted:
        # Past the border the lens polynomial may fold back into the image.
        low, high = field_of_view(camera)
        seen &= (u >= low[0]) & (u <= high[0]) & (v >= low[1]) & (v <= high[1])
        normalized = np.where(seen[..., None], np.stack([u, v], axis=-1), 0.0)
        u, v = np.moveaxis(camera.pixels_from_normalized(normalized), -1, 0)
    map_x, map_y = u.astype(np.float32), v.astype(np.float32)
    if not seen.all():
        map_x[~seen] = map_y[~seen] = _OUTSIDE
    # A pixel centre on the border may fall outside by rounding alone.
    slack = 1e-3
    source_width, source_height = camera.size
    valid = (map_x >= -slack) & (map_x <= source_width - 1 + slack)
    valid &= (map_y >= -slack) & (map_y <= source_height - 1 + slack)
    return map_x, map_y, valid


def _frame_volume(
    left: Camera, right: Camera, R: np.ndarray, vertices: np.ndarray, focal_px: float, angle: float
) -> Rectification | Refusal:
    """Intrinsics, size and disparity range that just hold the common volume."""
    x_left, y, disparity = vertices.T
    x_right = x_left - disparity
    cx_left, cx_right = -focal_px * x_left.min(), -focal_px * x_right.min()
    cy = -focal_px * y.min()
    K_left = np.array([[focal_px, 0.0, cx_left], [0.0, focal_px, cy], [0.0, 0.0, 1.0]])
    K_right = K_left.copy()
    K_right[0, 2] = cx_right
    extent = focal_px * np.array([max(np.ptp(x_left), np.ptp(x_right)), np.ptp(y)])
    width, height = (int(n) for n in np.ceil(extent) + 1)
    disparity = disparity * focal_px + cx_left - cx_right
    low, high = float(disparity.min()), float(disparity.max())
    if max(-low, high) > MAX_DISPARITY_PX:
        return Refusal(
            f"disparities would reach {max(-low, high):.0f} px, more than {MAX_DISPARITY_PX}: lower "
            "rectify scale",
            angle,
        )
    return Rectification(K_left, K_right, R, left.center, right.center, (width, height), (low, high), angle)
