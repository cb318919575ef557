"""N.N. all-time: the most similar-looking picture that any input camera filmed at any time.

The query is the true held-out image, as in N.N. same-time. Films are searched at the evaluated
frames and at `evaluate.neighbour_frames` others, evenly spread.
"""

import numpy as np

from fourd.baselines.evidence import Evidence


def render(evidence: Evidence) -> np.ndarray:
    """(H, W, 3) uint8 nearest picture of the whole event; of two equally near, the first."""
    return evidence.films.read(*evidence.films.nearest(evidence.query))
