"""Speed of projection and fusion, and error against the settings of the consensus.

    python -m benches.fuse --output DIR [--size 960 540]

The scene is exact: seven cameras on an arc, a floor, a wall and four balls, ray cast in closed form.
Disparities are the true ones, with noise, outliers and holes like a matcher's, and with what only one
camera of a pair can see left out. Writes fuse_speed.csv (compiled, torch on one CPU thread, plain
numpy, the slow reference) and fuse_error.csv (tolerance and pairs).
"""

import argparse
import dataclasses
import math
import resource
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benches.fuse_numpy import NumpyBackend
from fourd import io
from fourd.camera import Camera
from fourd.fuse import FusedView, FuseOptions, PairFrame, fuse_view, view
from fourd.fuse.cpu import CpuBackend
from fourd.geometry import look_at

BALLS = ((0.0, 0.9, 0.0, 0.5), (0.8, 0.6, -0.6, 0.35), (-0.9, 0.5, 0.4, 0.4), (0.3, 1.7, 0.9, 0.25))
SIGMA_PX = 0.3
# Neighbours share most of a matcher's error, because they share most of its support.
NOISE_WIDTH_PX = 2.0
OUTLIERS = 0.04
DENSITY = 0.55
SPEED_COLUMNS = (
    "method",
    "size",
    "pairs",
    "points",
    "seconds",
    "mpoints_per_s",
    "without_colours_mpoints_per_s",
)
ERROR_COLUMNS = (
    "tolerance", "min_pairs", "max_front", "covered", "error", "within_1_percent", "seconds", "cpu_seconds",
    "peak_rss_mb",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Scene:
    target: Camera
    truth: np.ndarray
    cameras: dict[str, Camera]
    images: dict[str, np.ndarray]
    pairs: list[PairFrame]


def place_camera(azimuth_deg: float, size: tuple[int, int]) -> Camera:
    a = math.radians(azimuth_deg)
    center = np.array([4.8 * math.sin(a), 1.5, -4.8 * math.cos(a)])
    R, t = look_at(center, np.array([0.0, 0.8, 0.0]), np.array([0.0, 1.0, 0.0]))
    K = np.array([[0.85 * size[0], 0, (size[0] - 1) / 2], [0, 0.85 * size[0], (size[1] - 1) / 2], [0, 0, 1]])
    return Camera(K, R, t, size)


def ray_cast(camera: Camera) -> np.ndarray:
    """(H, W) z of the first surface: a floor, a cylinder wall of radius 9, balls."""
    y, x = np.mgrid[: camera.size[1], : camera.size[0]].astype(np.float64)
    d = camera.rays(np.stack([x, y], -1)) @ camera.R
    o = camera.center
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(d[..., 1] < 0, -o[1] / d[..., 1], np.inf)
        for center, radius, axes in [((0, 0, 0), 9.0, (0, 2))] + [(b[:3], b[3], (0, 1, 2)) for b in BALLS]:
            e, f = d[..., axes], (o - np.array(center))[list(axes)]
            a, b, c = (e * e).sum(-1), e @ f, f @ f - radius * radius
            root = np.sqrt(b * b - a * c)
            s = np.where(c < 0, (-b + root) / a, (-b - root) / a)
            depth = np.where(s > 0, np.fmin(depth, s), depth)
    return depth


def make_pair(names: tuple[str, str], cameras: dict[str, Camera], rng: np.random.Generator) -> PairFrame:
    left, right = (cameras[name] for name in names)
    baseline = right.center - left.center
    x = baseline / np.linalg.norm(baseline)
    z = left.forward + right.forward
    z = (z - x * (z @ x)) / np.linalg.norm(z - x * (z @ x))
    R = np.stack([x, np.cross(z, x), z])
    rectified = [Camera(left.K, R, -R @ c.center, left.size) for c in (left, right)]
    depths = [ray_cast(camera) for camera in rectified]
    maps: dict[str, np.ndarray] = {}
    for side, i in (("left", 0), ("right", 1)):
        disparity, confidence = match(rectified, depths, i, float(np.linalg.norm(baseline)), rng)
        maps[f"{side}_disparity"], maps[f"{side}_confidence"] = disparity, confidence
    return PairFrame(
        *names, K_left=left.K, K_right=left.K, R_left=R, R_right=R, center_left=left.center,
        center_right=right.center, disparity_at_infinity=(0.0, 0.0),
        inverse_depth_per_px=(float(1 / (left.K[0, 0] * np.linalg.norm(baseline))),) * 2,
        sigma_px=SIGMA_PX, **maps,
    )  # fmt: skip


def match(
    rectified: list[Camera], depths: list[np.ndarray], side: int, baseline: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """True disparity of one image with a matcher's faults, and confidence in 0.3..1."""
    depth, other = depths[side], depths[1 - side]
    disparity = rectified[0].K[0, 0] * baseline / depth
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]].astype(np.float32)
    shifted = x + np.float32(1 if side else -1) * disparity.astype(np.float32)
    seen = cv2.remap(other.astype(np.float32), shifted, y, cv2.INTER_NEAREST, borderValue=-1.0)
    holes = cv2.GaussianBlur(rng.normal(size=depth.shape).astype(np.float32), (0, 0), 6)
    usable = (np.abs(seen - depth) < 0.02 * depth) & (holes < np.quantile(holes, DENSITY))
    confidence = cv2.resize(rng.uniform(0.3, 1, (8, 12)), depth.shape[::-1], interpolation=cv2.INTER_LINEAR)
    noise = cv2.GaussianBlur(rng.normal(size=depth.shape), (0, 0), NOISE_WIDTH_PX)
    noisy = disparity + noise / noise.std() * SIGMA_PX / confidence
    wrong = rng.random((depth.shape[0] // 8 + 1, depth.shape[1] // 8 + 1)) < OUTLIERS
    wrong = np.kron(wrong, np.ones((8, 8), bool))[: depth.shape[0], : depth.shape[1]]
    noisy = np.where(wrong, noisy * rng.uniform(0.6, 1.6), noisy)
    return np.where(usable, noisy, np.nan).astype(np.float32), confidence.astype(np.float32)


def make_scene(size: tuple[int, int], seed: int = 0) -> Scene:
    rng = np.random.default_rng(seed)
    cameras = {f"cam{i:02d}": place_camera(14.0 * (i - 3), size) for i in range(7)}
    images = {name: rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8) for name in cameras}
    names = list(cameras)
    couples = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    target = place_camera(5.0, size)
    pairs = [make_pair(couple, cameras, rng) for couple in couples]
    return Scene(target, ray_cast(target), cameras, images, pairs)


def fuse(scene: Scene, options: FuseOptions, device: str) -> FusedView:
    return fuse_view(scene.target, scene.pairs, scene.images, scene.cameras, options, device=device)


def measure_speed(scene: Scene, method: str, backend: Any, repeats: int) -> dict[str, Any]:
    """Best of a few runs; CPU seconds, because other work may share the machine."""
    device = {"torch": "torch:cpu", "reference": "reference"}.get(method, "cpu")
    colours: list[float] = []
    plain = backend.colours

    def timed(self: Any, *arguments: Any) -> Any:
        start = time.process_time()
        result = plain(self, *arguments)
        colours.append(time.process_time() - start)
        return result

    seconds, without = math.inf, math.inf
    backend.colours = timed
    original = view.CpuBackend
    view.CpuBackend = backend if method == "numpy" else original
    for _ in range(repeats):
        colours.clear()
        start = time.process_time()
        fused = fuse(scene, FuseOptions(), device)
        spent = time.process_time() - start
        seconds, without = min(seconds, spent), min(without, spent - sum(colours))
    backend.colours, view.CpuBackend = plain, original
    return {
        "method": method, "size": "x".join(map(str, scene.target.size)), "pairs": len(scene.pairs),
        "points": fused.num_points, "seconds": f"{seconds:.4f}",
        "mpoints_per_s": f"{fused.num_points / seconds / 1e6:.3f}",
        "without_colours_mpoints_per_s": f"{fused.num_points / without / 1e6:.3f}",
    }  # fmt: skip


def measure_error(scene: Scene, options: FuseOptions) -> dict[str, Any]:
    start, cpu_start = time.monotonic(), time.process_time()
    fused = fuse(scene, options, "cpu")
    depth = fused.depths["consensus"]
    known = np.isfinite(depth)
    error = np.abs(depth - scene.truth)[known] / scene.truth[known]
    return {
        "tolerance": options.tolerance, "min_pairs": options.min_pairs, "max_front": options.max_front,
        "covered": f"{known.mean():.4f}", "error": f"{error.mean():.5f}",
        "within_1_percent": f"{(error < 0.01).mean():.4f}", "seconds": f"{time.monotonic() - start:.3f}",
        "cpu_seconds": f"{time.process_time() - cpu_start:.3f}",
        "peak_rss_mb": f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f}",
    }  # fmt: skip


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--size", type=int, nargs=2, default=[960, 540])
    args = parser.parse_args(argv)
    import torch

    from fourd.fuse.reference import ReferenceBackend
    from fourd.fuse.torch_kernels import TorchBackend

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    small = make_scene((48, 28))
    scene = make_scene(tuple(args.size))
    fuse(small, FuseOptions(), "cpu")
    rows = [
        measure_speed(scene, "compiled", CpuBackend, 5),
        measure_speed(scene, "numpy", NumpyBackend, 1),
        measure_speed(scene, "torch", TorchBackend, 1),
        measure_speed(small, "reference", ReferenceBackend, 1),
    ]
    io.write_csv(args.output / "fuse_speed.csv", SPEED_COLUMNS, rows)
    for row in rows:
        print(row)
    base = FuseOptions()
    sweep = [dataclasses.replace(base, tolerance=t) for t in (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)]
    sweep += [dataclasses.replace(base, min_pairs=k) for k in (1, 2, 4, 5)]
    sweep += [dataclasses.replace(base, max_front=f) for f in (0.2, 0.7, 1000.0)]
    errors = [measure_error(scene, options) for options in sweep]
    io.write_csv(args.output / "fuse_error.csv", ERROR_COLUMNS, errors)
    for row in errors:
        print(row)


if __name__ == "__main__":
    main()
