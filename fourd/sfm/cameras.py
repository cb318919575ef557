"""The file sfm/cameras.json: cameras of a scene as every later stage reads them."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fourd.camera import CameraTrack, tracks_from_dict, tracks_to_dict
from fourd.errors import explain_faults
from fourd.io import read_document, write_json


@dataclasses.dataclass(frozen=True, eq=False)
class SceneCameras:
    """All cameras of a scene in the normalised world.

    inputs, heldout: names in the scene's order;  tracks: name -> camera over time, both kinds
    origin: (3,), scale: similarity to the calibration's world, source = world * scale + origin
    up: (3,) unit vector, world direction that appears upward in the images
    depth_range_from: name -> `given`, `calibration`, `sparse points` or `camera geometry`
    left_out: cameras of the scene file that have no track, and why
    """

    fps: float
    num_frames: int
    inputs: tuple[str, ...]
    heldout: tuple[str, ...]
    tracks: Mapping[str, CameraTrack]
    origin: np.ndarray
    scale: float
    up: np.ndarray
    depth_range_from: Mapping[str, str]
    left_out: Mapping[str, str] = dataclasses.field(default_factory=dict)


def write_cameras(path: Path | str, scene: SceneCameras) -> None:
    """Write cameras.json (docs/formats.md)."""
    entries = tracks_to_dict(scene.tracks)
    for name, source in scene.depth_range_from.items():
        entries[name]["depth_range_from"] = source
    document = {
        "fps": scene.fps,
        "num_frames": scene.num_frames,
        "world": {"scale": scene.scale, "origin": scene.origin.tolist()},
        "up": scene.up.tolist(),
        "inputs": list(scene.inputs),
        "heldout": list(scene.heldout),
        "left_out": dict(scene.left_out),
        "cameras": entries,
    }
    write_json(path, document)


def read_cameras(path: Path | str) -> SceneCameras:
    """Read cameras.json; every camera is checked. Raises InputError, naming the file."""
    document = read_document(path)
    with explain_faults(f"cameras.json of this workflow in {path}"):
        scene = SceneCameras(
            fps=float(document["fps"]),
            num_frames=int(document["num_frames"]),
            inputs=tuple(document["inputs"]),
            heldout=tuple(document["heldout"]),
            tracks=tracks_from_dict(document["cameras"], str(path)),
            origin=np.asarray(document["world"]["origin"], dtype=np.float64).reshape(3),
            scale=float(document["world"]["scale"]),
            up=np.asarray(document["up"], dtype=np.float64).reshape(3),
            depth_range_from={n: e.get("depth_range_from", "given") for n, e in document["cameras"].items()},
            left_out={str(name): str(reason) for name, reason in document.get("left_out", {}).items()},
        )
        _check_scene(scene)
    return scene


def _check_scene(scene: SceneCameras) -> None:
    """Raise ValueError where the document contradicts itself."""
    without = [name for name in (*scene.inputs, *scene.heldout) if name not in scene.tracks]
    if without or not scene.inputs:
        raise ValueError(f"inputs {scene.inputs} and heldout {scene.heldout}, no camera of {without}")
    lengths = {name: len(track.cameras) for name, track in scene.tracks.items()}
    if any(length not in (1, scene.num_frames) for length in lengths.values()):
        raise ValueError(f"{scene.num_frames} frames and cameras at {lengths} of them")
    if not (scene.fps > 0 and scene.scale > 0 and np.isfinite([*scene.origin, *scene.up]).all()):
        raise ValueError(f"fps {scene.fps}, scale {scene.scale}, origin {scene.origin}, up {scene.up}")
