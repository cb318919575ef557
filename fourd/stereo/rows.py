"""Rows of a rectified pair that do not quite correspond: measured on the pictures, undone in the sampling.

Cameras solved from points are off by tenths of a pixel, and matchers look along rows only. How far
matches lie above or below their row is a smooth function of the place: an offset, a stretch along y
and a turn, which show as a + b y + c x.

Source: robust least squares with the biweight of J. Tukey, as in P. Holland, R. Welsch, "Robust
regression using iteratively reweighted least-squares", 1977.
"""

import dataclasses

import cv2
import numpy as np

_NUM_POINTS = 400
_CORNER_QUALITY = 0.01
_CORNER_DISTANCE_PX = 6
_HALF_BLOCK_PX = 7
_REACH_PX = 4
"""Rows above and below that are searched."""
_MIN_CORRELATION = 0.9
_MIN_MATCHES = 40
_ITERATIONS = 10
_BIWEIGHT = 4.685
"""In standard deviations: 95 % as efficient as plain least squares on normal errors."""
_SIGNIFICANT = 5.0
"""Standard errors from 0. Neighbouring matches share errors, hence more than the usual 3."""
_MIN_SHIFT_PX = 0.15
"""Root mean square over the matches: less costs no matches."""


@dataclasses.dataclass(frozen=True)
class RowShift:
    """Where the right image shows what lies in a row of the left one: y + offset + along_y y + along_x x.

    offset: px at the image's first pixel;  along_y, along_x: px per px
    num_matches: measured on;  before_px, after_px: their root mean square distance from the row
    """

    offset: float
    along_y: float
    along_x: float
    num_matches: int
    before_px: float
    after_px: float


def measure_rows(
    left: np.ndarray,
    right: np.ndarray,
    valid: tuple[np.ndarray, np.ndarray],
    disparity_range: tuple[float, float],
) -> RowShift | None:
    """Vertical misalignment of a rectified pair, None where it is not significant.

    left, right: (H, W, 3) uint8 RGB, planar rectification;  valid: (H, W) bool of each
    disparity_range: lowest and highest x_left - x_right, px
    """
    points, shifts = match_points(left, right, valid, disparity_range)
    if len(points) < _MIN_MATCHES:
        return None
    design = np.column_stack([np.ones(len(points)), points[:, ::-1]])
    # Terms that are not significant go one by one, the least so first; the offset stays last.
    terms = [0, 1, 2]
    while True:
        solution, deviation, weights = _fit_robustly(design[:, terms], shifts)
        strength = np.abs(solution) / deviation
        slopes = strength[1:]
        if len(slopes) == 0 or slopes.min() >= _SIGNIFICANT:
            break
        terms.pop(1 + int(np.argmin(slopes)))
    if strength.max() < _SIGNIFICANT:
        return None
    fitted = design[:, terms] @ solution
    if np.sqrt(np.mean(fitted**2)) < _MIN_SHIFT_PX:
        return None
    offset, along_y, along_x = (
        dict(zip(terms, solution.tolist(), strict=True)).get(i, 0.0) for i in range(3)
    )

    def spread(values: np.ndarray) -> float:
        return float(np.sqrt(np.average(values**2, weights=weights)))

    return RowShift(offset, along_y, along_x, len(points), spread(shifts), spread(shifts - fitted))


def match_points(
    left: np.ndarray,
    right: np.ndarray,
    valid: tuple[np.ndarray, np.ndarray],
    disparity_range: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the left image found in the right one, rows above and below included.

    Arguments as `measure_rows`. Returns (N, 2) float64 (x, y) px and (N,) float64 y_right - y_left px
    """
    greys = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right)]
    inside = cv2.erode(valid[0].astype(np.uint8), np.ones((2 * _HALF_BLOCK_PX + 1,) * 2, np.uint8))
    found = cv2.goodFeaturesToTrack(greys[0], _NUM_POINTS, _CORNER_QUALITY, _CORNER_DISTANCE_PX, mask=inside)
    corners = np.zeros((0, 2)) if found is None else found.reshape(-1, 2)
    points, shifts = [], []
    for x, y in np.rint(corners).astype(int):
        shift = _vertical_shift(greys[0], greys[1], valid[1], (int(x), int(y)), disparity_range)
        if shift is not None:
            points.append((x, y))
            shifts.append(shift)
    return np.array(points, float).reshape(-1, 2), np.array(shifts, float)


def _vertical_shift(
    left: np.ndarray,
    right: np.ndarray,
    right_valid: np.ndarray,
    at: tuple[int, int],
    disparity_range: tuple[float, float],
) -> float | None:
    """y_right - y_left px of the block around a pixel, None if it is cut off or has no clear match."""
    height, width = left.shape
    (x, y), half = at, _HALF_BLOCK_PX
    top, bottom = y - half - _REACH_PX, y + half + _REACH_PX + 1
    first = max(x - int(np.ceil(disparity_range[1])) - half, 0)
    last = min(x - int(np.floor(disparity_range[0])) + half + 1, width)
    if min(x, y) < half or x + half >= width or y + half >= height:
        return None
    if top < 0 or bottom > height or last - first < 2 * half + 1:
        return None
    block = left[y - half : y + half + 1, x - half : x + half + 1]
    score = cv2.matchTemplate(right[top:bottom, first:last], block, cv2.TM_CCOEFF_NORMED)
    row, column = np.unravel_index(int(np.argmax(score)), score.shape)
    peak = score[row, column]
    if not (peak >= _MIN_CORRELATION and 0 < row < score.shape[0] - 1):
        return None
    if not right_valid[top + row + half, first + column + half]:
        return None
    above, below = score[row - 1, column], score[row + 1, column]
    curvature = 2 * peak - above - below
    fraction = float((below - above) / (2 * curvature)) if curvature > 0 else 0.0
    return float(row - _REACH_PX) + fraction


def _fit_robustly(design: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solution (K,), its standard deviations (K,) and weights (N,) of a linear fit that bears outliers."""
    # The median is an answer that half of the matches may contradict.
    residual = values - np.median(values)
    weights = np.ones(len(values))
    solution = np.zeros(design.shape[1])
    for _ in range(_ITERATIONS):
        # A floor, because matches on whole rows alone would leave no scale.
        scale = max(1.4826 * float(np.median(np.abs(residual))), 0.02)
        weights = np.maximum(1 - (residual / (_BIWEIGHT * scale)) ** 2, 0) ** 2
        weighted = design * weights[:, None]
        solution = np.linalg.lstsq(weighted.T @ design, weighted.T @ values, rcond=None)[0]
        residual = values - design @ solution
    variance = np.sum(weights * residual**2) / max(weights.sum() - design.shape[1], 1.0)
    inverse = np.linalg.pinv((design * weights[:, None]).T @ design)
    deviation = np.sqrt(np.maximum(variance, 1e-4) * np.diag(inverse))
    return solution, np.maximum(deviation, 1e-12), weights
