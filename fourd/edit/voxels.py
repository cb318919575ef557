"""Moving points of all cameras at one instant, gathered in voxels, and which of them are the marked thing.

A voxel belongs to the thing because most of the pixels that look at it do: no camera decides alone. What
no mask reaches goes with the nearest voxel along the surface.
"""

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import KDTree

OBJECT, OTHER, UNKNOWN = 1, 0, 2
# In a picture: something else that moves, where OTHER stands still.
MOVER = 3
# Voxels whose centres are nearer than this many sides touch: holes of a voxel or so are bridged.
_REACH = 2.0
# Pixels of a voxel that is more than noise.
_MIN_PIXELS = 3
# Rounds in which voxels go with the majority around them.
_ROUNDS = 3
# Of the thing's voxels: what hangs on it and is less is no second thing.
_SPECK_SHARE = 0.06
# Share of a figure's size that an arm reaches from it.
_LIMB_SHARE = 0.25
# A thing is lost below the first share of its voxels. A new part of at least the second is the thing again
# if its colours are on average by the third more often the thing's than others' (-1 to 1).
LOST_SHARE, _RETURN_SHARE, _ALIKE = 0.06, 0.25, 0.15
# Votes of a colour that only the thing has, or only others have.
_COLOUR_VOTES = 2.0
_BITS = 20


@dataclasses.dataclass(frozen=True, eq=False)
class MovingVoxels:
    """What moves at one instant.

    side: of a voxel, world units;  centers: (V, 3) float64 mean of the points inside
    counts: (V,) pixels of all cameras in each;  index: camera -> (H, W) int32 voxel of a moving pixel, or -1
    """

    side: float
    centers: np.ndarray
    counts: np.ndarray
    index: Mapping[str, np.ndarray]


def gather_voxels(
    points: Mapping[str, tuple[np.ndarray, np.ndarray]], shapes: Mapping[str, tuple[int, int]], side: float
) -> MovingVoxels:
    """Voxels of moving pixels; those of very few are noise, and left out.

    points: camera -> (N, 3) world points and (N,) flat pixels;  shapes: camera -> (H, W)
    """
    names = list(points)
    stacked = np.concatenate([points[name][0] for name in names]) if names else np.zeros((0, 3))
    cells = np.floor(stacked / side).astype(np.int64) + (1 << (_BITS - 1))
    keys = (cells[:, 0] << 2 * _BITS) | (cells[:, 1] << _BITS) | cells[:, 2]
    _, voxel, counts = np.unique(keys, return_inverse=True, return_counts=True)
    sums = [np.bincount(voxel, stacked[:, axis], minlength=len(counts)) for axis in range(3)]
    centers = np.stack(sums, axis=-1) / np.maximum(counts, 1)[:, None]
    kept = counts >= _MIN_PIXELS
    number = np.where(kept, np.cumsum(kept) - 1, -1).astype(np.int32)
    index, first = {}, 0
    for name in names:
        pixels = points[name][1]
        image = np.full(shapes[name], -1, np.int32)
        image.ravel()[pixels] = number[voxel[first : first + len(pixels)]]
        index[name] = image
        first += len(pixels)
    return MovingVoxels(side, centers[kept], counts[kept], index)


def vote_labels(
    voxels: MovingVoxels,
    masks: Mapping[str, np.ndarray],
    before: tuple[np.ndarray, np.ndarray] | None = None,
    belief: np.ndarray | None = None,
) -> np.ndarray:
    """(V,) uint8 label of every voxel by the majority of the pixels that look at it.

    masks: camera -> (H, W) uint8 OBJECT, OTHER or UNKNOWN; a camera that is not named knows nothing
    before: (N, 3) points of the thing and (M, 3) of others in the neighbouring frame; the nearer has a vote
    belief: (V,) of `average_belief`
    Each camera has one vote per voxel, however many of its pixels lie there.
    """
    num = len(voxels.centers)
    balance = np.zeros(num)
    for name, mask in masks.items():
        at = voxels.index[name]
        told = (at >= 0) & (mask != UNKNOWN)
        opinion = np.where(mask[told] == OBJECT, 1.0, -1.0)
        total = np.bincount(at[told], opinion, minlength=num)
        counts = np.bincount(at[told], minlength=num)
        balance += np.divide(total, counts, out=np.zeros(num), where=counts > 0)
    if before is not None:
        ours, theirs = (distances_to(voxels.centers, points, _REACH * voxels.side) for points in before)
        balance += (ours < theirs).astype(float) - (theirs < ours)
    if belief is not None:
        # What nothing else is known about goes with the surface that it is on.
        balance += np.where(balance != 0, _COLOUR_VOTES * belief, 0)
    return np.where(balance > 0, OBJECT, np.where(balance < 0, OTHER, UNKNOWN)).astype(np.uint8)


def average_belief(voxels: MovingVoxels, beliefs: Mapping[str, np.ndarray]) -> np.ndarray:
    """(V,) how much the colours of a voxel are the thing's, -1 to 1.

    beliefs: camera -> (H, W) float32 in -1..1
    """
    num = len(voxels.centers)
    total, counts = np.zeros(num), np.zeros(num)
    for name, belief in beliefs.items():
        at = voxels.index[name]
        total += np.bincount(at[at >= 0], belief[at >= 0], minlength=num)
        counts += np.bincount(at[at >= 0], minlength=num)
    return np.divide(total, counts, out=np.zeros(num), where=counts > 0)


