"""Painting procedural pictures in metres: seeded noise, masonry, relief, and mipmaps of the result.

A picture is (H, W, 3) float32 linear reflectance with row 0 at the top. Random lattices are drawn
in metres, so that the same place appears at every resolution.
"""

import itertools
from collections.abc import Sequence

import cv2
import numpy as np

from fourd.demo.shading import Textures

MAX_LEVELS = 12


class Canvas:
    """A rectangle of `width_m` x `height_m` with its own random stream.

    u, v: (H, W) float32, metres to the right of the left edge and up from the bottom edge
    """

    def __init__(self, width_m: float, height_m: float, texels_per_m: float, seed: Sequence[int]) -> None:
        self.width_m, self.height_m, self.texels_per_m = width_m, height_m, texels_per_m
        self.rng = np.random.default_rng(list(seed))
        width, height = (max(4, round(size * texels_per_m)) for size in (width_m, height_m))
        self.shape = (height, width)
        u = (np.arange(width, dtype=np.float32) + 0.5) * (width_m / width)
        v = height_m - (np.arange(height, dtype=np.float32) + 0.5) * (height_m / height)
        self.u, self.v = np.broadcast_to(u, self.shape), np.broadcast_to(v[:, None], self.shape)

    def noise(
        self, feature_m: float | tuple[float, float], octaves: int = 4, gain: float = 0.55
    ) -> np.ndarray:
        """(H, W) float32 smooth noise, about -1 to 1; the largest feature is `feature_m` wide (and high).

        Repeats at the edges. Octaves finer than two texels are left out.
        """
        size = feature_m if isinstance(feature_m, tuple) else (feature_m, feature_m)
        total, norm = np.zeros(self.shape, np.float32), 0.0
        for octave in range(octaves):
            cells = [
                max(1, round(extent / s * 2**octave))
                for extent, s in zip((self.height_m, self.width_m), size[::-1], strict=True)
            ]
            lattice = self.rng.uniform(-1, 1, cells).astype(np.float32)
            norm += gain ** (2 * octave)
            if cells[0] * 2 <= self.shape[0] and cells[1] * 2 <= self.shape[1]:
                total += gain**octave * _enlarge(lattice, self.shape)
        return total * (1.6 / np.sqrt(norm))

    def paint(self, color: Sequence[float]) -> np.ndarray:
        """(H, W, 3) of one colour, sRGB 0-255."""
        return np.broadcast_to(linear_color(color), (*self.shape, 3)).copy()

    def pixel(self, u: float, v: float) -> tuple[int, int]:
        """Column and row of a point, for drawing."""
        return round(u * self.texels_per_m), round((self.height_m - v) * self.texels_per_m)

    def relief(self, height: np.ndarray, strength: float, light: tuple[float, float] = (1, 1)) -> np.ndarray:
        """(H, W, 1) factor that lights bumps from one side.

        height: (H, W) metres;  light: direction to the light, right and up
        """
        grad_down, grad_right = np.gradient(height * self.texels_per_m)
        slope = light[0] * grad_right - light[1] * grad_down
        return np.clip(1 - strength * slope, 0.35, 1.7)[:, :, None].astype(np.float32)


