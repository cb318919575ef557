"""What errors of clocks and cameras cost in the end: `python -m benches.downstream --event DIR --output DIR`.

DIR is a rendered event with truth: inputs_phones/CAM.mp4, truth/phones.json (clock, K, R, t of every
phone frame), truth/heldout/VIEW/000000.png with truth/heldout_cameras.json, truth/labels. Each variant
is a scene of its own that the workflow fuses for the held-out views; scored is the consensus over the
background where there is either, before any network. `recovered` takes clocks and cameras from a
finished scene of the same phones (--recovered results/SCENE), brought to the truth by one similarity
and one shift of time.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import numpy as np

from benches import workspace
from fourd.align.clock import read_offsets
from fourd.film_cameras import read_film_cameras
from fourd.image import undistort
from fourd.io import Archive, read_image, read_json, write_csv, write_json
from fourd.metrics import psnr_from_mse, squared_error
from fourd.sfm import read_cameras
from fourd.sfm.compare import fit_similarity
from fourd.views import read_view

FIRST_FRAME = 2
NUM_FRAMES = 28
HELDOUT_FRAMES = 3
NUM_SAMPLES = 5
COLUMNS = ("variant", "view", "region", "psnr_db", "coverage", "num_frames")


@dataclasses.dataclass(frozen=True)
class Variant:
    """wrong_frames: error of every clock, known to nobody;  lag_frames: pictures late, and known to be."""

    name: str
    is_compensated: bool = False
    wrong_frames: float = 0.0
    lag_frames: int = 0
    is_recovered: bool = False


VARIANTS = (
    Variant("true"),
    Variant("true, compensated", True),
    Variant("recovered", True, is_recovered=True),
    *(
        Variant(f"clock wrong by {e:g}{', compensated' * on}", on, wrong_frames=e)
        for e in (0.25, 0.5, 1, 3)
        for on in (False, True)
    ),
    *(
        Variant(f"pictures late by {e}{', compensated' * on}", on, lag_frames=e)
        for e in (1, 2)
        for on in (False, True)
    ),
)


def signs(count: int) -> np.ndarray:
    """(count,) of -1, 0, 1: the first camera is right, the others are early or late."""
    return np.concatenate([[0], np.random.default_rng(5).permutation(np.resize([1, -1], count - 1))])


def phone_truth(event: Path) -> dict:
    return read_json(event / "truth" / "phones.json")["phones"]


def write_scene(folder: Path, event: Path, variant: Variant, recovered: Path | None) -> list[str]:
    """Scene file and calibration of a variant; returns the names of the held-out views."""
    phones = phone_truth(event)
    held = read_json(event / "truth" / "heldout_cameras.json")
    offsets = {name: phone["start_time_s"] for name, phone in phones.items()}
    tracks = {name: phone["frames"] for name, phone in phones.items()}
    if variant.is_recovered:
        assert recovered is not None, "--recovered names the folder of a finished scene"
        offsets, tracks = recovered_truth(phones, recovered)
    fps = held["fps"]
    for name, sign in zip(offsets, signs(len(offsets)), strict=True):
        offsets[name] += float(sign) * variant.wrong_frames / fps
    size = [held["width"], held["height"]]
    cameras = {name: {"size": size, "frames": frames} for name, frames in tracks.items()}
    cameras |= {name: {"size": size, "frames": entry["frames"]} for name, entry in held["cameras"].items()}
    write_json(folder / "cameras.json", {"cameras": cameras})
    sources = {
        name: {"source": str(event / "inputs_phones" / f"{name}.mp4"), "offset_s": o}
        for name, o in offsets.items()
    }
    sources |= {name: {"source": str(event / "truth" / "heldout" / name)} for name in held["cameras"]}
    scene = {
        "fps": fps,
        "num_frames": NUM_FRAMES,
        "start_s": FIRST_FRAME / fps,
        "size": size,
        "cameras": {name.lower(): {**s, "calibration_name": name} for name, s in sources.items()},
        "heldout": [name.lower() for name in held["cameras"]],
        "clock": "given",
        "calibration": ["cameras.json"],
        "settings": {
            "chunk_frames": 1,
            "views": {"heldout_frames": HELDOUT_FRAMES},
            "background": {"num_samples": NUM_SAMPLES},
            "fuse": {"min_pairs": 2},
            "sample": {"max_dt_frames": 4},
            "frames": {"compensate": variant.is_compensated, "match_colours": False},
        },
    }
    workspace.write_scene(folder, "event", scene)
    return scene["heldout"]


def recovered_truth(phones: dict, results: Path) -> tuple[dict, dict]:
    """Offsets and per-frame cameras that the workflow found, in the truth's world and time."""
    from fourd.camera import camera_from_dict

    films = read_film_cameras(results / "sfm" / "film_cameras.json").cameras
    clocks = read_offsets(results / "align" / "offsets.json").clocks
    names = [name for name in phones if films[name].status == "ok" and clocks[name].status == "ok"]
    found, true = [], []
    for name in names:
        for frame in films[name].source_frames:
            found.append(films[name].at(int(frame)))
            true.append(camera_from_dict(phones[name]["frames"][frame], films[name].size, name))
    similarity = fit_similarity(found, true)
    shift = np.median([phones[name]["start_time_s"] - clocks[name].offset_s for name in names])
    offsets = {name: float(clocks[name].offset_s + shift) for name in names}
    tracks = {}
    for name in names:
        film = films[name]
        known = {int(f): similarity.apply(film.at(int(f))).to_dict() for f in film.source_frames}
        tracks[name] = [{"frame": f, **camera} for f, camera in sorted(known.items())]
    return offsets, tracks


