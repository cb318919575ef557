"""The named surfaces of the demo: which picture, tint, gloss and mirror share each has."""

import functools

import numpy as np

from fourd.demo import facades, people_textures, place_textures
from fourd.demo.canvas import Canvas, pack_textures
from fourd.demo.shading import SKY_BOTTOM_RAD, SKY_TOP_RAD, Textures

# Texels per metre at 480 px of width: about what the cameras resolve at each thing's distance.
SKY_TEXELS_PER_RAD = 420
GROUND, NEAR, FRONT, FAR, PEOPLE = 125, 110, 80, 36, 190
REFERENCE_WIDTH = 480

# name: (texture or None, tint r g b, specular, exponent, reflectance)
MATERIALS: dict[str, tuple] = {
    "paving": ("paving", 1, 1, 1, 0.0, 1, 0),
    "cobbles": ("cobbles", 1, 1, 1, 0.0, 1, 0),
    "meadow": ("leaves", 1.0, 0.85, 0.8, 0.0, 1, 0),
    "facade": ("facade", 1, 1, 1, 0.0, 1, 0),
    "side_wall": ("side_wall", 1, 1, 1, 0.0, 1, 0),
    "brick": ("brick", 1, 1, 1, 0.0, 1, 0),
    "rubble": ("rubble", 1, 1, 1, 0.0, 1, 0),
    "house0": ("house0", 1, 1, 1, 0.0, 1, 0),
    "house1": ("house1", 1, 1, 1, 0.0, 1, 0),
    "house2": ("house2", 1, 1, 1, 0.0, 1, 0),
    "plaster": ("plaster", 1, 1, 1, 0.0, 1, 0),
    "roof": ("roof", 1, 1, 1, 0.0, 1, 0),
    "wood": ("wood", 1, 1, 1, 0.06, 20, 0),
    "dark_wood": ("wood", 0.5, 0.42, 0.38, 0.05, 20, 0),
    "green_wood": ("wood", 0.28, 0.62, 0.5, 0.08, 30, 0),
    "crate": ("crate", 1, 1, 1, 0.0, 1, 0),
    "menu": ("menu", 1, 1, 1, 0.03, 30, 0),
    "awning": ("awning", 1, 1, 1, 0.0, 1, 0),
    "leaves": ("leaves", 1, 1, 1, 0.02, 8, 0),
    "blossom": ("blossom", 1, 1, 1, 0.0, 1, 0),
    "terracotta": ("rubble", 1.15, 0.52, 0.34, 0.0, 1, 0),
    "stone": ("stone", 1, 1, 1, 0.0, 1, 0),
    "iron": (None, 0.035, 0.04, 0.042, 0.25, 40, 0),
    "parasol": (None, 0.80, 0.80, 0.77, 0.0, 1, 0),
    "steel": (None, 0.20, 0.21, 0.22, 1.6, 260, 0.62),
    "lamp": (None, 0.75, 0.74, 0.66, 0.4, 60, 0.08),
    "glazed": ("glazed", 1, 1, 1, 0.5, 90, 0.05),
    "plaid": ("plaid", 1, 1, 1, 0.0, 1, 0),
    "denim": ("denim", 1, 1, 1, 0.0, 1, 0),
    "leather": ("wood", 0.42, 0.28, 0.2, 0.12, 20, 0),
    "rucksack": ("rucksack", 1, 1, 1, 0.0, 1, 0),
    "belt": ("wood", 0.25, 0.18, 0.14, 0.1, 30, 0),
    "dress": ("dress", 1, 1, 1, 0.0, 1, 0),
    "leggings": ("leggings", 1, 1, 1, 0.0, 1, 0),
    "sneaker": ("awning", 0.9, 0.95, 1.0, 0.05, 20, 0),
    "straw": ("straw", 1, 1, 1, 0.0, 1, 0),
    "ribbon": ("leggings", 0.9, 0.3, 0.35, 0.0, 1, 0),
    "skin1": ("skin", 1.0, 0.80, 0.68, 0.05, 12, 0),
    "skin2": ("skin", 0.72, 0.50, 0.38, 0.06, 12, 0),
    "head1": ("head1", 1, 1, 1, 0.05, 12, 0),
    "head2": ("head2", 1, 1, 1, 0.05, 12, 0),
    "hair1": ("hair1", 1, 1, 1, 0.06, 14, 0),
    "hair2": ("hair2", 1, 1, 1, 0.08, 14, 0),
    "ball": ("ball", 1, 1, 1, 0.35, 50, 0.03),
}


def material_index() -> dict[str, int]:
    """Number of every material."""
    return {name: index for index, name in enumerate(MATERIALS)}