def _enlarge(lattice: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Cubic interpolation of a lattice that repeats."""
    pad = 2
    padded = np.pad(lattice, pad, mode="wrap")
    scale = [shape[k] / lattice.shape[k] for k in range(2)]
    size = [round(padded.shape[k] * scale[k]) for k in range(2)]
    large = cv2.resize(padded, (size[1], size[0]), interpolation=cv2.INTER_CUBIC)
    top, left = round(pad * scale[0]), round(pad * scale[1])
    return large[top : top + shape[0], left : left + shape[1]]


def linear_color(color: Sequence[float]) -> np.ndarray:
    """(3,) float32 linear reflectance of an sRGB colour 0-255."""
    return ((np.asarray(color, np.float32) / 255) ** 2.2).astype(np.float32)


def mix(a: np.ndarray, b: np.ndarray | Sequence[float], share: np.ndarray) -> np.ndarray:
    """a where share is 0, b (a picture, or an sRGB colour) where it is 1; share: (H, W)."""
    other = b if isinstance(b, np.ndarray) else linear_color(b)
    return a + np.clip(share, 0, 1)[:, :, None].astype(np.float32) * (other - a)


def draw(canvas: Canvas, picture: np.ndarray, shapes: Sequence[tuple], alpha: float = 1.0) -> np.ndarray:
    """The picture with shapes painted on, antialiased.

    shapes: ("rectangle", u0, v0, u1, v1, color), ("disc", u, v, radius_u, radius_v, color),
    ("line", u0, v0, u1, v1, width, color), ("polygon", ((u, v), ...), color),
    ("text", u, v, height, text, color); metres, sRGB colours
    """
    picture = picture.copy()
    for color, run in itertools.groupby(shapes, key=lambda shape: shape[-1]):
        mask = np.zeros(canvas.shape, np.uint8)
        for shape in run:
            _draw_mask(canvas, mask, shape[0], shape[1:-1])
        left, top, width, height = cv2.boundingRect(mask)
        window = np.s_[top : top + height, left : left + width]
        picture[window] = mix(picture[window], color, mask[window].astype(np.float32) * (alpha / 255))
    return picture


def _draw_mask(canvas: Canvas, mask: np.ndarray, kind: str, values: tuple) -> None:
    """Add the coverage of one shape, 255 inside."""
    if kind == "rectangle":
        cv2.rectangle(mask, canvas.pixel(*values[:2]), canvas.pixel(*values[2:]), 255, cv2.FILLED)
    elif kind == "disc":
        center, axes = canvas.pixel(*values[:2]), [max(1, round(r * canvas.texels_per_m)) for r in values[2:]]
        cv2.ellipse(mask, center, axes, 0, 0, 360, 255, cv2.FILLED, cv2.LINE_AA)
    elif kind == "line":
        thickness = max(1, round(values[4] * canvas.texels_per_m))
        ends = canvas.pixel(*values[:2]), canvas.pixel(*values[2:4])
        cv2.line(mask, *ends, 255, thickness, cv2.LINE_AA)
    elif kind == "polygon":
        corners = np.array([canvas.pixel(*corner) for corner in values[0]], np.int32)
        cv2.fillPoly(mask, [corners], 255, cv2.LINE_AA)
    elif kind == "text":
        u0, v0, height, text = values
        # Hershey Duplex capitals are 21 px high at scale 1.
        scale = height * canvas.texels_per_m / 21
        font, thickness = cv2.FONT_HERSHEY_DUPLEX, max(1, round(scale * 2.4))
        cv2.putText(mask, text, canvas.pixel(u0, v0), font, scale, 255, thickness, cv2.LINE_AA)
    else:
        raise ValueError(f"unknown shape {kind!r}")


class Masonry:
    """Courses of blocks of uneven size: which block each texel is in and how far its edge is.

    block: (H, W) int index;  edge: (H, W) float32 metres to the nearest joint;  row: (H, W) int course
    """

    def __init__(
        self,
        canvas: Canvas,
        course_m: tuple[float, float],
        length_m: tuple[float, float],
        warp_m: float = 0.0,
    ) -> None:
        rng = canvas.rng
        u, v = canvas.u, canvas.v
        if warp_m > 0:
            u = u + warp_m * canvas.noise(0.5, 3)
            v = v + warp_m * canvas.noise(0.5, 3)
        rows = _cut(rng, canvas.height_m, course_m)
        period = canvas.width_m + 4
        keys = [k * period + _cut(rng, canvas.width_m, length_m) for k in range(len(rows) + 1)]
        edges = np.concatenate(keys)
        self.row = np.clip(np.searchsorted(rows, v), 1, len(rows) - 1)
        place = self.row * period + np.clip(u, 1e-3, canvas.width_m - 1e-3)
        self.block = np.searchsorted(edges, place)
        left, right = place - edges[self.block - 1], edges[self.block] - place
        low, high = v - rows[self.row - 1], rows[self.row] - v
        self.edge = np.minimum(np.minimum(left, right), np.minimum(low, high)).astype(np.float32)
        self._rng, self._count = rng, len(edges) + 1

    def random(self) -> np.ndarray:
        """(H, W) float32 in [0, 1), one value per block."""
        return self._rng.random(self._count).astype(np.float32)[self.block]

    def choose(self, colors: Sequence[Sequence[float]]) -> np.ndarray:
        """(H, W, 3) a colour per block, mixed at random from sRGB colours."""
        palette = np.stack([linear_color(c) for c in colors])
        weights = self._rng.dirichlet(np.full(len(colors), 0.45), self._count).astype(np.float32)
        return (weights @ palette)[self.block]


def _cut(rng: np.random.Generator, length: float, sizes: tuple[float, float]) -> np.ndarray:
    """Joints from 0 to `length` at random spacings."""
    count = int(np.ceil(length / sizes[0])) + 1
    joints = np.concatenate([[0.0], np.cumsum(rng.uniform(*sizes, count))])
    last = int(np.searchsorted(joints, length))
    return joints[: last + 1] * (length / joints[last])


def pack_textures(pictures: Sequence[np.ndarray], extents_m: Sequence[tuple[float, float]]) -> Textures:
    """Mipmaps of all pictures (linear, row 0 at the top) in one array for the ray caster."""
    texels, levels, offset = [], np.zeros((len(pictures), MAX_LEVELS, 3), np.int64), 0
    for index, picture in enumerate(pictures):
        # Texture coordinates rise upward, rows downward.
        image = np.ascontiguousarray(picture[::-1], dtype=np.float32)
        for level in range(MAX_LEVELS):
            height, width = image.shape[:2]
            encoded = np.sqrt(np.clip(image, 0, 1)) * 255
            texels.append(np.rint(encoded).astype(np.uint8).reshape(-1, 3))
            levels[index, level] = offset, width, height
            offset += width * height
            if level < MAX_LEVELS - 1:
                size = (max(1, width // 2), max(1, height // 2))
                image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return Textures(np.concatenate(texels), levels, np.array(extents_m, dtype=np.float64))
