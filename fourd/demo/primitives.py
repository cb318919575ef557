"""Collecting primitives in convenient forms, and the lists of who is met from where."""

from collections.abc import Sequence

import numpy as np

from fourd.demo import raycast
from fourd.demo.raycast import TILE_PX, CellLists, Geometry

Vector = Sequence[float] | np.ndarray
UP = np.array([0.0, 0.0, 1.0])


def frame_around(axis: Vector, front: Vector) -> np.ndarray:
    """(3, 3) rows x, y, z: z along `axis`, x as near to `front` as it can be."""
    z = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    x = np.asarray(front, dtype=np.float64) - np.dot(front, z) * z
    if np.linalg.norm(x) < 1e-6:
        x = (
            np.cross(z, [z[1], z[2], z[0]])
            if abs(z[0] - z[1]) + abs(z[1] - z[2]) > 1e-6
            else np.array([1, -1, 0])
        )
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def turned(degrees: float) -> np.ndarray:
    """(3, 3) rows of a frame turned about the vertical."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])


class Builder:
    """Grows the lists behind `Geometry`; materials are given by name.

    Texture coordinates: around a round thing `uv[0]` metres per turn, along it `uv[1]` per metre
    (per half turn for spheres), plus the offset `uv[2:]`; flat faces are in metres.
    """

    def __init__(self, material_index: dict[str, int]) -> None:
        self._materials = material_index
        self._rows: list[tuple] = []
        self.occluders: list[tuple[float, ...]] = []
        self.footprints: list[tuple[float, float, float]] = []
        self.label = 0

    def _add(
        self, kind: int, linear: np.ndarray, origin: Vector, shape: Vector, uv: Vector, name: str
    ) -> None:
        self._rows.append((kind, linear, origin, shape, uv, self._materials[name], self.label))

    def ellipsoid(
        self,
        center: Vector,
        radii: Vector,
        material: str,
        axes: np.ndarray | None = None,
        uv: Vector | None = None,
    ) -> None:
        """An ellipsoid; `axes` rows are the directions of its radii."""
        axes = np.eye(3) if axes is None else axes
        size = float(np.mean(radii))
        uv = (2 * np.pi * size, np.pi * size, 0, 0) if uv is None else uv
        self._add(raycast.SPHERE, axes / np.asarray(radii)[:, None], center, (1, 1, 1), uv, material)

    def box(
        self,
        center: Vector,
        half: Vector,
        material: str,
        axes: np.ndarray | None = None,
        uv: Vector | None = None,
    ) -> None:
        """A box; texture coordinates start at its lower left corner unless given."""
        axes = np.eye(3) if axes is None else axes
        uv = (1, 1, max(half[0], half[1]), half[2]) if uv is None else uv
        self._add(raycast.BOX, axes, center, half, uv, material)

    def rectangle(
        self, center: Vector, half: tuple[float, float], right: Vector, up: Vector, material: str
    ) -> None:
        """A flat picture, seen unmirrored from the side of right x up."""
        axes = np.stack([np.asarray(right, float), np.asarray(up, float), np.cross(right, up)])
        uv = (1, 1, half[0], half[1])
        self._add(raycast.RECTANGLE, axes, center, (*half, 0), uv, material)

    def limb(
        self,
        a: Vector,
        b: Vector,
        radii: tuple[float, float],
        material: str,
        front: Vector = (1, 0.013, 0),
        thickness: float = 1.0,
        uv: Vector | None = None,
    ) -> None:
        """A rounded cone from a to b; its extent along `front` is multiplied by `thickness`."""
        a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
        axes = frame_around(b - a, front) / np.array([thickness, 1.0, 1.0])[:, None]
        uv = (2 * np.pi * max(radii), 1, 0, 0) if uv is None else uv
        self._add(raycast.ROUND_CONE, axes, a, (*radii, float(np.linalg.norm(b - a))), uv, material)

    def frustum(
        self,
        a: Vector,
        b: Vector,
        radii: tuple[float, float],
        material: str,
        front: Vector = (1, 0.013, 0),
        thickness: float = 1.0,
    ) -> None:
        """A cone cut flat at a and b, with caps."""
        a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
        axes = frame_around(b - a, front) / np.array([thickness, 1.0, 1.0])[:, None]
        uv = (2 * np.pi * max(radii), 1, 0, 0)
        self._add(raycast.FRUSTUM, axes, a, (*radii, float(np.linalg.norm(b - a))), uv, material)

    def without(self, labels: Sequence[int]) -> "Builder":
        """The same primitives but for those that carry one of the labels."""
        rest = Builder(self._materials)
        rest._rows = [row for row in self._rows if row[6] not in labels]
        rest.occluders = [o for o in self.occluders if o[4] not in labels]
        return rest

    def extended(self, other: "Builder") -> "Builder":
        """These primitives and the other's."""
        both = Builder(self._materials)
        both._rows = self._rows + other._rows
        both.occluders = self.occluders + other.occluders
        return both

    def geometry(self) -> Geometry:
        """Arrays for the ray caster."""
        kind, linear, origin, shape, uv, material, label = zip(*self._rows, strict=True)
        return Geometry(
            np.array(kind, dtype=np.int64),
            np.array(linear, dtype=np.float64),
            np.array(origin, dtype=np.float64),
            np.array(shape, dtype=np.float64),
            np.array(uv, dtype=np.float64),
            np.array(material, dtype=np.int64),
            np.array(label, dtype=np.uint8),
        )


