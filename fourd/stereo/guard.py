"""What is known of a pair of cameras before any pixel is matched, and what that forbids.

Every number is measured first (`Guard`); the decisions below read nothing else. A pair is rectified
to one plane, or swept by planes where that would stretch an image too far, or refused.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from fourd.camera import Camera
from fourd.geometry import angle_deg
from fourd.stereo.volume import RectifyOptions, field_of_view

NOMINAL_SIGMA_PX = 0.3
"""Noise of a matched position for which the depth error is foretold."""
_MAX_OFF_AXIS_DEG = 80.0
_MAX_DISPARITY_PX = 1000
"""Files hold disparities in 16 bits at 1/32 px, which ends at 1023 px."""
_NAN = float("nan")
_IN_WORDS = (
    ("angle_deg", 1, ", {:.1f} degrees at the scene"),
    ("axes_deg", 1, ", {:.0f} degrees between the axes"),
    ("roll_deg", 1, ", rolled {:.0f} degrees"),
    ("focal_ratio", 1, ", focal ratio {:.2f}"),
    ("epipole_left", 0, ", epipoles {:.2f}"),
    ("epipole_right", 0, " and {:.2f} of the image outside"),
    ("overlap", 0, ", overlap {:.2f}"),
    ("stretch", 1, ", stretch {:.2f}"),
    ("disparity_low", 0, ", disparities {:.0f}"),
    ("disparity_high", 1, " to {:.0f} px"),
    ("depth_error", 1, ", depth error {:.2g} at the scene"),
)


@dataclasses.dataclass(frozen=True)
class Guard:
    """Measures of a pair at one instant; NaN where one has no meaning or was not needed.

    angle_deg: between the rays to both cameras at the scene's centre, or, where the baseline points
        into an image, in the quarter of it that sees the most;  axes_deg: between the optical axes
    roll_deg: turn of the right camera about its axis against the left one, -180..180
    focal_ratio: larger over smaller focal length, px;  baseline: world units
    epipole_left, epipole_right: how far outside its image each epipole lies, as a share of the
        image's width or height, whichever is more; 0 inside, infinite for a baseline across the axis
    off_axis_deg: largest angle between an image's corner and the axis of the images that are matched
    overlap: smaller share of an image that the other camera can see within the depth range
    stretch: worst linear magnification, or its inverse, of a matched part by planar rectification
    disparity_low, disparity_high: range to search, px
    depth_error: expected relative error of depth at the scene's centre at `NOMINAL_SIGMA_PX`
    """

    baseline: float
    axes_deg: float
    roll_deg: float
    focal_ratio: float
    epipole_left: float
    epipole_right: float
    angle_deg: float = _NAN
    off_axis_deg: float = _NAN
    overlap: float = _NAN
    stretch: float = _NAN
    disparity_low: float = _NAN
    disparity_high: float = _NAN
    depth_error: float = _NAN


@dataclasses.dataclass(frozen=True)
class Refusal:
    """Why a pair is not matched;  guard: what was measured until then."""

    reason: str
    guard: Guard


def measure_poses(left: Camera, right: Camera) -> Guard:
    """What poses and lenses alone tell."""
    ratio = left.focal_px / right.focal_px
    return Guard(
        baseline=float(np.linalg.norm(right.center - left.center)),
        axes_deg=float(angle_deg(left.forward, right.forward)),
        roll_deg=roll_deg(left, right),
        focal_ratio=max(ratio, 1 / ratio),
        epipole_left=epipole_outside(left, right.center),
        epipole_right=epipole_outside(right, left.center),
    )


def roll_deg(left: Camera, right: Camera) -> float:
    """Turn of `right` about its optical axis against `left`, degrees in -180..180.

    The twist about z of the relative rotation (swing-twist decomposition); 0 for opposite axes,
    where every turn is one about the axis.
    """
    _, _, z, w = Rotation.from_matrix(right.R @ left.R.T).as_quat()
    return float(np.degrees(np.arctan2(2 * z * w, w * w - z * z))) if abs(z) + abs(w) > 1e-9 else 0.0


def epipole_outside(camera: Camera, other_center: np.ndarray) -> float:
    """How far the image of another camera's centre, or of the opposite direction, lies outside.

    Returns a share of the image's width or height, whichever is more; 0 inside, infinite if the
    baseline is parallel to the image, NaN for one common centre
    """
    direction = camera.R @ (other_center - camera.center)
    if not np.any(direction):
        return _NAN
    # The square of a tiny baseline would be 0, and so would its length.
    direction /= np.abs(direction).max()
    if abs(direction[2]) < 1e-12:
        return float("inf")
    low, high = field_of_view(camera)
    epipole = direction[:2] / direction[2]
    # A picture one pixel wide shows a field of no width: all beside it is infinitely far outside.
    with np.errstate(divide="ignore", invalid="ignore"):
        outside = np.maximum(low - epipole, epipole - high) / (high - low)
    return max(0.0, float(np.fmax.reduce(outside)))


def extremes(guards: Sequence[Guard]) -> dict[str, tuple[float, float]]:
    """Field -> (lowest, highest) over the frames of a pair; fields that were not measured are left out."""
    found = {}
    for field in dataclasses.fields(Guard):
        values = [value for value in (getattr(guard, field.name) for guard in guards) if value == value]
        if values:
            found[field.name] = (min(values), max(values))
    return found


def refuse_by_poses(guard: Guard, near: float, options: RectifyOptions) -> str | None:
    """What no matching can mend.  near: smallest depth, world units."""
    if guard.baseline <= 1e-9 * near:
        return "the cameras share one centre, so depth leaves no trace: nothing to match"
    if guard.focal_ratio > options.max_focal_ratio:
        return (
            f"the focal lengths differ by a factor {guard.focal_ratio:.1f} in px, more than "
            f"{options.max_focal_ratio:g}: the images do not show the same detail"
        )
    return None


def refuse_by_field_of_view(guard: Guard) -> str | None:
    """Images that reach too far around for a plane: the common one, or each its own if swept."""
    if guard.off_axis_deg > _MAX_OFF_AXIS_DEG:
        return (
            f"the fields of view reach {guard.off_axis_deg:.0f} degrees away from the axis of the rectified "
            f"images, past {_MAX_OFF_AXIS_DEG:.0f}: one plane cannot hold both"
        )
    return None


def planar_obstacle(guard: Guard, options: RectifyOptions) -> str | None:
    """Why one plane cannot hold both images, as far as the guard has measured; None if it can."""
    for side, outside in (("left", guard.epipole_left), ("right", guard.epipole_right)):
        if outside <= options.epipole_margin:
            return (
                f"the epipole lies in or near the {side} image (the cameras stand almost one behind the "
                "other or face each other): planar rectification would stretch it without bound"
            )
    if guard.axes_deg > 2 * _MAX_OFF_AXIS_DEG:
        return f"the optical axes are {guard.axes_deg:.0f} degrees apart: no plane faces both images"
    wide = refuse_by_field_of_view(guard)
    if wide is not None:
        return wide
    if guard.stretch > options.max_stretch:
        return (
            f"rectification would stretch or shrink parts of an image {guard.stretch:.1f} times, more than "
            f"{options.max_stretch:g}"
        )
    return None


def refuse_by_angle(guard: Guard, options: RectifyOptions) -> str | None:
    """Too wide for pixels to look alike, or too narrow for depth."""
    if guard.angle_deg > options.max_angle_deg:
        return (
            f"the cameras see the scene {guard.angle_deg:.0f} degrees apart, more than "
            f"{options.max_angle_deg:g}: too few pixels would match"
        )
    if guard.angle_deg < options.min_angle_deg:
        return (
            f"the cameras see the scene {guard.angle_deg:.2g} degrees apart, less than "
            f"{options.min_angle_deg:g}: an error of 1 px would move the scene's centre by "
            f"{100 * guard.depth_error / NOMINAL_SIGMA_PX:.0f} % of its depth"
        )
    return None


def refuse_by_overlap(guard: Guard, options: RectifyOptions) -> str | None:
    """Too little seen in common, or disparities that the files cannot hold."""
    if guard.overlap == 0:
        return "no overlap: no point lies in both fields of view within both depth ranges"
    if guard.overlap < options.min_overlap:
        return (
            f"only {100 * guard.overlap:.0f} % of an image can be seen by the other camera, less than "
            f"{100 * options.min_overlap:g} %"
        )
    largest = max(-guard.disparity_low, guard.disparity_high)
    if largest > _MAX_DISPARITY_PX:
        return f"disparities would reach {largest:.0f} px, more than {_MAX_DISPARITY_PX}: lower rectify scale"
    return None


def describe_measures(measures: Mapping[str, tuple[float, float]]) -> str:
    """One line of `extremes`, the worse end of each."""
    parts = [text.format(measures[name][end]) for name, end, text in _IN_WORDS if name in measures]
    return "".join(parts).removeprefix(", ")
