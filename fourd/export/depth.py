"""A camera's own depth from the disparities of its pairs, without projecting between cameras.

A rectified picture has its camera's centre, so a disparity map is carried to the camera by a lookup.
"""

import logging
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.export.event import own_pinhole
from fourd.fuse.files import DisparityFiles
from fourd.fuse.geometry import PairFrame
from fourd.io import ArchiveWriter
from fourd.sfm.cameras import SceneCameras

log = logging.getLogger(__name__)

# Two estimates agree within so many standard deviations of their difference.
TOLERANCE = 3.0


def inverse_depth_of_pair(pair: PairFrame, name: str, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth, and its standard deviation, of every pixel of a pinhole from one pair.

    name: of the pair's camera whose place the pinhole has
    Returns (H, W) float32 each, NaN where the pair knows nothing.
    """
    is_left = name == pair.left
    K, R = (pair.K_left, pair.R_left) if is_left else (pair.K_right, pair.R_right)
    disparity = pair.left_disparity if is_left else pair.right_disparity
    confidence = pair.left_confidence if is_left else pair.right_confidence
    side = 0 if is_left else 1
    width, height = camera.size
    rays = R @ camera.R.T @ np.linalg.inv(camera.K)
    # Nearest, because a mean of two depths at an edge is the depth of nothing.
    how = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    there = {"flags": how, "borderMode": cv2.BORDER_CONSTANT, "borderValue": float("nan")}
    d, c = (cv2.warpPerspective(m, K @ rays, camera.size, **there) for m in (disparity, confidence))
    # z along the rectified axis of the ray that has z = 1 in the camera.
    across = (rays[2, 0] * np.arange(width)).astype(np.float32)
    along = (rays[2, 1] * np.arange(height)[:, None] + rays[2, 2]).astype(np.float32)
    z = across + along
    per_px = np.float32(pair.inverse_depth_per_px[side]) * z
    inverse = (d - np.float32(pair.disparity_at_infinity[side])) * per_px
    with np.errstate(divide="ignore", invalid="ignore"):
        sigma = np.float32(pair.sigma_px) * per_px / c
    unknown = ~((inverse > 0) & (sigma > 0) & (sigma < np.inf) & (z > 0))
    inverse[unknown] = sigma[unknown] = np.nan
    return inverse, sigma


def agree(inverse: np.ndarray, sigma: np.ndarray, min_agreeing: int) -> np.ndarray:
    """The depth that most pairs agree on, averaged over them with the weights of their sigmas.

    inverse, sigma: (P, H, W), NaN where unknown;  min_agreeing: pairs that must, itself included
    Returns (H, W) float32 depth, 0 where fewer agree.
    """
    best = np.zeros(inverse.shape[1:], np.float32)
    most = np.full(inverse.shape[1:], min_agreeing - 1, np.uint8)
    variance = np.square(sigma, dtype=np.float32)
    weight = np.nan_to_num(1 / variance)
    value = weight * np.nan_to_num(inverse)
    for own, own_variance in zip(inverse, variance, strict=True):
        with np.errstate(invalid="ignore"):
            near = np.square(inverse - own) <= np.float32(TOLERANCE**2) * (variance + own_variance)
        count = near.sum(axis=0, dtype=np.uint8)
        wins = count > most
        with np.errstate(divide="ignore", invalid="ignore"):
            mean = (value * near).sum(axis=0) / (weight * near).sum(axis=0)
        best[wins], most[wins] = mean[wins], count[wins]
    return np.divide(1, best, out=np.zeros_like(best), where=best > 0)


def run_depth(
    scene: SceneCameras, name: str, disparity: Sequence[Path], size: tuple[int, int] | None, output: Path
) -> None:
    """Write the archive of an input camera's depths, scene units, one `depth` per scene frame, 0 = unknown.

    disparity: files of the pairs that the camera is in
    Raises InputError if a frame is missing in all files of a pair.
    """
    if name in scene.left_out:
        log.warning("%s is left out: %s", name, scene.left_out[name])
        with ArchiveWriter(output, {"camera": name, "status": scene.left_out[name]}):
            return
    if name not in scene.tracks:
        raise InputError(f"expected a camera of {', '.join(scene.tracks)}, got {name}: check the name")
    files = DisparityFiles(disparity, view="")
    pairs = [pair for pair in files.pairs if name in pair.split("-")]
    if not pairs:
        reasons = "; ".join(f"{pair}: {reason}" for pair, reason in files.refused.items())
        log.warning("%s: no pair could be matched, its depths are empty (%s)", name, reasons)
    meta = {"camera": name, "status": "ok", "pairs": pairs, "min_agreeing": min(2, len(pairs))}
    with ArchiveWriter(output, meta) as writer:
        for frame in range(scene.num_frames):
            camera = own_pinhole(scene, name, frame, size)
            depth = np.zeros(camera.size[::-1], np.float32)
            if pairs:
                known = [inverse_depth_of_pair(files.read(pair, frame), name, camera) for pair in pairs]
                inverse, sigma = (np.stack(maps) for maps in zip(*known, strict=True))
                depth = agree(inverse, sigma, min(2, len(pairs)))
            writer.add_frame(frame, depth=depth)
    files.close()