def bounding_corners(g: Geometry) -> np.ndarray:
    """(N, 8, 3) world corners of a box around every primitive."""
    r0, r1, height = g.shape[:, 0], g.shape[:, 1], g.shape[:, 2]
    wide = np.maximum(r0, r1)
    low, high = -g.shape.copy(), g.shape.copy()
    for kind in (raycast.ROUND_CONE, raycast.FRUSTUM):
        cap = float(kind == raycast.ROUND_CONE)
        chosen = g.kind == kind
        low[chosen] = np.stack([-wide, -wide, -cap * r0], axis=1)[chosen]
        high[chosen] = np.stack([wide, wide, height + cap * r1], axis=1)[chosen]
    steps = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(1, 8, 3)
    corners = low[:, None] + steps * (high - low)[:, None]
    world_from_local = np.linalg.inv(g.linear)
    return corners @ world_from_local.transpose(0, 2, 1) + g.origin[:, None]


def _cell_lists(boxes: np.ndarray, order: np.ndarray, near: np.ndarray, columns: int, rows: int) -> CellLists:
    start = np.zeros(columns * rows + 1, dtype=np.int64)
    boxes, order = boxes.astype(np.int64), order.astype(np.int64)
    raycast.fill_cells(boxes, order, columns, columns * rows, start, np.zeros(0, dtype=np.int64))
    items = np.zeros(start[-1] + 1, dtype=np.int64)
    raycast.fill_cells(boxes, order, columns, columns * rows, start, items)
    return CellLists(start, items, near)


def camera_tiles(
    corners: np.ndarray, K: np.ndarray, R: np.ndarray, t: np.ndarray, size: tuple[int, int]
) -> CellLists:
    """Primitives that each square tile of a picture can see, nearest first.

    corners: (N, 8, 3) world;  K, R, t: cam_from_world pinhole;  size: (width, height) px
    """
    in_cam = corners @ R.T + t
    z = in_cam[..., 2]
    near = np.maximum(z.min(axis=1), 0.0)
    crosses = z.min(axis=1) < 0.05
    safe = np.maximum(z, 0.05)
    width, height = size
    columns, rows = -(-width // TILE_PX), -(-height // TILE_PX)
    boxes = np.zeros((len(corners), 4))
    for axis, count in ((0, columns), (1, rows)):
        pixels = in_cam[..., axis] / safe * K[axis, axis] + K[axis, 2]
        # One pixel of margin: rays of a pixel lie up to half a pixel from its centre.
        boxes[:, 2 * axis] = np.clip(np.floor((pixels.min(axis=1) - 1) / TILE_PX), 0, count)
        boxes[:, 2 * axis + 1] = np.clip(np.floor((pixels.max(axis=1) + 1) / TILE_PX), -1, count - 1)
    boxes[crosses] = 0, columns - 1, 0, rows - 1
    boxes[z.max(axis=1) <= 0] = 0, -1, 0, -1
    return _cell_lists(boxes, np.argsort(near, kind="stable"), near, columns, rows)


def sun_lists(
    corners: np.ndarray, axes: np.ndarray, casts: np.ndarray, cell: float
) -> tuple[np.ndarray, CellLists]:
    """Grid across the sun's rays and the primitives behind each cell.

    axes: (2, 3) unit vectors across the rays;  casts: (N,) bool;  cell: metres
    Returns grid (5,) minimum p, minimum q, cell, columns, rows; lists
    """
    plane = corners @ axes.T
    low = plane[casts].min(axis=(0, 1)) - 1e-3
    high = plane[casts].max(axis=(0, 1)) + 1e-3
    columns, rows = (int(n) for n in np.ceil((high - low) / cell))
    first = np.floor((plane.min(axis=1) - 1e-3 - low) / cell)
    last = np.floor((plane.max(axis=1) + 1e-3 - low) / cell)
    boxes = np.stack([first[:, 0], last[:, 0], first[:, 1], last[:, 1]], axis=1)
    boxes[:, :2], boxes[:, 2:] = np.clip(boxes[:, :2], 0, columns - 1), np.clip(boxes[:, 2:], 0, rows - 1)
    boxes[~casts] = 0, -1, 0, -1
    lists = _cell_lists(boxes, np.arange(len(corners)), np.zeros(len(corners)), columns, rows)
    return np.array([low[0], low[1], cell, columns, rows], dtype=np.float64), lists


def everything(count: int) -> CellLists:
    """One cell that lists every primitive."""
    return CellLists(
        np.array([0, count], dtype=np.int64), np.arange(count, dtype=np.int64), np.full(count, -1.0)
    )
