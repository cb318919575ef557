"""A mask through one film, without depth: flow carries it, other times and colour settle its outline.

For films that no second camera saw. Several cameras do better (`carry.py`).
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from fourd.edit.carry import carry_flow
from fourd.edit.colours import learn_colours
from fourd.edit.outline import widen
from fourd.edit.still import find_movers, register_film
from fourd.edit.voxels import OBJECT, OTHER

# How far beyond the carried outline pixels are taken back, and the surroundings whose colours are learned:
# shares of the diagonal.
_OUTER_SHARE, _NEAR_SHARE = 0.045, 0.27
# Opinions are shared along what looks alike: how far, and colours that are alike, grey levels.
_SMOOTHNESS, _ALIKE_LEVELS = 30.0, 15.0
# Work is done on pictures of at most so many px in width.
_MAX_WIDTH_PX = 427
# Less of the first mask than this is no thing that is seen.
_LEAST_SHARE = 0.05
_COLOUR_VOTES = 1.0
# The first round shows what moves, the second leaves it out of what stands still.
_ROUNDS = 2
Carry = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def follow_mask(
    images: Sequence[np.ndarray], mask: np.ndarray, carry: Carry = carry_flow
) -> list[np.ndarray]:
    """(H, W) bool masks of all pictures of a film.

    images: (H, W, 3) uint8 each;  mask: (H, W) bool of the first
    carry: takes a mask from frame to frame, as `carry_flow` does
    """
    size = mask.shape[1], mask.shape[0]
    step = max(1.0, size[0] / _MAX_WIDTH_PX)
    small = round(size[0] / step), round(size[1] / step)
    pictures = [cv2.resize(image, small, interpolation=cv2.INTER_AREA) for image in images]
    first = cv2.resize(mask.astype(np.uint8), small, interpolation=cv2.INTER_AREA) > 0
    near = widen(first, _pixels(small, _NEAR_SHARE)) & ~widen(first, 2)
    colours = learn_colours({"": pictures[0]}, {"": (first, near)})
    places = register_film(pictures)
    found, gone = [first], None
    for _ in range(_ROUNDS):
        found, moves = [first], [first]
        for now, picture in enumerate(pictures[1:], start=1):
            carried = carry(picture, pictures[now - 1], found[-1].astype(np.uint8))
            evidence = find_movers(pictures, places, now, gone)
            cut = cut_mask(picture, found[-1], carried, colours.of(picture), evidence)
            # A thing that is hidden keeps its place until it is seen again.
            found.append(cut if cut.sum() >= _LEAST_SHARE * first.sum() else carried == OBJECT)
            moves.append(found[-1] & (evidence > 0))
        gone = moves
    large = [cv2.resize(m.astype(np.uint8) * 255, size, interpolation=cv2.INTER_LINEAR) > 127 for m in found]
    return [mask, *large[1:]]


def _pixels(size: tuple[int, int], share: float) -> int:
    return max(1, round(share * float(np.hypot(*size))))


def cut_mask(
    picture: np.ndarray, before: np.ndarray, carried: np.ndarray, belief: np.ndarray, evidence: np.ndarray
) -> np.ndarray:
    """(H, W) bool: the carried mask with its outline settled.

    picture: (H, W, 3) uint8;  before: (H, W) bool mask of the picture before
    carried: (H, W) uint8 OBJECT, OTHER or UNKNOWN
    belief: (H, W) float32 -1 to 1, how much a colour is the thing's
    evidence: (H, W) float32 -1 to 1, how much the place looks unlike at other times
    Flow, colour and change have a vote each, which is shared along what looks alike.
    Source: D. Min et al., "Fast Global Image Smoothing Based on Weighted Least Squares", TIP 2014.
    """
    size = picture.shape[1], picture.shape[0]
    sign = np.where(carried == OBJECT, 1.0, np.where(carried == OTHER, -1.0, 0.0)).astype(np.float32)
    score = sign + _COLOUR_VOTES * cv2.GaussianBlur(belief, (0, 0), 1.0) + evidence
    score = cv2.ximgproc.fastGlobalSmootherFilter(picture, score, _SMOOTHNESS, _ALIKE_LEVELS)
    # Flow loses what moves fast, which is not far from where it was.
    mask = (score > 0) & widen((carried == OBJECT) | before, _pixels(size, _OUTER_SHARE))
    # What hangs together with nothing that was carried is another thing.
    labels = np.asarray(cv2.connectedComponents(mask.astype(np.uint8))[1], dtype=np.int64)
    ours = np.zeros(int(labels.max()) + 1, bool)
    ours[np.unique(labels[carried == OBJECT])] = True
    return cv2.medianBlur((ours[labels] & mask).astype(np.uint8), 3) > 0
