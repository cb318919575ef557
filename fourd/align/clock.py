"""Clocks of cameras, delays between two of them, and the file align/offsets.json.

A camera's own clock counts seconds since its first frame (`pts_s` of ingest/{cam}.json). The common
clock is that of the scene: common = offset_s + (1 + rate_ppm * 1e-6) * own.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fourd.errors import explain_faults
from fourd.io import SCHEMA_VERSION, read_json, write_json

PPM = 1e-6


@dataclasses.dataclass(frozen=True)
class CameraClock:
    """How one camera's own clock stands to the common one.

    offset_s: common time of its first frame;  rate_ppm: how much faster common time runs
    sigma_s: standard deviation of a frame's common time;  score: 0 (a guess) to 1 (certain)
    method: `given`, `reference`, `audio`, `vision` or `audio+vision`;  status: `ok` or the reason why
    the camera is left out
    """

    offset_s: float
    rate_ppm: float = 0.0
    sigma_s: float = 0.0
    score: float = 1.0
    method: str = "given"
    status: str = "ok"

    def common_time(self, own_s: np.ndarray) -> np.ndarray:
        """Common time of times on the camera's own clock, seconds, float64."""
        return self.offset_s + (1 + self.rate_ppm * PPM) * np.asarray(own_s, dtype=np.float64)

    def own_time(self, common_s: np.ndarray) -> np.ndarray:
        """Inverse of `common_time`."""
        return (np.asarray(common_s, dtype=np.float64) - self.offset_s) / (1 + self.rate_ppm * PPM)


@dataclasses.dataclass(frozen=True)
class PairDelay:
    """One measured relation of two clocks: left_s = delay_s + (1 + rate_ppm * 1e-6) * right_s.

    delay_s: offset_s of `right` minus offset_s of `left`;  rate_ppm: rate of right minus rate of left
    sigma_s: standard deviation of delay_s;  score: 0 to 1;  method: `audio` or `vision`
    status: `ok`, or the reason why this pair says nothing
    time_s: time on the right camera's own clock at which left_s is known to sigma_s
    rate_sigma_ppm: standard deviation of rate_ppm, None where the rate was not measured
    """

    left: str
    right: str
    delay_s: float
    sigma_s: float
    score: float
    method: str
    rate_ppm: float = 0.0
    status: str = "ok"
    time_s: float = 0.0
    rate_sigma_ppm: float | None = None


@dataclasses.dataclass(frozen=True)
class Offsets:
    """Content of align/offsets.json (and of align/audio.json).

    reference: camera whose clock is the common one
    start_s: common time of scene frame 0, None where no camera could be placed
    pairs: the evidence;  notes: sentences for the report
    """

    reference: str
    clocks: Mapping[str, CameraClock]
    start_s: float | None = None
    pairs: tuple[PairDelay, ...] = ()
    notes: tuple[str, ...] = ()


def write_offsets(path: Path | str, offsets: Offsets) -> None:
    """Write align/offsets.json (docs/formats.md)."""
    write_json(
        path,
        {
            "reference": offsets.reference,
            "start_s": offsets.start_s,
            "cameras": {name: dataclasses.asdict(clock) for name, clock in offsets.clocks.items()},
            "pairs": [dataclasses.asdict(pair) for pair in offsets.pairs],
            "notes": list(offsets.notes),
        },
    )


def read_offsets(path: Path | str) -> Offsets:
    """Inverse of `write_offsets`. Raises InputError, naming the file."""
    document: dict[str, Any] = read_json(path)
    with explain_faults(f"offsets of the stage align in {path}"):
        if document["schema_version"] != SCHEMA_VERSION:
            raise ValueError(f"schema_version {document['schema_version']}")
        return Offsets(
            reference=str(document["reference"]),
            clocks={name: _read_clock(entry) for name, entry in document["cameras"].items()},
            start_s=None if document["start_s"] is None else float(document["start_s"]),
            pairs=tuple(PairDelay(**entry) for entry in document["pairs"]),
            notes=tuple(document["notes"]),
        )


def _read_clock(entry: Mapping[str, Any]) -> CameraClock:
    clock = CameraClock(**entry)
    numbers = ("offset_s", "rate_ppm", "sigma_s", "score")
    return dataclasses.replace(clock, **{key: float(getattr(clock, key)) for key in numbers})
