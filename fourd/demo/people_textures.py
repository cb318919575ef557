"""Pictures that the figures wear: faces, hair, fabrics; and the ball. Linear, row 0 at the top."""

from collections.abc import Sequence

import numpy as np

from fourd.demo.canvas import Canvas, draw, linear_color, mix


def _weave(canvas: Canvas, picture: np.ndarray, strength: float = 0.1) -> np.ndarray:
    """Threads and soft folds over a pattern."""
    folds = canvas.noise((0.12, 0.35), 4)
    thread = canvas.noise((0.02, 0.006), 2, 0.8) + canvas.noise((0.006, 0.02), 2, 0.8)
    return picture * (1 + strength * thread + 1.8 * strength * folds)[:, :, None]


def paint_plaid(texels_per_m: float, seed: int) -> np.ndarray:
    """Checked flannel, 0.48 x 0.48 m."""
    canvas = Canvas(0.48, 0.48, texels_per_m, (seed, 21))
    picture = canvas.paint((196, 44, 40))
    for axis in (canvas.u, canvas.v):
        phase = axis / 0.12 % 1
        picture = mix(picture, (26, 30, 62), 0.62 * (np.abs(phase - 0.5) < 0.2))
        picture = mix(picture, (240, 208, 120), 0.8 * (np.abs(phase - 0.06) < 0.03))
        picture = mix(picture, (244, 236, 220), 0.6 * (np.abs(phase - 0.5) < 0.025))
    return _weave(canvas, picture)


def paint_denim(texels_per_m: float, seed: int) -> np.ndarray:
    """Washed jeans with seams, 0.5 x 0.9 m."""
    canvas = Canvas(0.5, 0.9, texels_per_m, (seed, 22))
    faded = np.clip(0.4 + 0.45 * canvas.noise((0.14, 0.3), 4), 0, 1)
    picture = mix(canvas.paint((40, 62, 112)), (124, 152, 196), faded)
    twill = np.sin((canvas.u + canvas.v) * 2 * np.pi / 0.014)
    picture = picture * (1 + 0.08 * twill)[:, :, None]
    seams = [("line", u, 0.0, u, 0.9, 0.007, (206, 160, 90)) for u in (0.06, 0.25, 0.44)]
    return _weave(canvas, draw(canvas, picture.astype(np.float32), seams))


def paint_dress(texels_per_m: float, seed: int) -> np.ndarray:
    """Flowers on yellow cotton, 0.6 x 0.6 m."""
    canvas = Canvas(0.6, 0.6, texels_per_m, (seed, 23))
    picture = canvas.paint((246, 196, 52))
    petals = ((232, 84, 96), (250, 246, 236), (60, 120, 190), (236, 120, 40))
    shapes: list[tuple] = []
    for index in range(58):
        u, v = canvas.rng.uniform(0.03, 0.57, 2)
        size, turn = canvas.rng.uniform(0.012, 0.024), canvas.rng.uniform(0, 6.28)
        color = petals[index % len(petals)]
        for k in range(5):
            a = turn + 2 * np.pi * k / 5
            shapes.append(
                ("disc", u + size * np.cos(a), v + size * np.sin(a), 0.62 * size, 0.62 * size, color)
            )
        shapes.append(("disc", u, v, 0.55 * size, 0.55 * size, (96, 62, 30)))
    return _weave(canvas, draw(canvas, picture, shapes), 0.07)


def paint_stripes(
    texels_per_m: float, seed: int, colors: Sequence[Sequence[float]], band_m: float
) -> np.ndarray:
    """Level bands of changing colours, 0.5 x (band x colours x 4) m."""
    canvas = Canvas(0.5, band_m * len(colors) * 4, texels_per_m, (seed, 24, len(colors)))
    index = (canvas.v / band_m).astype(int) % len(colors)
    palette = np.stack([linear_color(c) for c in colors])
    return _weave(canvas, palette[index], 0.08)


