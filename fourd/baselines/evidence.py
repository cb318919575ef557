"""What a method is given to make one frame of a held-out view."""

import dataclasses
from collections.abc import Mapping

import numpy as np


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """All images are (H, W, 3) uint8 RGB of the output size, masks (H, W) bool.

    foreground: `consensus_rgb`, `consensus_valid`;  background: `farthest_rgb`, `farthest_valid`
    rendered:   the frame that the stage `render` wrote
    inputs:     what each input camera filmed at the same time, brought to the output size
    truth:      what the held-out camera filmed; only the nearest neighbours may ask it which
                camera is nearest, no method may copy from it
    """

    foreground: Mapping[str, np.ndarray]
    background: Mapping[str, np.ndarray]
    rendered: np.ndarray
    inputs: Mapping[str, np.ndarray]
    truth: np.ndarray
