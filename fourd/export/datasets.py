"""Datasets of the published methods and plain films: N3DV, EasyVolcap, Dynamic 3D Gaussians, videos."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from fourd.camera import Camera, check_camera
from fourd.errors import InputError
from fourd.export.cameras import write_easymocap
from fourd.export.event import MOVING, Event, place_file
from fourd.io import read_image, read_json, write_json, write_png
from fourd.sfm.importers.colmap import PIXEL_CENTER
from fourd.sfm.importers.llff import OPENCV_FROM_LLFF


def depth_bounds(event: Event, name: str) -> tuple[float, float]:
    """Nearest and farthest depth worth seeing of a camera, export's units; both are finite."""
    track = event.scene.tracks[name]
    near, far = track.near or 0.1, track.far
    if not np.isfinite(far):
        far = 20 * near
        archive = event.depths(name if name in event.scene.inputs else event.scene.inputs[0])
        assert archive is not None
        depth = archive[f"{event.frames[len(event.frames) // 2]:06d}/depth"]
        archive.close()
        if (depth > 0).any():
            far = max(1.1 * float(np.percentile(depth[depth > 0], 99.9)), 2 * near)
    return float(event.length(near)), float(event.length(far))


def write_videos(event: Event, folder: Path) -> None:
    """Write CAM.mp4, the synchronised, undistorted, colour-matched film of each camera from one place."""
    for name in event.names:
        place_file(event.held_path(name), folder / f"{name}.mp4")


def write_n3dv(event: Event, folder: Path) -> None:
    """Write camNN.mp4 and poses_bounds.npy, rows in the order of the films' names."""
    event.common_size("n3dv")
    names = sorted(event.names)
    rows = []
    for index, name in enumerate(names):
        place_file(event.held_path(name), folder / f"cam{index:02d}.mp4")
        camera = event.held(name)
        size = np.array([camera.size[1], camera.size[0], camera.focal_px])
        matrix = np.column_stack([camera.R.T @ OPENCV_FROM_LLFF.T, camera.center, size])
        rows.append([*matrix.ravel(), *depth_bounds(event, name)])
    np.save(folder / "poses_bounds.npy", np.array(rows, dtype=np.float64))
    write_json(folder / "names.json", {"cameras": {f"cam{i:02d}": name for i, name in enumerate(names)}})


def write_easyvolcap(event: Event, folder: Path) -> None:
    """Write videos/CAM.mp4, intri.yml and extri.yml: EasyMocap's and EasyVolcap's layout."""
    for name in event.names:
        place_file(event.held_path(name), folder / "videos" / f"{name}.mp4")
    bounds = {name: depth_bounds(event, name) for name in event.names}
    write_easymocap(folder, {name: event.held(name) for name in event.names}, bounds)


def write_dynamic3dg(event: Event, folder: Path) -> None:
    """Write ims/N/000012.png, seg/N/000012.png (1 where something moves), train_meta.json,
    test_meta.json (held-out cameras) and init_pt_cld.npz (x, y, z, red, green, blue 0 to 1, moves).
    """
    width, height = event.common_size("dynamic3dg")
    numbers = {name: index for index, name in enumerate(event.names)}
    for name, number in numbers.items():
        for frame in event.frames:
            place_file(event.picture_path(name, frame), folder / "ims" / str(number) / f"{frame:06d}.png")
            moves = read_image(event.mask_path(name, frame))[..., 0] == MOVING
            write_png(folder / "seg" / str(number) / f"{frame:06d}.png", moves.astype(np.uint8))
    for kind, names in (("train", event.scene.inputs), ("test", event.scene.heldout)):
        document: dict[str, Any] = {"w": width, "h": height, "k": [], "w2c": [], "fn": [], "cam_id": []}
        for frame in event.frames:
            cameras = [event.camera(name, frame) for name in names]
            document["k"].append([_matrix_at_corner(camera) for camera in cameras])
            document["w2c"].append([_pose(camera) for camera in cameras])
            document["fn"].append([f"{numbers[name]}/{frame:06d}.png" for name in names])
            document["cam_id"].append([numbers[name] for name in names])
        text = json.dumps({**document, "names": list(event.names)}, allow_nan=False)
        (folder / f"{kind}_meta.json").write_text(text + "\n", encoding="utf-8")
    cloud = event.cloud(0, event.options.max_points)
    table = np.column_stack([cloud.xyz, cloud.rgb / 255, cloud.moves])
    np.savez(folder / "init_pt_cld.npz", data=table)


def _matrix_at_corner(camera: Camera) -> list[list[float]]:
    K = camera.K.copy()
    K[:2, 2] += PIXEL_CENTER
    return K.tolist()


def _pose(camera: Camera) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = camera.R, camera.t
    return matrix.tolist()


def read_dynamic3dg(path: Path) -> dict[str, tuple[Camera, ...]]:
    """Cameras of train_meta.json (or another such file), one per frame. Raises InputError.

    They are named cam00, cam01 ... by `cam_id`, or as `names` says.
    """
    file = path / "train_meta.json" if path.is_dir() else path
    document = read_json(file)
    tracks: dict[str, list[Camera]] = {}
    try:
        size, names = (int(document["w"]), int(document["h"])), document.get("names")
        for Ks, poses, numbers in zip(document["k"], document["w2c"], document["cam_id"], strict=True):
            for K, pose, number in zip(Ks, poses, numbers, strict=True):
                matrix, K = np.array(pose, dtype=np.float64).reshape(4, 4), np.array(K, dtype=np.float64)
                K[:2, 2] -= PIXEL_CENTER
                name = names[number] if names else f"cam{number:02d}"
                camera = Camera(K, matrix[:3, :3], matrix[:3, 3], size)
                check_camera(camera, f"{file}, camera {name}")
                tracks.setdefault(name, []).append(camera)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"expected the cameras of Dynamic 3D Gaussians in {file}, got {error!r}") from None
    if not tracks:
        raise InputError(f"expected cameras in {file}, found none: is it the right file?")
    return {name: tuple(cameras) for name, cameras in tracks.items()}
