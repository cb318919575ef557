"""A wall, and squares that move before it, as three cameras see them: every depth in closed form."""

import numpy as np

from fourd.camera import Camera
from fourd.edit.carry import Instant
from fourd.edit.moving import find_moving
from fourd.fuse.geometry import PairFrame

SIZE = (96, 64)
NUM_FRAMES = 9
WALL_Z, NEAR_Z, MIDDLE_Z = 10.0, 4.0, 6.0
NAMES = ("cam00", "cam01", "cam02")
RED, GREEN = (200, 40, 40), (40, 180, 60)


def camera(name: str) -> Camera:
    """Cameras side by side, 0.8 apart, looking along z."""
    K = np.array([[80.0, 0, 47.5], [0, 80.0, 31.5], [0, 0, 1]])
    return Camera(K, np.eye(3), np.array([-0.8 * (NAMES.index(name) - 1), 0, 0]), SIZE)


def squares(frame: int) -> list[tuple[float, float, float, tuple[int, int, int]]]:
    """z, x of the middle, half side, colour: a green one that passes from the left behind a red one."""
    return [(MIDDLE_Z, -1.5 + 0.4 * frame, 0.7, GREEN), (NEAR_Z, 1.2 - 0.25 * frame, 0.6, RED)]


def see(name: str, frame: int, without: tuple[int, ...] = ()) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Picture (H, W, 3) uint8, depth (H, W) float32, label (H, W): 0 the wall, else a square's number + 1."""
    view = camera(name)
    grid = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).astype(float)
    wall = view.unproject(grid, np.full(grid.shape[:2], WALL_Z))
    checks = (np.floor(2 * wall[..., 0]) + np.floor(2 * wall[..., 1])) % 2
    image = np.where(checks[..., None] > 0, 150, 90) + np.zeros(3)
    depth, label = np.full(grid.shape[:2], WALL_Z, np.float32), np.zeros(grid.shape[:2], np.uint8)
    for number, (z, x, half, colour) in enumerate(squares(frame)):
        if number + 1 in without:
            continue
        places = view.unproject(grid, np.full(grid.shape[:2], z))
        inside = (np.abs(places[..., 0] - x) <= half) & (np.abs(places[..., 1]) <= half) & (z < depth)
        fine = 20 * ((np.floor(8 * (places[..., 0] - x)) + np.floor(8 * places[..., 1])) % 2)
        image[inside] = (np.array(colour) + fine[..., None])[inside]
        depth[inside], label[inside] = z, number + 1
    return image.astype(np.uint8), depth, label


def instant(frame: int) -> Instant:
    """Everything about a frame, with the others as the times to compare with."""
    cameras = {name: camera(name) for name in NAMES}
    images = {name: see(name, frame)[0] for name in NAMES}
    depths = {name: see(name, frame)[1] for name in NAMES}
    moving, untold, still = {}, {}, {}
    for name in NAMES:
        times = [t for t in range(NUM_FRAMES) if t != frame]
        views = [(camera(o), see(o, t)[1]) for t in times for o in NAMES]
        moving[name], untold[name] = find_moving(cameras[name], depths[name], views)
        still[name] = []
        for t in times:
            image, depth, label = see(name, t)
            still[name].append((cameras[name], image, np.where(label > 0, np.nan, depth).astype(np.float32)))
    return Instant(cameras, images, depths, moving, untold, still)


def pair_frame(left: str, right: str, frame: int) -> PairFrame:
    """The exact disparities of two of the cameras, which are rectified as they stand."""
    views = {name: camera(name) for name in (left, right)}
    focal_px, baseline = 80.0, float(np.linalg.norm(views[right].center - views[left].center))
    maps = {}
    for side, name in (("left", left), ("right", right)):
        maps[f"{side}_disparity"] = (focal_px * baseline / see(name, frame)[1]).astype(np.float32)
        maps[f"{side}_confidence"] = np.ones(SIZE[::-1], np.float32)
        maps |= {f"K_{side}": views[name].K, f"R_{side}": np.eye(3), f"center_{side}": views[name].center}
    return PairFrame(
        left, right, disparity_at_infinity=(0.0, 0.0), sigma_px=0.25,
        inverse_depth_per_px=(1 / (focal_px * baseline),) * 2, **maps,
    )  # fmt: skip
