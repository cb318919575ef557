"""What a training shows while it runs: quality on samples kept apart, pictures, TensorBoard events."""

import dataclasses
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd import io, metrics
from fourd.composition import data, infer
from fourd.composition.model import CompositionNet
from fourd.errors import InputError
from fourd.image import label_image, resize_area, tile_images

log = logging.getLogger("fourd.composition")

TILE_WIDTH_PX = 480
CAPTION_PX = 18
# An epoch that gains less than this, dB, is none: the measure is that of a few frames.
MIN_GAIN_DB = 0.01


@dataclasses.dataclass(frozen=True, eq=False)
class Composed:
    """A sample pasted, composed and as its camera saw it, each (H, W, 3) uint8; valid: (H, W) bool."""

    pasted: np.ndarray
    composed: np.ndarray
    truth: np.ndarray
    valid: np.ndarray


Report = Callable[[Mapping[str, Any], Sequence[Composed]], None]


def compose_samples(
    network: CompositionNet, samples: data.SampleSet, ids: Sequence[data.SampleId], precision: str
) -> list[Composed]:
    """What the network makes of samples' test-time inputs."""
    found = []
    for images in map(samples.images, ids):
        composed, target = infer.run_network(network, images, precision), images[data.TARGET]
        found.append(Composed(infer.paste_images(images), composed, target[..., :3], target[..., 3] > 0))
    return found


def measure(found: Sequence[Composed]) -> dict[str, float]:
    """Mean PSNR, dB, of the composed and of the pasted pictures; nothing without a pixel to compare."""
    rows = [
        [metrics.psnr(image, sample.truth, sample.valid) for image in (sample.composed, sample.pasted)]
        for sample in found
        if sample.valid.any()
    ]
    if not rows:
        return {}
    composed, pasted = np.mean(rows, axis=0)
    log.info("test-time inputs, %d samples: %.2f dB, pasted %.2f dB", len(rows), composed, pasted)
    if composed < pasted:
        log.warning("the network is worse than pasting consensus over background: train longer")
    return {"validation_psnr_db": float(composed), "paste_psnr_db": float(pasted)}


def is_stale(rows: Sequence[Mapping[str, Any]], patience: int | None) -> bool:
    """Whether the last `patience` rows of the log hold no better PSNR than one before; None: never."""
    values = [float(row["validation_psnr_db"]) for row in rows if row["validation_psnr_db"] != ""]
    if patience is None or len(values) <= patience:
        return False
    return max(values[-patience:]) < max(values[:-patience]) + MIN_GAIN_DB


def draw_validation(found: Sequence[Composed], epoch: int) -> np.ndarray:
    """(H, W, 3) uint8: a row per sample, in columns what is pasted, what is composed and what was filmed."""
    height, width = found[0].truth.shape[:2]
    scale = min(1.0, TILE_WIDTH_PX / width)
    size = (max(1, round(scale * width)), max(1, round(scale * height)))
    captions = ("pasted", f"network, epoch {epoch}", "camera")
    rows = [[label_image(text, (size[0], CAPTION_PX)) for text in captions]]
    for sample in found:
        rows.append([resize_area(image, size) for image in (sample.pasted, sample.composed, sample.truth)])
    return tile_images(rows)


def open_events(folder: Path, step: int) -> Any:
    """A writer of TensorBoard events; those of later steps in the folder are marked as undone.

    Raises InputError if the package is not installed.
    """
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise InputError(
            "expected the package tensorboard for composition tensorboard: true, found none: install it with "
            "`pip install 'fourd[tensorboard]'`, or set tensorboard to false"
        ) from None
    return SummaryWriter(str(folder), purge_step=step + 1)


def epoch_report(picture_path: Path, events_folder: Path | None, step: int) -> Report:
    """What to do with a new row of the log: a picture, and events where there is a folder for them.

    step: the one that training begins or continues at
    """
    events = open_events(events_folder, step) if events_folder else None

    def report(row: Mapping[str, Any], found: Sequence[Composed]) -> None:
        sheet = draw_validation(found, row["epoch"])
        io.write_png(picture_path, sheet)
        if events is None:
            return
        for name, value in row.items():
            if name not in ("epoch", "step") and value != "":
                events.add_scalar(name, float(value), row["step"])
        events.add_image("validation", sheet, row["step"], dataformats="HWC")
        events.flush()

    return report
