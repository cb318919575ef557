"""Pictures of house fronts, doors, windows and posters, composed from the materials of the place."""

from collections.abc import Sequence

import numpy as np

from fourd.demo.canvas import Canvas, draw, mix
from fourd.demo.place_textures import paint_brick, paint_plaster, paint_rubble, paint_wood

FRAME_WHITE, GLASS = (224, 220, 208), (46, 58, 70)


def draw_window(
    canvas: Canvas,
    picture: np.ndarray,
    u: float,
    v: float,
    width: float,
    height: float,
    panes: tuple[int, int],
) -> np.ndarray:
    """A window with stone lintel, frame, panes that mirror a cloudy sky, and a curtain."""
    right, top = u + width, v + height
    picture = draw(
        canvas,
        picture,
        [
            ("rectangle", u - 0.12, top, right + 0.12, top + 0.2, (196, 186, 164)),
            ("rectangle", u - 0.06, v - 0.06, right + 0.06, top + 0.01, (150, 142, 126)),
            ("rectangle", u, v, right, top, FRAME_WHITE),
        ],
    )
    mirrored = mix(canvas.paint(GLASS), (150, 176, 200), 0.35 + 0.5 * canvas.noise((0.6, 0.25), 4))
    folds = 0.5 + 0.3 * np.sin(canvas.u * 60 + 2 * canvas.noise(0.3, 2))
    curtain = canvas.paint((206, 190, 160)) * folds[:, :, None].astype(np.float32)
    side = np.clip((np.abs(canvas.u - u - width / 2) / width - 0.27) * 30, 0, 1)
    inside = mix(mirrored, curtain, side * 0.75)
    bar, mask = 0.035, np.zeros(canvas.shape, np.float32)
    for column in range(panes[0]):
        for row in range(panes[1]):
            u0 = u + bar + (width - bar) * column / panes[0]
            v0 = v + bar + (height - bar) * row / panes[1]
            u1, v1 = u0 + (width - bar) / panes[0] - bar, v0 + (height - bar) / panes[1] - bar
            pane = (canvas.u > u0) & (canvas.u < u1) & (canvas.v > v0) & (canvas.v < v1)
            mask[pane] = 1
    return mix(picture, inside, mask)


def draw_door(
    canvas: Canvas, picture: np.ndarray, u: float, width: float, color: Sequence[float]
) -> np.ndarray:
    """A panelled wooden door from the ground up, with a stone surround, letter box and number."""
    height = 2.1
    surround = [("rectangle", u - 0.16, 0.0, u + width + 0.16, height + 0.2, (188, 178, 156))]
    picture = draw(canvas, picture, surround)
    wood = (
        canvas.paint(color)
        * (1 + 0.25 * canvas.noise((0.02, 0.8), 3) + 0.1 * canvas.noise(0.2, 3))[:, :, None]
    )
    inside = (canvas.u > u) & (canvas.u < u + width) & (canvas.v < height)
    picture = mix(picture, wood, inside.astype(np.float32))
    dark, light = tuple(0.55 * c for c in color), tuple(min(255, 1.35 * c) for c in color)
    for column in range(2):
        for v0, v1 in ((0.18, 0.85), (1.0, 1.62)):
            a = u + 0.09 + column * (width / 2 - 0.03)
            b = a + width / 2 - 0.15
            picture = draw(
                canvas,
                picture,
                [
                    ("line", a, v0, b, v0, 0.03, light), ("line", b, v0, b, v1, 0.03, light),
                    ("line", a, v0, a, v1, 0.03, dark), ("line", a, v1, b, v1, 0.03, dark),
                ],
            )  # fmt: skip
    return draw(
        canvas,
        picture,
        [
            ("rectangle", u + 0.08, 1.74, u + width - 0.08, 2.0, GLASS),
            ("text", u + width / 2 - 0.1, 1.79, 0.14, "17", (230, 200, 110)),
            ("disc", u + width - 0.09, 0.98, 0.035, 0.035, (226, 196, 96)),
            ("rectangle", u + 0.3, 0.9, u + width - 0.3, 0.96, (200, 170, 90)),
        ],
    )


