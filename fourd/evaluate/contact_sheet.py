"""Pictures of every method side by side, labelled, to look at before any number is believed."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from fourd.baselines import LABELS
from fourd.image import fit_inside, label_image, tile_images

COLUMNS = ("truth", "inst", "background", "paste", "ours", "error", "nn_same_time")
HEADER_PX = 24
CAPTION_PX = 18
GAP_PX = 2


@dataclasses.dataclass(frozen=True, eq=False)
class SheetRow:
    """One frame: images (H, W, 3) uint8 by column, one line of text under each."""

    images: dict[str, np.ndarray]
    captions: dict[str, str]


def amplified_error(image: np.ndarray, truth: np.ndarray, gain: float) -> np.ndarray:
    """(H, W, 3) uint8 absolute difference times `gain`, clipped."""
    difference = np.abs(image.astype(np.float32) - truth.astype(np.float32))
    return np.minimum(difference * gain + 0.5, 255).astype(np.uint8)


def draw_sheet(rows: Sequence[SheetRow], tile_px: int, error_gain: float) -> np.ndarray:
    """Sheet of all rows, uint8, with one header line; as wide as seven tiles and six gaps.

    Tiles keep the pictures' aspect. Raises ValueError without rows.
    """
    titles = {**LABELS, "truth": "truth", "error": f"|ours - truth| x {error_gain:g}"}
    grid = [[label_image(titles[column], (tile_px, HEADER_PX)) for column in COLUMNS]]
    for row in rows:
        height, width = row.images["truth"].shape[:2]
        size = (tile_px, max(1, round(tile_px * height / width)))
        grid.append([fit_inside(row.images[column], size) for column in COLUMNS])
        grid.append([label_image(row.captions.get(column, ""), (tile_px, CAPTION_PX)) for column in COLUMNS])
    return tile_images(grid, GAP_PX)


def stack_sheets(sheets: Sequence[np.ndarray]) -> np.ndarray:
    """Sheets under each other, narrower ones filled with white at the right."""
    width = max(sheet.shape[1] for sheet in sheets)
    filled = [np.pad(s, ((0, 0), (0, width - s.shape[1]), (0, 0)), constant_values=255) for s in sheets]
    return tile_images([[sheet] for sheet in filled], 3 * GAP_PX)
