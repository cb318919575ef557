"""Pictures of the square: sky, paving, facades, wood, leaves. Linear reflectance, row 0 at the top."""

from collections.abc import Sequence

import numpy as np

from fourd.demo.canvas import Canvas, Masonry, draw, linear_color, mix
from fourd.demo.shading import SKY_BOTTOM_RAD, SKY_TOP_RAD

BEIGE_STONES = ((176, 166, 150), (150, 143, 134), (190, 172, 146), (128, 124, 120), (168, 140, 116))
BRICKS = ((164, 84, 62), (140, 66, 50), (184, 108, 78), (116, 62, 54), (176, 126, 98), (92, 54, 50))


def paint_sky(texels_per_rad: float, seed: int) -> np.ndarray:
    """Sky over hills, all around: width 2 pi, height from SKY_BOTTOM_RAD to SKY_TOP_RAD."""
    canvas = Canvas(2 * np.pi, SKY_TOP_RAD - SKY_BOTTOM_RAD, texels_per_rad, (seed, 1))
    elevation = canvas.v + SKY_BOTTOM_RAD
    height = np.clip(elevation / SKY_TOP_RAD, 0, 1) ** 0.6
    picture = mix(canvas.paint((225, 232, 240)), (96, 150, 222), height)
    clouds = canvas.noise((0.9, 0.16), 6, 0.6) + 0.15
    body = np.clip(clouds * 1.3 - 0.15 + 0.3 * canvas.noise((0.3, 0.08), 4), 0, 1)
    shade = np.clip(0.75 + 0.5 * canvas.noise((0.4, 0.1), 4), 0.4, 1)[:, :, None]
    picture = mix(picture, linear_color((255, 253, 250)) * shade, 0.85 * body)
    for base, swing, feature, color in (
        (0.085, 0.035, 1.1, (126, 148, 170)),
        (0.050, 0.030, 0.7, (96, 124, 112)),
        (0.018, 0.018, 0.35, (86, 112, 66)),
    ):
        crest = base + swing * canvas.noise((feature, 9.0), 5)[:1] + 0.004 * canvas.noise((0.03, 9.0), 3)[:1]
        inside = np.clip((crest - elevation) * texels_per_rad + 0.5, 0, 1)
        ground = 0.6 * canvas.paint(color) * (1 + 0.45 * canvas.noise((0.08, 0.02), 5, 0.7))[:, :, None]
        picture = mix(picture, ground, inside)
    return picture


def paint_paving(texels_per_m: float, seed: int, footprints: Sequence[tuple]) -> np.ndarray:
    """The square's flagstones, 12 x 12 m, with a compass mosaic in the middle.

    footprints: (u, v, radius) of things that stand on it and keep sky light away
    """
    canvas = Canvas(12.0, 12.0, texels_per_m, (seed, 2))
    stones = Masonry(canvas, (0.22, 0.42), (0.26, 0.72), warp_m=0.018)
    grain = canvas.noise(0.09, 5, 0.75)
    broad = canvas.noise(1.6, 4)
    picture = stones.choose(BEIGE_STONES) * (0.72 + 0.5 * stones.random() + 0.2 * grain)[:, :, None]
    _lay_mosaic(canvas, picture, stones.edge)
    height = np.minimum(stones.edge, 0.02) + 0.0025 * grain + 0.0012 * canvas.noise(0.03, 3, 0.8)
    picture = picture * canvas.relief(height, 0.5, (0.7, -1.0))
    mortar = np.clip((0.011 + 0.004 * grain - stones.edge) / 0.006, 0, 1)
    moss = np.clip(2.5 * broad - 0.6, 0, 1)
    picture = mix(picture, (92, 86, 78), mortar)
    picture = mix(picture, (74, 92, 48), mortar * moss * 0.9)
    stains = np.clip(1.5 * canvas.noise(0.7, 7, 0.75) - 0.7, 0, 0.8) * 0.6
    picture = mix(picture, (66, 60, 54), stains)
    spots = np.clip(6 * canvas.noise(0.045, 2) - 5.2, 0, 1)
    picture = mix(picture, (58, 54, 50), spots * 0.6)
    picture *= (1 + 0.16 * broad)[:, :, None]
    picture = draw(canvas, picture, _chalk(), alpha=0.75)
    shade = np.ones(canvas.shape, np.float32)
    for u, v, radius in footprints:
        gap = np.hypot(canvas.u - u, canvas.v - v) - radius
        shade *= 1 - 0.5 * np.exp(-np.clip(gap, 0, None) / 0.16)
    return picture * shade[:, :, None]


