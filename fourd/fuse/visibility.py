"""Which depths the cameras contradict: a second look at every disparity map, from the depth of a pixel.

A surface that one pair alone sees is as real as any: the side of a head that the other cameras have no view
of. What tells it from a mistake is that no camera sees through it. So is the front of two samples that
happen to agree told from the surface behind it.

Source: P. Merrell et al., "Real-Time Visibility-Based Fusion of Depth Maps", ICCV 2007 (free-space
violations), with votes of cameras for sums of confidences.
"""

from collections.abc import Sequence

import numpy as np
from numba import njit

from fourd.camera import Camera
from fourd.fuse.geometry import PairFrame
from fourd.fuse.options import MAX_STEP_PX

# Cameras that have to see a point for it to need no second pair.
MIN_AGREEING = 2
# Cameras that have to see through a consensus for it to give way.
MIN_CONTRADICTING = 3
# Share of inverse depth by which a sample has to differ from a consensus to be another surface: among
# hundreds of pairs there is always one somewhat before the surface.
MIN_APART = np.float32(0.03)
# Valid disparities among the nine about a pixel below which its map says nothing.
_MIN_KNOWN = 5
_MAX_STEP = np.float32(MAX_STEP_PX)
_CONSENSUS, _CLOSEST, _MEDIAN = 0, 1, 2
_AGREE, _BEYOND, _HIDDEN = 0, 1, 2


def apply_visibility(
    target: Camera,
    pairs: Sequence[PairFrame],
    names: Sequence[str],
    first_row: int,
    chosen: np.ndarray,
    cameras: np.ndarray,
    counts: np.ndarray,
) -> None:
    """Let the consensus be the closest sample where cameras confirm it and none sees through it.

    target: ideal pinhole;  pairs: as for `fuse_view`;  names: of the cameras, in the order of bits
    chosen: (4, h, W) float32 inverse depth by `ESTIMATES`, blank < 0;  cameras: (4, h, W) uint64
    counts: (2, h, W) uint8 pairs and cameras of the consensus;  first_row: of the tile in the target
    The consensus of all three is changed in place. Where `MIN_CONTRADICTING` cameras see through it, it is
    the median, if that is confirmed and not contradicted. Its pairs count as 1 where it was changed.
    """
    has_consensus = chosen[_CONSENSUS] >= 0
    differs = (chosen[:3] >= 0) & (np.abs(chosen[:3] - chosen[_CONSENSUS]) > MIN_APART * chosen[_CONSENSUS])
    differs[_MEDIAN] &= has_consensus
    differs[_CONSENSUS] = differs[_MEDIAN]
    if not differs.any():
        return
    agreeing, contradicting = count_cameras(target, pairs, names, first_row, chosen[:3], differs)
    confirmed = differs & (agreeing >= MIN_AGREEING) & (contradicting == 0)
    confirmed[_MEDIAN] &= contradicting[_CONSENSUS] >= MIN_CONTRADICTING
    for estimate in (_MEDIAN, _CLOSEST):
        at = confirmed[estimate]
        chosen[_CONSENSUS][at] = chosen[estimate][at]
        cameras[_CONSENSUS][at] = cameras[estimate][at]
        counts[0][at] = 1
        counts[1][at] = np.bitwise_count(cameras[estimate][at])


def count_cameras(
    target: Camera,
    pairs: Sequence[PairFrame],
    names: Sequence[str],
    first_row: int,
    inverse_depth: np.ndarray,
    wanted: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """How many cameras see a surface at a point, and how many see what is behind it.

    inverse_depth: (E, h, W) float32 in the target;  wanted: (E, h, W) bool, points to look up
    A camera has as many maps as pairs. It sees the surface where more maps have it than what is behind, and
    sees through it where more have what is behind, and no more have something in front.
    Returns two (E, h, W) uint8, 0 where not wanted.
    """
    agreeing, contradicting = (np.zeros(wanted.shape, np.uint8) for _ in range(2))
    e, y, x = np.nonzero(wanted)
    points = np.stack([x.astype(np.float32), (y + first_row).astype(np.float32), inverse_depth[e, y, x]])
    for name in names:
        votes = np.zeros((3, len(e)), np.uint8)
        for pair in pairs:
            if name in (pair.left, pair.right):
                _count_votes(points, *_map_of_camera(target, pair, name), votes)
        more_behind = votes[_BEYOND] > votes[_AGREE]
        agreeing[e, y, x] += votes[_AGREE] > votes[_BEYOND]
        contradicting[e, y, x] += more_behind & (votes[_BEYOND] >= votes[_HIDDEN])
    return agreeing, contradicting


def _map_of_camera(
    target: Camera, pair: PairFrame, name: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A (3, 3), b (3,): pixel (u, v) of the target at inverse depth t is at A @ [u, v, 1] + t * b in the
    rectified picture of a camera of a pair, homogeneous; its disparity at infinity and inverse depth per px;
    and its disparities."""
    side, index = ("left", 0) if name == pair.left else ("right", 1)
    K, R, center = (getattr(pair, f"{part}_{side}") for part in ("K", "R", "center"))
    rectified_from_target = K @ R @ target.R.T @ np.linalg.inv(target.K)
    b = K @ R @ (target.center - center)
    units = pair.disparity_at_infinity[index], pair.inverse_depth_per_px[index]
    disparity = getattr(pair, f"{side}_disparity")
    return (
        rectified_from_target.astype(np.float32),
        b.astype(np.float32),
        np.array(units, np.float32),
        disparity,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _count_votes(points, A, b, units, disparity, votes):
    """What one disparity map says of points: the surface is there, farther, or nearer.

    points: (3, N) float32 column, row, inverse depth in the target;  votes: (3, N) uint8, added to
    The disparity nearest to the point's among nine about its pixel counts: at an edge the map may have the
    one surface or the other.
    """
    height, width = disparity.shape
    for i in range(points.shape[1]):
        u, v, t = points[0, i], points[1, i], points[2, i]
        x = A[0, 0] * u + A[0, 1] * v + A[0, 2] + t * b[0]
        y = A[1, 0] * u + A[1, 1] * v + A[1, 2] + t * b[1]
        z = A[2, 0] * u + A[2, 1] * v + A[2, 2] + t * b[2]
        px, py = np.rint(x / z), np.rint(y / z)
        if not (z > 0 and 1 <= px < width - 1 and 1 <= py < height - 1):
            continue
        column, row = int(px), int(py)
        if np.isnan(disparity[row, column]):
            continue
        expected = t / z / units[1] + units[0]
        known, nearest = 0, np.float32(np.inf)
        for dy in range(-1, 2):
            for dx in range(-1, 2):
                difference = disparity[row + dy, column + dx] - expected
                known += not np.isnan(difference)
                if abs(difference) < abs(nearest):
                    nearest = difference
        if known >= _MIN_KNOWN:
            votes[0, i] += abs(nearest) <= _MAX_STEP
            votes[1, i] += nearest < -_MAX_STEP
            votes[2, i] += nearest > _MAX_STEP
