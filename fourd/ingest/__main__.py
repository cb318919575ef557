"""Command line of the stage `ingest`: probe and check one camera's source."""

import argparse
import dataclasses
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd.cli import add_options, options_from_args, run_stage, set_num_threads
from fourd.ingest.flags import (
    SAMPLE_STEP,
    find_gaps,
    find_repeats,
    is_constant_picture,
    measure_changes,
    words_by_frame,
)
from fourd.ingest.options import IngestOptions
from fourd.ingest.reader import SourceReader
from fourd.ingest.source import Source, hash_source, probe_source
from fourd.io import write_csv, write_json

logger = logging.getLogger(__name__)


def run(
    camera: str,
    source: Path,
    fps: float | None,
    output_json: Path,
    output_table: Path,
    options: IngestOptions,
) -> None:
    """Write ingest/{cam}.json and ingest/{cam}.csv. fps: of images on their own clock.

    Raises InputError for a source that is missing, damaged or no pictures.
    """
    probed = probe_source(source, fps, options.square_pixels)
    document = _describe(camera, source, probed)
    dropped, paused = find_gaps(probed.info.pts_s, probed.info.fps)
    document["flags"] = {"dropped_before": dropped, "pause_before": paused, "duplicate": [], "still": []}
    document["is_constant"] = False
    if options.verify:
        # Every picture is decoded, so that damage stops here and not hours later.
        with SourceReader(document, output_json) as reader:
            samples = (reader.read_luma(i, SAMPLE_STEP) for i in range(reader.num_frames))
            mean, worst, lasting = measure_changes(samples)
        document["is_constant"] = len(mean) > 0 and is_constant_picture(lasting)
        document["flags"]["duplicate"], document["flags"]["still"] = find_repeats(mean, worst)
    document["notes"] = describe_oddities(document)
    document["sha256"] = hash_source(source, probed.files)
    words = words_by_frame(document["flags"], len(probed.info.pts_s))
    rows = [
        {"frame": frame, "pts_s": repr(time_s), "flags": word}
        for frame, (time_s, word) in enumerate(zip(document["pts_s"], words, strict=True))
    ]
    write_csv(output_table, ("frame", "pts_s", "flags"), rows)
    write_json(output_json, document)
    logger.info(
        "%s: %s, %d frames of %d x %d, %g fps",
        camera, source, len(rows), *probed.info.size, probed.info.fps,
    )  # fmt: skip
    for note in document["notes"]:
        logger.info("%s: %s", camera, note)


def _describe(camera: str, source: Path, probed: Source) -> dict[str, Any]:
    info = probed.info
    return {
        "camera": camera,
        "source": str(source),
        "kind": "images" if probed.files else "video",
        "num_source_frames": len(info.pts_s),
        **dataclasses.asdict(info),
        "pts_s": info.pts_s.tolist(),
        "start_s": probed.start_s,
        "audio_start_s": probed.audio_start_s,
        "audio_duration_s": probed.audio_duration_s,
        "files": list(probed.files),
        "num_bytes": probed.num_bytes,
    }


def describe_oddities(document: dict[str, Any]) -> list[str]:
    """One sentence for each thing about a film that a person should know."""
    pts_s, flags, fps = np.array(document["pts_s"]), document["flags"], document["fps"]
    notes = []
    if len(pts_s) == 1:
        notes.append("a single frame: it shows one instant, and no sound or motion can place it in time")
    if document["is_constant"]:
        notes.append("the picture never changes: a covered lens, a frozen camera or an empty scene")
    if flags["duplicate"]:
        notes.append(f"{len(flags['duplicate'])} of {len(pts_s)} frames repeat the picture before them")
    if flags["still"]:
        notes.append(f"{len(flags['still'])} frames show no change: nothing moves there, or the camera froze")
    if flags["dropped_before"]:
        missing = sum(round((pts_s[i] - pts_s[i - 1]) * fps) - 1 for i in flags["dropped_before"])
        notes.append(f"about {missing} frames are missing at {len(flags['dropped_before'])} places")
    for frame in flags["pause_before"]:
        gap_s = pts_s[frame] - pts_s[frame - 1]
        notes.append(f"the film pauses for {gap_s:.2f} s before frame {frame}, at {pts_s[frame - 1]:.2f} s")
    capture_fps = document["capture_fps"]
    if capture_fps is not None and capture_fps > 1.5 * fps:
        notes.append(
            f"slow motion: taken at {capture_fps:g} fps and stored to play at {fps:g} fps, so its clock runs "
            f"{capture_fps / fps:.3g} times slow; store it at its true speed"
        )
    if document["transfer"] != "sdr":
        notes.append(f"{document['transfer'].upper()} pictures are mapped to SDR")
    return notes


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of the stage."""
    parser = argparse.ArgumentParser(prog="python -m fourd.ingest", description=__doc__)
    parser.add_argument("--camera", required=True)
    parser.add_argument("--source", type=Path, required=True, help="video, folder of images or image")
    parser.add_argument("--fps", type=float, help="of images, which have no times; not used for videos")
    parser.add_argument("--output-json", type=Path, required=True)
    parser.add_argument("--output-table", type=Path, required=True)
    add_options(parser, IngestOptions)
    args = parser.parse_args(argv)
    set_num_threads(1)
    options = options_from_args(IngestOptions, args)
    run(args.camera, args.source, args.fps, args.output_json, args.output_table, options)


if __name__ == "__main__":
    sys.exit(run_stage(main))