def paint_canvas_cloth(texels_per_m: float, seed: int, color: Sequence[float]) -> np.ndarray:
    """Rucksack cloth with straps and a patch, 0.4 x 0.5 m."""
    canvas = Canvas(0.4, 0.5, texels_per_m, (seed, 25))
    picture = canvas.paint(color) * (1 + 0.15 * canvas.noise(0.1, 4))[:, :, None]
    shapes = [
        ("line", 0.02, 0.32, 0.38, 0.32, 0.02, (60, 40, 30)),
        ("line", 0.1, 0.0, 0.1, 0.5, 0.025, (60, 40, 30)),
        ("line", 0.3, 0.0, 0.3, 0.5, 0.025, (60, 40, 30)),
        ("disc", 0.2, 0.16, 0.06, 0.06, (240, 236, 220)),
        ("disc", 0.2, 0.16, 0.035, 0.035, (40, 90, 150)),
    ]
    return _weave(canvas, draw(canvas, picture, shapes))


def paint_head(
    texels_per_m: float,
    seed: int,
    skin: Sequence[float],
    hair: Sequence[float],
    fringe_v: float,
    variant: int,
) -> np.ndarray:
    """A head unrolled, 0.62 x 0.36 m; the face looks out from the middle.

    fringe_v: height where the hair begins in front, metres
    """
    canvas = Canvas(0.62, 0.36, texels_per_m, (seed, 26, variant))
    u, v = canvas.u - 0.31, canvas.v
    picture = canvas.paint(skin) * (1 + 0.07 * canvas.noise(0.1, 4))[:, :, None]
    cheeks = np.exp(-((np.abs(u) - 0.055) ** 2 + (v - 0.145) ** 2) / 0.0008)
    picture = mix(picture, (214, 104, 92), 0.35 * cheeks)
    dark = tuple(0.6 * c for c in hair)
    shapes: list[tuple] = []
    for side in (-1, 1):
        at = 0.31 + side * 0.042
        shapes += [
            ("disc", at, 0.19, 0.02, 0.012, (246, 244, 240)),
            ("disc", at, 0.19, 0.0095, 0.0105, (52, 70, 60)),
            ("line", at - 0.023, 0.217, at + 0.023, 0.219, 0.01, dark),
        ]
    shapes += [
        ("line", 0.31, 0.185, 0.316, 0.145, 0.008, tuple(0.72 * c for c in skin)),
        ("line", 0.298, 0.14, 0.322, 0.14, 0.008, tuple(0.66 * c for c in skin)),
        ("disc", 0.31, 0.11, 0.028, 0.009, (168, 56, 56)),
    ]
    picture = draw(canvas, picture, shapes)
    strands = (0.75 + 0.5 * canvas.noise((0.012, 0.2), 3))[:, :, None]
    edge = fringe_v - 0.9 * np.clip(np.abs(u) - 0.085, 0, 0.2) + 0.008 * canvas.noise(0.02, 2)
    return mix(picture, canvas.paint(hair) * strands, (v > edge).astype(np.float32))


def paint_hair(texels_per_m: float, seed: int, color: Sequence[float]) -> np.ndarray:
    """Strands, 0.4 x 0.4 m."""
    canvas = Canvas(0.4, 0.4, texels_per_m, (seed, 27, int(color[0])))
    return canvas.paint(color) * (0.8 + 0.45 * canvas.noise((0.016, 0.3), 3))[:, :, None]


def paint_straw(texels_per_m: float, seed: int) -> np.ndarray:
    """Plaited straw, 0.3 x 0.3 m."""
    canvas = Canvas(0.3, 0.3, texels_per_m, (seed, 28))
    plait = np.sin(canvas.u * 2 * np.pi / 0.02) * np.sin(canvas.v * 2 * np.pi / 0.015)
    return canvas.paint((226, 190, 120)) * (0.85 + 0.2 * plait + 0.1 * canvas.noise(0.05, 3))[:, :, None]


def paint_ball(texels_per_m: float, seed: int) -> np.ndarray:
    """Beach ball panels with stars, 0.72 x 0.36 m."""
    canvas = Canvas(0.72, 0.36, texels_per_m, (seed, 29))
    palette = np.stack(
        [linear_color(c) for c in ((226, 44, 52), (246, 244, 238), (34, 92, 190), (250, 206, 50))]
    )
    picture = palette[(canvas.u / 0.06).astype(int) % 4]
    stars: list[tuple] = [("disc", 0.03 + 0.06 * k, 0.18, 0.016, 0.026, (24, 26, 40)) for k in range(12)]
    stars += [
        ("rectangle", 0.0, 0.33, 0.72, 0.36, (30, 150, 110)),
        ("rectangle", 0.0, 0.0, 0.72, 0.03, (30, 150, 110)),
    ]
    return draw(canvas, picture, stars)
