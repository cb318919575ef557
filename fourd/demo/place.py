"""The square and all that stands still on it. Metres, x right, y away from the cameras, z up."""

import numpy as np

from fourd.demo.primitives import UP, Builder, turned

SUN = np.array([0.40, -0.62, 0.66]) / np.linalg.norm([0.40, -0.62, 0.66])
PAVING_HALF = 6.0
PARASOL = (-2.35, 2.5)
MIRROR_CENTER, MIRROR_RADIUS = (2.05, 2.35, 1.12), 0.36


def build_place(builder: Builder) -> None:
    """Add every static primitive."""
    _add_ground(builder)
    _add_walls(builder)
    _add_countryside(builder)
    _add_cafe(builder)
    _add_monument(builder)
    _add_goods(builder)
    _add_plants(builder)


def _stand(builder: Builder, x: float, y: float, radius: float) -> None:
    """Remember a thing that darkens the paving around its foot."""
    builder.footprints.append((x + PAVING_HALF, y + PAVING_HALF, radius))


def _add_ground(builder: Builder) -> None:
    east, north = (1, 0, 0), (0, 1, 0)
    builder.rectangle((0, 0, 0), (PAVING_HALF, PAVING_HALF), east, north, "paving")
    builder.rectangle((0, 0, -0.03), (26, 26), east, north, "cobbles")
    builder.rectangle((0, 0, -0.06), (300, 300), east, north, "meadow")


def _add_walls(builder: Builder) -> None:
    # The bakery: a body with the painted front just before it.
    builder.box((-0.3, 7.2, 2.7), (3.58, 2.6, 2.7), "brick")
    builder.rectangle((-0.3, 4.58, 2.7), (3.6, 2.7), (1, 0, 0), UP, "facade")
    for u in (0.55, 4.55):
        width = 1.5 if u < 1 else 1.9
        builder.box(
            (-3.9 + u + width / 2, 4.5, 0.77 if u < 1 else 0.64), (width / 2 + 0.1, 0.12, 0.05), "stone"
        )
    builder.box((-0.475, 4.4, 0.06), (0.7, 0.3, 0.06), "stone")
    tilt = np.radians(24)
    across = np.array([[1, 0, 0], [0, np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), np.cos(tilt)]])
    front = np.stack([across[1], -across[0], across[2]])
    builder.box((1.6, 4.18, 2.26), (0.46, 1.15, 0.012), "awning", front)
    # The plastered house along the left.
    builder.box((-7.4, 2.0, 1.8), (1.78, 4.5, 1.8), "plaster")
    builder.rectangle((-5.6, 2.0, 1.8), (4.5, 1.8), (0, 1, 0), UP, "side_wall")
    ridge = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])
    builder.box((-7.3, 2.0, 3.75), (4.7, 2.0, 0.09), "roof", ridge)
    # The low wall on the right, with a coping.
    builder.box((5.75, 2.2, 0.5), (0.17, 4.6, 0.5), "rubble")
    builder.box((5.75, 2.2, 1.04), (0.24, 4.6, 0.05), "stone")
    for y in (-2.4, 6.8):
        builder.box((5.75, y, 0.75), (0.3, 0.3, 0.75), "rubble")
        builder.ellipsoid((5.75, y, 1.7), (0.24, 0.24, 0.24), "stone")


def _add_house(builder: Builder, x: float, y: float, degrees: float, variant: int, tall: float) -> None:
    axes = turned(degrees)
    half = (3.0, 2.4, tall / 2)
    builder.box((x, y, tall / 2), half, f"house{variant}", axes, uv=(1, 3.4 / tall, 3.0, 1.7))
    # A roof is a box on its edge, flattened, sunk into the house.
    diagonal = np.sqrt(0.5)
    tip = np.stack([axes[0], diagonal * (axes[1] + UP / 0.62), diagonal * (-axes[1] + UP / 0.62)])
    builder.box((x, y, tall - 0.05), (3.25, 1.93, 1.93), "roof", tip, uv=(1, 1, 3.0, 3.0))
    chimney = np.array([x, y, tall + 1.2]) + 1.5 * axes[0]
    builder.box(chimney, (0.3, 0.3, 0.9), "brick", axes)


