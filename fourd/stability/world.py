"""One small event through the stages from calibration to background, in worlds of any scale and origin."""

import dataclasses
import functools
import itertools
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fourd.align.__main__ import main as align
from fourd.background.__main__ import main as estimate_background
from fourd.camera import Camera
from fourd.demo import DemoOptions, FrozenScene, camera_names, camera_tracks, clip_times
from fourd.fuse.__main__ import main as fuse
from fourd.ingest.__main__ import main as ingest
from fourd.io import Archive, read_json, write_json, write_png
from fourd.sfm.__main__ import main as sfm
from fourd.stereo.__main__ import main as stereo
from fourd.views import main as views

EVENT = DemoOptions(num_cameras=4, num_frames=2, width=96, height=54, arc_deg=36.0)
DEPTH_RANGE_M = (2.0, 60.0)
VIEW = "cam01"


@dataclasses.dataclass(frozen=True, eq=False)
class Filmed:
    """What the stages made of the event in one world.

    rgb: name -> (H, W, 3) uint8, valid: name -> (H, W) bool, depth_m: name -> (H, W) float64 metres of the
    event, NaN where blank; of every frame
    """

    rgb: dict[str, np.ndarray]
    valid: dict[str, np.ndarray]
    depth_m: dict[str, np.ndarray]


def move_camera(camera: Camera, scale: float, origin: Sequence[float]) -> Camera:
    """The camera in a world whose points are those of this one times `scale` plus `origin`."""
    center = camera.center * scale + np.asarray(origin, np.float64)
    return dataclasses.replace(camera, t=-camera.R @ center)


@functools.cache
def film_event(scale: float = 1.0, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Filmed:
    """The event in a world of another scale and origin, from its calibration file to its background."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write_films(folder)
        _write_calibration(folder / "calibration.json", scale, origin)
        _place_cameras(folder, scale)
        _match_pairs(folder)
        _fuse_view(folder)
        return _read_views(folder, scale)


def _write_films(folder: Path) -> None:
    tracks = camera_tracks(EVENT)
    for frame, time_s in enumerate(clip_times(EVENT)):
        scene = FrozenScene(float(time_s), EVENT)
        for name in camera_names(EVENT):
            write_png(folder / f"films/{name}/{frame:06d}.png", scene.render(tracks[name].at(frame))[0])
    clock = ["--fps", "30", "--num-frames", str(EVENT.num_frames), "--offset-s=0", "--start-s=0"]
    for name in camera_names(EVENT):
        facts, film = str(folder / f"ingest/{name}.json"), str(folder / f"films/{name}.json")
        source = ["--camera", name, "--source", str(folder / f"films/{name}"), "--fps", "30"]
        ingest([*source, "--output-json", facts, "--output-table", str(folder / f"ingest/{name}.csv")])
        align(["sample", *clock, "--ingest", facts, "--output", film])


def _write_calibration(path: Path, scale: float, origin: Sequence[float]) -> None:
    cameras = {
        name: {
            "size": list(track.size),
            "frames": [move_camera(camera, scale, origin).to_dict() for camera in track.cameras],
        }
        for name, track in camera_tracks(EVENT).items()
    }
    write_json(path, {"cameras": cameras})


def _place_cameras(folder: Path, scale: float) -> None:
    names = camera_names(EVENT)
    near, far = (repr(depth_m * scale) for depth_m in DEPTH_RANGE_M)
    words = ["import", "--calibration", str(folder / "calibration.json"), "--camera", *names, "--films"]
    words += [str(folder / f"films/{name}.json") for name in names]
    words += ["--num-frames", str(EVENT.num_frames), "--fps", "30", "--depth-range", near, far]
    points = str(folder / "points.npz")
    sfm([*words, "--output-cameras", str(folder / "cameras.json"), "--output-points", points])
    frames = map(str, range(EVENT.num_frames))
    words = ["--cameras", str(folder / "cameras.json"), "--view", VIEW, "--frames", *frames]
    views([*words, "--output", str(folder / f"{VIEW}.json")])


def _match_pairs(folder: Path) -> None:
    cameras = ["--cameras", str(folder / "cameras.json")]
    for left, right in itertools.combinations(camera_names(EVENT), 2):
        rectification = str(folder / f"rectification/{left}-{right}.npz")
        stereo(["rectify", *cameras, "--left", left, "--right", right, "--output", rectification])
        films = [f"--left-film={folder}/films/{left}.json", f"--right-film={folder}/films/{right}.json"]
        words = ["disparity", *cameras, *films, "--rectification", rectification, "--first", "0"]
        output = str(folder / f"disparity/{left}-{right}.npz")
        stereo([*words, "--last", str(EVENT.num_frames - 1), "--output", output])


def _fuse_view(folder: Path) -> None:
    disparities = map(str, sorted((folder / "disparity").glob("*.npz")))
    films = [str(folder / f"films/{name}.json") for name in camera_names(EVENT)]
    words = ["--view-file", str(folder / f"{VIEW}.json"), "--cameras", str(folder / "cameras.json")]
    words += ["--frames", *map(str, range(EVENT.num_frames)), "--disparity", *disparities, "--films", *films]
    fuse(["foreground", *words, "--device", "cpu", "--output", str(folder / "foreground.npz")])
    estimate_background([*words, "--output", str(folder / "background.npz")])


def _read_views(folder: Path, scale: float) -> Filmed:
    metres_per_unit = read_json(folder / "cameras.json")["world"]["scale"] / scale
    filmed = Filmed({}, {}, {})
    for stage in ("foreground", "background"):
        archive = Archive(folder / f"{stage}.npz")
        for frame in archive.frames():
            for key, array in archive.frame(frame).items():
                name = f"{stage} {frame} {key.removesuffix('_rgb').removesuffix('_valid')}"
                if key.endswith("_rgb"):
                    filmed.rgb[name] = array
                elif key.endswith("_valid"):
                    filmed.valid[name] = array
                elif key == "depth":
                    filmed.depth_m[name] = array.astype(np.float64) * metres_per_unit
        archive.close()
    return filmed