def _lay_mosaic(canvas: Canvas, picture: np.ndarray, edge: np.ndarray) -> None:
    """Replace, in place, the flagstones around the middle by a compass rose of small coloured stones."""
    rings = np.array([0.0, 0.14, 0.27, 0.40, 0.52, 0.65, 0.77, 0.90, 1.02, 1.15, 1.28])
    reach = round((rings[-1] + 0.05) * canvas.texels_per_m)
    row, column = canvas.shape[0] // 2, canvas.shape[1] // 2
    window = np.s_[row - reach : row + reach, column - reach : column + reach]
    x, y = canvas.u[window] - 6.0, canvas.v[window] - 6.0
    radius, angle = np.hypot(x, y), np.arctan2(y, x) % (2 * np.pi)
    ring = np.clip(np.searchsorted(rings, radius), 1, len(rings) - 1)
    count = np.round(2 * np.pi * (ring + 0.5) * 0.13 / 0.15)
    turn = angle / (2 * np.pi) * count + 0.37 * ring
    side = (0.5 - np.abs(turn % 1 - 0.5)) * 2 * np.pi * radius / count
    joint = np.minimum(np.minimum(radius - rings[ring - 1], rings[ring] - radius), side)
    index = (ring * 97 + turn.astype(int) % count.astype(int)) % 4096
    rays = np.abs(((angle * 4 / np.pi) % 2) - 1) > radius / 1.05
    odd = (np.abs(((angle * 2 / np.pi) % 2) - 1) > radius / 1.05) & rays
    stone_colors = (196, 186, 166), (52, 74, 104), (150, 62, 44), (66, 62, 62)
    palette = np.stack([linear_color(c) for c in stone_colors])
    color = palette[np.where(ring >= 9, 3, rays.astype(int) + odd)]
    rng = canvas.rng
    tint = (rng.uniform(0.6, 1.35, (4096, 1)) * rng.uniform(0.9, 1.1, (4096, 3))).astype(np.float32)
    inside = radius < rings[-1]
    picture[window][inside] = (color * tint[index])[inside]
    edge[window] = np.where(inside, joint, np.minimum(edge[window], np.abs(radius - rings[-1])))


def _chalk() -> list[tuple]:
    """Hopscotch and scribbles near the cameras, and a drain cover."""
    white, blue, pink = (236, 234, 226), (120, 170, 214), (226, 130, 160)
    shapes: list[tuple] = [
        ("disc", 4.15, 3.55, 0.33, 0.33, (58, 56, 56)),
        ("disc", 4.15, 3.55, 0.29, 0.29, (92, 88, 84)),
    ]
    shapes += [("line", 3.93 + 0.07 * k, 3.4, 3.93 + 0.07 * k, 3.7, 0.02, (40, 38, 38)) for k in range(7)]
    u, v, side = 7.35, 3.3, 0.38
    for number, (du, dv) in enumerate(((0, 0), (0, 1), (-0.5, 2), (0.5, 2), (0, 3), (-0.5, 4), (0.5, 4))):
        u0, v0 = u + du * side, v + dv * side
        corners = ((u0, v0), (u0 + side, v0), (u0 + side, v0 + side), (u0, v0 + side), (u0, v0))
        for a, b in zip(corners[:-1], corners[1:], strict=True):
            shapes.append(("line", *a, *b, 0.022, white))
        shapes.append(("text", u0 + 0.11, v0 + 0.1, 0.18, str(number + 1), blue if number % 2 else pink))
    for k in range(24):
        a, b = 0.42 * k, 0.42 * (k + 1)
        shapes.append(
            ("line", 5.2 + 0.015 * k * np.cos(a), 4.0 + 0.015 * k * np.sin(a),
             5.2 + 0.015 * (k + 1) * np.cos(b), 4.0 + 0.015 * (k + 1) * np.sin(b), 0.02, pink)
        )  # fmt: skip
    return shapes


def paint_cobbles(texels_per_m: float, seed: int) -> np.ndarray:
    """Street around the square, 16 x 16 m, repeating."""
    canvas = Canvas(16.0, 16.0, texels_per_m, (seed, 3))
    stones = Masonry(canvas, (0.10, 0.15), (0.11, 0.2), warp_m=0.02)
    picture = (
        stones.choose(((120, 112, 104), (96, 92, 90), (142, 128, 112)))
        * (0.7 + 0.6 * stones.random() + 0.2 * canvas.noise(0.3, 4, 0.7))[:, :, None]
    )
    picture = mix(picture, (70, 64, 56), np.clip((0.014 - stones.edge) / 0.008, 0, 1))
    return picture * (1 + 0.22 * canvas.noise(2.5, 5))[:, :, None]


def paint_brick(canvas: Canvas, colors: Sequence[Sequence[float]] = BRICKS) -> np.ndarray:
    """Bricks with mortar, weathering and a darker foot, on any canvas."""
    bricks = Masonry(canvas, (0.078, 0.082), (0.2, 0.27), warp_m=0.002)
    grain = canvas.noise(0.12, 4, 0.7)
    picture = bricks.choose(colors) * (0.75 + 0.45 * bricks.random() + 0.12 * grain)[:, :, None]
    picture = mix(picture, (186, 176, 160), np.clip((0.011 - bricks.edge) / 0.006, 0, 1))
    picture = picture * canvas.relief(np.minimum(bricks.edge, 0.01) + 0.001 * grain, 0.45)
    return weather(canvas, picture)


