"""SfM+humans, a body model fitted to people over the sparse points: not built, and its row says so."""

import numpy as np

from fourd.baselines.evidence import Evidence, Unavailable


def render(evidence: Evidence) -> np.ndarray:
    """Raises Unavailable: nothing here finds people or fits bodies yet."""
    raise Unavailable("not built: needs a pose and a body model")
