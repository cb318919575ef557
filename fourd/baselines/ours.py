"""The frame that the trained generators made (stage `render`)."""

import numpy as np

from fourd.baselines.evidence import Evidence


def render(evidence: Evidence) -> np.ndarray:
    """(H, W, 3) uint8 as read from the rendered PNG."""
    return evidence.rendered