def paint_plaster(canvas: Canvas, color: Sequence[float]) -> np.ndarray:
    """Painted plaster with patches where the brick shows."""
    grain = canvas.noise(0.05, 3, 0.8)
    picture = canvas.paint(color) * (1 + 0.13 * canvas.noise(0.8, 6, 0.65) + 0.05 * grain)[:, :, None]
    bare = canvas.noise(1.3, 5, 0.5)
    under = paint_brick(canvas)
    picture = mix(picture, under, np.clip((bare - 0.62) * 14, 0, 1))
    rim = np.clip(1 - np.abs(bare - 0.6) * 16, 0, 1)
    picture = mix(picture, (232, 222, 204), rim * 0.6)
    cracks = np.clip(1 - np.abs(canvas.noise(1.1, 5, 0.6)) * 60, 0, 1) * np.clip(
        canvas.noise(2.0, 2) * 3, 0, 1
    )
    return weather(canvas, mix(picture, (92, 80, 70), cracks * 0.7))


def weather(canvas: Canvas, picture: np.ndarray) -> np.ndarray:
    """Rain streaks, dirt toward the ground, broad variation."""
    streaks = np.clip(1.6 * canvas.noise((0.16, 3.0), 3) - 0.5, 0, 0.6) * 0.5
    foot = np.exp(-canvas.v / 0.35) * (0.55 + 0.3 * canvas.noise(0.4, 3))
    picture = mix(picture, (70, 62, 52), streaks * 0.6)
    return mix(picture, (60, 54, 46), foot) * (1 + 0.14 * canvas.noise(1.5, 4))[:, :, None]


def paint_rubble(canvas: Canvas) -> np.ndarray:
    """A wall of uneven field stones."""
    stones = Masonry(canvas, (0.12, 0.26), (0.15, 0.5), warp_m=0.035)
    grain = canvas.noise(0.1, 4, 0.75)
    picture = stones.choose(((150, 140, 120), (118, 108, 98), (170, 156, 128), (126, 106, 84), (98, 96, 92)))
    picture = picture * (0.7 + 0.5 * stones.random() + 0.2 * grain)[:, :, None]
    picture = picture * canvas.relief(np.minimum(stones.edge, 0.03) + 0.003 * grain, 0.5)
    picture = mix(picture, (72, 66, 56), np.clip((0.014 - stones.edge) / 0.01, 0, 1))
    return weather(canvas, mix(picture, (88, 104, 56), np.clip(2 * canvas.noise(0.7, 4) - 0.9, 0, 0.7)))


def paint_wood(canvas: Canvas, color: Sequence[float], plank_m: float = 0.11) -> np.ndarray:
    """Horizontal planks with grain, knots and nails."""
    planks = Masonry(canvas, (0.95 * plank_m, 1.05 * plank_m), (0.9, 1.6))
    fibre = canvas.noise((0.7, 0.012), 3, 0.7)
    rings = np.sin(26 * canvas.noise((0.9, 0.14), 2))
    picture = canvas.paint(color) * (0.7 + 0.5 * planks.random() + 0.16 * fibre + 0.09 * rings)[:, :, None]
    return mix(picture, (42, 30, 22), np.clip((0.006 - planks.edge) / 0.004, 0, 1))


def paint_leaves(texels_per_m: float, seed: int, color: Sequence[float]) -> np.ndarray:
    """Foliage, 2 x 2 m, repeating: many small leaves over dark gaps."""
    canvas = Canvas(2.0, 2.0, texels_per_m, (seed, 7, int(color[1])))
    picture = canvas.paint((20, 34, 16))
    for layer, size in enumerate((0.10, 0.08, 0.065, 0.05)):
        clumps = canvas.noise(size, 2, 0.7) + 0.5 * canvas.noise(0.3, 2)
        tone = (0.35 + 0.33 * layer) * (1 + 0.5 * canvas.noise(0.12, 3, 0.8))
        picture = mix(picture, canvas.paint(color) * tone[:, :, None], np.clip((clumps - 0.35) * 6, 0, 1))
    return picture


def paint_tiles(canvas: Canvas) -> np.ndarray:
    """Clay roof tiles."""
    tiles = Masonry(canvas, (0.2, 0.24), (0.18, 0.24))
    picture = tiles.choose(((176, 92, 66), (150, 78, 60), (196, 122, 86), (120, 74, 62)))
    picture = picture * (0.7 + 0.5 * tiles.random() + 0.12 * canvas.noise(0.4, 4))[:, :, None]
    return mix(picture, (64, 40, 34), np.clip((0.03 - tiles.edge) / 0.03, 0, 0.8))
