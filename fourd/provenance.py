"""What a rendered pixel rests on, from the estimates that it was composed of."""

import dataclasses
from collections.abc import Mapping

import numpy as np

# Pairs of cameras at this instant and the visual hull have the numbers of `depth_source`.
NOTHING, PAIRS, HULL, STATIC, CONTINUED = range(5)
NAMES = ("nothing", "pairs", "visual hull", "static surface", "filled")
FOREGROUND_KEYS = ("consensus_valid", "depth", "depth_source", "source")
BACKGROUND_KEYS = ("farthest_valid", "depth", "filled")
# In an archive, a pixel whose colour no camera gave.
NO_CAMERA = 255


@dataclasses.dataclass(frozen=True, eq=False)
class Provenance:
    """Of every pixel of one picture.

    depth: (H, W) float32, world units along the optical axis, infinite where unknown
    kind: (H, W) uint8 NOTHING (the network's guess), PAIRS, HULL, STATIC or CONTINUED (static, into a hole)
    source: (H, W) int32 index of the camera whose colour weighs most, -1 where none is told apart
    """

    depth: np.ndarray
    kind: np.ndarray
    source: np.ndarray


def find_provenance(foreground: Mapping[str, np.ndarray], background: Mapping[str, np.ndarray]) -> Provenance:
    """The instantaneous surface before the static one, as composition pastes them.

    foreground: FOREGROUND_KEYS;  background: BACKGROUND_KEYS of the same pixels (docs/formats.md)
    """
    near, far = foreground["consensus_valid"], background["farthest_valid"]
    static = np.where(background["filled"], CONTINUED, STATIC)
    depth = np.where(near, foreground["depth"], np.where(far, background["depth"], np.inf))
    source = foreground["source"].astype(np.int32)
    return Provenance(
        depth=np.nan_to_num(depth, nan=np.inf, posinf=np.inf).astype(np.float32),
        kind=np.where(near, foreground["depth_source"], np.where(far, static, NOTHING)).astype(np.uint8),
        source=np.where(near & (source != NO_CAMERA), source, -1),
    )
