"""Cameras that stand, look or see in ways that stereo was not made for."""

import dataclasses
import functools

import numpy as np

from fourd.camera import Camera, CameraTrack
from fourd.demo.cameras import TARGET, arc_position
from fourd.stability import rig
from fourd.stability.case import REFUSED, Outcome, judge, judge_refusal, make_cases, reason_of
from fourd.stereo.rectification import PLANAR, Rectification
from fourd.stereo.rectify import RectifyOptions, rectify_tracks

MAX_ROW_PX = 0.1
# Against an ordinary pair of the same pictures, 10 degrees apart.
MAX_WRONG_RATIO = 2.0
MIN_FOUND_RATIO = 0.2


def _refused(result: tuple[Rectification | None, str], *causes: str) -> Outcome:
    return judge_refusal(result[1] or None, *causes)


def _geometry_error_px(result: Rectification, left: Camera, right: Camera) -> float:
    """By how much stored geometry misses points that both cameras see: rows, disparities, their range."""
    points = rig.seen_points((left, right))
    worst = 0.0
    for i, (side, source) in enumerate((("left", left), ("right", right))):
        camera = result.camera(side)
        offset = float(np.linalg.norm(camera.center - source.center)) / float(np.linalg.norm(source.t))
        depth = camera.project(points)[1]
        disparity = 1 / (depth * result.inverse_depth_per_px[i]) + result.disparity_at_infinity[i]
        low, high = result.disparity_range if i == 0 else _range_right(result)
        worst = max(worst, offset * camera.focal_px, low - disparity.min(), disparity.max() - high)
    if result.kind == PLANAR:
        at_left, at_right = (result.camera(side).project(points)[0] for side in ("left", "right"))
        shift = at_left - at_right - np.stack([disparity, 0 * disparity], axis=1)
        worst = max(worst, float(np.abs(shift).max()))
    return worst


def _range_right(result: Rectification) -> tuple[float, float]:
    return result.disparity_range if result.swept is None else result.swept.disparity_range_right


def _rectified_or_refused(left: Camera, right: Camera, *causes: str) -> Outcome:
    """Refused with the cause; or geometry holds to 0.1 px and matching finds the truth."""
    result, reason = rig.rectify(left, right)
    if result is None:
        return judge_refusal(reason, *causes)
    error_px = _geometry_error_px(result, left, right)
    found, wrong = _found_and_wrong(result, left, right)
    ordinary_found, ordinary_wrong = _ordinary()
    is_right = wrong < MAX_WRONG_RATIO * ordinary_wrong and found > MIN_FOUND_RATIO * ordinary_found
    return judge(
        error_px < MAX_ROW_PX and is_right,
        f"{result.kind}: geometry within {error_px:.1g} px, {found:.0%} found, {wrong:.1%} of it wrong",
    )


def _found_and_wrong(result: Rectification, left: Camera, right: Camera) -> tuple[float, float]:
    """Share of the pictures that is matched, and share of these matches that is wrong."""
    found = rig.match(result, left, right, (rig.render(left), rig.render(right)))
    maps = list(zip((found.left_disparity, found.right_disparity), rig.true_disparities(result), strict=True))
    shares = [float(np.isfinite(disparity).mean()) for disparity, _ in maps]
    return min(shares), max(rig.share_wrong(disparity, truth) for disparity, truth in maps)


@functools.cache
def _ordinary() -> tuple[float, float]:
    left, right = rig.on_arc(0), rig.on_arc(10)
    result, reason = rig.rectify(left, right)
    if result is None:
        raise AssertionError(f"the ordinary pair is refused: {reason}")
    return _found_and_wrong(result, left, right)


def epipole_inside_both_pictures() -> Outcome:
    """Refused because of the epipole, or swept and right."""
    return _rectified_or_refused(rig.on_arc(0), rig.on_arc(3, distance_m=5.2), "epipole")


def epipole_at_the_edge_of_the_picture() -> Outcome:
    """Refused because of the epipole, or right."""
    return _rectified_or_refused(rig.on_arc(0), rig.on_arc(12, distance_m=5.7), "epipole", "stretch")


def pure_rotation() -> Outcome:
    """Refused: one centre, no depth."""
    left = rig.on_arc(0)
    right = rig.on_arc(0, roll_deg=8)
    return _refused(rig.rectify(left, right), "share one centre")


def baseline_of_a_millionth() -> Outcome:
    """Refused: the depth error at this baseline is named."""
    moved = arc_position(0, 4.5, 1.6) + [4.5e-6, 0, 0]
    return _refused(rig.rectify(rig.on_arc(0), rig.camera_at(moved)), "of its depth")


def axes_almost_parallel_with_a_short_baseline() -> Outcome:
    """Refused because the scene is seen from one angle, or right."""
    left = rig.on_arc(0)
    right = dataclasses.replace(left, t=left.t - np.array([0.2, 0, 0]))
    return _rectified_or_refused(left, right, "less than")


def exactly_parallel_axes() -> Outcome:
    """Right, infinity included."""
    left = rig.on_arc(0)
    right = dataclasses.replace(left, t=left.t - np.array([0.9, 0, 0]))
    return _rectified_or_refused(left, right)


def cameras_90_degrees_apart() -> Outcome:
    """Refused because of the angle."""
    return _rectified_or_refused(rig.on_arc(-45), rig.on_arc(45), "degrees", "stretch")


def cameras_180_degrees_apart() -> Outcome:
    """Refused: they face each other."""
    return _rectified_or_refused(rig.on_arc(-90), rig.on_arc(90), "epipole", "degrees apart")