def find_returned(
    voxels: MovingVoxels, votes: np.ndarray, belief: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """Parts that come into view while the thing is lost.

    votes: (V,) of `vote_labels`;  belief: (V,) of `average_belief`;  size: voxels that the thing had
    Returns (V,) bool what has its colours, and (V,) bool what is too small to be told yet.
    """
    if not len(votes):
        return np.zeros(0, bool), np.zeros(0, bool)
    parts = find_parts(voxels.centers, voxels.side)
    counts = np.bincount(parts)
    is_new = np.bincount(parts, votes == OTHER) < 0.5 * counts
    is_large = counts >= _RETURN_SHARE * size
    is_alike = np.bincount(parts, belief) >= _ALIKE * counts
    return (is_new & is_large & is_alike)[parts], (is_new & ~is_large)[parts]


def find_parts(points: np.ndarray, side: float) -> np.ndarray:
    """(V,) int32 connected part of every voxel centre, (V, 3)."""
    return connected_components(_graph(points, side), directed=False)[1].astype(np.int32)


def find_strangers(
    points: np.ndarray, parts: np.ndarray, counts: np.ndarray, reach: float = 0.0
) -> np.ndarray:
    """(P,) bool parts that lie farther from the part with most counts, (P,), than they are long themselves.

    points: (V, 3);  parts: (V,) of `find_parts`
    reach: share of the largest part's own length that is not far yet
    What a missing depth cuts off from a figure is longer than the gap.
    """
    main = int(counts.argmax())
    gaps = np.full(len(counts), np.inf)
    np.minimum.at(gaps, parts, distances_to(points, points[parts == main], np.inf))
    low, high = np.full((len(counts), 3), np.inf), np.full((len(counts), 3), -np.inf)
    np.minimum.at(low, parts, points)
    np.maximum.at(high, parts, points)
    lengths = np.linalg.norm(high - low, axis=1)
    return gaps > np.maximum(lengths, reach * lengths[main])


def find_strays(points: np.ndarray, side: float) -> np.ndarray:
    """(V,) bool points of a thing, (V, 3), that lie apart from most of it and belong to somebody else.

    They are farther away than a limb reaches: a hand whose arm has no depth stays.
    """
    if not len(points):
        return np.zeros(0, bool)
    parts = find_parts(points, side)
    return find_strangers(points, parts, np.bincount(parts), _LIMB_SHARE)[parts]


def is_one_thing(points: np.ndarray, side: float) -> bool:
    """Whether voxels, (V, 3) centres, are one thing and not several that were marked together."""
    return float(find_strays(points, side).sum()) <= _SPECK_SHARE * len(points)


def find_specks(
    voxels: MovingVoxels, labels: np.ndarray, before: tuple[np.ndarray, np.ndarray] | None
) -> np.ndarray:
    """(V,) bool others that hang on the thing, too small for a second one, and unknown before they did.

    labels: (V,) uint8 OBJECT or OTHER;  before: as for `vote_labels`
    Noise around a foot that lands is such, and takes the foot with it if it is handed on.
    """
    is_other = labels == OTHER
    if before is not None:
        ours, theirs = (distances_to(voxels.centers, points, _REACH * voxels.side) for points in before)
        is_old = theirs < ours
    else:
        is_old = np.zeros(len(labels), bool)
    parts, wholes = np.zeros(len(labels), np.int32), find_parts(voxels.centers, voxels.side)
    parts[is_other] = find_parts(voxels.centers[is_other], voxels.side)
    counts = np.bincount(parts[is_other])
    old = np.bincount(parts[is_other & is_old], minlength=len(counts))
    is_new = (counts < _SPECK_SHARE * (labels == OBJECT).sum()) & (old < 0.5 * counts)
    return is_other & np.append(is_new, False)[parts] & np.isin(wholes, wholes[labels == OBJECT])


def distances_to(points: np.ndarray, targets: np.ndarray, most: float) -> np.ndarray:
    """(N,) distance of every point to the nearest target, infinite beyond `most`."""
    if not len(targets) or not len(points):
        return np.full(len(points), np.inf)
    return KDTree(targets).query(points, distance_upper_bound=most)[0]


def _graph(points: np.ndarray, side: float) -> csr_matrix:
    """(V, V) distances of voxels that touch, both ways. points: (V, 3) centres"""
    num = len(points)
    pairs = KDTree(points).query_pairs(_REACH * side, output_type="ndarray")
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    # A length of exactly 0 would be no edge.
    lengths = np.maximum(lengths, 1e-6 * side)
    half = csr_matrix((lengths, (pairs[:, 0], pairs[:, 1])), shape=(num, num))
    return half + half.T


def settle_labels(voxels: MovingVoxels, labels: np.ndarray) -> np.ndarray:
    """(V,) uint8 OBJECT or OTHER for every voxel.

    labels: (V,) uint8, of which some are UNKNOWN
    Voxels go with the majority of those around them, a few times; unknown ones then take the label that is
    nearest along the surface. A part without any label is something else.
    """
    graph = _graph(voxels.centers, voxels.side)
    # A surface fills its voxels, noise is spread over many.
    own = 2 * np.sqrt(voxels.counts)
    touching = graph.copy()
    touching.data[:] = 1
    touching = touching @ diags(own / 2)
    sign = np.where(labels == OBJECT, 1.0, np.where(labels == OTHER, -1.0, 0.0)).astype(np.float32)
    for _ in range(_ROUNDS):
        sign = np.sign(touching @ sign + own * sign)
    distances = []
    for wanted in (1, -1):
        seeds = np.flatnonzero(sign == wanted)
        if len(seeds):
            distances.append(dijkstra(graph, directed=False, indices=seeds, min_only=True))
        else:
            distances.append(np.full(len(labels), np.inf))
    return np.where(distances[0] < distances[1], OBJECT, OTHER).astype(np.uint8)