def draw_poster(canvas: Canvas, picture: np.ndarray, u: float, v: float, style: int) -> np.ndarray:
    """One of four printed posters, about 0.6 x 0.85 m."""
    w, h = 0.6, 0.85
    papers = ((240, 222, 170), (28, 60, 104), (214, 60, 50), (240, 240, 234))
    inks = ((180, 40, 36), (246, 206, 80), (250, 244, 226), (30, 110, 90))
    paper, ink = papers[style], inks[style]
    title = ("CIRCUS", "JAZZ 21", "FAIR!", "LOST CAT")[style]
    shapes: list[tuple] = [("rectangle", u, v, u + w, v + h, paper)]
    shapes.append(("text", u + 0.05, v + h - 0.17, 0.1, title, ink))
    center = (u + w / 2, v + 0.4)
    if style == 0:
        for k in range(12):
            a, b = 2 * np.pi * k / 12, 2 * np.pi * (k + 0.5) / 12
            corners = tuple((center[0] + 0.23 * np.cos(x), center[1] + 0.23 * np.sin(x)) for x in (a, b))
            shapes.append(("polygon", (center, *corners), ink))
        shapes.append(("disc", *center, 0.1, 0.1, (40, 70, 130)))
    elif style == 1:
        shapes += [("disc", u + 0.2 + 0.1 * k, v + 0.26 + 0.1 * (k % 2), 0.05, 0.035, ink) for k in range(3)]
        shapes += [
            ("line", u + 0.24 + 0.1 * k, v + 0.28, u + 0.24 + 0.1 * k, v + 0.52, 0.015, ink) for k in range(3)
        ]
    elif style == 2:
        shapes += [
            ("rectangle", u + 0.08 + 0.16 * k, v + 0.18, u + 0.18 + 0.16 * k, v + 0.5, ink) for k in range(3)
        ]
        shapes.append(("disc", u + 0.3, v + 0.5, 0.2, 0.08, (250, 200, 60)))
    else:
        shapes += [
            ("disc", *center, 0.15, 0.12, (70, 60, 56)),
            ("disc", center[0], center[1] + 0.12, 0.09, 0.08, (70, 60, 56)),
            ("disc", center[0] - 0.03, center[1] + 0.13, 0.014, 0.02, (240, 220, 90)),
            ("disc", center[0] + 0.04, center[1] + 0.13, 0.014, 0.02, (240, 220, 90)),
        ]
    for k in range(4):
        shapes.append(
            (
                "line",
                u + 0.06,
                v + 0.17 - 0.035 * k,
                u + 0.5 - 0.07 * (k % 3),
                v + 0.17 - 0.035 * k,
                0.012,
                ink,
            )
        )
    printed = draw(canvas, picture, shapes)
    faded = (0.88 + 0.14 * canvas.noise(0.3, 4))[:, :, None]
    inside = (canvas.u > u) & (canvas.u < u + w) & (canvas.v > v) & (canvas.v < v + h)
    return np.where(inside[:, :, None], printed * faded, printed).astype(np.float32)


def paint_main_facade(texels_per_m: float, seed: int) -> np.ndarray:
    """Brick house with a shop, 7.2 x 5.4 m: the backdrop of the action."""
    canvas = Canvas(7.2, 5.4, texels_per_m, (seed, 11))
    picture = paint_brick(canvas)
    picture = mix(picture, paint_rubble(canvas), np.clip((0.5 - canvas.v) * 60, 0, 1))
    picture = draw(canvas, picture, [("rectangle", 0.0, 2.72, 7.2, 2.84, (190, 180, 158))])
    for u in (0.45, 2.25, 4.05, 5.7):
        picture = draw_window(canvas, picture, u, 3.15, 0.85, 1.35, (2, 3))
    picture = draw_window(canvas, picture, 0.55, 0.85, 1.5, 1.2, (3, 2))
    picture = draw_window(canvas, picture, 4.55, 0.7, 1.9, 1.4, (4, 1))
    picture = draw_door(canvas, picture, 2.95, 0.95, (36, 92, 84))
    sign = [
        ("rectangle", 4.2, 2.28, 6.8, 2.66, (44, 66, 52)),
        ("text", 4.38, 2.36, 0.2, "BOULANGERIE", (238, 214, 150)),
    ]
    picture = draw(canvas, picture, sign)
    picture = draw_poster(canvas, picture, 2.2, 1.0, 1)
    return draw_poster(canvas, picture, 6.55, 1.05, 3)


