"""Layers of the cost volume: the samples of what is marked, taken out or kept before the consensus."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import overload

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.fuse.geometry import PairFrame

# Disparities spread over an outline by about half a matching window; so far beyond it they go as well.
_REACH_PX = 3


class LayeredPairs(Sequence[PairFrame]):
    """Pairs whose disparities are blank inside, or outside, a mask of each camera's picture."""

    def __init__(
        self,
        pairs: Sequence[PairFrame],
        masks: Mapping[str, np.ndarray],
        cameras: Mapping[str, Camera],
        is_kept: bool = False,
    ) -> None:
        """masks: camera -> (H, W) bool of its ideal pinhole;  cameras: at the instant of the pairs

        is_kept: whether the marked samples stay and all else goes, or the other way round
        A camera without a mask has nothing marked.
        """
        self._pairs = pairs
        self._is_kept = is_kept
        self._cameras = cameras
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _REACH_PX + 1, 2 * _REACH_PX + 1))
        self._masks = {
            name: mask.astype(np.uint8) if is_kept else cv2.dilate(mask.astype(np.uint8), disc)
            for name, mask in masks.items()
        }

    def __len__(self) -> int:
        return len(self._pairs)

    @overload
    def __getitem__(self, index: int) -> PairFrame: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[PairFrame]: ...
    def __getitem__(self, index):
        pair = self._pairs[index]
        left = self._blank(pair.left, pair.left_disparity, pair.K_left, pair.R_left)
        right = self._blank(pair.right, pair.right_disparity, pair.K_right, pair.R_right)
        return dataclasses.replace(pair, left_disparity=left, right_disparity=right)

    def _blank(self, name: str, disparity: np.ndarray, K: np.ndarray, R: np.ndarray) -> np.ndarray:
        marked = np.zeros(disparity.shape, bool)
        if name in self._masks:
            marked = rectify_mask(self._masks[name], self._cameras[name], disparity.shape, K, R)
        gone = ~marked if self._is_kept else marked
        return np.where(gone, np.float32(np.nan), disparity)


def rectify_mask(
    mask: np.ndarray, camera: Camera, shape: tuple[int, ...], K: np.ndarray, R: np.ndarray
) -> np.ndarray:
    """(h, w) bool mask as the rectified picture of the same centre sees it.

    mask: (H, W) uint8 of the camera's ideal pinhole;  shape: (h, w);  K, R: of the rectified picture
    """
    camera_from_rectified = camera.K @ camera.R @ R.T @ np.linalg.inv(K)
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(mask, camera_from_rectified, (shape[1], shape[0]), flags=flags) > 0
