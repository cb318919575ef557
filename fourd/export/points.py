"""Point clouds: PLY files, one per frame."""

from pathlib import Path

import numpy as np

from fourd.errors import InputError
from fourd.export.event import Event
from fourd.io import atomic_path

PLY_TYPES = {"f8": "double", "f4": "float", "u1": "uchar"}
_DTYPES = {"char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4"}
_DTYPES |= {"float": "<f4", "double": "<f8", "uint8": "u1", "float32": "<f4", "float64": "<f8"}


def write_ply(path: Path, xyz: np.ndarray, rgb: np.ndarray, **columns: np.ndarray) -> None:
    """Write points (N, 3), colours (N, 3) uint8 and further columns (N,) as a binary PLY.

    Positions are doubles: a world may lie far from its origin.
    """
    names = [("x", "f8"), ("y", "f8"), ("z", "f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    values = [*xyz.T, *rgb.T]
    for name, column in columns.items():
        names.append((name, "f4" if column.dtype.kind == "f" else "u1"))
        values.append(column)
    table = np.zeros(len(xyz), dtype=[(name, f"<{kind}") for name, kind in names])
    for (name, _), column in zip(names, values, strict=True):
        table[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    header += [f"property {PLY_TYPES[kind]} {name}" for name, kind in names]
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode())
        file.write(table.tobytes())


def read_ply(path: Path) -> np.ndarray:
    """The vertices of a binary little-endian PLY as a structured array. Raises InputError."""
    data = path.read_bytes() if path.is_file() else b""
    head, mark, body = data.partition(b"end_header\n")
    lines = head.decode("ascii", errors="replace").split("\n")
    if not mark or lines[0] != "ply" or "format binary_little_endian 1.0" not in lines:
        raise InputError(f"expected a binary little-endian PLY at {path}, got something else: check the file")
    first = next((i for i, line in enumerate(lines) if line.startswith("element ")), len(lines))
    count, kinds = 0, []
    for line in lines[first:]:
        words = line.split()
        if words[:1] == ["element"] and (words[1] != "vertex" or kinds):
            break
        if words[:1] == ["element"]:
            count = int(words[2])
        elif words[:1] == ["property"]:
            if words[1] not in _DTYPES:
                raise InputError(f"{path}: a vertex with {line!r} cannot be read: write plain numbers")
            kinds.append((words[2], _DTYPES[words[1]]))
    dtype = np.dtype(kinds)
    if not kinds or len(body) < count * dtype.itemsize:
        raise InputError(f"{path}: expected {count} vertices, the file is too short: write it anew")
    return np.frombuffer(body, dtype, count)


def write_clouds(event: Event, folder: Path) -> None:
    """Write 000012.ply of every scene frame: x, y, z, red, green, blue, camera (index of the input
    camera whose depth it is), moves (1 where the picture changes over time).
    """
    for frame in event.frames:
        cloud = event.cloud(frame, event.options.max_points)
        moves = cloud.moves.astype(np.uint8)
        write_ply(folder / f"{frame:06d}.ply", cloud.xyz, cloud.rgb, camera=cloud.source, moves=moves)