def _add_countryside(builder: Builder) -> None:
    for x, y, degrees, variant, tall in (
        (12.5, 8.5, -38, 0, 3.0),
        (11.5, 18.0, -15, 1, 3.6),
        (20.5, 10.5, -62, 2, 3.2),
        (19.0, 21.5, -40, 1, 3.4),
        (-5.2, 16.5, 14, 1, 3.4),
        (-10.5, 13.0, 38, 0, 3.9),
        (3.5, 21.0, 4, 2, 4.6),
        (13.5, -1.5, -84, 1, 3.1),
    ):
        _add_house(builder, x, y, degrees, variant, tall)
    rng = np.random.default_rng(3)
    for x, y, size in (
        (8.0, 4.2, 1.0), (7.6, 10.5, 1.3), (15.0, 13.5, 1.5), (9.6, -0.6, 0.9), (16.5, 4.5, 1.3),
        (6.4, 14.5, 1.2),
        (24.0, 15.5, 1.8), (-4.6, 11.5, 0.9), (-8.2, 20.0, 1.6), (25.0, 4.0, 1.8), (15.5, 22.0, 1.6),
    ):  # fmt: skip
        _add_tree(builder, rng, x, y, size)


def _add_tree(builder: Builder, rng: np.random.Generator, x: float, y: float, size: float) -> None:
    builder.frustum((x, y, -0.1), (x, y, 1.5 * size), (0.16 * size, 0.09 * size), "dark_wood")
    for k in range(7):
        angle = 2 * np.pi * k / 6 + rng.uniform(0, 0.6)
        reach = 0.0 if k == 6 else 0.62 * size
        center = (
            x + reach * np.cos(angle),
            y + reach * np.sin(angle),
            (2.35 if k == 6 else 1.75 + 0.3 * rng.uniform(-1, 1)) * size,
        )
        radius = size * rng.uniform(0.55, 0.75)
        uv = (4.0, 2.0, rng.uniform(0, 2), rng.uniform(0, 2))
        builder.ellipsoid(center, (radius, radius, 0.85 * radius), "leaves", turned(rng.uniform(0, 360)), uv)


def _add_cafe(builder: Builder) -> None:
    x, y = PARASOL
    builder.frustum((x, y, 0), (x, y, 2.6), (0.028, 0.024), "wood")
    builder.frustum((x, y, 1.98), (x, y, 2.48), (1.2, 0.04), "parasol")
    builder.frustum((x, y, 0), (x, y, 0.09), (0.28, 0.24), "iron")
    builder.frustum((x, y, 0.70), (x, y, 0.735), (0.46, 0.46), "wood")
    _stand(builder, x, y, 0.27)
    _add_cups(builder, x, y)
    for degrees, dx, dy in ((205, 0.62, -0.38), (78, -0.72, 0.1)):
        _add_chair(builder, x + dx, y + dy, degrees)
    board = turned(12)
    lean = np.radians(12)
    back = np.cos(lean) * UP + np.sin(lean) * board[1]
    builder.rectangle((0.95, 3.25, 0.51), (0.35, 0.5), board[0], back, "menu")
    builder.rectangle(np.array([0.95, 3.25, 0.51]) + 0.22 * board[1], (0.35, 0.5), -board[0],
                      np.cos(lean) * UP - np.sin(lean) * board[1], "menu")  # fmt: skip
    _stand(builder, 0.95, 3.35, 0.3)


def _add_cups(builder: Builder, x: float, y: float) -> None:
    builder.frustum((x + 0.2, y - 0.18, 0.735), (x + 0.2, y - 0.18, 0.86), (0.055, 0.085), "glazed")
    builder.frustum((x - 0.14, y - 0.22, 0.735), (x - 0.14, y - 0.22, 0.82), (0.032, 0.042), "glazed")
    builder.limb((x + 0.02, y + 0.2, 0.80), (x + 0.02, y + 0.2, 0.93), (0.07, 0.03), "glazed")


def _add_chair(builder: Builder, x: float, y: float, degrees: float) -> None:
    axes = turned(degrees)

    def at(u: float, v: float, z: float) -> np.ndarray:
        return np.array([x, y, z]) + u * axes[0] + v * axes[1]

    builder.box(at(0, 0, 0.45), (0.2, 0.2, 0.018), "green_wood", axes)
    for z in (0.66, 0.78, 0.9):
        builder.box(at(0, -0.205, z), (0.2, 0.012, 0.035), "green_wood", axes)
    for u in (-0.18, 0.18):
        builder.frustum(at(u, 0.18, 0), at(u, 0.18, 0.45), (0.018, 0.018), "iron")
        builder.frustum(at(u, -0.19, 0), at(u, -0.205, 0.95), (0.018, 0.018), "iron")
        _stand(builder, float(at(u, 0.18, 0)[0]), float(at(u, 0.18, 0)[1]), 0.02)


