"""Clocks and cameras from phone files against the truth, by the workflow itself.

`python -m benches.phones --films FOLDER --truth phones.json --output DIR [--mute]`: the films named in
phones.json (start_time_s, fps, K, R, t of every frame) are worked on as anyone's; --mute takes their sound
away first. Clock errors are relative to the reference camera, and once more with the mean taken out.
"""

import argparse
import json
from pathlib import Path

import av
import numpy as np

from benches import workspace
from fourd.align.clock import read_offsets
from fourd.camera import camera_from_dict
from fourd.film_cameras import read_film_cameras
from fourd.io import write_csv
from fourd.sfm.compare import align_similarity

COLUMNS = ("quantity", "median", "p95", "max", "unit")


def mute(source: Path, target: Path) -> None:
    """Copy the pictures of a film as they are, without its sound."""
    target.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(source)) as given, av.open(str(target), "w") as written:
        stream = written.add_stream_from_template(given.streams.video[0])
        for packet in given.demux(given.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                written.mux(packet)


def write_workspace(folder: Path, films: dict[str, Path], num_frames: int, heldout: list[str]) -> None:
    scene = {
        "fps": 30,
        "num_frames": num_frames,
        "size": [480, 270],
        "cameras": {name: {"source": str(path)} for name, path in films.items()},
        "heldout": heldout,
    }
    workspace.write_scene(folder, "phones", scene)


def summarize(quantity: str, values: np.ndarray, unit: str) -> dict[str, str]:
    size = np.abs(values)
    figures = (np.median(size), np.percentile(size, 95), size.max())
    return {
        "quantity": quantity,
        **dict(zip(COLUMNS[1:4], (f"{f:.4f}" for f in figures), strict=True)),
        "unit": unit,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--films", type=Path, required=True)
    parser.add_argument("--truth", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--heldout", nargs="*", default=[])
    parser.add_argument("--num-frames", type=int, default=28)
    parser.add_argument("--mute", action="store_true")
    parser.add_argument("--cores", type=int, default=2)
    args = parser.parse_args()
    phones = json.loads(args.truth.read_text())["phones"]
    films = {name: (args.films / f"{name}.mp4").resolve() for name in phones}
    if args.mute:
        for name, path in films.items():
            mute(path, args.output / "muted" / f"{name}.mp4")
            films[name] = (args.output / "muted" / f"{name}.mp4").resolve()
    write_workspace(args.output, films, args.num_frames, args.heldout)
    workspace.run_workflow(args.output, args.cores, "results/phones/align/offsets.json")
    results = args.output / "results" / "phones"
    offsets = read_offsets(results / "align" / "offsets.json")
    cameras = read_film_cameras(results / "sfm" / "film_cameras.json").cameras
    placed = [name for name in phones if offsets.clocks[name].status == "ok"]
    true_start = phones[offsets.reference]["start_time_s"]
    frames = 30 * np.array(
        [offsets.clocks[n].offset_s - (phones[n]["start_time_s"] - true_start) for n in placed]
    )
    for name, error in zip(placed, frames, strict=True):
        clock = offsets.clocks[name]
        print(f"{name}: {error:+.3f} frames, sigma {30 * clock.sigma_s:.3f}, {clock.method}")
    others = np.array([name != offsets.reference for name in placed])
    found, true = [], []
    for name, film in cameras.items():
        for frame in film.source_frames:
            found.append(film.at(int(frame)))
            true.append(camera_from_dict(phones[name]["frames"][int(frame)], film.size, name))
    errors = align_similarity(found, true)
    rows = [
        summarize("clock against the reference", frames[others], "frames at 30 fps"),
        summarize("clock, mean taken out", frames - frames.mean(), "frames at 30 fps"),
        summarize("rotation", errors.rotation_deg, "degrees"),
        summarize("centre", 100 * errors.center / errors.distance, "% of camera distance"),
        summarize("focal length", 100 * errors.focal, "%"),
    ]
    print(f"{len(placed)} of {len(phones)} films placed in time, {len(found)} frames with a camera")
    for row in rows:
        print("{quantity}: median {median}, 95 % {p95}, max {max} {unit}".format(**row))
    write_csv(args.output / "phones.csv", COLUMNS, rows)


if __name__ == "__main__":
    main()
