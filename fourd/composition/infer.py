"""One frame through the trained levels, coarse to fine, and the plain paste it is measured against.

Section 4.1: the output of a level fills the holes of the next level's inputs. It is done only for
frames with large holes, and only from as coarse a level as they need.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from fourd.composition import STAGE_VERSION, CascadeOptions
from fourd.composition.checkpoint import read_torch
from fourd.composition.data import (
    ESTIMATES,
    reduce_image,
    reduction_factor,
    streams_from_images,
)
from fourd.composition.model import TEST_STREAMS, CompositionNet, resolve_precision
from fourd.composition.model import paste as paste_streams
from fourd.errors import InputError, explain_faults
from fourd.image import uint8_from_float

CONSENSUS, STATIC = 0, 3
MODEL_KEYS = ("level", "num_levels", "network", "state_dict")

Arrays = Mapping[str, np.ndarray]


def load_models(paths: Sequence[Path], device: str = "cpu") -> list[CompositionNet]:
    """The networks of a cascade, coarsest first, ready for `compose_frame`.

    paths: `composition/{level}/model.pt` of every level, in any order
    Raises InputError if a file is missing, is no model, or the levels are not 0 to the last.
    """
    where = ", ".join(map(str, paths))
    documents = [read_torch(path, MODEL_KEYS) for path in paths]
    with explain_faults(f"models of this workflow in {where}"):
        documents.sort(key=lambda document: document["level"])
        levels = [document["level"] for document in documents]
        num_levels = sorted({document["num_levels"] for document in documents})
        if levels != [document["network"]["level"] for document in documents]:
            raise ValueError("a network of another level than its file")
    if num_levels != [len(levels)] or levels != list(range(len(levels))):
        raise InputError(
            f"expected one model per level, 0 to the last, got levels {levels} of cascades of "
            f"{num_levels} levels in {where}: give the models of one training"
        )
    with explain_faults(f"models of this workflow in {where}"):
        return [_network(document, device) for document in documents]


def _network(document: Mapping[str, Any], device: str) -> CompositionNet:
    network = CompositionNet(**document["network"])
    try:
        network.load_state_dict(document["state_dict"])
    except RuntimeError:
        raise InputError(
            f"expected a model of stage version {STAGE_VERSION} for level {document['level']}, got that of "
            f"another network (version {document.get('stage_version', 'unknown')}): train it again"
        ) from None
    if not all(tensor.isfinite().all() for tensor in network.state_dict().values()):
        raise InputError(
            f"expected finite weights for level {document['level']}, got NaN or infinity: train it again"
        )
    return network.to(device, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]


def run_network(network: CompositionNet, images: np.ndarray, precision: str = "auto") -> np.ndarray:
    """(H, W, 3) uint8 composed from test-time inputs.

    images: (N, H, W, 4) uint8 RGBA in the order of `ESTIMATES`; those of `network.test_streams` are read
    precision: of `resolve_precision`
    """
    device = next(network.parameters()).device
    streams = streams_from_images(images, network.test_streams).to(device)
    with torch.inference_mode():
        output = network(streams, resolve_precision(precision, device.type))
    return _image(output)


def paste_images(images: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8: consensus where valid, else static background, else the mean colour of these.

    images: as for `run_network`
    """
    image, filled = paste_streams(streams_from_images(images, TEST_STREAMS["paper"]))
    mean = image.sum(dim=(2, 3), keepdim=True) / filled.sum(dim=(2, 3), keepdim=True).clamp(min=1)
    return _image(torch.where(filled > 0, image, mean))


def paste(foreground: Arrays, background: Arrays) -> np.ndarray:
    """The baseline without a network, (H, W, 3) uint8; arguments as for `compose_frame`."""
    return paste_images(_stack(foreground, background, TEST_STREAMS["paper"], 1))


def estimates_read(models: Sequence[CompositionNet], kind: str) -> list[str]:
    """Names of the arrays that `compose_frame` reads of a `foreground` or `background`."""
    indices = {index for model in models for index in (*model.test_streams, CONSENSUS, STATIC)}
    names = [ESTIMATES[index][1] for index in sorted(indices) if ESTIMATES[index][0] == kind]
    return [f"{name}_{part}" for name in names for part in ("rgb", "valid")]


