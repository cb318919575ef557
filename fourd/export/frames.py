"""Rendered films as frames for compositing: EXR with depth and provenance, or 16-bit PNG with depth.

Depth is z along the optical axis in the calibration's units; provenance and source are those of
`fourd.provenance`.
"""

import contextlib
import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.export.nerfstudio import write_png16
from fourd.io import Archive, atomic_folder, read_image, write_json
from fourd.provenance import BACKGROUND_KEYS, FOREGROUND_KEYS, NAMES, Provenance, find_provenance
from fourd.render import BackgroundReader, list_frames, read_arrays
from fourd.sfm.cameras import SceneCameras
from fourd.views import View

CHANNELS = ("R", "G", "B", "Z", "provenance", "source")


def linear_light(rgb: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 sRGB as float32 light of BT.709 primaries, 0 to 1 (IEC 61966-2-1)."""
    display = np.arange(256) / 255
    light = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
    return light.astype(np.float32)[rgb]


def camera_attributes(camera: Camera) -> dict[str, Any]:
    """What OpenEXR and this project say about a camera.

    worldToCamera and worldToNDC are OpenEXR's standard attributes: matrices for row vectors, camera
    axes x right, y up, z forward as renderers have them, NDC from (0, 0) at the top left corner of the
    picture to (1, 1).
    """
    width, height = camera.size
    flip = np.diag([1.0, -1.0, 1.0])
    to_camera = np.eye(4)
    to_camera[:3, :3], to_camera[:3, 3] = flip @ camera.R, flip @ camera.t
    K = camera.K.copy()
    # Corner of the first pixel, in pixels, is (-0.5, -0.5).
    K[:2, 2] += 0.5
    to_ndc = np.zeros((4, 4))
    to_ndc[:2, :3] = np.diag([1 / width, 1 / height]) @ (K @ flip)[:2]
    to_ndc[2, 2] = to_ndc[3, 2] = 1.0
    document = {
        "K": camera.K.tolist(),
        "R": camera.R.tolist(),
        "t": camera.t.tolist(),
        "size": [width, height],
    }
    return {
        "worldToCamera": to_camera.T,
        "worldToNDC": (to_ndc @ to_camera).T,
        "fourd:camera": json.dumps(document),
    }


def write_exr(path: Path, rgb: np.ndarray, found: Provenance, attributes: Mapping[str, Any]) -> None:
    """Write an EXR: (H, W, 3) uint8 sRGB colour as half-float light, depth as float, the rest as half.

    Raises InputError if OpenImageIO is not installed or refuses.
    """
    oiio: Any = _open_image_io()
    height, width = found.depth.shape
    spec = oiio.ImageSpec(width, height, len(CHANNELS), oiio.FLOAT)
    spec.channelnames = CHANNELS
    spec.channelformats = tuple(oiio.FLOAT if name == "Z" else oiio.HALF for name in CHANNELS)
    spec.attribute("compression", "zip")
    spec.attribute("oiio:ColorSpace", "lin_rec709_scene")
    spec.attribute("Software", "fourd")
    for name, value in attributes.items():
        if isinstance(value, np.ndarray):
            spec.attribute(name, oiio.TypeDesc("matrix"), tuple(value.ravel().tolist()))
        else:
            spec.attribute(name, value)
    layers = [linear_light(rgb), found.depth[..., None]]
    layers += [found.kind[..., None].astype(np.float32), found.source[..., None].astype(np.float32)]
    output: Any = oiio.ImageOutput.create(str(path))
    done = bool(output) and output.open(str(path), spec)
    done = done and output.write_image(np.ascontiguousarray(np.concatenate(layers, axis=2)))
    if not done or not output.close():
        raise InputError(f"expected to write {path}, got: {output.geterror() if output else oiio.geterror()}")


def read_exr(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Channels by name, (H, W) float32, and the camera of an EXR of ours. Raises InputError."""
    oiio = _open_image_io()
    given = oiio.ImageInput.open(str(path))
    if given is None:
        raise InputError(f"expected an EXR at {path}, got: {oiio.geterror()}")
    spec = given.spec()
    pixels = given.read_image(oiio.FLOAT)
    given.close()
    names = list(spec.channelnames)
    text = spec.get_string_attribute("fourd:camera")
    return {name: pixels[..., i] for i, name in enumerate(names)}, json.loads(text) if text else {}


def _open_image_io() -> Any:
    try:
        import OpenImageIO
    except ImportError:
        raise InputError(
            "expected OpenImageIO to write or read EXR, it is not installed: pip install 'fourd[exr]'"
        ) from None
    return OpenImageIO


def run_frames(
    view: View,
    scene: SceneCameras,
    folders: Sequence[Path],
    estimates: Sequence[Path],
    picture_format: str,
    scale: float,
    output: Path,
) -> None:
    """Write 000012.exr, or 000012.png (16 bits) and 000012_depth.png, of every frame of a film.

    folders: rendered chunks;  estimates: foreground and background archives of the same chunks
    scale: as in the options
    frames.json says what depths and cameras mean. The network's colours have 8 bits; 16 hold them without
    another rounding. Raises InputError for a frame that is not in all three.
    """
    pictures = list_frames(folders)
    with contextlib.ExitStack() as stack, atomic_folder(output) as folder:
        archives = [stack.enter_context(contextlib.closing(Archive(path))) for path in estimates]
        near = [archive for archive in archives if "sample_frames" not in archive.meta]
        far_readers = [
            BackgroundReader(archive, BACKGROUND_KEYS)
            for archive in archives
            if "sample_frames" in archive.meta
        ]
        frames, names = [], list(near[0].meta["cameras"]) if near else []
        unit = scene.scale * scale
        step = 1e-3 * unit
        for frame, path in pictures.items():
            archive = next((a for a in near if f"{frame:06d}/depth" in a), None)
            reader = next((r for r in far_readers if frame in r.frames()), None)
            if archive is None or reader is None:
                raise InputError(
                    f"expected the estimates of frame {frame} of {view.name}, found none: fuse it again"
                )
            rgb = read_image(path)
            found = find_provenance(read_arrays(archive, frame, FOREGROUND_KEYS), reader.read(frame))
            found = dataclasses.replace(found, depth=found.depth * np.float32(unit))
            entry = view.at(frame)
            center = (entry.camera.center * scene.scale + scene.origin) * scale
            camera = dataclasses.replace(entry.camera, t=-entry.camera.R @ center)
            if picture_format == "exr":
                facts = {"fourd:sceneFrame": entry.scene_frame, "fourd:cameras": json.dumps(names)}
                write_exr(folder / f"{frame:06d}.exr", rgb, found, {**camera_attributes(camera), **facts})
            else:
                write_png16(folder / f"{frame:06d}.png", rgb[:, :, ::-1].astype(np.uint16) * 257)
                steps = np.where(np.isfinite(found.depth), np.rint(found.depth / step), 0)
                write_png16(folder / f"{frame:06d}_depth.png", np.minimum(steps, 65535).astype(np.uint16))
            frames.append({"frame": frame, "scene_frame": entry.scene_frame, **camera.to_dict()})
        facts = {"view": view.name, "size": list(view.size), "cameras": names, "provenance": list(NAMES)}
        write_json(folder / "frames.json", {**facts, "depth_step": step, "frames": frames})
