"""A COLMAP dataset: images, masks, and the model as text and binary."""

from pathlib import Path

# OpenCV must be loaded before pycolmap: the other order aborts the process when a PNG is written.
import cv2  # noqa: F401
import numpy as np
from scipy.spatial.transform import Rotation

from fourd.export.event import STILL, Event, place_file
from fourd.io import read_image, write_png
from fourd.sfm.importers.colmap import PIXEL_CENTER


def write_colmap(event: Event, folder: Path) -> None:
    """Write images/CAM/000012.png, masks/CAM/000012.png.png, sparse/text, sparse/0 (binary).

    A camera that stands still is one COLMAP camera, and so is a moving one, as its lens does not
    change; every frame is an image with a pose of its own. Masks are COLMAP's: 0 where no feature is
    to be taken, because the picture is blank or something moves. The points are the fused surface of
    the first frame, with colours and without tracks.
    """
    cameras, images = _model_lines(event)
    xyz, rgb = event.seed_points()
    points = [
        f"{i + 1} {x!r} {y!r} {z!r} {r} {g} {b} 0.0"
        for i, ((x, y, z), (r, g, b)) in enumerate(zip(xyz.tolist(), rgb.tolist(), strict=True))
    ]
    text = folder / "sparse" / "text"
    text.mkdir(parents=True)
    for name, lines in {"cameras": cameras, "images": images, "points3D": points}.items():
        (text / f"{name}.txt").write_text("\n".join([*lines, ""]), encoding="utf-8")
    _write_binary(text, folder / "sparse" / "0")
    for name in event.names:
        for frame in event.frames:
            place_file(event.picture_path(name, frame), folder / "images" / name / f"{frame:06d}.png")
            mask = read_image(event.mask_path(name, frame))[..., 0] == STILL
            write_png(folder / "masks" / name / f"{frame:06d}.png.png", 255 * mask.astype(np.uint8))


def _model_lines(event: Event) -> tuple[list[str], list[str]]:
    cameras, images, lenses = [], [], {}
    for name in event.names:
        for frame in event.frames:
            camera = event.camera(name, frame)
            K = camera.K
            lens = (K[0, 0], K[1, 1], K[0, 2] + PIXEL_CENTER, K[1, 2] + PIXEL_CENTER)
            key = (name, *map(float, lens))
            if key not in lenses:
                lenses[key] = len(lenses) + 1
                words = [lenses[key], "PINHOLE", *camera.size, *(repr(value) for value in key[1:])]
                cameras.append(" ".join(map(str, words)))
            quaternion = Rotation.from_matrix(camera.R).as_quat(canonical=True, scalar_first=True)
            pose = [repr(value) for value in (*quaternion.tolist(), *camera.t.tolist())]
            image = [len(images) // 2 + 1, *pose, lenses[key], f"{name}/{frame:06d}.png"]
            # The second line of an image lists its observations: none.
            images += [" ".join(map(str, image)), ""]
    return cameras, images


def _write_binary(text: Path, binary: Path) -> None:
    import pycolmap

    binary.mkdir(parents=True)
    pycolmap.Reconstruction(str(text)).write_binary(str(binary))
