"""How a pair of cameras is brought into one frame for matching: rectified to one plane, or swept.

The rectified frame has its origin at a camera's centre, x along the baseline from left to right,
z as near as possible to the mean of the optical axes and y = z x x. Both images share rotation,
focal length and rows; each has its own cx, so that it frames what its own camera sees. Rows,
columns and disparities are those of the common visible volume (`fourd.stereo.volume`). Where a
plane would be stretched too far, above all with an epipole in or near an image, each side keeps
its own axes (`fourd.stereo.sweep_frame`).

Source: A. Fusiello, E. Trucco, A. Verri, "A compact algorithm for rectification of stereo pairs",
Machine Vision and Applications 12, 2000.
"""

import dataclasses

import numpy as np

from fourd.camera import Camera, CameraTrack
from fourd.errors import InputError
from fourd.stereo.guard import (
    NOMINAL_SIGMA_PX,
    Guard,
    Refusal,
    extremes,
    measure_poses,
    planar_obstacle,
    refuse_by_angle,
    refuse_by_field_of_view,
    refuse_by_overlap,
    refuse_by_poses,
)
from fourd.stereo.rectification import (
    STATUS_OK,
    SWEEP,
    PairRectification,
    Rectification,
    with_one_size,
)
from fourd.stereo.rows import RowShift
from fourd.stereo.sweep_frame import measure_sweep, sweep_sides, swept_rectification
from fourd.stereo.volume import (
    RectifyOptions,
    angle_at_scene_deg,
    common_volume,
    field_of_view,
    image_overlap,
    off_axis_deg,
    worst_stretch,
)

_OUTSIDE = -1e4


def inverse_depth_from_disparity(
    rectification: Rectification, disparity: np.ndarray, side: str = "left"
) -> np.ndarray:
    """1 / depth (world units, z of that side) of disparities (...,) px; <= 0 is at infinity or beyond."""
    i = 0 if side == "left" else 1
    return (disparity - rectification.disparity_at_infinity[i]) * rectification.inverse_depth_per_px[i]


def disparity_from_depth(rectification: Rectification, depth: np.ndarray, side: str = "left") -> np.ndarray:
    """Disparity (...,) px of one side's depths (...,) > 0, world units, possibly infinite."""
    i = 0 if side == "left" else 1
    inverse_depth = 1 / np.asarray(depth)
    return inverse_depth / rectification.inverse_depth_per_px[i] + rectification.disparity_at_infinity[i]


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
    kind: str | None = None,
) -> Rectification | Refusal:
    """Bring one pair into one frame at one instant, or say why it should not be matched.

    range_left, range_right: near > 0 and far (may be infinite) depth of what each camera films,
    z in its own frame, world units;  kind: `sweep` if another frame of the pair has to be swept
    Returns a planar Rectification, whose images hold exactly the rows and columns that can
    correspond; a swept one where a plane would be stretched too far; or a Refusal
    """
    guard = measure_poses(left, right)
    reason = refuse_by_poses(guard, min(range_left[0], range_right[0]), options)
    if reason is not None:
        return Refusal(reason, guard)
    margin = 1 + options.depth_margin
    (near_left, far_left), (near_right, far_right) = range_left, range_right
    range_left, range_right = (
        (near_left / margin, far_left * margin),
        (near_right / margin, far_right * margin),
    )
    if kind == SWEEP:
        obstacle: str | None = "another frame of the pair has to be swept"
        planar = None
    else:
        planar, guard = _rectify_planar(left, right, range_left, range_right, guard, options)
        reason = refuse_by_angle(guard, options)
        if reason is not None:
            return Refusal(reason, guard)
        obstacle = planar_obstacle(guard, options)
    if obstacle is not None:
        return _sweep_or_refuse(left, right, range_left, range_right, guard, obstacle, options)
    reason = refuse_by_overlap(guard, options)
    if reason is not None:
        return Refusal(reason, guard)
    # Without an obstacle and with some overlap there is a plane.
    assert planar is not None
    return dataclasses.replace(planar, guard=guard)


