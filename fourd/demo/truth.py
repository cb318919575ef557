"""Everything that is known about the event: cameras, depth, labels, clocks, a frozen-time orbit."""

import dataclasses
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from fourd.camera import Camera
from fourd.demo.cameras import camera_at, camera_tracks, clip_times, middle_time, orbit_cameras
from fourd.demo.figures import BALL_RADIUS, LABELS, SPEED_M_S, ball_center
from fourd.demo.options import DemoOptions, camera_names
from fourd.demo.phones import CLAP_POSITION, SOUND_M_S, clap_times, make_phone
from fourd.demo.place import MIRROR_CENTER, MIRROR_RADIUS, PARASOL, SUN
from fourd.demo.render import FrozenScene
from fourd.errors import InputError
from fourd.io import ArchiveWriter, atomic_folder, write_json, write_png

log = logging.getLogger(__name__)

PARTS = ("phones", "depth", "labels", "orbit", "scene")


def write_camera_frames(
    output: Path | str, name: str, options: DemoOptions, without: Sequence[int] = ()
) -> None:
    """Render the synchronised frames of one camera to OUTPUT/000000.png ...; the folder appears whole.

    without: labels left out of the scene, with their shadows
    """
    with atomic_folder(output) as folder:
        for frame, time_s in enumerate(clip_times(options)):
            scene = FrozenScene(float(time_s), options, without)
            write_png(folder / f"{frame:06d}.png", scene.render(camera_at(name, float(time_s), options))[0])
            log.info("%s: frame %d of %d", name, frame + 1, options.num_frames)


def write_camera_labels(
    output: Path | str, name: str, options: DemoOptions, without: Sequence[int] = (), of_phone: bool = False
) -> None:
    """Write what moves in the frames of one camera to OUTPUT/000000.png ... (0 static).

    of_phone: the frames are those of the phone's film instead of the synchronised ones
    """
    with atomic_folder(output) as folder:
        for frame, (_, labels) in enumerate(_trace_frames(name, options, without, of_phone)):
            write_png(folder / f"{frame:06d}.png", labels)


def write_camera_depths(
    output: Path | str, name: str, options: DemoOptions, without: Sequence[int] = (), of_phone: bool = False
) -> None:
    """Write the depth of one camera's frames to OUTPUT/000000.npz ...: `z`, metres, infinite in the sky.

    of_phone: as for the labels
    """
    with atomic_folder(output) as folder:
        for frame, (depth, _) in enumerate(_trace_frames(name, options, without, of_phone)):
            with ArchiveWriter(folder / f"{frame:06d}.npz") as archive:
                archive.add("z", depth)


def _trace_frames(
    name: str, options: DemoOptions, without: Sequence[int], of_phone: bool
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(H, W) depth, metres, and (H, W) uint8 labels of each frame of one camera."""
    for time_s in make_phone(name, options).frame_times if of_phone else clip_times(options):
        yield FrozenScene(float(time_s), options, without).trace(camera_at(name, float(time_s), options))


def write_cameras(output: Path | str, options: DemoOptions) -> None:
    """Write all cameras of the synchronised frames in the native calibration format."""
    tracks = camera_tracks(options)
    cameras = {
        name: {"size": list(track.size), "frames": [camera.to_dict() for camera in track.cameras]}
        for name, track in tracks.items()
    }
    write_json(output, {"fps": options.fps, "cameras": cameras})


def write_truth(
    output: Path | str,
    options: DemoOptions,
    parts: Sequence[str] = PARTS,
    frames: Sequence[int] | None = None,
    without: Sequence[int] = (),
) -> None:
    """Write the chosen parts of the truth below a folder.

    frames: synchronised frames that get depth and labels, all when None
    Raises InputError for an unknown part or a frame outside the clip.
    """
    unknown = [part for part in parts if part not in PARTS]
    if unknown:
        raise InputError(f"expected parts among {', '.join(PARTS)}, got {unknown[0]!r}: correct --only")
    chosen = list(range(options.num_frames)) if frames is None else list(frames)
    outside = [frame for frame in chosen if not 0 <= frame < options.num_frames]
    if outside:
        raise InputError(f"expected frames 0..{options.num_frames - 1}, got {outside[0]}: correct --frames")
    folder = Path(output)
    if "phones" in parts:
        write_json(folder / "phones.json", describe_phones(options))
    if "scene" in parts:
        write_json(folder / "scene.json", describe_scene(options))
    if "depth" in parts or "labels" in parts:
        _write_maps(folder, options, parts, chosen, without)
    if "orbit" in parts:
        _write_orbit(folder, options, without)


def _write_maps(
    folder: Path, options: DemoOptions, parts: Sequence[str], frames: Sequence[int], without: Sequence[int]
) -> None:
    for frame in frames:
        time_s = float(clip_times(options)[frame])
        scene = FrozenScene(time_s, options, without)
        for name in camera_names(options):
            depth, labels = scene.trace(camera_at(name, time_s, options))
            if "depth" in parts:
                with ArchiveWriter(folder / "depth" / name / f"{frame:06d}.npz") as archive:
                    archive.add("z", depth)
            if "labels" in parts:
                write_png(folder / "labels" / name / f"{frame:06d}.png", labels)
        log.info("depth and labels: frame %d", frame)


def _write_orbit(folder: Path, options: DemoOptions, without: Sequence[int]) -> None:
    scene = FrozenScene(middle_time(options), options, without)
    cameras = orbit_cameras(options)
    with atomic_folder(folder / "orbit") as orbit:
        for view, camera in enumerate(cameras):
            write_png(orbit / f"{view:06d}.png", scene.render(camera)[0])
            log.info("orbit: view %d of %d", view + 1, len(cameras))
    document = {"time_s": middle_time(options), "size": list(cameras[0].size)}
    write_json(folder / "orbit_cameras.json", {**document, "frames": [c.to_dict() for c in cameras]})


def describe_phones(options: DemoOptions) -> dict:
    """Clock, frame rate and true camera of every phone frame; claps. JSON form of phones.json."""
    phones = {}
    for name in camera_names(options):
        phone = make_phone(name, options)
        cameras: list[Camera] = [camera_at(name, float(t), options) for t in phone.frame_times]
        phones[name] = {
            "start_time_s": phone.start_time_s,
            "fps": phone.fps,
            "num_frames": phone.num_frames,
            "gain": phone.gain,
            "frames": [camera.to_dict() for camera in cameras],
        }
    return {
        "time": "event time in seconds, 0 = synchronised frame 0; phone frame n is at start_time_s + n / fps",
        "clap_times_s": clap_times(options).tolist(),
        "clap_position": CLAP_POSITION.tolist(),
        "sound_m_s": SOUND_M_S,
        "phones": phones,
    }


def describe_scene(options: DemoOptions) -> dict:
    """Parameters of the event. JSON form of scene.json."""
    return {
        "options": dataclasses.asdict(options),
        "units": "metres, z up",
        "labels": {"static": 0, **LABELS},
        "sun": SUN.tolist(),
        "figure_speed_m_s": SPEED_M_S,
        "ball_radius": BALL_RADIUS,
        "ball_center": [ball_center(float(t)).tolist() for t in clip_times(options)],
        "textureless": {"what": "parasol", "axis_xy": list(PARASOL), "z": [1.98, 2.48]},
        "shiny": {"what": "steel sphere", "center": list(MIRROR_CENTER), "radius": MIRROR_RADIUS},
        "crossing_time_s": middle_time(options),
    }
