"""The static background alone, blanks shown as black (section 3.2)."""

import numpy as np

from fourd.baselines.evidence import Evidence


def render(evidence: Evidence) -> np.ndarray:
    """(H, W, 3) uint8 temporal median of the farthest images, black where it is blank."""
    valid = evidence.background["farthest_valid"]
    return np.where(valid[..., None], evidence.background["farthest_rgb"], np.uint8(0))
