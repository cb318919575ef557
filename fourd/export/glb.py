"""One GLB with the cameras and the points of every frame, animated: opens in any viewer of glTF 2.0."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from fourd.export.event import Event
from fourd.io import atomic_path, json_text
from fourd.sfm.importers.nerfstudio import OPENCV_FROM_OPENGL

FLOAT, USHORT = 5126, 5123
POINTS, LINES = 0, 1
MAGIC, JSON_CHUNK, BIN_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942


class GlbWriter:
    """Collects accessors into one buffer. `document` is the glTF's JSON."""

    def __init__(self) -> None:
        self._chunks: list[bytes] = []
        self._length = 0
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "fourd"},
            "extensionsUsed": ["KHR_materials_unlit"],
            "materials": [{"name": "as filmed", "extensions": {"KHR_materials_unlit": {}}}],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [],
            "meshes": [],
            "cameras": [],
            "accessors": [],
            "bufferViews": [],
            "animations": [{"name": "event", "channels": [], "samplers": []}],
        }

    def add(self, key: str, entry: dict[str, Any]) -> int:
        """Append an entry to one of the document's lists; returns its index."""
        self.document[key].append(entry)
        return len(self.document[key]) - 1

    def add_array(self, values: np.ndarray, kind: str, normalized: bool = False) -> int:
        """Append an accessor. values: (N,) or (N, k) float32 or uint16;  kind: SCALAR, VEC3 ...

        Bounds are stated, as positions and key times must.
        """
        data = np.ascontiguousarray(values)
        view = self.add("bufferViews", {"buffer": 0, "byteOffset": self._length, "byteLength": data.nbytes})
        self._chunks.append(data.tobytes() + bytes(-data.nbytes % 4))
        self._length += len(self._chunks[-1])
        entry: dict[str, Any] = {"bufferView": view, "count": len(data), "type": kind}
        entry["componentType"] = FLOAT if data.dtype == np.float32 else USHORT
        if normalized:
            entry["normalized"] = True
        else:
            table = data.reshape(len(data), -1)
            entry |= {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}
        return self.add("accessors", entry)

    def animate(self, node: int, path: str, times: int, values: int, interpolation: str) -> None:
        """Let a node's translation, rotation or scale follow keys. times, values: accessors."""
        animation = self.document["animations"][0]
        animation["samplers"].append({"input": times, "output": values, "interpolation": interpolation})
        target = {"node": node, "path": path}
        animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})

    def write(self, path: Path) -> None:
        """Write the file."""
        document = {key: value for key, value in self.document.items() if value or key == "scene"}
        if not self.document["animations"][0]["channels"]:
            document.pop("animations")
        document["buffers"] = [{"byteLength": self._length}]
        text = json_text(document, path).encode()
        text += b" " * (-len(text) % 4)
        body = b"".join(self._chunks)
        total = 12 + 8 + len(text) + 8 + len(body)
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            file.write(struct.pack("<III", MAGIC, 2, total))
            file.write(struct.pack("<II", len(text), JSON_CHUNK) + text)
            file.write(struct.pack("<II", len(body), BIN_CHUNK) + body)


def write_glb(event: Event, folder: Path) -> None:
    """Write event.glb: a node per camera that moves as it did, and the points of each frame in turn.

    glTF's up is y, so the node above all turns the scene's up there. Positions are the export's minus
    the import's origin, which keeps single precision where the world lies far off; the node's extras
    hold it.
    """
    writer = GlbWriter()
    origin = event.world(np.zeros(3))
    to_y_up = Rotation.align_vectors([[0.0, 1.0, 0.0]], [event.scene.up])[0]
    root: dict[str, Any] = {"name": "event", "rotation": to_y_up.as_quat().tolist(), "children": []}
    writer.add("nodes", root | {"extras": {"origin": origin.tolist()}})
    children = writer.document["nodes"][0]["children"]
    times = np.array(list(event.frames), dtype=np.float32) / np.float32(event.scene.fps)
    key_times = writer.add_array(times, "SCALAR")
    for name in event.names:
        children.append(_add_camera(writer, event, name, origin, key_times))
    for frame in event.frames:
        cloud = event.cloud(frame, event.options.glb_points)
        if len(cloud.xyz):
            node = _add_points(writer, f"points {frame:06d}", cloud.xyz - origin, cloud.rgb)
            children.append(node)
            _show_at(writer, node, frame, times)
    writer.write(folder / "event.glb")


