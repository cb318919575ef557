"""A mask through one film, without depth: flow carries it, colour settles its outline.

For films that no second camera saw. Several cameras do better (`carry.py`).
"""

from collections.abc import Callable, Iterable, Iterator

import cv2
import numpy as np

from fourd.edit.carry import carry_flow
from fourd.edit.colours import learn_colours
from fourd.edit.outline import widen
from fourd.edit.voxels import OBJECT, OTHER

# How far beyond the carried outline colour may take pixels, and the blur of opinions: shares of the diagonal.
_OUTER_SHARE, _BLUR_SHARE = 0.045, 0.002
# Weight of the flow's opinion against that of a colour, which lies between -1 and 1.
_TRUST = 0.7
# Work is done on pictures of at most so many px in width.
_MAX_WIDTH_PX = 427
_LEAST_SHARE = 0.1
Carry = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def follow_mask(
    images: Iterable[np.ndarray], mask: np.ndarray, carry: Carry = carry_flow
) -> Iterator[np.ndarray]:
    """(H, W) bool masks of all pictures of a film.

    images: (H, W, 3) uint8 each;  mask: (H, W) bool of the first
    carry: takes a mask from frame to frame, as `carry_flow` does
    """
    size = mask.shape[1], mask.shape[0]
    step = max(1.0, size[0] / _MAX_WIDTH_PX)
    small = round(size[0] / step), round(size[1] / step)
    before, colours, first = None, None, None
    current = cv2.resize(mask.astype(np.uint8), small, interpolation=cv2.INTER_AREA) > 0
    for image in images:
        picture = cv2.resize(image, small, interpolation=cv2.INTER_AREA)
        if before is None:
            near = widen(current, _pixels(small, 6 * _OUTER_SHARE)) & ~widen(current, 1)
            colours = learn_colours({"": picture}, {"": (current, near)})
            first = float(current.sum())
            yield mask
        else:
            carried = carry(picture, before, current.astype(np.uint8))
            assert colours is not None and first is not None
            found = cut(picture, carried, colours.of(picture))
            # A thing that is hidden keeps its place until it is seen again.
            current = found if found.sum() >= _LEAST_SHARE * first else carried == OBJECT
            yield cv2.resize(current.astype(np.uint8) * 255, size, interpolation=cv2.INTER_LINEAR) > 127
        before = picture


def _pixels(size: tuple[int, int], share: float) -> int:
    return max(1, round(share * float(np.hypot(*size))))


def cut(picture: np.ndarray, carried: np.ndarray, belief: np.ndarray) -> np.ndarray:
    """(H, W) bool: the carried mask with its outline settled by colour.

    carried: (H, W) uint8 OBJECT, OTHER or UNKNOWN;  belief: (H, W) float32, how much a colour is the thing's
    What flow has carried goes on unless its colour is surely another's; where flow knows nothing, colour
    decides.
    """
    size = picture.shape[1], picture.shape[0]
    reach = widen(carried == OBJECT, _pixels(size, _OUTER_SHARE))
    likely = cv2.GaussianBlur(belief, (0, 0), 1.0)
    sign = np.where(carried == OBJECT, _TRUST, np.where(carried == OTHER, -_TRUST, 0.0)).astype(np.float32)
    score = cv2.GaussianBlur(sign + likely, (0, 0), max(1.0, _pixels(size, _BLUR_SHARE)))
    return np.asarray((score > 0) & reach)
