"""Observations of moving points in several films: what visual alignment works on."""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True, eq=False)
class MovingPoints:
    """N observations of M moving points by C cameras; the same point has one number in all cameras.

    names: the C camera names
    cam: (N,) int64 index into names;  point: (N,) int64 in 0..M-1;  frame: (N,) int64 source frame
    own_s: (N,) float64 time on the camera's own clock, s;  pixels: (N, 2) float64 px, lens as it is
    sigma_px: (N,) float64 standard deviation of the pixel position
    """

    names: tuple[str, ...]
    cam: np.ndarray
    point: np.ndarray
    frame: np.ndarray
    own_s: np.ndarray
    pixels: np.ndarray
    sigma_px: np.ndarray