def compose_frame(
    models: Sequence[CompositionNet],
    frame: int,
    foreground: Arrays,
    background: Arrays,
    options: CascadeOptions | None = None,
) -> tuple[np.ndarray, list[dict[str, Any]]]:
    """One frame of a view.

    models:     of `load_models`, coarsest first
    frame:      output frame, for the report only
    foreground: arrays of one frame of a foreground archive, see `estimates_read`
    background: arrays of one (resolved) frame of a background archive
    Returns (H, W, 3) uint8 and a row per level that ran: `frame`, `level`, `hole_share` and
    `largest_hole_share` of its inputs, `filled_share` (0 or hole_share), `reason`.
    """
    options = options or CascadeOptions()
    num_levels = len(models)
    level = num_levels - 1
    inputs = {level: _stack(foreground, background, models[level].test_streams, 1)}
    while level > 0 and holes_are_large(find_holes(inputs[level]), options):
        level -= 1
        factor = reduction_factor(level, num_levels)
        inputs[level] = _stack(foreground, background, models[level].test_streams, factor)
    rows: list[dict[str, Any]] = []
    image: np.ndarray | None = None
    for level in sorted(inputs):
        holes = find_holes(inputs[level])
        rows.append(_describe(frame, level, holes, image is not None, options))
        if image is not None:
            fill_holes(inputs[level], holes, image)
        image = run_network(models[level], inputs[level])
    assert image is not None
    return image, rows


def find_holes(images: np.ndarray) -> np.ndarray:
    """(H, W) bool: no estimate is valid."""
    return (images[..., 3] == 0).all(axis=0)


def hole_shares(holes: np.ndarray) -> tuple[float, float]:
    """Share of the frame that is holes, and share of the largest hole (8-connected)."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(holes.astype(np.uint8), connectivity=8)
    areas = stats[1:, cv2.CC_STAT_AREA]
    return float(holes.mean()), float(areas.max() / holes.size) if areas.size else 0.0


def holes_are_large(holes: np.ndarray, options: CascadeOptions) -> bool:
    """Whether a frame's holes are to be filled from a coarser level."""
    share, largest = hole_shares(holes)
    return share > options.min_hole_share or largest > options.min_largest_hole_share


def fill_holes(images: np.ndarray, holes: np.ndarray, coarser: np.ndarray) -> None:
    """Put a coarser level's output into the holes of the static background, in place, as valid.

    images: (N, H, W, 4) uint8;  holes: (H, W) bool;  coarser: (ceil(H / 2), ceil(W / 2), 3) uint8
    """
    height, width = coarser.shape[:2]
    finer = cv2.resize(coarser, (2 * width, 2 * height), interpolation=cv2.INTER_LINEAR)
    background = images[STATIC]
    background[holes, :3] = finer[: holes.shape[0], : holes.shape[1]][holes]
    background[holes, 3] = 255


def _describe(
    frame: int, level: int, holes: np.ndarray, is_filled: bool, options: CascadeOptions
) -> dict[str, Any]:
    share, largest = hole_shares(holes)
    if is_filled:
        reason = "large holes, filled from the coarser level"
    elif not holes_are_large(holes, options):
        reason = "holes are small, no coarser level needed"
    else:
        reason = "large holes, but this is the coarsest level"
    return {
        "frame": frame,
        "level": level,
        "hole_share": share,
        "largest_hole_share": largest,
        "filled_share": share if is_filled else 0.0,
        "reason": reason,
    }


def _stack(foreground: Arrays, background: Arrays, order: Sequence[int], factor: int) -> np.ndarray:
    """(6, H, W, 4) uint8 in the order of `ESTIMATES`; those that are not in `order` are blank."""
    arrays = {"foreground": foreground, "background": background}
    images: np.ndarray | None = None
    for index in sorted(set(order)):
        kind, key = ESTIMATES[index]
        image = reduce_image(arrays[kind][f"{key}_rgb"], arrays[kind][f"{key}_valid"], factor)
        if images is None:
            images = np.zeros((len(ESTIMATES), *image.shape), np.uint8)
        if image.shape != images.shape[1:]:
            raise InputError(
                f"expected foreground and background of one size, got {images.shape[1:3]} and "
                f"{image.shape[:2]} (height, width): run fuse and background again for this view"
            )
        images[index] = image
    assert images is not None
    return images


def _image(output: torch.Tensor) -> np.ndarray:
    return uint8_from_float(output[0].permute(1, 2, 0).cpu().numpy())
