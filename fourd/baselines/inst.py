"""Inst: the instantaneous foreground by consensus alone, blanks shown as black (section 3.1)."""

import numpy as np

from fourd.baselines.evidence import Evidence


def render(evidence: Evidence) -> np.ndarray:
    """(H, W, 3) uint8 consensus image, black where it is blank."""
    valid = evidence.foreground["consensus_valid"]
    return np.where(valid[..., None], evidence.foreground["consensus_rgb"], np.uint8(0))
