"""How alike two pictures look: the feature of the nearest neighbours, and all films by it.

The paper compares conv-5 activations of AlexNet (`FeatureNetwork.describe`, where its weights are
given). `describe_image` is the fallback without weights: a grey thumbnail and a grid of gradient
orientation histograms, each normalised, with equal weight. Both are of unit length.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np

from fourd.image import grey_from_rgb, resize_area

THUMBNAIL_SIZE = (64, 36)
NUM_ORIENTATIONS = 9
CELL_PX = 4
FALLBACK_FEATURE = "feature: thumbnail and gradient histograms"
NETWORK_FEATURE = "feature: AlexNet conv5"


@dataclasses.dataclass(frozen=True, eq=False)
class FilmIndex:
    """Features of all input cameras over the event, and how to get a picture back.

    keys: (camera, scene frame) of each row of `features`, (N, D)
    read: the picture of a key, (H, W, 3) uint8 of the output size
    name: which feature it is, for the table
    """

    keys: Sequence[tuple[str, int]]
    features: np.ndarray
    read: Callable[[str, int], np.ndarray]
    name: str

    def feature_of(self, camera: str, frame: int) -> np.ndarray:
        """(D,) feature of a key. Raises ValueError for one that is not in the index."""
        return self.features[self.keys.index((camera, frame))]

    def nearest(self, query: np.ndarray) -> tuple[str, int]:
        """The key with the nearest feature; of two equally near, the first."""
        return self.keys[int(np.linalg.norm(self.features - query, axis=1).argmin())]


def nearest_name(features: Mapping[str, np.ndarray], query: np.ndarray) -> str:
    """The name with the nearest feature; of two equally near, the first."""
    distances = {name: float(np.linalg.norm(feature - query)) for name, feature in features.items()}
    return min(distances, key=distances.__getitem__)


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
