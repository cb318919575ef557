"""Depth-blended image-based rendering: the two nearest inputs warped over the estimated surface.

The surface is the consensus depth, else that of the static background; which inputs see it is
found from the same depth (`fourd.baselines.warp`). What none sees gets the mean colour of the rest.
Source: Buehler, Bosse, McMillan, Gortler, Cohen, "Unstructured lumigraph rendering", SIGGRAPH 2001,
with two cameras and angles alone.
"""

import numpy as np

from fourd.baselines.evidence import Evidence


def render(evidence: Evidence) -> np.ndarray:
    """(H, W, 3) uint8 blend of two inputs."""
    image, shown = evidence.warp.image, evidence.warp.num_seen > 0
    if not shown.any():
        return np.zeros_like(image)
    image = image.copy()
    image[~shown] = np.floor(image[shown].mean(axis=0, dtype=np.float64) + 0.5).astype(np.uint8)
    return image
