"""Pictures moved in time: what moves by itself is shifted along its flow, the rest stays as it is.

Two pictures of one camera bracket the wanted time. The second is registered to the first by the
homography of the camera's own motion, so that flow between them is what moves by itself. Every
dynamic pixel of either picture proposes its flow where it will be at the wanted time; where both
pictures agree better under the best proposal than under standing still, the pixel is moved.
"""

import dataclasses

import cv2
import numpy as np

# Times come from sums of seconds: the last bits of a wanted time at the neighbour itself say nothing.
_TIE = 1e-6
_NUM_CORNERS = 600
_MIN_INLIERS = 20
_MIN_INLIER_SHARE = 0.3
_INLIER_PX = 1.5
# Flow near the border has nothing to hold on to beyond it.
_BORDER_SHARE = 0.02
# A mover stands out of the background's own flow by this many of its deviations.
_NOISE_SIGMAS = 5.0
# Flow longer than this share of the picture's smaller side is not believed.
_MAX_MOTION_SHARE = 0.25
# What makes a patch of flow a mover: so many pixels above the threshold, and at most this share of the
# pictures' difference left unexplained.
_MIN_SEEDS = 8
_MAX_UNEXPLAINED = 0.65
# Side of the window in which a pixel goes with the majority, moved or not.
_OUTLINE_PX = 5
# Grey levels by which moving must explain a pixel better than standing still.
_STILL_MARGIN = 2.0
# Median difference of the registered pictures, grey levels, above which the light itself changed.
_MAX_LIGHT_CHANGE = 8.0


@dataclasses.dataclass(frozen=True)
class CompensationOptions:
    """Settings of `compensate_motion` (config/schemas/frames.schema.yaml).

    min_dt_s: pictures nearer in time than this are left as they are
    min_motion_px: flow against the background from which something moves, px over the gap
    max_flow_width_px: wider pictures are halved until they fit, for the flow only
    """

    min_dt_s: float = 0.002
    min_motion_px: float = 0.7
    max_flow_width_px: int = 960


def compensate_motion(
    image: np.ndarray, neighbour: np.ndarray, dt_s: float, gap_s: float, options: CompensationOptions
) -> np.ndarray:
    """The picture as it would have been at the wanted time, for what moves by itself.

    image: (H, W, 3) uint8 RGB, taken dt_s after the wanted time (negative: before)
    neighbour: (H, W, 3) uint8 RGB, the camera's picture on the other side of the wanted time, gap_s
    (> 0) away from `image`
    Returns (H, W, 3) uint8 seen from where the camera was when it took `image`; static pixels, and
    those whose flow cannot be trusted, are those of `image`, bit for bit.
    Raises ValueError for pictures of unequal shape or type, or a wanted time that is not between them.
    """
    if image.shape != neighbour.shape or image.dtype != np.uint8 or neighbour.dtype != np.uint8:
        raise ValueError(
            f"expected two uint8 pictures of one size, got {image.shape} {image.dtype} and "
            f"{neighbour.shape} {neighbour.dtype}"
        )
    if not (np.isfinite(dt_s) and np.isfinite(gap_s) and gap_s > 0 and abs(dt_s) <= gap_s * (1 + _TIE)):
        raise ValueError(f"expected a gap above 0 and dt_s within it, got gap_s {gap_s} and dt_s {dt_s}")
    result = image.copy()
    if dt_s == 0 or abs(dt_s) < options.min_dt_s:
        return result
    neighbour_from_image = find_background_homography(image, neighbour)
    if neighbour_from_image is None:
        return result
    registered, inside = _register(neighbour, neighbour_from_image)
    still_cost = _difference(image, registered)
    if not inside.any() or np.median(still_cost[inside]) > _MAX_LIGHT_CHANGE:
        return result
    share = min(1.0, abs(dt_s) / gap_s)
    flow, moved = _flow_at(share, (image, registered), still_cost, inside, options)
    _render_moved(result, (image, neighbour), neighbour_from_image, share, flow, moved)
    return result