def _place_pictures(
    q: float, seed: int, footprints: tuple
) -> dict[str, tuple[np.ndarray, tuple[float, float]]]:
    paint = place_textures

    def painted(width: float, height: float, density: float, key: int) -> Canvas:
        return Canvas(width, height, density * q, (seed, 40, key))

    glazed = painted(0.6, 0.6, NEAR, 6)
    waves = np.clip(3 * np.sin(glazed.v * 60 + 2 * glazed.noise(0.2, 2)), 0, 1)
    pot = people_textures.mix(glazed.paint((34, 92, 170)), (236, 232, 220), waves)
    return {
        "sky": (paint.paint_sky(SKY_TEXELS_PER_RAD * q, seed), (2 * np.pi, SKY_TOP_RAD - SKY_BOTTOM_RAD)),
        "paving": (paint.paint_paving(GROUND * q, seed, footprints), (12.0, 12.0)),
        "cobbles": (paint.paint_cobbles(50 * q, seed), (16.0, 16.0)),
        "facade": (facades.paint_main_facade(FRONT * q, seed), (7.2, 5.4)),
        "side_wall": (facades.paint_side_wall(FRONT * q, seed), (9.0, 3.6)),
        "brick": (paint.paint_brick(painted(5.0, 4.0, FRONT, 1)), (5.0, 4.0)),
        "rubble": (paint.paint_rubble(painted(5.0, 2.5, FRONT, 2)), (5.0, 2.5)),
        "plaster": (paint.paint_plaster(painted(6.0, 4.0, FAR, 3), (214, 186, 146)), (6.0, 4.0)),
        "roof": (paint.paint_tiles(painted(6.0, 6.0, FAR, 4)), (6.0, 6.0)),
        "wood": (paint.paint_wood(painted(1.6, 1.1, NEAR, 5), (176, 124, 76)), (1.6, 1.1)),
        "stone": (people_textures.mix(glazed.paint((178, 168, 150)), (120, 112, 100),
                                      0.5 + 0.5 * glazed.noise(0.15, 5, 0.7)), (0.6, 0.6)),
        "glazed": (pot, (0.6, 0.6)),
        "leaves": (paint.paint_leaves(FRONT * q, seed, (98, 148, 52)), (2.0, 2.0)),
        "blossom": (paint.paint_leaves(FRONT * q, seed, (226, 92, 130)), (2.0, 2.0)),
        **{f"house{k}": (facades.paint_far_house(FAR * q, seed, k), (6.0, 3.4)) for k in range(3)},
        "crate": (facades.paint_crate(NEAR * q, seed), (0.9, 0.9)),
        "menu": (facades.paint_menu_board(NEAR * q, seed), (0.7, 1.0)),
    }  # fmt: skip


def _people_pictures(q: float, seed: int) -> dict[str, tuple[np.ndarray, tuple[float, float]]]:
    wear, density = people_textures, PEOPLE * q
    skin = Canvas(0.4, 0.4, density, (seed, 41))
    face1, face2 = (232, 184, 152), (196, 140, 108)
    hair1, hair2 = (70, 46, 30), (150, 62, 34)
    legging_colors = ((40, 120, 130), (246, 240, 226), (226, 92, 70), (34, 42, 78))
    return {
        "awning": (wear.paint_stripes(density, seed, ((186, 48, 44), (244, 238, 224)), 0.11), (0.5, 0.88)),
        "plaid": (wear.paint_plaid(density, seed), (0.48, 0.48)),
        "denim": (wear.paint_denim(density, seed), (0.5, 0.9)),
        "rucksack": (wear.paint_canvas_cloth(density, seed, (226, 126, 40)), (0.4, 0.5)),
        "dress": (wear.paint_dress(density, seed), (0.6, 0.6)),
        "leggings": (wear.paint_stripes(density, seed, legging_colors, 0.035), (0.5, 0.56)),
        "straw": (wear.paint_straw(density, seed), (0.3, 0.3)),
        "skin": (skin.paint((236, 206, 186)) * (1 + 0.08 * skin.noise(0.08, 4))[:, :, None], (0.4, 0.4)),
        "head1": (wear.paint_head(density, seed, face1, hair1, 0.262, 1), (0.62, 0.36)),
        "head2": (wear.paint_head(density, seed, face2, hair2, 0.25, 2), (0.62, 0.36)),
        "hair1": (wear.paint_hair(density, seed, hair1), (0.4, 0.4)),
        "hair2": (wear.paint_hair(density, seed, hair2), (0.4, 0.4)),
        "ball": (wear.paint_ball(density, seed), (0.72, 0.36)),
    }


@functools.lru_cache(maxsize=2)
def make_materials(width: int, seed: int, footprints: tuple) -> tuple[Textures, np.ndarray]:
    """All textures at the resolution that pictures of `width` px need, and the (M, 7) material table.

    footprints: (u, v, radius) metres on the paving, see `paint_paving`
    """
    # Beyond twice the reference, painting would take longer than rendering.
    q = min(2.0, max(0.15, width / REFERENCE_WIDTH))
    pictures = {**_place_pictures(q, seed, footprints), **_people_pictures(q, seed)}
    textures = pack_textures([p for p, _ in pictures.values()], [e for _, e in pictures.values()])
    number = {name: index for index, name in enumerate(pictures)}
    rows = [(-1 if m[0] is None else number[m[0]], *m[1:]) for m in MATERIALS.values()]
    return textures, np.array(rows, dtype=np.float64)