def _add_camera(writer: GlbWriter, event: Event, name: str, origin: np.ndarray, key_times: int) -> int:
    poses = [event.camera(name, frame) for frame in event.frames]
    first = poses[0]
    width, height = first.size
    near = float(event.length(event.scene.tracks[name].near or 0.1))
    yfov = 2 * float(np.arctan2(height, 2 * first.K[1, 1]))
    lens = {
        "type": "perspective",
        "perspective": {"yfov": yfov, "aspectRatio": width / height, "znear": near},
    }
    camera = writer.add("cameras", {"name": name, **lens})
    turned = Rotation.from_matrix(np.stack([pose.R.T @ OPENCV_FROM_OPENGL for pose in poses]))
    rotations = turned.as_quat().astype(np.float32)
    # Neighbouring quaternions of opposite sign would be joined the long way round.
    signs = np.sign(np.sum(rotations[1:] * rotations[:-1], axis=1))
    rotations[1:] *= np.cumprod(np.where(signs == 0, 1, signs))[:, None]
    centers = (np.stack([pose.center for pose in poses]) - origin).astype(np.float32)
    mesh = _add_frustum(writer, name, yfov, width / height, 0.3 * near)
    node = writer.add(
        "nodes",
        {"name": name, "camera": camera, "mesh": mesh}
        | {"translation": centers[0].tolist(), "rotation": rotations[0].tolist()},
    )
    if not event.scene.tracks[name].is_static:
        writer.animate(node, "translation", key_times, writer.add_array(centers, "VEC3"), "LINEAR")
        writer.animate(node, "rotation", key_times, writer.add_array(rotations, "VEC4"), "LINEAR")
    return node


def _add_frustum(writer: GlbWriter, name: str, yfov: float, aspect: float, depth: float) -> int:
    half = depth * np.tan(yfov / 2)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [half * aspect, half]
    ring = np.column_stack([corners, np.full(4, -depth)])
    lines = [v for i in range(4) for v in (np.zeros(3), ring[i], ring[i], ring[(i + 1) % 4])]
    position = writer.add_array(np.array(lines, dtype=np.float32), "VEC3")
    primitive = {"attributes": {"POSITION": position}, "mode": LINES, "material": 0}
    return writer.add("meshes", {"name": f"view of {name}", "primitives": [primitive]})


def _add_points(writer: GlbWriter, name: str, xyz: np.ndarray, rgb: np.ndarray) -> int:
    display = rgb / 255.0
    # Colours of glTF are linear light.
    linear = np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)
    rgba = np.column_stack([linear, np.ones(len(rgb))])
    position = writer.add_array(xyz.astype(np.float32), "VEC3")
    colour = writer.add_array(np.rint(rgba * 65535).astype(np.uint16), "VEC4", normalized=True)
    attributes = {"POSITION": position, "COLOR_0": colour}
    primitive = {"attributes": attributes, "mode": POINTS, "material": 0}
    mesh = writer.add("meshes", {"name": name, "primitives": [primitive]})
    return writer.add("nodes", {"name": name, "mesh": mesh})


def _show_at(writer: GlbWriter, node: int, frame: int, times: np.ndarray) -> None:
    """Points are as large as they are at their frame, and of no size at all others."""
    keys = sorted({0, frame, min(frame + 1, len(times) - 1)})
    if len(times) == 1:
        return
    sizes = np.array([[1.0 if key == frame else 0.0] * 3 for key in keys], dtype=np.float32)
    writer.animate(
        node, "scale", writer.add_array(times[keys], "SCALAR"), writer.add_array(sizes, "VEC3"), "STEP"
    )
    if frame:
        writer.document["nodes"][node]["scale"] = [0.0, 0.0, 0.0]
