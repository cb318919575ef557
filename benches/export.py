"""What an export costs and keeps: `python -m benches.export --results results/demo --output DIR`.

--results is a finished scene, called from the folder it was made in. Every job of `snakemake export` runs
as a process of its own, one after the other; `error` is, of formats that can be read, the largest difference
in px between points projected by the cameras read back and by those that were exported, and of depths the
share of pixels without one. Then every codec encodes the frames of one film: `error` is the RMS difference
of luma, grey levels, `megabytes` of the film. Writes export.csv.
"""

import argparse
import os
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fourd.export import EVENT_FORMATS, FILM_FORMATS, READ_FORMATS, ExportOptions
from fourd.export.event import Event
from fourd.export.formats import MOVING, read_format
from fourd.io import Archive, read_image, write_csv
from fourd.render import list_frames
from fourd.sfm.cameras import read_cameras
from fourd.video import encode_video, read_video_frames
from fourd.video.encode import CODECS

COLUMNS = ("step", "what", "megabytes", "error", "seconds", "cpu_seconds", "peak_rss_mb")
LUMA = np.array([0.2126, 0.7152, 0.0722])
FILES = {
    "nerfstudio": "transforms.json",
    "pose2sim": "Calib.toml",
    "anipose": "calibration.toml",
    "caliscope": "camera_array.toml",
    "qualisys": "event.qca.txt",
}


def run_job(*words: object) -> dict[str, str]:
    """Run a command of the stage; what it took. The peak is that of all jobs so far."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "fourd.export", *map(str, words)]
    subprocess.run(command, check=True, capture_output=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {
        "seconds": f"{time.perf_counter() - start:.2f}",
        "cpu_seconds": f"{cpu_s:.2f}",
        "peak_rss_mb": f"{after.ru_maxrss / 1024:.0f}",
    }


def megabytes(path: Path) -> str:
    """Size of a file or of all files in a folder."""
    files = [p for p in path.rglob("*") if p.is_file()] if path.is_dir() else [path]
    return f"{sum(p.stat().st_size for p in files) / 1e6:.2f}"


def reprojection_error(event: Event, name: str, folder: Path) -> float:
    """Largest difference, px, of points around the scene's origin, over cameras and frames."""
    points = event.world(np.random.default_rng(0).uniform(-0.3, 0.3, (100, 3)))
    worst = 0.0
    for camera, poses in read_format(folder / FILES.get(name, ""), name).items():
        # Films are numbered in the order of the cameras' names.
        known = sorted(event.names)[int(camera[3:])] if name == "n3dv" else camera
        for frame, pose in enumerate(poses):
            given = event.camera(known, frame) if name in MOVING else event.held(known)
            difference = pose.project(points)[0] - given.project(points)[0]
            worst = max(worst, float(np.nanmax(np.abs(difference))))
    return worst


def measure_formats(results: Path, output: Path, trajectory: str) -> list[dict[str, Any]]:
    """A row per job of an export of all formats."""
    cameras = results / "sfm" / "cameras.json"
    scene = read_cameras(cameras)
    event = Event(scene, ExportOptions(), output / "pictures", output / "depth")
    rows = []
    for name in event.names:
        film, folder = results / "frames" / "cameras" / f"{name}.npz", event.pictures / name
        cost = run_job("pictures", "--film", film, "--cameras", cameras, "--output", folder)
        rows.append({"step": "pictures", "what": name, "megabytes": megabytes(folder), **cost})
    for name in scene.inputs:
        pairs = [p for p in (results / "disparity").glob("*/[0-9]*.npz") if name in p.parent.name.split("-")]
        path = event.depth / f"{name}.npz"
        flags = ("--camera", name, "--disparity", *sorted(pairs), "--cameras", cameras, "--output", path)
        cost = run_job("depth", *flags)
        archive = Archive(path)
        blank = np.mean([(archive[f"{frame:06d}/depth"] == 0).mean() for frame in event.frames])
        row = {"step": "depth", "what": name, "megabytes": megabytes(path), "error": f"{blank:.3f}"}
        rows.append({**row, **cost})
    for name in EVENT_FORMATS:
        flags = ("--pictures", event.pictures, "--depth", event.depth, "--cameras", cameras)
        cost = run_job("write", "--format", name, *flags, "--output", output / name)
        row = {"step": "format", "what": name, "megabytes": megabytes(output / name), **cost}
        if name in READ_FORMATS:
            row["error"] = f"{reprojection_error(event, name, output / name):.1e}"
        rows.append(row)
    chunks = sorted((results / "render" / trajectory).glob("[0-9]*"))
    kinds = ("foreground", "background")
    estimates = [results / kind / trajectory / f"{chunk.name}.npz" for kind in kinds for chunk in chunks]
    for name in FILM_FORMATS:
        flags = ("--view-file", results / "views" / f"{trajectory}.json", "--frames-dir", *chunks)
        flags += ("--estimates", *estimates, "--cameras", cameras, "--output", output / name)
        cost = run_job("frames", "--format", name, *flags)
        rows.append({"step": "format", "what": name, "megabytes": megabytes(output / name), **cost})
    return rows


def measure_codecs(results: Path, output: Path, trajectory: str) -> list[dict[str, Any]]:
    """A row per codec, encoding the frames of one film."""
    chunks = sorted((results / "render" / trajectory).glob("[0-9]*"))
    pictures = [read_image(path) for path in list_frames(chunks).values()]
    rows = []
    for name, codec in CODECS.items():
        path, start, cpu_s = output / f"film_{name}{codec.suffix}", time.perf_counter(), time.process_time()
        encode_video(path, pictures, 30, name)
        cost = {
            "seconds": f"{time.perf_counter() - start:.2f}",
            "cpu_seconds": f"{time.process_time() - cpu_s:.2f}",
            "peak_rss_mb": f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f}",
        }
        height, width = pictures[0].shape[:2]
        read = [image[:height, :width] for _, image in read_video_frames(path, range(len(pictures)))]
        difference = (np.stack(read).astype(np.float64) - np.stack(pictures)) @ LUMA
        error = np.sqrt(np.mean(difference**2))
        row = {"step": "codec", "what": name, "megabytes": megabytes(path), "error": f"{error:.2f}"}
        rows.append({**row, **cost})
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--results", type=Path, required=True, help="results/SCENE")
    parser.add_argument("--trajectory", default="time_and_view", help="film whose frames are exported")
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args(argv)
    rows = measure_formats(args.results, args.output, args.trajectory)
    rows += measure_codecs(args.results, args.output, args.trajectory)
    for row in rows:
        print(*(row.get(column, "") for column in COLUMNS))
    print(
        f"all jobs: {sum(float(row['cpu_seconds']) for row in rows if row['step'] != 'codec'):.1f} s of CPU"
    )
    write_csv(args.output / "export.csv", COLUMNS, rows)


if __name__ == "__main__":
    main()
