"""`sample`: one film on the common clock, picture by picture."""

import dataclasses
import logging
from pathlib import Path

import numpy as np

from fourd.align.clock import CameraClock, read_offsets
from fourd.align.sampling import check_coverage, match_frames
from fourd.errors import InputError
from fourd.ingest import read_ingest
from fourd.io import write_json

log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class SampleOptions:
    """Settings of the config section `sample` (config/schemas/sample.schema.yaml)."""

    max_dt_frames: float = 0.75


@dataclasses.dataclass(frozen=True)
class GivenClock:
    """A clock that the scene file states. Times in seconds; start_s: common time of scene frame 0."""

    offset_s: float = 0.0
    start_s: float = 0.0


def clock_from_offsets(camera: str, offsets_path: Path) -> tuple[CameraClock, float]:
    """A camera's clock and the common time of scene frame 0. Raises InputError, naming the file."""
    offsets = read_offsets(offsets_path)
    if camera not in offsets.clocks or offsets.start_s is None:
        raise InputError(
            f"{offsets_path}: expected the clock of camera {camera} and a start, got clocks of "
            f"{', '.join(offsets.clocks) or 'no camera'}: delete the file and run again"
        )
    return offsets.clocks[camera], offsets.start_s


def run_sample(
    ingest_path: Path,
    clock: CameraClock,
    start_s: float,
    fps: float,
    num_frames: int,
    output: Path,
    options: SampleOptions,
) -> None:
    """Write align/cameras/{cam}.json (docs/formats.md).

    A camera without a clock, or whose film does not show every scene frame, has a status that says so.
    """
    document = read_ingest(ingest_path)
    camera = document["camera"]
    common_s = clock.common_time(np.array(document["pts_s"]))
    source_frame, dt_s = match_frames(common_s, fps, num_frames, start_s)
    status = clock.status
    if status == "ok":
        status = check_coverage(
            camera, document["source"], common_s, dt_s, fps, start_s, options.max_dt_frames
        )
    if status == "ok":
        log.info("%s: pictures within %.1f ms of the common clock", camera, 1e3 * np.abs(dt_s).max())
    else:
        log.warning("%s is left out: %s", camera, status)
        source_frame, dt_s = source_frame[:0], dt_s[:0]
    write_json(
        output,
        {
            "camera": camera,
            "status": status,
            "offset_s": clock.offset_s,
            "rate_ppm": clock.rate_ppm,
            "sigma_s": clock.sigma_s,
            "method": clock.method,
            "fps": fps,
            "num_frames": num_frames,
            "source_frame": source_frame.tolist(),
            "dt_s": dt_s.tolist(),
            "ingest": document,
        },
    )
