"""Error against time of alignment by sight, on films with true cameras and clocks.

    python -m benches.visual_sync --event DIR TRUTH [--event DIR TRUTH] --output DIR

DIR holds one film per camera, TRUTH is the phones.json of the demo (start_time_s and K, R, t per frame).
Films of two events are also compared with each other, and every film with itself played backwards: none
of these pairs may be accepted. Writes visual_sync.csv: one row per setting and event.
"""

import argparse
import contextlib
import dataclasses
import itertools
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from unittest import mock

import numpy as np
from scipy.spatial.transform import Rotation

from fourd import io
from fourd.align import epipolar_motion, motion_maps
from fourd.align.clock import PairDelay
from fourd.align.clock_graph import solve_clocks
from fourd.align.epipolar_motion import compare_motion
from fourd.align.motion_maps import MotionMaps, map_motion
from fourd.align.moving_tracks import MovingTracks, track_motion
from fourd.align.vision_options import VisionOptions
from fourd.align.visual_delay import estimate_visual_delay, rays_of_tracks
from fourd.camera import Camera
from fourd.film_cameras import FilmCamera
from fourd.video import VideoReader, probe_video

SEARCH_S = (-1.1, 1.1)
DISTURBED_DEG = 0.2
PLANE_SETTINGS = {
    "planes": {},
    "planes_48": {"NUM_PLANES": 48},
    "planes_192": {"NUM_PLANES": 192},
    "planes_120px": {"WORK_PX": 120, "SHRINK": 1},
    "planes_480px": {"WORK_PX": 480, "SHRINK": 4},
}
COLUMNS = ("setting", "event", "disturbed_deg", "pairs_ok", "pairs", "wrong_accepted", "pair_median_frames")
COLUMNS += ("pair_max_frames", "cameras_placed", "median_frames", "max_frames", "seconds")


@dataclasses.dataclass(eq=False)
class Pictures:
    """A film decoded once, so that decoding is not measured."""

    pts_s: np.ndarray
    size: tuple[int, int]
    frames: tuple[np.ndarray, ...]

    def read(self, source_frame: int) -> np.ndarray:
        return self.frames[source_frame]


@dataclasses.dataclass(frozen=True, eq=False)
class Event:
    name: str
    pictures: Mapping[str, Pictures]
    films: Mapping[str, FilmCamera]
    start_s: Mapping[str, float]
    fps: float

    def disturbed(self, angle_deg: float) -> "Event":
        """Each camera turned by one fixed angle about a random axis."""
        rng = np.random.default_rng(0)
        films = {}
        for name, film in self.films.items():
            axis = rng.normal(size=3)
            turn = Rotation.from_rotvec(np.radians(angle_deg) * axis / np.linalg.norm(axis)).as_matrix()
            cameras = tuple(dataclasses.replace(c, R=turn @ c.R, t=turn @ c.t) for c in film.cameras)
            films[name] = dataclasses.replace(film, cameras=cameras)
        return dataclasses.replace(self, films=films)


def read_event(folder: Path, truth: Path) -> Event:
    """Films, cameras and clocks of one event."""
    document = io.read_json(truth)["phones"]
    pictures, films = {}, {}
    for name, phone in document.items():
        info = probe_video(folder / f"{name}.mp4")
        with VideoReader(folder / f"{name}.mp4", info) as reader:
            frames = tuple(reader.read(i) for i in range(len(info.pts_s)))
        pictures[name] = Pictures(np.asarray(info.pts_s) - info.pts_s[0], info.size, frames)
        cameras = tuple(
            Camera(np.array(f["K"]), np.array(f["R"]), np.array(f["t"]), info.size) for f in phone["frames"]
        )
        films[name] = FilmCamera(name, info.size, np.arange(len(cameras)), cameras)
    start_s = {name: float(phone["start_time_s"]) for name, phone in document.items()}
    fps = max(float(phone["fps"]) for phone in document.values())
    return Event(folder.parent.name, pictures, films, start_s, fps)


def compare_tracks(event: Event) -> tuple[list[PairDelay], dict[str, MovingTracks]]:
    """Delays of all pairs by tracks of moving points."""
    options = VisionOptions()
    motions = {n: track_motion(event.pictures[n], event.films[n], options) for n in event.films}
    rays = {n: rays_of_tracks(motions[n], event.films[n]) for n in event.films}
    pairs = [
        estimate_visual_delay(motions[a], motions[b], (rays[a], rays[b]), SEARCH_S, options).delay
        for a, b in itertools.combinations(event.films, 2)
    ]
    return pairs, motions


