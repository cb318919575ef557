"""Stage stereo: planar rectification of camera pairs, then disparity in both directions (paper 3.1)."""

STAGE_VERSION = 4