def find_background_homography(image: np.ndarray, neighbour: np.ndarray) -> np.ndarray | None:
    """(3, 3) float64 neighbour_from_image, px, of what stands still; None where it is not found.

    image, neighbour: (H, W, 3) uint8 RGB of one size
    Corners are tracked there and back; most of them must agree on one homography (RANSAC).
    """
    gray, other = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (image, neighbour))
    spacing = max(4.0, 0.5 * float(np.sqrt(gray.size / _NUM_CORNERS)))
    corners = cv2.goodFeaturesToTrack(gray, _NUM_CORNERS, 0.01, spacing)
    if corners is None:
        return None
    there, found, _ = cv2.calcOpticalFlowPyrLK(gray, other, corners, None)  # type: ignore[call-overload]
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, gray, there, None)  # type: ignore[call-overload]
    good = (found[:, 0] > 0) & (returned[:, 0] > 0)
    good &= np.linalg.norm(back - corners, axis=2)[:, 0] < 0.5
    if good.sum() < _MIN_INLIERS:
        return None
    homography, inliers = cv2.findHomography(corners[good], there[good], cv2.RANSAC, _INLIER_PX)
    if homography is None or inliers.sum() < max(_MIN_INLIERS, _MIN_INLIER_SHARE * len(corners)):
        return None
    return np.asarray(homography)


