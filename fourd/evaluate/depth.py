"""Estimated depth of a held-out view against the true one, where somebody knows it.

The true depth of a film's frame 12 is `000012.npz` in a folder of the camera, with one array `z`: (H, W)
depth along the optical axis at every pixel of the film, infinite in the sky. Frames without a file are
not compared.
"""

import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from fourd.baselines import Evidence
from fourd.camera import Camera
from fourd.errors import InputError

KEY = "z"
# What is compared, as methods of the rows: the consensus alone, and with the background behind it.
CONSENSUS, SURFACE = "depth_consensus", "depth_surface"
WITHIN = {"depth_within_1": 0.01, "depth_within_5": 0.05}
# Of each frame this many pixels, evenly spread, tell the scale of the world.
NUM_SCALE_PIXELS = 4096


def read_true_depth(folder: Path, frame: int, camera: Camera, target: Camera) -> np.ndarray | None:
    """(h, w) float32 true z as the target view sees it, NaN where the camera did not look.

    camera: took the film's frame;  target: of the same centre. The nearest pixel counts: a mean over a
    depth edge would be the depth of nothing. None without a file. Raises InputError for a file of
    another form or size.
    """
    path = folder / f"{frame:06d}.npz"
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as archive:
            depth = archive[KEY].astype(np.float32)
    except (KeyError, ValueError, EOFError, OSError, zipfile.BadZipFile) as error:
        raise InputError(
            f"expected an array `{KEY}` of true depth in {path}, got: {error}: write it again"
        ) from None
    if depth.shape != camera.size[::-1]:
        raise InputError(
            f"expected depth of the film's {camera.size[0]} x {camera.size[1]} px in {path}, got an array "
            f"of shape {depth.shape}: give depth of the original size"
        )
    return _seen_from(depth, camera, target)


def _seen_from(depth: np.ndarray, camera: Camera, target: Camera) -> np.ndarray:
    width, height = target.size
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    pixels, z = camera.project(target.unproject(grid, np.ones((height, width))))
    pixels = np.floor(np.nan_to_num(pixels, nan=-1.0) + 0.5)
    inside = (z > 0) & (pixels >= 0).all(axis=-1) & (pixels < camera.size).all(axis=-1)
    column, row = np.where(inside[..., None], pixels, 0).astype(np.intp).transpose(2, 0, 1)
    # A point at z 1 of the target is at `z` of the camera.
    return np.where(inside, depth[row, column] / np.where(inside, z, 1), np.nan).astype(np.float32)


def compare_depth(found: np.ndarray, true: np.ndarray, region: np.ndarray) -> dict[str, tuple[float, int]]:
    """Metric -> (value, pixels it is of) within a region; NaN where there is none.

    found, true: (H, W) z in one unit, NaN where there is no estimate, or nobody knows;  region: (H, W) bool
    depth_coverage: share of the pixels of finite true depth that have an estimate;  depth_error: median of
    |found - true| / true over those, an infinite estimate being infinitely wrong;  depth_within_N: share
    of those whose error is at most N percent.
    """
    known = region & np.isfinite(true)
    has_both = known & ~np.isnan(found)
    num_known, count = int(known.sum()), int(has_both.sum())
    errors = np.abs(found[has_both].astype(np.float64) / true[has_both] - 1)
    values = {
        "depth_coverage": (count / num_known if num_known else np.nan, num_known),
        "depth_error": (float(np.median(errors)) if count else np.nan, count),
    }
    return values | {
        name: (float((errors <= limit).mean()) if count else np.nan, count) for name, limit in WITHIN.items()
    }


def score_depth(
    evidence: Evidence, true: np.ndarray, regions: Mapping[str, np.ndarray]
) -> Iterable[tuple[str, str, str, float, int]]:
    """(method, region, metric, value, num_pixels) of both estimates. true: (H, W) z, world units."""
    near = evidence.foreground["consensus_valid"]
    consensus = np.where(near, evidence.foreground["depth"], np.float32(np.nan))
    for method, found in ((CONSENSUS, consensus), (SURFACE, evidence.depth)):
        for name, region in regions.items():
            for metric, (value, count) in compare_depth(found, true, region).items():
                yield method, name, metric, value, count


def fit_scale(pairs: Iterable[tuple[np.ndarray, np.ndarray]]) -> float:
    """True units in one of the estimates': the median ratio of true depth to found depth; NaN without any.

    pairs: (found, true), (H, W) each, NaN or infinite where unknown
    """
    ratios = []
    for found, true in pairs:
        usable = np.isfinite(found) & np.isfinite(true) & (found > 0)
        ratio = true[usable].astype(np.float64) / found[usable]
        ratios.append(ratio[:: max(1, len(ratio) // NUM_SCALE_PIXELS)])
    joined = np.concatenate(ratios) if ratios else np.zeros(0)
    return float(np.median(joined)) if len(joined) else np.nan
