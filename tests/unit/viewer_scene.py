"""A small event with known pictures and depth, as the workflow leaves it for the page: three cameras, one
held out, five places between them, a board that moves before a wall."""

from pathlib import Path

import cv2
import numpy as np

from fourd import io, views
from fourd.camera import Camera, CameraTrack
from fourd.geometry import look_at
from fourd.provenance import HULL, STATIC
from fourd.sfm import SceneCameras, write_cameras
from fourd.trajectory import trajectory_from_mapping
from fourd.viewer.lattice import MAP_REDUCTION
from fourd.viewer.maps import FIRST_CAMERA, ORIGINS
from tests.films import put_on_clock
from tests.unit.sfm_rig import make_texture, render_planes

SIZE = (192, 108)
NUM_FRAMES = 12
FRAMES = (0, 2, 4, 7, 9, 11)
NAMES = ("cam00", "cam01", "cam02")
HELDOUT = "cam01"
NUM_VIEWS = 5
CHUNK = "000000-000005"
UP = np.array([0, 0, 1.0])
# Grey and without the finest grain, which no small picture keeps.
TEXTURE = np.repeat(cv2.GaussianBlur(make_texture(256), (0, 0), 1.5).mean(axis=-1, keepdims=True), 3, axis=-1)
TEXTURE = TEXTURE.astype(np.uint8)


def camera_at(angle_deg: float) -> Camera:
    """A pinhole on a circle of radius 4 around the origin."""
    angle = np.radians(angle_deg)
    R, t = look_at(4 * np.array([np.sin(angle), -np.cos(angle), 0.1]), np.zeros(3), UP)
    K = np.array([[170.0, 0, (SIZE[0] - 1) / 2], [0, 170, (SIZE[1] - 1) / 2], [0, 0, 1]])
    return Camera(K, R, t, SIZE)


def planes_at(frame: int) -> list[tuple[np.ndarray, list[float], list[float]]]:
    """Wall and board at a frame: corner, side to the right, side down."""
    wall = (np.array([-5, 1.5, 3.0]), [10.0, 0, 0], [0, 0, -6.0])
    board = (np.array([-0.9 + 0.1 * frame, -0.5, 0.5]), [0.8, 0, 0], [0, 0, -1.0])
    return [wall, board]


def render(camera: Camera, frame: int) -> np.ndarray:
    """(H, W, 3) uint8."""
    return render_planes(camera, planes_at(frame), TEXTURE)


def depth_at(camera: Camera, frame: int) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) float32 depth, and bool where the board is seen."""
    grid = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).astype(np.float64)
    directions = camera.rays(grid) @ camera.R
    depth, is_board = np.full(SIZE[::-1], np.nan), np.zeros(SIZE[::-1], bool)
    for i, (origin, x_edge, y_edge) in enumerate(planes_at(frame)):
        edges = np.array([x_edge, y_edge])
        normal = np.cross(*edges)
        z = ((origin - camera.center) @ normal) / (directions @ normal)
        shares = ((camera.center + directions * z[..., None] - origin) @ edges.T) / (edges**2).sum(axis=1)
        inside = ((shares >= 0) & (shares <= 1)).all(axis=-1)
        depth, is_board = np.where(inside, z, depth), np.where(inside, i == 1, is_board)
    return depth.astype(np.float32), is_board


def make_scene() -> SceneCameras:
    tracks = {
        name: CameraTrack(name, (camera_at(angle),), 1.0, 9.0)
        for name, angle in zip(NAMES, (-24, 2, 24), strict=True)
    }
    given = dict.fromkeys(NAMES, "given")
    inputs = tuple(name for name in NAMES if name != HELDOUT)
    return SceneCameras(30.0, NUM_FRAMES, inputs, (HELDOUT,), tracks, np.zeros(3), 1.0, UP, given)


def lattice_views(scene: SceneCameras) -> list[views.View]:
    found = []
    for i in range(NUM_VIEWS):
        spec = {"kind": "hold", "position": i / (NUM_VIEWS - 1), "num_frames": len(FRAMES)}
        found.append(
            views.virtual_view(scene, f"lattice-{i:02d}", trajectory_from_mapping(spec, "test"), SIZE)
        )
    return found


def write_event(folder: Path) -> list[str]:
    """All files that the page is made from; the words of `python -m fourd.viewer page` but for --output."""
    scene = make_scene()
    write_cameras(folder / "sfm" / "cameras.json", scene)
    with io.ArchiveWriter(folder / "sfm" / "points.npz") as writer:
        writer.add("points", np.random.default_rng(0).normal(0, 1, (50, 3)))
    for name, track in scene.tracks.items():
        footage = folder / "footage" / name
        for frame in range(NUM_FRAMES):
            io.write_png(footage / f"{frame:06d}.png", render(track.at(frame), frame))
        path = put_on_clock(
            footage, name, folder / "align" / "cameras" / f"{name}.json", scene.fps, NUM_FRAMES
        )
        meta = {**io.read_json(path), "tone": None, "compensation": None}
        with io.ArchiveWriter(folder / "frames" / "cameras" / f"{name}.npz", meta):
            pass
    for view in lattice_views(scene):
        views.write_view(folder / "lattice" / "views" / f"{view.name}.json", view)
        _write_pictures(folder / "lattice", view)
    paths = {
        "films": sorted(folder.glob("frames/cameras/*.npz")),
        "views": sorted(folder.glob("lattice/views/*.json")),
        "render": sorted(folder.glob("lattice/render/*/*")),
        "maps": sorted(folder.glob("lattice/maps/*/*.npz")),
    }
    words = ["page", "--cameras", str(folder / "sfm/cameras.json"), "--forecast-mb", "1"]
    words += ["--points", str(folder / "sfm" / "points.npz")]
    for flag, files in paths.items():
        words += [f"--{flag}", *map(str, files)]
    return words


def _write_pictures(lattice: Path, view: views.View) -> None:
    with io.ArchiveWriter(
        lattice / "maps" / view.name / f"{CHUNK}.npz", {"view": view.name, "cameras": ["cam00", "cam02"]}
    ) as writer:
        for entry in view.frames:
            picture = render(entry.camera, entry.scene_frame)
            io.write_png(lattice / "render" / view.name / CHUNK / f"{entry.frame:06d}.png", picture)
            depth, is_board = depth_at(entry.camera, entry.scene_frame)
            origin = np.where(is_board, FIRST_CAMERA, ORIGINS[STATIC])
            origin[:20] = ORIGINS[HULL]
            small = (slice(1, None, MAP_REDUCTION), slice(1, None, MAP_REDUCTION))
            inverse = np.nan_to_num(1 / depth[small])
            writer.add_frame(entry.frame, inverse_depth=inverse, origin=origin[small].astype(np.uint8))


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    """Without the outermost pixels, where views end."""
    inner = slice(8, -8)
    error = np.mean((a[inner, inner].astype(float) - b[inner, inner]) ** 2)
    return float(10 * np.log10(255**2 / error))


def cross_fade(first: np.ndarray, second: np.ndarray, weight: float) -> np.ndarray:
    return cv2.addWeighted(first, 1 - weight, second, weight, 0)
