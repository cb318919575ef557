"""SfM+humans: a body model fitted to the people over the sparse points; its row says why it is empty."""

import numpy as np

from fourd.baselines.evidence import Evidence, Unavailable


def render(evidence: Evidence) -> np.ndarray:
    """Raises Unavailable: the pose and body models are an extra that is not installed."""
    raise Unavailable("extra not installed: pose and body models")
