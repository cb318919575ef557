"""Sparse points by matching SIFT features between neighbouring known cameras."""

import itertools
from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.geometry import angle_deg, triangulate
from fourd.sfm.options import SfmOptions

# Closer centres than this, in normalised world units, give no parallax.
MIN_BASELINE = 1e-6


def sparse_frames(num_frames: int, num_sparse_frames: int) -> list[int]:
    """Frames at the middles of equal parts of the clip, ascending."""
    count = min(num_frames, num_sparse_frames)
    return [int((i + 0.5) * num_frames / count) for i in range(count)]


def select_pairs(cameras: Mapping[str, Camera], options: SfmOptions) -> list[tuple[str, str]]:
    """Every camera with its nearest neighbours by centre, among those that look the same way.

    The order is that of `cameras`; a pair is named once.
    """
    wanted = set()
    for name, camera in cameras.items():
        ranked = []
        for other, candidate in cameras.items():
            baseline = float(np.linalg.norm(candidate.center - camera.center))
            angle = float(angle_deg(camera.forward, candidate.forward))
            if other != name and baseline > MIN_BASELINE and angle <= options.max_pair_angle_deg:
                ranked.append((baseline, other))
        wanted |= {frozenset((name, other)) for _, other in sorted(ranked)[: options.num_neighbors]}
    return [pair for pair in itertools.combinations(cameras, 2) if frozenset(pair) in wanted]


def detect_features(
    image: np.ndarray, max_features: int, min_contrast: float = 0.04
) -> tuple[np.ndarray, np.ndarray]:
    """SIFT: (N, 2) float64 px, our pixel centres, and (N, 128) float32 descriptors of whole numbers.

    image: (H, W, 3) uint8 RGB;  min_contrast: of an extremum, its default is the detector's own
    """
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = cv2.SIFT.create(
        nfeatures=max_features, contrastThreshold=min_contrast, enable_precise_upscale=True
    ).detectAndCompute(gray, None)  # type: ignore[call-overload]
    if descriptors is None or len(keypoints) == 0:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    rows = np.array([(*k.pt, k.size, k.angle) for k in keypoints])
    # The detector's order depends on its threads; the results must not.
    order = np.lexsort(rows.T[::-1])
    return rows[order, :2].astype(np.float64), descriptors[order].astype(np.float32)


def match_descriptors(a: np.ndarray, b: np.ndarray, ratio: float) -> np.ndarray:
    """(M, 2) indices of mutual nearest descriptors that pass the ratio test in both directions.

    a: (N, 128), b: (P, 128) float32;  ratio: nearest over second nearest distance, below this
    Source: D. Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", section 7.1.
    """
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    # SIFT's whole numbers stay below 2^24 here, so the product is exact in any order of summation.
    squared = (a * a).sum(1)[:, None] + (b * b).sum(1)[None] - 2 * (a @ b.T)
    nearest = squared.argmin(axis=1)
    distance = squared[np.arange(len(a)), nearest]
    mutual = np.flatnonzero(distance <= squared.min(axis=0)[nearest])
    # Two descriptors with one and the same nearest are ambiguous.
    mutual = mutual[np.bincount(nearest[mutual], minlength=len(b))[nearest[mutual]] == 1]
    matched = nearest[mutual]
    squared[mutual, matched] = np.inf
    second = np.minimum(squared.min(axis=1)[mutual], squared.min(axis=0)[matched])
    distinct = distance[mutual] < ratio**2 * second
    return np.stack([mutual[distinct], matched[distinct]], axis=1)


def epipolar_error_px(
    left: Camera, right: Camera, left_pixels: np.ndarray, right_pixels: np.ndarray
) -> np.ndarray:
    """(N,) distance of each pixel to the epipolar line of its match, the larger of both images.

    left_pixels, right_pixels: (N, 2) px, of the lens as it is; lines are straight, so distances
    are measured in the ideal pinhole images. NaN for a pair without a baseline.
    Source: Hartley and Zisserman, Multiple View Geometry, 9.2.
    """
    right_from_left = right.R @ left.R.T
    translation = right.R @ (left.center - right.center)
    tx, ty, tz = translation / np.linalg.norm(translation) if translation.any() else np.full(3, np.nan)
    essential = np.array([[0, -tz, ty], [tz, 0, -tx], [-ty, tx, 0]]) @ right_from_left
    fundamental = np.linalg.inv(right.K).T @ essential @ np.linalg.inv(left.K)
    in_left = left.rays(left_pixels) @ left.K.T
    in_right = right.rays(right_pixels) @ right.K.T
    lines_right = in_left @ fundamental.T
    lines_left = in_right @ fundamental
    residual = np.abs((in_right * lines_right).sum(axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        return residual / np.minimum(
            np.linalg.norm(lines_left[:, :2], axis=1), np.linalg.norm(lines_right[:, :2], axis=1)
        )


def triangulate_matches(
    left: Camera, right: Camera, left_pixels: np.ndarray, right_pixels: np.ndarray, options: SfmOptions
) -> np.ndarray:
    """(M, 3) world points of the matches that hold up.

    Kept are matches near their epipolar lines, in front of both cameras, whose rays meet at more
    than the smallest angle and whose point projects back near both pixels.
    """
    error = epipolar_error_px(left, right, left_pixels, right_pixels)
    near_line = np.isfinite(error) & (error <= options.max_epipolar_error_px)
    pixels = np.stack([left_pixels[near_line], right_pixels[near_line]])
    if pixels.shape[1] == 0:
        return np.zeros((0, 3))
    points = triangulate([left, right], pixels)
    keep = np.isfinite(points).all(axis=1)
    points, pixels = points[keep], pixels[:, keep]
    good = angle_deg(points - left.center, points - right.center) >= options.min_triangulation_angle_deg
    for camera, seen in zip((left, right), pixels, strict=True):
        projected, depth = camera.project(points)
        # Behind the camera the projection is NaN, and no comparison with NaN is true.
        good &= (depth > 0) & (np.linalg.norm(projected - seen, axis=1) <= options.max_reprojection_error_px)
    return points[good]


def find_sparse_points(
    cameras_at: Callable[[int], Mapping[str, Camera]],
    read_frame: Callable[[str, int], np.ndarray],
    frames: Sequence[int],
    options: SfmOptions,
) -> np.ndarray:
    """(N, 3) sparse points, world units, from the given frames of the cameras.

    cameras_at: frame -> cameras by name;  read_frame: (name, frame) -> (H, W, 3) uint8 RGB
    A point that several pairs see is in the list once per pair.
    """
    found = [np.zeros((0, 3))]
    for frame in frames:
        cameras = cameras_at(frame)
        pairs = select_pairs(cameras, options)
        used = sorted({name for pair in pairs for name in pair})
        features = {name: detect_features(read_frame(name, frame), options.max_features) for name in used}
        for left, right in pairs:
            matches = match_descriptors(features[left][1], features[right][1], options.match_ratio)
            seen = (features[left][0][matches[:, 0]], features[right][0][matches[:, 1]])
            found.append(triangulate_matches(cameras[left], cameras[right], *seen, options))
    return np.concatenate(found)