def _rectify_planar(
    left: Camera,
    right: Camera,
    range_left: tuple[float, float],
    range_right: tuple[float, float],
    guard: Guard,
    options: RectifyOptions,
) -> tuple[Rectification | None, Guard]:
    """The planar rectification, None if there is none, and the guard with all that it tells."""
    if planar_obstacle(guard, options) is not None:
        return None, guard
    R = rectifying_rotation(left, right)
    guard = dataclasses.replace(guard, off_axis_deg=max(off_axis_deg(c, R) for c in (left, right)))
    if planar_obstacle(guard, options) is not None:
        return None, guard
    vertices = common_volume(left, right, R, range_left, range_right)
    if len(vertices) == 0:
        return None, dataclasses.replace(guard, overlap=0.0)
    focal_px = common_focal_px(left, right, R) * options.scale
    planar = _frame_volume(left, right, R, vertices, focal_px)
    angle = angle_at_scene_deg(left, right, R, vertices, range_left, range_right)
    return planar, dataclasses.replace(
        guard,
        angle_deg=angle,
        stretch=worst_stretch(left, right, R, vertices, focal_px / options.scale),
        overlap=min(image_overlap(left, R, vertices, 0.0), image_overlap(right, R, vertices, 1.0)),
        disparity_low=planar.disparity_range[0],
        disparity_high=planar.disparity_range[1],
        depth_error=float(NOMINAL_SIGMA_PX / (focal_px * np.radians(angle))),
    )


def _sweep_or_refuse(
    left: Camera,
    right: Camera,
    range_left: tuple[float, float],
    range_right: tuple[float, float],
    guard: Guard,
    obstacle: str,
    options: RectifyOptions,
) -> Rectification | Refusal:
    """A swept pair, or both reasons: why not one plane, and why not many.

    range_left, range_right: widened depths;  obstacle: of `planar_obstacle`
    """
    guard = dataclasses.replace(guard, off_axis_deg=max(off_axis_deg(c, c.R) for c in (left, right)))
    reason = refuse_by_field_of_view(guard)
    if reason is None:
        sides = sweep_sides(left, right, range_left, range_right, options.scale)
        guard = measure_sweep(guard, *sides)
        reason = refuse_by_angle(guard, options) or refuse_by_overlap(guard, options)
        if reason is None:
            return swept_rectification(*sides, guard, obstacle)
    return Refusal(f"{obstacle}. Nor can the pair be swept by planes: {reason}", guard)


def rectify_tracks(left: CameraTrack, right: CameraTrack, options: RectifyOptions) -> PairRectification:
    """Bring a pair into one frame over the clip.

    All frames of a planar pair get one image size, the largest any of them needs. All frames are of
    one kind, and one refused frame refuses the pair: a pair that comes and goes would make depth flicker.
    Raises InputError if a depth range is not 0 < near < far or the tracks differ in length.
    """
    for track in (left, right):
        if not 0 < track.near < track.far:
            raise InputError(
                f"camera {track.name}: expected depths 0 < near < far, got near {track.near:g} and far "
                f"{track.far:g} in the cameras file: give the depth range of the scene"
            )
    num_frames = max(len(left.cameras), len(right.cameras))
    ranges = (left.near, left.far), (right.near, right.far)

    def rectify_all(kind: str | None) -> list[Rectification | Refusal]:
        return [
            rectify_pair(left.at(frame), right.at(frame), *ranges, options, kind)
            for frame in range(num_frames)
        ]

    results = rectify_all(None)
    if len({r.kind for r in results if isinstance(r, Rectification)}) > 1:
        results = rectify_all(SWEEP)
    measures = extremes([r.guard for r in results if r.guard])
    refused = [(frame, r) for frame, r in enumerate(results) if isinstance(r, Refusal)]
    if refused:
        frame, first = refused[0]
        where = "" if num_frames == 1 else f" (frame {frame}; {len(refused)} of {num_frames} frames refused)"
        return PairRectification(left.name, right.name, first.reason + where, num_frames, measures=measures)
    frames = with_one_size([r for r in results if isinstance(r, Rectification)])
    return PairRectification(left.name, right.name, STATUS_OK, num_frames, frames, measures)


def sampling_maps(
    rectification: Rectification, camera: Camera, side: str, rows: RowShift | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where each rectified pixel lies in a source image: lens and rotation in one resampling.

    side: `left` or `right`;  camera: the source view
    rows: how far the right image of a planar pair lies off the left one's rows, to be undone
    Returns map_x, map_y (H, W) float32 px of the source, for cv2.remap, and valid (H, W) bool:
    the place is inside the source image, so that interpolation invents nothing
    """
    ideal = rectification.camera(side)
    K, (width, height) = ideal.K, ideal.size
    x = (np.arange(width) - K[0, 2]) / K[0, 0]
    y = np.arange(height)[:, None]
    if rows is not None and side == "right":
        y = y + rows.offset + rows.along_y * y + rows.along_x * np.arange(width)
    y = (y - K[1, 2]) / K[1, 1]
    in_camera = camera.R @ ideal.R.T
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
    left: Camera, right: Camera, R: np.ndarray, vertices: np.ndarray, focal_px: float
) -> Rectification:
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
    disparity_range = float(disparity.min()), float(disparity.max())
    return Rectification(K_left, K_right, R, left.center, right.center, (width, height), disparity_range)