def _add_monument(builder: Builder) -> None:
    x, y, z = MIRROR_CENTER
    builder.box((x, y, 0.09), (0.46, 0.46, 0.09), "stone", turned(20))
    builder.box((x, y, 0.42), (0.3, 0.3, 0.27), "rubble", turned(20))
    builder.box((x, y, 0.73), (0.36, 0.36, 0.045), "stone", turned(20))
    builder.ellipsoid((x, y, z), (MIRROR_RADIUS,) * 3, "steel")
    _stand(builder, x, y, 0.5)
    builder.frustum((4.6, 1.6, 0), (4.6, 1.6, 0.5), (0.11, 0.07), "iron")
    builder.frustum((4.6, 1.6, 0.5), (4.6, 1.6, 3.0), (0.05, 0.04), "iron")
    builder.ellipsoid((4.6, 1.6, 3.2), (0.2, 0.2, 0.24), "lamp")
    _stand(builder, 4.6, 1.6, 0.1)


def _add_goods(builder: Builder) -> None:
    corner = (1, 1, 0.45, 0.45)
    builder.box((3.75, 3.35, 0.45), (0.45, 0.45, 0.45), "crate", turned(14), corner)
    builder.box((3.70, 3.40, 1.18), (0.3, 0.3, 0.28), "crate", turned(-21), (1.4, 1.4, 0.45, 0.45))
    builder.box((4.55, 2.75, 0.3), (0.3, 0.3, 0.3), "crate", turned(40), (1.4, 1.4, 0.45, 0.45))
    for x, y, radius in ((3.72, 3.35, 0.5), (4.55, 2.75, 0.33)):
        _stand(builder, x, y, radius)
    x, y = 2.95, 3.75
    builder.frustum((x, y, 0), (x, y, 0.42), (0.25, 0.31), "wood")
    builder.frustum((x, y, 0.42), (x, y, 0.84), (0.31, 0.25), "wood")
    for z in (0.12, 0.40, 0.70):
        radius = 0.262 + 0.05 * (1 - abs(z - 0.40) / 0.3)
        builder.frustum((x, y, z), (x, y, z + 0.045), (radius, radius), "iron")
    _stand(builder, x, y, 0.28)
    # A bench by the plastered wall.
    for z, dx in ((0.45, 0.0), (0.45, 0.16), (0.45, -0.16)):
        builder.box((-4.75 + dx, 1.3, z), (0.07, 0.85, 0.02), "wood")
    for z in (0.62, 0.78):
        builder.box((-5.0, 1.3, z), (0.018, 0.85, 0.06), "wood")
    for dy in (-0.7, 0.7):
        builder.box((-4.78, 1.3 + dy, 0.22), (0.2, 0.035, 0.22), "stone")
        _stand(builder, -4.78, 1.3 + dy, 0.15)


def _add_plants(builder: Builder) -> None:
    rng = np.random.default_rng(5)
    for x, y, size, flower in (
        (-1.55, 4.1, 1.0, "blossom"), (0.35, 4.15, 0.8, "leaves"), (-4.3, 3.6, 1.15, "leaves"),
        (-3.45, 4.1, 0.9, "blossom"), (5.1, 4.6, 1.1, "blossom"), (-5.15, -0.5, 0.9, "leaves"),
    ):  # fmt: skip
        builder.frustum((x, y, 0), (x, y, 0.42 * size), (0.19 * size, 0.27 * size), "terracotta")
        builder.frustum((x, y, 0.38 * size), (x, y, 0.44 * size), (0.29 * size, 0.3 * size), "terracotta")
        _stand(builder, x, y, 0.19 * size)
        for k in range(5):
            angle = 2 * np.pi * k / 4 + rng.uniform(0, 0.5)
            reach = 0.0 if k == 4 else 0.17 * size
            radius = size * rng.uniform(0.2, 0.27)
            center = (
                x + reach * np.cos(angle),
                y + reach * np.sin(angle),
                (0.80 if k == 4 else 0.6 + 0.05 * rng.uniform(-1, 1)) * size,
            )
            uv = (1.5, 0.8, rng.uniform(0, 2), rng.uniform(0, 2))
            name = flower if k % 2 else "leaves"
            builder.ellipsoid(center, (radius,) * 3, name, turned(rng.uniform(0, 360)), uv)
