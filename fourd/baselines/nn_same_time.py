"""N.N. same-time: what the most similar-looking input camera filmed at the same time.

The query is the true held-out image, so this picks the best neighbour by appearance; the paper
queries with its own generated frame, which can only choose worse.
"""

import numpy as np

from fourd.baselines.evidence import Evidence
from fourd.baselines.nearest import nearest_name


def render(evidence: Evidence) -> np.ndarray:
    """(H, W, 3) uint8 frame of the nearest camera; of two equally near, the first."""
    features = {name: entry.feature for name, entry in evidence.inputs.items()}
    return evidence.inputs[nearest_name(features, evidence.query)].image
