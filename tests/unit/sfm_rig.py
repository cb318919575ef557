"""Known cameras around a textured scene, for the tests of the stage sfm."""

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.geometry import look_at

SIZE = (320, 240)
TARGET = np.array([0.3, -0.2, 1.0])
LENS = np.array([-0.05, 0.01, 5e-4, -3e-4, 0.0])
POINTS = TARGET + np.random.default_rng(3).uniform(-0.7, 0.7, (40, 3))


def make_rig(num_cameras=4, radius=4.0, distortion=None, spread_deg=40.0) -> dict[str, Camera]:
    """Cameras on an arc that look at TARGET, each with its own intrinsics."""
    cameras = {}
    for i, angle in enumerate(np.radians(np.linspace(-spread_deg / 2, spread_deg / 2, num_cameras))):
        center = TARGET + radius * np.array([np.sin(angle), -np.cos(angle), 0.15])
        R, t = look_at(center, TARGET + [0.02 * i, 0, 0], np.array([0.0, 0, 1]))
        K = np.array([[300.0 + 10 * i, 0, 157.3 + i], [0, 305.0 + 10 * i, 121.2 - i], [0, 0, 1]])
        lens = np.zeros(5) if distortion is None else np.asarray(distortion)
        cameras[f"cam{i:02d}"] = Camera(K, R, t, SIZE, lens)
    return cameras


def moved_rig(num_frames: int, **arguments) -> dict[str, tuple[Camera, ...]]:
    """Hand-held: every camera drifts a little from frame to frame."""
    drift = np.random.default_rng(5).normal(0, 0.01, (num_frames, 3))
    return {
        name: tuple(dataclasses.replace(camera, t=camera.t + step) for step in drift)
        for name, camera in make_rig(**arguments).items()
    }


def transform_world(camera: Camera, scale: float, shift: np.ndarray) -> Camera:
    """The same camera after the world's points became point * scale + shift."""
    center = camera.center * scale + shift
    return dataclasses.replace(camera, t=-camera.R @ center)


def write_native(path: Path, tracks: dict[str, tuple[Camera, ...]], **extra) -> Path:
    cameras = {
        name: {"size": list(track[0].size), "frames": [camera.to_dict() for camera in track]}
        for name, track in tracks.items()
    }
    path.write_text(json.dumps({"cameras": cameras, **extra}))
    return path


def write_ingest(folder: Path, name: str, size=SIZE, num_frames=1, **changes) -> Path:
    """align/cameras/{cam}.json of a film that stage sfm need not look at."""
    source_frame = changes.pop("source_frame", list(range(num_frames)))
    status = changes.pop("status", "ok")
    ingest = {"size": list(size), "num_source_frames": num_frames, "files": [], **changes}
    document = {"camera": name, "status": status, "source_frame": source_frame, "ingest": ingest}
    path = folder / f"{name}.json"
    path.write_text(json.dumps(document))
    return path


def make_texture(size=512, seed=0) -> np.ndarray:
    """(size, size, 3) uint8 with detail at several scales."""
    rng = np.random.default_rng(seed)
    texture = np.zeros((size, size, 3), np.float32)
    for cells in (16, 32, 64, 128):
        noise = rng.normal(0, 1, (cells, cells, 3)).astype(np.float32)
        texture += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC) * (16 / cells) ** 0.5
    return np.clip(128 + 60 * texture, 0, 255).astype(np.uint8)


def render_planes(camera: Camera, planes, texture: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: textured rectangles (origin, x edge, y edge), painted in the order given."""
    width, height = camera.size
    image = np.zeros((height, width, 3), np.uint8)
    side = texture.shape[0] - 1
    for origin, x_edge, y_edge in planes:
        world_from_texture = np.stack([np.asarray(x_edge) / side, np.asarray(y_edge) / side, origin], axis=1)
        in_cam = camera.R @ world_from_texture
        in_cam[:, 2] += camera.t
        homography = camera.K @ in_cam
        warp = {"flags": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_CONSTANT}
        drawn = cv2.warpPerspective(texture, homography, (width, height), **warp)
        mask = cv2.warpPerspective(
            np.full(texture.shape[:2], 255, np.uint8), homography, (width, height), **warp
        )
        image = np.where(mask[..., None] > 127, drawn, image)
    return image


def wall_and_box():
    """A wall 2 behind TARGET and a board 1 before it, seen by `make_rig`."""
    wall = (TARGET + [-4, 2, 3], [8.0, 0, 0], [0, 0, -6.0])
    board = (TARGET + [-0.6, -1, 0.4], [1.2, 0, 0], [0, 0, -0.9])
    return [wall, board]


def assert_same_views(read, expected, atol=1e-9):
    """Equal cameras by what matters: where known points appear."""
    assert sorted(read) == sorted(expected)
    for name, track in expected.items():
        assert len(read[name]) == len(track)
        for got, wanted in zip(read[name], track, strict=True):
            assert got.size == wanted.size
            np.testing.assert_allclose(got.project(POINTS)[0], wanted.project(POINTS)[0], atol=atol)


def as_tracks(cameras):
    return {name: (camera,) for name, camera in cameras.items()}