def compare_planes(event: Event) -> tuple[list[PairDelay], dict[str, MotionMaps]]:
    """Delays of all pairs by motion on epipolar planes."""
    maps = {n: map_motion(event.pictures[n], event.films[n]) for n in event.films}
    pairs = [compare_motion(maps[a], maps[b], SEARCH_S).delay for a, b in itertools.combinations(maps, 2)]
    return pairs, maps


def score_pairs(setting: str, event: Event, pairs: Sequence[PairDelay]) -> dict[str, object]:
    """Errors of the pairs and of the clocks that follow, frames."""
    start = event.start_s
    good = [p for p in pairs if p.status == "ok"]
    errors = np.array([(p.delay_s - start[p.right] + start[p.left]) * event.fps for p in good] or [np.nan])
    names = list(event.films)
    clocks, _ = solve_clocks(names, pairs, names[0])
    placed = [n for n in names if clocks[n].status == "ok"]
    zero = start[placed[0]] if placed else 0.0
    off = np.array([(clocks[n].offset_s - start[n] + zero) * event.fps for n in placed[1:]] or [np.nan])
    return {
        "setting": setting,
        "event": event.name,
        "pairs_ok": len(good),
        "pairs": len(pairs),
        "pair_median_frames": round(float(np.median(np.abs(errors))), 3),
        "pair_max_frames": round(float(np.abs(errors).max()), 3),
        "cameras_placed": len(placed),
        "median_frames": round(float(np.median(np.abs(off))), 3),
        "max_frames": round(float(np.abs(off).max()), 3),
    }


def count_wrong(maps: Sequence[Mapping[str, MotionMaps]]) -> int:
    """Pairs of films of different events, or of one film played backwards, that are accepted."""
    pairs = [
        (a, b) for one, two in itertools.combinations(maps, 2) for a in one.values() for b in two.values()
    ]
    for event in maps:
        backwards = {
            n: dataclasses.replace(m, maps=m.maps[::-1], cameras=m.cameras[::-1]) for n, m in event.items()
        }
        pairs += [(event[a], backwards[b]) for a, b in itertools.combinations(event, 2)]
    return sum(compare_motion(a, b, SEARCH_S).delay.status == "ok" for a, b in pairs)


def measure(events: Sequence[Event], disturbed_deg: float) -> Iterator[dict[str, object]]:
    """One row per setting and event."""
    shown = [event.disturbed(disturbed_deg) if disturbed_deg else event for event in events]
    planes: dict[str, list[PairDelay]] = {}
    for setting, constants in PLANE_SETTINGS.items():
        with contextlib.ExitStack() as stack:
            for key, value in constants.items():
                module = motion_maps if hasattr(motion_maps, key) else epipolar_motion
                stack.enter_context(mock.patch.object(module, key, value))
            rows, maps = [], []
            for event in shown:
                start = time.process_time()
                pairs, made = compare_planes(event)
                rows.append({**score_pairs(setting, event, pairs), "seconds": time.process_time() - start})
                planes.setdefault(event.name, pairs)
                maps.append(made)
            wrong = count_wrong(maps)
        yield from ({**row, "wrong_accepted": wrong} for row in rows)
    for event in shown:
        start = time.process_time()
        pairs, _ = compare_tracks(event)
        seconds = time.process_time() - start
        yield {**score_pairs("tracks", event, pairs), "seconds": seconds}
        both = [p if p.status == "ok" else q for p, q in zip(pairs, planes[event.name], strict=True)]
        yield {**score_pairs("tracks_else_planes", event, both), "seconds": seconds}


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--event", type=Path, nargs=2, action="append", required=True)
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args(argv)
    events = [read_event(folder, truth) for folder, truth in args.event]
    rows = []
    for disturbed_deg in (0.0, DISTURBED_DEG):
        for row in measure(events, disturbed_deg):
            row = {"wrong_accepted": "", **row, "disturbed_deg": disturbed_deg}
            row["seconds"] = round(float(str(row["seconds"])), 2)
            rows.append(row)
            print(" ".join(f"{row[key]!s:>10}" for key in COLUMNS), flush=True)
    io.write_csv(args.output / "visual_sync.csv", COLUMNS, rows)


if __name__ == "__main__":
    main()
