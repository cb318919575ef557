"""SfM, densified: every pixel has the colour of the nearest sparse point in the picture."""

import numpy as np

from fourd.baselines.evidence import Evidence
from fourd.baselines.sfm import draw_points, fill_nearest


def render(evidence: Evidence) -> np.ndarray:
    """(H, W, 3) uint8 without blanks."""
    return fill_nearest(*draw_points(evidence, 0))
