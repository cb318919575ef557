"""Pictures and truth of the event from any camera at any time."""

import functools
from collections.abc import Sequence

import numpy as np

from fourd.camera import Camera
from fourd.demo.cameras import middle_time
from fourd.demo.figures import BALL, LABELS, MAN, WOMAN, add_ball, add_figure
from fourd.demo.materials import MATERIALS, make_materials, material_index
from fourd.demo.options import DemoOptions
from fourd.demo.place import SUN, build_place
from fourd.demo.primitives import (
    UP,
    Builder,
    bounding_corners,
    camera_tiles,
    everything,
    frame_around,
    sun_lists,
)
from fourd.demo.raycast import Geometry
from fourd.demo.shading import Textures, World, render_pixels, trace_depth
from fourd.errors import InputError

LIGHT_CELL_M = 0.3
_GROUND_MATERIALS = ("paving", "cobbles", "meadow")


def label_numbers(names: Sequence[str]) -> tuple[int, ...]:
    """Label numbers of figure1, figure2, ball. Raises InputError for another name."""
    for name in names:
        if name not in LABELS:
            raise InputError(
                f"expected one of {', '.join(LABELS)} to leave out, got {name!r}: correct --without"
            )
    return tuple(LABELS[name] for name in names)


@functools.cache
def _static_builder() -> Builder:
    builder = Builder(material_index())
    build_place(builder)
    return builder


def build_scene(time_s: float, options: DemoOptions, without: Sequence[int] = ()) -> Builder:
    """All primitives at an instant.

    without: labels that are left out, with their shadows (1 and 2 the figures, 3 the ball)
    """
    moving = Builder(material_index())
    add_figure(moving, MAN, time_s, middle_time(options))
    add_figure(moving, WOMAN, time_s, middle_time(options))
    add_ball(moving, time_s)
    return _static_builder().extended(moving.without(without))


class FrozenScene:
    """The event at one instant, ready to be seen from any number of cameras."""

    def __init__(self, time_s: float, options: DemoOptions, without: Sequence[int] = ()) -> None:
        self.options = options
        scene = build_scene(time_s, options, without)
        self.geometry: Geometry = scene.geometry()
        self.corners = bounding_corners(self.geometry)
        self._occluders = np.array(scene.occluders, dtype=np.float64).reshape(-1, 5)

    @functools.cached_property
    def world(self) -> World:
        """Geometry with textures and light; the textures are painted once per process."""
        textures: Textures
        footprints = tuple(_static_builder().footprints)
        textures, materials = make_materials(self.options.width, self.options.seed, footprints)
        axes = frame_around(SUN, UP)[:2]
        ground = [list(MATERIALS).index(name) for name in _GROUND_MATERIALS]
        casts = ~np.isin(self.geometry.material, ground)
        grid, lists = sun_lists(self.corners, axes, casts, LIGHT_CELL_M)
        count = len(self.geometry.kind)
        return World(
            self.geometry, textures, materials, self._occluders, SUN, axes, grid, lists, everything(count)
        )

    def render(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Picture (H, W, 3) uint8 sRGB, depth (H, W) float32 z (inf = sky), labels (H, W) uint8."""
        width, height = camera.size
        tiles = camera_tiles(self.corners, camera.K, camera.R, camera.t, camera.size)
        color = np.empty((height, width, 3), np.float32)
        depth, label = np.empty((height, width), np.float32), np.empty((height, width), np.uint8)
        surface = np.empty((height, width), np.int64)
        samples = self.options.samples_per_axis
        world_from_cam = np.ascontiguousarray(camera.R.T)
        render_pixels(
            self.world, tiles, camera.K, world_from_cam, camera.center, samples, color, depth, label, surface
        )
        return encode_srgb(color), depth, label

    def trace(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Depth (H, W) float32 z (inf = sky) and labels (H, W) uint8 at pixel centres, no colours."""
        width, height = camera.size
        tiles = camera_tiles(self.corners, camera.K, camera.R, camera.t, camera.size)
        depth, label = np.empty((height, width), np.float32), np.empty((height, width), np.uint8)
        world_from_cam = np.ascontiguousarray(camera.R.T)
        trace_depth(self.geometry, tiles, camera.K, world_from_cam, camera.center, depth, label)
        return depth, label


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """uint8 display-referred sRGB of linear values in [0, 1]. Source: IEC 61966-2-1."""
    linear = np.clip(linear, 0, 1)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.rint(255 * encoded).astype(np.uint8)


__all__ = ["BALL", "FrozenScene", "build_scene", "encode_srgb", "label_numbers"]
