"""Real synchronised films, shifted by known lags: `python -m benches.real_sync --data DIR [--output CSV]`.

DIR holds data/CAM/video.avi and a calibration CAM -> K, dist, R, t_mm (four static cameras, true lag 0).
Lagged films start later by whole frames, so that the truth is exact. Printed is every pair, refused or
not, and the clocks that follow.
"""

import argparse
import itertools
from pathlib import Path

import numpy as np

from fourd.align.clock import CameraClock, Offsets
from fourd.align.clock_graph import solve_clocks
from fourd.align.motion_maps import map_motion
from fourd.align.moving_tracks import track_motion
from fourd.align.solve import Motion, compare_films
from fourd.align.vision_options import VisionOptions
from fourd.camera import Camera
from fourd.film_cameras import FilmCamera
from fourd.io import read_json, write_csv
from fourd.video import VideoReader, probe_video

LAGS = (0, 7, 40, 23)
COLUMNS = ("pair", "status", "error_frames", "sigma_frames", "score")


class LaggedFilm:
    """A film without its first frames."""

    def __init__(self, path: Path, lag: int) -> None:
        info = probe_video(path)
        self._reader, self._lag = VideoReader(path, info), lag
        self.pts_s = info.pts_s[lag:] - info.pts_s[lag]
        self.size, self.fps = info.size, info.fps

    def read(self, source_frame: int) -> np.ndarray:
        return self._reader.read(source_frame + self._lag)


def static_film(name: str, entry: dict, size: tuple[int, int]) -> FilmCamera:
    K, R, t = (np.array(entry[key], float) for key in ("K", "R", "t_mm"))
    camera = Camera(K, R.reshape(3, 3), t.ravel(), size, np.array(entry["dist"], float).ravel()[:5])
    return FilmCamera(name, size, np.array([0]), (camera,), is_static=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--search-s", type=float, default=4.0)
    parser.add_argument("--output", type=Path)
    args = parser.parse_args()
    calibration = read_json(next(args.data.glob("calib*.json")))
    names = [name for name, entry in calibration.items() if isinstance(entry, dict) and "K" in entry]
    options = VisionOptions(max_delay_s=args.search_s)
    films, motions, starts_s = {}, {}, {}
    for name, lag in zip(names, LAGS, strict=False):
        reader = LaggedFilm(args.data / "data" / name / "video.avi", lag)
        films[name] = static_film(name, calibration[name], reader.size)
        motions[name] = Motion(track_motion(reader, films[name], options), map_motion(reader, films[name]))
        starts_s[name] = lag / reader.fps
        print(f"{name}: lag {lag} frames, {motions[name].tracks.num_tracks} tracks", flush=True)
    fps = reader.fps
    silent = Offsets(names[0], {name: CameraClock(0.0, status="no sound") for name in names})
    pairs = list(itertools.combinations(names, 2))
    delays = [m.delay for m in compare_films(pairs, motions, films, silent, options)]
    rows = []
    for delay in delays:
        error = (delay.delay_s - starts_s[delay.right] + starts_s[delay.left]) * fps
        is_ok = delay.status == "ok"
        figures = (f"{error:+.2f}", f"{delay.sigma_s * fps:.2f}") if is_ok else ("", "")
        pair = f"{delay.left}-{delay.right}"
        rows.append(dict(zip(COLUMNS, (pair, delay.status, *figures, f"{delay.score:.2f}"), strict=True)))
        print(rows[-1])
    for name, clock in solve_clocks(names, delays, names[0])[0].items():
        error = (clock.offset_s - starts_s[name] + starts_s[names[0]]) * fps
        print(f"{name}: {error:+.2f} frames, sigma {clock.sigma_s * fps:.2f}, {clock.status}")
    if args.output:
        write_csv(args.output, COLUMNS, rows)


if __name__ == "__main__":
    main()