def paint_side_wall(texels_per_m: float, seed: int) -> np.ndarray:
    """Plastered house along the left, 9 x 3.6 m, with posters and shutters."""
    canvas = Canvas(9.0, 3.6, texels_per_m, (seed, 12))
    picture = paint_plaster(canvas, (206, 164, 104))
    picture = mix(
        picture, paint_rubble(canvas), np.clip((0.35 - canvas.v + 0.1 * canvas.noise(0.6, 3)) * 30, 0, 1)
    )
    for u in (1.0, 4.6, 7.3):
        picture = draw_window(canvas, picture, u, 1.3, 0.9, 1.25, (2, 2))
        for left in (u - 0.56, u + 0.96):
            slats = [("rectangle", left, 1.25, left + 0.5, 2.6, (62, 96, 120))]
            slats += [
                ("line", left + 0.04, 1.3 + 0.065 * k, left + 0.46, 1.3 + 0.065 * k, 0.02, (40, 62, 80))
                for k in range(20)
            ]
            picture = draw(canvas, picture, slats)
    for u, v, style in ((2.75, 1.35, 0), (3.42, 1.2, 2), (6.25, 1.1, 3)):
        picture = draw_poster(canvas, picture, u, v, style)
    return picture


def paint_far_house(texels_per_m: float, seed: int, variant: int) -> np.ndarray:
    """Front of a distant house, 6 x 3.4 m."""
    canvas = Canvas(6.0, 3.4, texels_per_m, (seed, 13, variant))
    color = ((222, 200, 160), (196, 128, 104), (176, 186, 190))[variant]
    picture = paint_plaster(canvas, color)
    for u in (0.5, 2.0, 4.7):
        picture = draw_window(canvas, picture, u, 1.7 + 0.1 * variant, 0.75, 1.05, (2, 2))
    picture = draw_window(canvas, picture, 0.7 + 0.4 * variant, 0.5, 1.1, 0.8, (3, 1))
    return draw_door(canvas, picture, 3.5, 0.85, ((110, 60, 40), (50, 70, 110), (120, 40, 44))[variant])


def paint_crate(texels_per_m: float, seed: int) -> np.ndarray:
    """Planks with a stencilled word, 0.9 x 0.9 m."""
    canvas = Canvas(0.9, 0.9, texels_per_m, (seed, 14))
    picture = paint_wood(canvas, (178, 132, 82), 0.12)
    shapes = [
        ("line", 0.04, 0.04, 0.86, 0.86, 0.09, (150, 108, 66)),
        ("text", 0.2, 0.62, 0.11, "FRAGILE", (70, 30, 26)),
        ("line", 0.05, 0.0, 0.05, 0.9, 0.09, (130, 92, 58)),
        ("line", 0.85, 0.0, 0.85, 0.9, 0.09, (130, 92, 58)),
    ]
    return draw(canvas, picture, shapes) * (1 + 0.18 * canvas.noise(0.25, 4))[:, :, None]


def paint_menu_board(texels_per_m: float, seed: int) -> np.ndarray:
    """Chalk board of the cafe, 0.7 x 1 m."""
    canvas = Canvas(0.7, 1.0, texels_per_m, (seed, 15))
    picture = canvas.paint((40, 46, 44)) * (1 + 0.3 * canvas.noise(0.2, 4))[:, :, None]
    lines = [("text", 0.14, 0.8, 0.1, "MENU", (240, 220, 140))]
    words = ("soup", "quiche", "tarte", "cafe", "cidre")
    colors = ((236, 236, 230), (150, 200, 230), (236, 236, 230), (236, 160, 150), (190, 226, 160))
    for k, (word, color) in enumerate(zip(words, colors, strict=True)):
        lines.append(("text", 0.1, 0.65 - 0.13 * k, 0.06, word, color))
        lines.append(("text", 0.48, 0.65 - 0.13 * k, 0.06, str(3 + 2 * k), color))
    picture = draw(canvas, picture, lines, alpha=0.9)
    edge = np.minimum(np.minimum(canvas.u, 0.7 - canvas.u), np.minimum(canvas.v, 1.0 - canvas.v))
    return mix(picture, (150, 98, 56), (edge < 0.04).astype(np.float32))