def _register(neighbour: np.ndarray, neighbour_from_image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The neighbour as seen by the image's camera, and (H, W) bool where it looked, a rim left out."""
    height, width = neighbour.shape[:2]
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    rim = max(2, round(_BORDER_SHARE * min(height, width)))
    seen = np.zeros((height, width), np.uint8)
    seen[rim:-rim, rim:-rim] = 255
    registered = cv2.warpPerspective(neighbour, neighbour_from_image, (width, height), flags=flags)
    seen_there = cv2.warpPerspective(seen, neighbour_from_image, (width, height), flags=flags)
    return np.asarray(registered), (seen_there == 255) & (seen == 255)


def _difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(H, W) float32 absolute difference, grey levels, mean over channels and 3 x 3 pixels."""
    over_channels = cv2.transform(cv2.absdiff(a, b).astype(np.float32), np.full((1, 3), 1 / 3, np.float32))
    return np.asarray(cv2.blur(over_channels, (3, 3)))


def _flow_at(
    share: float,
    pictures: tuple[np.ndarray, np.ndarray],
    still_cost: np.ndarray,
    inside: np.ndarray,
    options: CompensationOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """Flow of the pixels of the picture at the wanted time.

    share: of the way from the first to the second of the registered pictures
    Returns (H, W, 2) float32 px from first to second, and (H, W) bool where it is to be used.
    """
    first, second = pictures
    forward = dense_flow(first, second, options.max_flow_width_px)
    backward = dense_flow(second, first, options.max_flow_width_px)
    flow = np.zeros_like(forward)
    moved = np.zeros(inside.shape, bool)
    best = still_cost - _STILL_MARGIN
    for source, target, there, sign, part in (
        (first, second, forward, 1, share),
        (second, first, backward, -1, 1 - share),
    ):
        cost = _difference(source, _sample(target, there))
        mask = _find_movers(there, still_cost, cost, inside, options.min_motion_px)
        _propose(there, sign, part, cost, mask, (best, flow, moved))
    return _smooth_outline(flow, moved)


def _smooth_outline(flow: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same without single pixels, and with pin holes filled with the flow around them."""
    before = moved.astype(np.float32)
    smooth = cv2.medianBlur(moved.astype(np.uint8), _OUTLINE_PX) > 0
    side = (_OUTLINE_PX, _OUTLINE_PX)
    around = cv2.blur(flow * before[..., None], side) / np.maximum(cv2.blur(before, side), 1e-6)[..., None]
    return np.where((smooth & ~moved)[..., None], around, flow), smooth


def dense_flow(
    first: np.ndarray, second: np.ndarray, max_width_px: int | None = None, finest_scale: int = 0
) -> np.ndarray:
    """(H, W, 2) float32 flow, px, from the first picture to the second.

    first, second: (H, W, 3) uint8 RGB of one size
    max_width_px: wider pictures are halved until they fit, None for never
    finest_scale: of the pyramid that is searched, 0 is the picture itself and 1 half of it
    Source: T. Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016.
    """
    grays = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (first, second)]
    height, width = grays[0].shape
    step = 1
    while max_width_px is not None and width > step * max_width_px and min(height, width) >= 64 * step:
        step *= 2
    if step > 1:
        small = (width // step, height // step)
        grays = [cv2.resize(gray, small, interpolation=cv2.INTER_AREA) for gray in grays]
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    method.setFinestScale(finest_scale)
    flow = np.asarray(method.calc(grays[0], grays[1], None))  # type: ignore[call-overload]
    if step == 1:
        return flow
    scale = np.array([width / flow.shape[1], height / flow.shape[0]], np.float32)
    return cv2.resize(flow, (width, height), interpolation=cv2.INTER_LINEAR) * scale


def _sample(picture: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """The picture where (H, W, 2) flow leads, px."""
    height, width = flow.shape[:2]
    x, y = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)[:, None]
    border = cv2.BORDER_REFLECT
    return np.asarray(
        cv2.remap(picture, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR, borderMode=border)
    )


def _find_movers(
    flow: np.ndarray, still_cost: np.ndarray, cost: np.ndarray, inside: np.ndarray, min_motion_px: float
) -> np.ndarray:
    """(H, W) bool: patches above half the threshold, partly above it, that moving explains well.

    flow: (H, W, 2) px;  still_cost, cost: (H, W) grey levels, unexplained by standing still and by moving
    """
    speed = cv2.magnitude(flow[..., 0], flow[..., 1])
    noise = 1.4826 * float(np.median(speed[inside]))
    threshold = max(min_motion_px, _NOISE_SIGMAS * noise)
    _, labels = cv2.connectedComponents(((speed > threshold / 2) & inside).astype(np.uint8))
    patch = np.asarray(labels, dtype=np.int64)
    count = int(patch.max()) + 1
    is_mover = np.bincount(patch[inside & (speed > threshold)], minlength=count) >= _MIN_SEEDS
    unexplained = [np.bincount(patch.ravel(), c.ravel(), minlength=count) for c in (still_cost, cost)]
    is_mover &= unexplained[1] < _MAX_UNEXPLAINED * unexplained[0]
    is_mover[0] = False
    return is_mover[patch] & (speed < _MAX_MOTION_SHARE * min(flow.shape[:2]))


def _propose(
    there: np.ndarray,
    sign: int,
    part: float,
    cost: np.ndarray,
    mask: np.ndarray,
    at_wanted_time: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Carry dynamic pixels `part` of their flow on; where they cost less than the best so far, they stay.

    there: (H, W, 2) px;  sign: -1 if it leads from the second picture to the first
    at_wanted_time: cost of the best, flow and whether moved, changed in place
    """
    best, flow, moved = at_wanted_time
    height, width = mask.shape
    y, x = np.nonzero(mask)
    vectors, costs = there[y, x], cost[y, x]
    left = np.floor(x + part * vectors[:, 0]).astype(np.int64)
    top = np.floor(y + part * vectors[:, 1]).astype(np.int64)
    order = np.argsort(-costs, kind="stable")
    for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        at_x, at_y = left[order] + right, top[order] + down
        lands = (at_x >= 0) & (at_x < width) & (at_y >= 0) & (at_y < height)
        at_x, at_y, index = at_x[lands], at_y[lands], order[lands]
        cheaper = costs[index] < best[at_y, at_x]
        at_x, at_y, index = at_x[cheaper], at_y[cheaper], index[cheaper]
        # Of repeated places the last assignment stays, which is the cheapest.
        best[at_y, at_x] = costs[index]
        flow[at_y, at_x] = sign * vectors[index]
        moved[at_y, at_x] = True


def _render_moved(
    result: np.ndarray,
    pictures: tuple[np.ndarray, np.ndarray],
    neighbour_from_image: np.ndarray,
    share: float,
    flow: np.ndarray,
    moved: np.ndarray,
) -> None:
    """Fill the moved pixels of `result` from both original pictures, the nearer in time weighs more.

    The outermost of them keep a share of what is there, so that outlines do not turn hard.
    """
    left, top, width, height = cv2.boundingRect(moved.astype(np.uint8))
    if width == 0:
        return
    window = (slice(top, top + height), slice(left, left + width))
    vectors = flow[window].astype(np.float64)
    grid = np.stack(np.meshgrid(np.arange(left, left + width), np.arange(top, top + height)), axis=-1)
    behind = grid - share * vectors
    ahead = (grid + (1 - share) * vectors).reshape(-1, 1, 2)
    ahead = cv2.perspectiveTransform(ahead, neighbour_from_image).reshape(behind.shape)
    first, second = (
        cv2.remap(picture, at.astype(np.float32), None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)  # type: ignore[call-overload]
        for picture, at in zip(pictures, (behind, ahead), strict=True)
    )
    blend = cv2.addWeighted(first, 1 - share, second, share, 0)
    inner = moved[window].astype(np.float32)
    weight = (inner * cv2.blur(inner, (3, 3)))[..., None]
    result[window] = np.rint(result[window] + weight * (blend - result[window].astype(np.float32)))