def axes_180_degrees_apart_side_by_side() -> Outcome:
    """Refused: no plane faces both pictures."""
    left = rig.on_arc(0)
    turned = np.diag([-1.0, 1.0, -1.0]) @ left.R
    right = dataclasses.replace(left, R=turned, t=-turned @ (left.center + left.R[0]))
    return _refused(rig.rectify(left, right), "degrees", "overlap")


def focal_ratio_of_10() -> Outcome:
    """Refused because of the focal lengths."""
    return _refused(rig.rectify(rig.on_arc(0), rig.on_arc(10, focal_px=1300.0)), "focal lengths differ")


def focal_ratio_of_2() -> Outcome:
    """Right."""
    return _rectified_or_refused(rig.on_arc(0), rig.on_arc(10, focal_px=260.0))


def one_camera_upside_down() -> Outcome:
    """Right."""
    return _rectified_or_refused(rig.on_arc(0), rig.on_arc(10, roll_deg=180))


def one_camera_on_its_side() -> Outcome:
    """Right."""
    return _rectified_or_refused(rig.on_arc(0, roll_deg=90), rig.on_arc(10))


def portrait_beside_landscape() -> Outcome:
    """Right."""
    return _rectified_or_refused(rig.on_arc(0, size=(90, 160)), rig.on_arc(10))


def one_camera_above_the_other() -> Outcome:
    """Right."""
    upper = rig.camera_at(arc_position(0, 4.5, 2.6))
    return _rectified_or_refused(rig.on_arc(0), upper)


def pictures_of_very_different_size() -> Outcome:
    """Right."""
    small = rig.on_arc(10, size=(72, 41), focal_px=58.0)
    return _rectified_or_refused(rig.on_arc(0), small)


def overlap_of_nothing() -> Outcome:
    """Refused: no overlap."""
    left, right = rig.on_arc(0), rig.on_arc(10)
    away = np.diag([-1.0, 1.0, -1.0]) @ right.R
    return _refused(rig.rectify(left, dataclasses.replace(right, R=away, t=-away @ right.center)))


def near_plane_at_the_lens() -> Outcome:
    """Refused: disparities beyond what files hold, or too little in common."""
    left, right = (rig.on_arc(angle, focal_px=2000.0, size=(1920, 1080)) for angle in (0, 20))
    return _refused(rig.rectify(left, right, (1e-3, 60.0)), "disparities would reach", "stretch")


def near_behind_far() -> Outcome:
    """Refused: the depth range is named."""
    tracks = [CameraTrack(f"cam{i}", (rig.on_arc(10.0 * i),), 8.0, 2.0) for i in range(2)]
    return judge_refusal(reason_of(rectify_tracks, *tracks, RectifyOptions()), "near < far")


def one_camera_never_moves() -> Outcome:
    """One rectification per frame of the camera that does; rows agree in each."""
    still = rig.on_arc(0)
    moving = tuple(rig.on_arc(10 + 0.5 * frame) for frame in range(4))
    pair = rectify_tracks(
        CameraTrack("still", (still,), *rig.RANGE),
        CameraTrack("moving", moving, *rig.RANGE),
        RectifyOptions(),
    )
    if pair.status != "ok":
        return Outcome(pair.status, REFUSED)
    worst = max(_geometry_error_px(r, still, c) for r, c in zip(pair.frames, moving, strict=True))
    return judge(
        len(pair.frames) == 4 and worst < MAX_ROW_PX, f"{len(pair.frames)} frames, rows within {worst:.1g} px"
    )


def one_frame_of_many_is_useless() -> Outcome:
    """The pair is refused and the frame named, so that depth does not flicker."""
    good = rig.on_arc(10)
    tracks = (
        CameraTrack("still", (rig.on_arc(0),), *rig.RANGE),
        CameraTrack("moving", (good, good, rig.on_arc(0), good), *rig.RANGE),
    )
    status = rectify_tracks(*tracks, RectifyOptions()).status
    return judge_refusal(None if status == "ok" else status, "frame 2")


def camera_at_the_point_it_films() -> Outcome:
    """Refused, or 95 % of what little is found within three of its own sigmas."""
    left, right = rig.on_arc(0), rig.camera_at(TARGET + [0.0, -0.4, 0.1])
    result, reason = rig.rectify(left, right)
    if result is None:
        return judge_refusal(reason)
    found = rig.match(result, left, right, (rig.render(left), rig.render(right)))
    truth = rig.true_disparities(result)
    maps = (found.left_disparity, found.left_confidence), (found.right_disparity, found.right_confidence)
    trusted = [
        np.abs(disparity - true)[confidence > 0] < 3 * found.sigma_px / confidence[confidence > 0]
        for (disparity, confidence), true in zip(maps, truth, strict=True)
    ]
    share = float(np.concatenate(trusted).mean()) if any(map(len, trusted)) else 1.0
    count = sum(map(len, trusted)) / sum(true.size for true in truth)
    return judge(share >= 0.95, f"{result.kind}: {count:.0%} found, {share:.1%} of it within three sigmas")


CASES = make_cases(
    "geometry",
    epipole_inside_both_pictures,
    epipole_at_the_edge_of_the_picture,
    pure_rotation,
    baseline_of_a_millionth,
    axes_almost_parallel_with_a_short_baseline,
    exactly_parallel_axes,
    cameras_90_degrees_apart,
    cameras_180_degrees_apart,
    axes_180_degrees_apart_side_by_side,
    focal_ratio_of_10,
    focal_ratio_of_2,
    one_camera_upside_down,
    one_camera_on_its_side,
    portrait_beside_landscape,
    one_camera_above_the_other,
    pictures_of_very_different_size,
    overlap_of_nothing,
    near_plane_at_the_lens,
    near_behind_far,
    one_camera_never_moves,
    one_frame_of_many_is_useless,
    camera_at_the_point_it_films,
)
