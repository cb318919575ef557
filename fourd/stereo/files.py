"""Files of stage stereo (docs/formats.md): rectification of a pair, disparity of a pair and chunk."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fourd.errors import InputError, explain_faults
from fourd.io import Archive, ArchiveWriter
from fourd.stereo.disparity import PairDisparity
from fourd.stereo.rectify import STATUS_OK, PairRectification, Rectification

DISPARITY_UNITS_PER_PX = 32
INVALID_DISPARITY = -32768


def write_rectification(path: Path | str, pair: PairRectification) -> None:
    """Write `rectification/{pair}.npz`; a refused pair is a file with its reason and no frames."""
    meta = {
        "left": pair.left,
        "right": pair.right,
        "status": pair.status,
        "kind": pair.kind,
        "obstacle": pair.obstacle,
        "size": list(pair.size),
        "size_right": list(pair.size_right),
        "angle_deg": pair.angle_deg if np.isfinite(pair.angle_deg) else None,
        "frames": pair.num_frames,
        "guard": {
            name: [v if np.isfinite(v) else None for v in pair.measures[name]] for name in pair.measures
        },
    }
    with ArchiveWriter(path, meta) as writer:
        for frame, rectification in enumerate(pair.frames):
            writer.add_frame(frame, **rectification.to_arrays())


def read_rectification(path: Path | str) -> PairRectification:
    """Inverse of `write_rectification`. Raises InputError if the file is not one."""
    with Archive(path) as archive, explain_faults(f"a rectification of this workflow at {path}"):
        meta = archive.meta
        (width, height), (width_right, height_right) = meta["size"], meta["size_right"]
        frames = tuple(
            Rectification.from_arrays(
                archive.frame(frame),
                (width, height),
                (width_right, height_right),
                f"{path}, frame {frame}",
                meta["obstacle"] or "",
            )
            for frame in archive.frames()
        )
        measures = {name: (_from_json(low), _from_json(high)) for name, (low, high) in meta["guard"].items()}
        return PairRectification(
            meta["left"], meta["right"], meta["status"], meta["frames"], frames, measures
        )


def _from_json(value: float | None) -> float:
    """JSON has no infinity; what was not measured is left out altogether."""
    return float("inf") if value is None else float(value)


def disparity_meta(pair: PairRectification, sigma_px: float) -> dict[str, Any]:
    """The meta of a disparity file."""
    return {
        "left": pair.left,
        "right": pair.right,
        "status": pair.status,
        "kind": pair.kind,
        "sigma_px": sigma_px,
    }


def add_disparity_frame(writer: ArchiveWriter, frame: int, disparity: PairDisparity) -> None:
    """Append one frame to a disparity file, with its rectification."""
    writer.add_frame(
        frame,
        left_disparity=encode_disparity(disparity.left_disparity),
        right_disparity=encode_disparity(disparity.right_disparity),
        left_confidence=encode_confidence(disparity.left_confidence),
        right_confidence=encode_confidence(disparity.right_confidence),
        **disparity.rectification.to_arrays(),
    )


def read_disparity_frame(archive: Archive, frame: int) -> PairDisparity:
    """One frame of a disparity file.

    Raises InputError if the pair was refused or the frame is not in the file.
    """
    if archive.meta.get("status") != STATUS_OK:
        raise InputError(
            f"expected disparities in {archive.path}, got a refused pair ({archive.meta.get('status')}): "
            "leave the pair out"
        )
    try:
        arrays = archive.frame(frame)
    except KeyError:
        raise InputError(
            f"expected frame {frame} in {archive.path}, got frames {archive.frames()}: ask for the chunk "
            "that holds it"
        ) from None
    with explain_faults(f"disparities of this workflow at frame {frame} of {archive.path}"):
        size, size_right = (_size_of_maps(arrays, side) for side in ("left", "right"))
        rectification = Rectification.from_arrays(arrays, size, size_right, f"{archive.path}, frame {frame}")
        sigma_px = float(archive.meta["sigma_px"])
        if rectification.size_right != size_right or not 0 <= sigma_px < float("inf"):
            raise ValueError(f"maps of {size} and {size_right} px, sigma_px {sigma_px}")
        return PairDisparity(
            rectification,
            decode_disparity(arrays["left_disparity"]),
            decode_disparity(arrays["right_disparity"]),
            decode_confidence(arrays["left_confidence"]),
            decode_confidence(arrays["right_confidence"]),
            sigma_px,
        )


def _size_of_maps(arrays: Mapping[str, np.ndarray], side: str) -> tuple[int, int]:
    """(width, height) px of a side. Raises ValueError for maps of another form."""
    disparity, confidence = arrays[f"{side}_disparity"], arrays[f"{side}_confidence"]
    if (disparity.dtype, confidence.dtype) != (np.int16, np.uint8) or disparity.shape != confidence.shape:
        raise ValueError(
            f"{side} maps of {disparity.dtype} {disparity.shape} and {confidence.dtype} {confidence.shape}"
        )
    height, width = disparity.shape
    return width, height


def encode_disparity(disparity: np.ndarray) -> np.ndarray:
    """(H, W) float px, NaN invalid, to int16 in units of 1/32 px, -32768 invalid.

    Raises ValueError if a disparity does not fit into 16 bits.
    """
    valid = np.isfinite(disparity)
    fixed = np.rint(np.where(valid, disparity, 0) * np.float32(DISPARITY_UNITS_PER_PX))
    if np.abs(fixed).max(initial=0) > np.iinfo(np.int16).max:
        raise ValueError(f"disparities up to {np.nanmax(np.abs(disparity)):.0f} px do not fit into the file")
    return np.where(valid, fixed, INVALID_DISPARITY).astype(np.int16)


def decode_disparity(fixed: np.ndarray) -> np.ndarray:
    """Inverse of `encode_disparity`: (H, W) float32 px, NaN invalid."""
    return np.where(
        fixed == INVALID_DISPARITY, np.float32(np.nan), fixed / np.float32(DISPARITY_UNITS_PER_PX)
    )


def encode_confidence(confidence: np.ndarray) -> np.ndarray:
    """(H, W) float to uint8, 255 = 1; what lies outside 0..1 is cut off."""
    return np.rint(np.clip(confidence, 0, 1) * np.float32(255)).astype(np.uint8)


def decode_confidence(levels: np.ndarray) -> np.ndarray:
    """Inverse of `encode_confidence`: (H, W) float32."""
    return levels / np.float32(255)
