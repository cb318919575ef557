"""N.N. same-time: what the most similar-looking input camera filmed at the same time.

The query is the true held-out image, so this picks the best neighbour by appearance; the paper
queries with its own generated frame, which can only choose worse. The feature is a documented
fallback for the paper's conv-5 activations of AlexNet: a grey thumbnail and a grid of gradient
orientation histograms, each normalised, with equal weight.
"""

import cv2
import numpy as np

from fourd.baselines.evidence import Evidence
from fourd.image import grey_from_rgb, resize_area

THUMBNAIL_SIZE = (64, 36)
NUM_ORIENTATIONS = 9
CELL_PX = 4


def render(evidence: Evidence) -> np.ndarray:
    """(H, W, 3) uint8 frame of the nearest camera; of two equally near, the first."""
    query = describe_image(evidence.truth)
    distances = {cam: np.linalg.norm(describe_image(i) - query) for cam, i in evidence.inputs.items()}
    return evidence.inputs[min(distances, key=distances.__getitem__)]


def describe_image(image: np.ndarray) -> np.ndarray:
    """Feature vector of a picture of any size, float64 of norm 1 (0 for a constant picture).

    The thumbnail has its mean taken off, so brightness does not count; orientations are unsigned,
    weighted with the gradient's length and collected over cells of 4 x 4 thumbnail px.
    """
    # The luma of areas, not areas of luma rounded to 8 bits.
    grey = grey_from_rgb(resize_area(image, THUMBNAIL_SIZE)).astype(np.float64)
    dx = cv2.Sobel(grey, cv2.CV_64F, 1, 0)
    dy = cv2.Sobel(grey, cv2.CV_64F, 0, 1)
    orientation = np.arctan2(dy, dx) % np.pi
    bins = np.minimum((orientation * (NUM_ORIENTATIONS / np.pi)).astype(int), NUM_ORIENTATIONS - 1)
    rows, columns = np.indices(grey.shape) // CELL_PX
    num_columns = THUMBNAIL_SIZE[0] // CELL_PX
    index = (rows * num_columns + columns) * NUM_ORIENTATIONS + bins
    num_bins = (THUMBNAIL_SIZE[1] // CELL_PX) * num_columns * NUM_ORIENTATIONS
    histograms = np.bincount(index.ravel(), np.hypot(dx, dy).ravel(), minlength=num_bins)
    feature = np.concatenate([_normalize(grey.ravel() - grey.mean()), _normalize(histograms)])
    return _normalize(feature)


def _normalize(vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector)
    return vector / length if length > 0 else vector