def delay_pictures(folder: Path, lag_frames: int) -> None:
    """Take every camera's picture `lag_frames` late or early, and say so in dt_s."""
    paths = sorted((folder / "results" / "event" / "align" / "cameras").glob("cam*.json"))
    for path, sign in zip(paths, signs(len(paths)), strict=True):
        document = json.loads(path.read_text())
        last = document["ingest"]["num_source_frames"] - 1
        pts_s = document["ingest"]["pts_s"]
        for i, frame in enumerate(document["source_frame"]):
            late = min(max(frame + int(sign) * lag_frames, 0), last)
            document["dt_s"][i] += pts_s[late] - pts_s[frame]
            document["source_frame"][i] = late
        path.write_text(json.dumps(document))


def score(folder: Path, event: Path, view_name: str, variant: str) -> list[dict]:
    """PSNR of the consensus over the background, full frame and moving pixels."""
    results = folder / "results" / "event"
    scene = read_cameras(results / "sfm" / "cameras.json")
    view = read_view(results / "views" / f"{view_name}.json")
    on_disk = next(p for p in (event / "truth" / "heldout").iterdir() if p.name.lower() == view_name)
    errors: dict[str, list[float]] = {"full": [], "dynamic": []}
    coverage: list[float] = []
    for entry in view.frames:
        name = f"{entry.frame:06d}-{entry.frame:06d}.npz"
        foreground = Archive(results / "foreground" / view_name / name).frame(entry.frame)
        background = Archive(results / "background" / view_name / name).frame(entry.frame)
        own = entry.scene_frame + FIRST_FRAME
        camera = scene.tracks[view_name].at(entry.scene_frame)
        truth, valid = undistort(read_image(on_disk / f"{own:06d}.png"), camera, entry.camera)
        labels = read_image(event / "truth" / "labels" / on_disk.name / f"{own:06d}.png")
        moving = labels[..., 0] > 0
        image = np.where(background["farthest_valid"][..., None], background["farthest_rgb"], 0)
        image = np.where(foreground["consensus_valid"][..., None], foreground["consensus_rgb"], image)
        covered = foreground["consensus_valid"] | background["farthest_valid"]
        valid &= covered
        coverage.append(float(covered.mean()))
        squared = squared_error(image.astype(np.uint8), truth)
        errors["full"].append(psnr_from_mse(float(squared[valid].mean())))
        if (moving & valid).any():
            errors["dynamic"].append(psnr_from_mse(float(squared[moving & valid].mean())))
    return [
        {
            "variant": variant,
            "view": view_name,
            "region": k,
            "psnr_db": f"{np.mean(v):.2f}",
            "coverage": f"{np.mean(coverage):.3f}",
            "num_frames": len(v),
        }
        for k, v in errors.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--event", type=Path, required=True)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--recovered", type=Path, help="results/SCENE made from the same phones")
    parser.add_argument("--only", nargs="*", help="names of variants")
    parser.add_argument("--cores", type=int, default=2)
    args = parser.parse_args()
    rows: list[dict] = []
    for variant in VARIANTS:
        if (args.only and variant.name not in args.only) or (variant.is_recovered and args.recovered is None):
            continue
        folder = args.output / variant.name.replace(",", "").replace(" ", "_")
        views = write_scene(folder, args.event.resolve(), variant, args.recovered)
        stems = [f"results/event/align/cameras/{n.lower()}.json" for n in [*phone_truth(args.event), *views]]
        workspace.run_workflow(folder, args.cores, *stems)
        if variant.lag_frames:
            delay_pictures(folder, variant.lag_frames)
        from fourd.config import spread_frames

        chunks = [f"{f:06d}-{f:06d}.npz" for f in spread_frames(NUM_FRAMES, HELDOUT_FRAMES)]
        kinds = ("foreground", "background")
        workspace.run_workflow(
            folder, args.cores, *(f"results/event/{k}/{v}/{c}" for k in kinds for v in views for c in chunks)
        )
        for view in views:
            rows += score(folder, args.event, view, variant.name)
            print(*rows[-2:], sep="\n", flush=True)
        write_csv(args.output / "downstream.csv", COLUMNS, rows)


if __name__ == "__main__":
    main()
