"""A small event ready to be exported: a textured plane, three phones that shake, one of them held out."""

import dataclasses
from pathlib import Path

import numpy as np

from fourd.camera import Camera, CameraTrack
from fourd.export import ExportOptions
from fourd.export.event import MOVING, STILL, Event, own_pinhole
from fourd.geometry import look_at
from fourd.io import ArchiveWriter, write_png
from fourd.sfm.cameras import SceneCameras
from fourd.video import encode_video

NUM_FRAMES = 3
SIZE = (64, 48)
ORIGIN, SCALE = np.array([120.0, -40.5, 7.25]), 3.7
# Points of the scene's world that lie on its plane z = 0.
POINTS = np.array([[0.1, 0.2, 0.0], [-0.2, 0.15, 0.0], [0.0, -0.25, 0.0]])


def make_scene(size=SIZE) -> SceneCameras:
    rng = np.random.default_rng(5)
    tracks = {}
    for i, x in enumerate((-0.4, 0.0, 0.45)):
        poses = []
        for _ in range(NUM_FRAMES):
            center = np.array([x, -0.3, 1.0]) + rng.normal(0, 0.01, 3)
            R, t = look_at(center, np.array([0.02 * i, 0, 0]), np.array([0.0, 1, 0]))
            K = np.array([[61.0 + i, 0, 32.2], [0, 60.0, 22.9], [0, 0, 1]])
            poses.append(Camera(K, R, t, size, np.array([-0.05, 0.01, 0, 0, 0])))
        tracks[f"cam{i:02d}"] = CameraTrack(f"cam{i:02d}", tuple(poses), 0.6, float("inf"))
    return SceneCameras(
        30.0, NUM_FRAMES, ("cam00", "cam02"), ("cam01",), tracks, ORIGIN, SCALE,
        np.array([0.0, 1, 0]), dict.fromkeys(tracks, "given"),
    )  # fmt: skip


def colour_of(points: np.ndarray) -> np.ndarray:
    """(..., 3) uint8 of the plane's points."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([100 + 200 * x, 110 + 200 * y, 90 + 0 * x], axis=-1).clip(0, 255).astype(np.uint8)


def plane_depth(camera: Camera) -> np.ndarray:
    """(H, W) float64 depth of the plane z = 0 of the world."""
    width, height = camera.size
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    rays = camera.rays(grid) @ camera.R
    return -camera.center[2] / rays[..., 2]


def make_event(folder: Path, options: ExportOptions | None = None) -> Event:
    """The event with all files that the writers read."""
    scene = make_scene()
    for name in scene.tracks:
        pictures = []
        with ArchiveWriter(folder / "depth" / f"{name}.npz", {"camera": name}) as writer:
            for frame in range(NUM_FRAMES):
                camera = own_pinhole(scene, name, frame, None)
                depth = plane_depth(camera)
                grid = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1)
                pictures.append(colour_of(camera.unproject(grid.astype(float), depth)))
                write_png(folder / "pictures" / name / f"{frame:06d}.png", pictures[-1])
                mask = np.full(SIZE[::-1], STILL, np.uint8)
                mask[10:20, 5:25], mask[:, 0] = MOVING, 0
                write_png(folder / "pictures" / name / "masks" / f"{frame:06d}.png", mask)
                unknown = np.zeros(SIZE[::-1], bool)
                unknown[:4] = True
                writer.add_frame(frame, depth=np.where(unknown, 0, depth).astype(np.float32))
        encode_video(folder / "pictures" / name / "held.mp4", pictures, scene.fps)
    return Event(scene, options or ExportOptions(), folder / "pictures", folder / "depth")


def source_camera(scene: SceneCameras, name: str, frame: int) -> Camera:
    """The undistorted camera in the calibration's world, by hand."""
    camera = scene.tracks[name].at(frame).without_distortion()
    center = camera.center * SCALE + ORIGIN
    return dataclasses.replace(camera, t=-camera.R @ center)
