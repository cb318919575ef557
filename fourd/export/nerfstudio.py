"""A nerfstudio dataset: transforms.json with times, masks and depths, and points to begin with."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.export.event import OUTSIDE, Event, place_file
from fourd.export.points import write_ply
from fourd.io import atomic_path, read_image, write_json, write_png
from fourd.sfm.importers.nerfstudio import OPENCV_FROM_OPENGL, PIXEL_CENTER

# nerfstudio's own default, metres; kept where 16 bits reach far enough and depths are not all tiny.
DEPTH_UNIT = 1e-3
UNITS_OF_NEAREST = 200


def transform_of(camera: Camera) -> list[list[float]]:
    """world_from_cam, 4 x 4, of a camera with OpenGL axes."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = camera.R.T @ OPENCV_FROM_OPENGL, camera.center
    return matrix.tolist()


def write_nerfstudio(event: Event, folder: Path) -> None:
    """Write images, masks (0 where blank), depth (16 bits, 0 where unknown), points3d.ply, transforms.json.

    `time` is 0 at the first frame and 1 at the last. Held-out cameras are test_filenames; they have no
    depths of their own, and share an empty one, since the format wants all or none.
    """
    unit = _depth_unit(event)
    frames: list[dict[str, Any]] = []
    for name in event.names:
        archive = event.depths(name)
        for frame in event.frames:
            image = f"images/{name}/{frame:06d}.png"
            mask = f"masks/{name}/{frame:06d}.png"
            dynamic = f"motion/{name}/{frame:06d}.png"
            place_file(event.picture_path(name, frame), folder / image)
            place_file(event.mask_path(name, frame), folder / dynamic)
            given = read_image(event.mask_path(name, frame))[..., 0]
            write_png(folder / mask, 255 * (given != OUTSIDE).astype(np.uint8))
            camera = event.camera(name, frame)
            depth = f"depth/{name}/{frame:06d}.png"
            if archive is None:
                depth = f"depth/none_{camera.size[0]}x{camera.size[1]}.png"
                if not (folder / depth).exists():
                    write_png16(folder / depth, np.zeros(camera.size[::-1], np.uint16))
            else:
                lengths = event.length(archive[f"{frame:06d}/depth"])
                write_png16(folder / depth, np.minimum(np.rint(lengths / unit), 65535).astype(np.uint16))
            entry: dict[str, Any] = {"file_path": image, "mask_path": mask, "depth_file_path": depth}
            entry |= {"dynamic_mask_path": dynamic, "camera": name, "frame": frame}
            entry["time"] = frame / max(event.scene.num_frames - 1, 1)
            frames.append({**entry, **_intrinsics(camera), "transform_matrix": transform_of(camera)})
        if archive is not None:
            archive.close()
    xyz, rgb = event.seed_points()
    write_ply(folder / "points3d.ply", xyz, rgb)
    held_out = [f["file_path"] for f in frames if f["camera"] in event.scene.heldout]
    train = [f["file_path"] for f in frames if f["camera"] in event.scene.inputs]
    document = {"camera_model": "OPENCV", "fps": event.scene.fps, "depth_unit_scale_factor": unit}
    document |= {"ply_file_path": "points3d.ply", "train_filenames": train}
    document |= {"val_filenames": held_out or train[:1], "test_filenames": held_out or train[:1]}
    write_json(folder / "transforms.json", {**document, "frames": frames})


def _intrinsics(camera: Camera) -> dict[str, float | int]:
    values: dict[str, float | int] = {"w": camera.size[0], "h": camera.size[1]}
    values |= {"fl_x": float(camera.K[0, 0]), "fl_y": float(camera.K[1, 1])}
    return values | {"cx": float(camera.K[0, 2] + PIXEL_CENTER), "cy": float(camera.K[1, 2] + PIXEL_CENTER)}


def _depth_unit(event: Event) -> float:
    """Length of a step of 16-bit depths: a thousandth, or what the scene's depths call for."""
    nearest, farthest = np.inf, 0.0
    for name in event.scene.inputs:
        archive = event.depths(name)
        assert archive is not None
        for frame in event.frames:
            depth = archive[f"{frame:06d}/depth"]
            known = depth[depth > 0]
            if known.size:
                # A few far points must not coarsen all others; they are clipped.
                nearest = min(nearest, float(known.min()))
                farthest = max(farthest, float(np.percentile(known, 99.9)))
        archive.close()
    nearest, farthest = float(event.length(nearest)), float(event.length(farthest))
    fits = farthest <= 65535 * DEPTH_UNIT and nearest >= UNITS_OF_NEAREST * DEPTH_UNIT
    return DEPTH_UNIT if fits or farthest == 0 else farthest / 65000


def write_png16(path: Path, image: np.ndarray) -> None:
    """Write (H, W) uint16 as PNG."""
    done, data = cv2.imencode(".png", image)
    if not done:
        raise ValueError(f"cannot encode an array of shape {image.shape} as PNG for {path}")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())
