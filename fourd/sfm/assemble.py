"""From calibration files to the scene's cameras: names, frames, sizes, every check."""

import dataclasses
import logging
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fourd.camera import Camera, check_camera, folded_share
from fourd.errors import InputError, explain_faults
from fourd.film_cameras import FilmCamera, FilmCameras
from fourd.ingest import read_ingest
from fourd.io import read_json
from fourd.sfm.importers import DepthBounds, ImportedCameras

log = logging.getLogger(__name__)

MAX_ASPECT_DIFFERENCE = 0.005


@dataclasses.dataclass(frozen=True)
class IngestedCamera:
    """What the frames of a camera say.

    size: (width, height) px;  source_frame: the source frame that each scene frame shows
    file_numbers: number in the name of each source image, none for a video
    status: `ok`, or why the camera has no place on the common clock
    """

    path: Path
    size: tuple[int, int]
    num_source_frames: int
    source_frame: tuple[int, ...]
    file_numbers: tuple[int, ...] = ()
    status: str = "ok"


def read_ingested(path: Path | str) -> IngestedCamera:
    """Read what is needed here of align/cameras/{cam}.json. Raises InputError for missing entries."""
    document = read_json(path)
    with explain_faults(f"status, source_frame and the ingest document of the align stage in {path}"):
        ingest = document["ingest"]
        size = (int(ingest["size"][0]), int(ingest["size"][1]))
        frames = tuple(int(frame) for frame in document["source_frame"])
        count = int(ingest["num_source_frames"])
        numbers = _file_numbers(ingest["files"])
        return IngestedCamera(Path(path), size, count, frames, numbers, str(document["status"]))


def _file_numbers(files: Sequence[str]) -> tuple[int, ...]:
    """The last number in the name of every image; none unless all have one."""
    digits = [re.findall(r"\d+", Path(file).stem) for file in files]
    return tuple(int(d[-1]) for d in digits) if all(digits) else ()


@dataclasses.dataclass(frozen=True, eq=False)
class SelectedCameras:
    """Cameras of the scene, still in the calibration's world.

    tracks: name -> one camera or one per scene frame;  points: (N, 3) seen by input cameras only
    """

    tracks: dict[str, tuple[Camera, ...]]
    bounds: dict[str, DepthBounds]
    points: np.ndarray
    up: np.ndarray | None


def split_cameras(names: Sequence[str], heldout: Sequence[str]) -> tuple[str, ...]:
    """Names of the input cameras. Raises InputError for unknown held-out names or under 2 inputs."""
    unknown = [name for name in heldout if name not in names]
    if unknown:
        raise InputError(
            f"heldout: expected names of the scene's cameras ({', '.join(names) or 'there are none'}), got "
            f"{', '.join(unknown)}: correct heldout in the scene file"
        )
    inputs = tuple(name for name in names if name not in heldout)
    if len(inputs) < 2:
        got = "0" if not inputs else f"1 ({inputs[0]})"
        raise InputError(
            f"expected at least 2 input cameras besides the {len(heldout)} held out, got {got}: depth needs "
            "two views; add cameras to the scene file or hold out fewer"
        )
    return inputs


def select_cameras(
    calibrations: Sequence[ImportedCameras],
    names_in_file: Mapping[str, str],
    inputs: Sequence[str],
    ingested: Mapping[str, IngestedCamera],
    num_frames: int,
) -> SelectedCameras:
    """The scene's cameras, at the size of their frames and one pose per scene frame.

    names_in_file: camera name -> its name in the calibration, in the scene's order
    Raises InputError, with file and camera, for whatever does not fit together.
    """
    found = _find_cameras(calibrations, names_in_file)
    tracks, bounds = {}, {}
    for name, (calibration, name_in_file) in found.items():
        where = f"{calibration.path}, camera {name_in_file}"
        cameras = calibration.cameras[name_in_file]
        for i, camera in enumerate(cameras):
            check_camera(camera, where if len(cameras) == 1 else f"{where}, frame {i}")
        folded = folded_share(cameras[0])
        if folded > 0:
            log.warning(
                "%s: the lens folds back in %.1f %% of the picture, and depth there is wrong: fewer "
                "coefficients would give every pixel a ray", where, 100 * folded,
            )  # fmt: skip
        cameras = _at_scene_frames(calibration, name_in_file, ingested[name], num_frames, where)
        tracks[name] = tuple(_at_size(camera, ingested[name], where) for camera in cameras)
        if name_in_file in calibration.bounds:
            bounds[name] = calibration.bounds[name_in_file]
    inputs_in_file = {names_in_file[name] for name in inputs}
    points = [_points_of_inputs(calibration, inputs_in_file) for calibration in calibrations]
    up = next((c.up for c in calibrations if c.up is not None), None)
    return SelectedCameras(tracks, bounds, np.concatenate(points), up)


def _find_cameras(
    calibrations: Sequence[ImportedCameras], names_in_file: Mapping[str, str]
) -> dict[str, tuple[ImportedCameras, str]]:
    found: dict[str, tuple[ImportedCameras, str]] = {}
    for name, name_in_file in names_in_file.items():
        holders = [c for c in calibrations if name_in_file in c.cameras]
        files = ", ".join(str(c.path) for c in (holders or calibrations))
        if not holders:
            known = sorted({known for c in calibrations for known in c.cameras})
            more = f" and {len(known) - 30} more" if len(known) > 30 else ""
            shown = f"only {', '.join(known[:30])}{more}" if known else "no camera"
            raise InputError(
                f"camera {name}: expected {name_in_file!r} in {files}, found {shown}: "
                "set calibration_name in the scene file"
            )
        if len(holders) > 1:
            raise InputError(
                f"camera {name}: expected {name_in_file!r} in one file, got it in {files}: take it "
                "out of the others"
            )
        sharers = [n for n, other in found.items() if other == (holders[0], name_in_file)]
        if sharers:
            raise InputError(
                f"cameras {sharers[0]} and {name} are both {name_in_file!r} in {files}: give each its own "
                "calibration_name in the scene file"
            )
        found[name] = (holders[0], name_in_file)
    return found


def find_left_out(
    calibrations: Sequence[ImportedCameras],
    names_in_file: Mapping[str, str],
    ingested: Mapping[str, IngestedCamera],
) -> dict[str, str]:
    """Cameras that a stage above has given up, and why: no pose or no place on the clock."""
    reasons: dict[str, str] = {}
    for name, name_in_file in names_in_file.items():
        stated = [c.left_out[name_in_file] for c in calibrations if name_in_file in c.left_out]
        if ingested[name].status != "ok":
            stated.append(ingested[name].status)
        if stated:
            reasons[name] = stated[0]
            log.warning("camera %s is left out: %s", name, stated[0])
    return reasons


def check_inputs_left(
    names: Sequence[str] | Mapping[str, str], heldout: Sequence[str], left_out: Mapping[str, str]
) -> tuple[str, ...]:
    """Names of the input cameras that remain. Raises InputError, with the reasons, under two."""
    inputs = tuple(name for name in names if name not in heldout)
    if len(inputs) < 2:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise InputError(
            f"expected at least 2 input cameras, but {len(inputs)} of them remain ({reasons}): replace these "
            "films or take others"
        )
    return inputs


def film_cameras_of(
    calibrations: Sequence[ImportedCameras],
    names_in_file: Mapping[str, str],
    heldout: Sequence[str],
    ingest_paths: Mapping[str, Path],
) -> FilmCameras:
    """Known cameras over the films' own frames and at their sizes; what is left out stays out.

    Raises InputError for whatever does not fit together.
    """
    left_out = {
        name: c.left_out[given]
        for name, given in names_in_file.items()
        for c in calibrations
        if given in c.left_out
    }
    found = _find_cameras(calibrations, {n: g for n, g in names_in_file.items() if n not in left_out})
    films = {}
    for name, path in ingest_paths.items():
        document = read_ingest(path)
        size = (int(document["size"][0]), int(document["size"][1]))
        if name in left_out:
            films[name] = FilmCamera(name, size, np.zeros(0, np.int64), (), status=left_out[name])
            continue
        calibration, given = found[name]
        where = f"{calibration.path}, camera {given}"
        count = int(document["num_source_frames"])
        film = IngestedCamera(path, size, count, tuple(range(count)), _file_numbers(document["files"]))
        films[name] = _film_camera(name, calibration, given, film, where)
    inputs_in_file = {given for name, given in names_in_file.items() if name not in heldout}
    points = [_points_of_inputs(calibration, inputs_in_file) for calibration in calibrations]
    return FilmCameras(
        films,
        np.concatenate(points),
        next((c.up for c in calibrations if c.up is not None), None),
        next((c.metres_per_unit for c in calibrations if c.metres_per_unit is not None), None),
        tuple(note for calibration in calibrations for note in calibration.notes),
    )


def _film_camera(
    name: str, calibration: ImportedCameras, given: str, film: IngestedCamera, where: str
) -> FilmCamera:
    cameras, frames = calibration.cameras[given], np.arange(film.num_source_frames)
    for camera in cameras:
        check_camera(camera, where)
    if calibration.has_film_frames and given in calibration.image_numbers and len(cameras) > 1:
        frames = np.array(calibration.image_numbers[given], dtype=np.int64)
        if frames[-1] >= film.num_source_frames:
            raise InputError(
                f"{where}: expected poses of frames below {film.num_source_frames}, which the film of "
                f"{film.path} has, got one of frame {frames[-1]}: take the film that was calibrated"
            )
    elif len(cameras) > 1:
        cameras = _at_scene_frames(calibration, given, film, film.num_source_frames, where)
    is_static = len(cameras) == 1
    fitted = tuple(_at_size(camera, film, where) for camera in cameras)
    return FilmCamera(name, film.size, frames[: len(cameras)], fitted, is_static)


def _at_scene_frames(
    calibration: ImportedCameras,
    name: str,
    ingested: IngestedCamera,
    num_frames: int,
    where: str,
) -> tuple[Camera, ...]:
    """One camera, or one per scene frame.

    A list has one pose per frame of the camera's own film, so a scene frame takes the pose of the
    source frame that it shows. A list of exactly num_frames poses beside a film of another length
    is on the scene's clock already.
    """
    cameras, numbers = calibration.cameras[name], calibration.image_numbers.get(name)
    if len(ingested.source_frame) < num_frames:
        raise InputError(
            f"{ingested.path}: expected {num_frames} scene frames, got {len(ingested.source_frame)}: shorten "
            "num_frames in the scene file or run ingest again"
        )
    if len(cameras) == 1:
        return cameras
    wanted: Sequence[int] = ingested.source_frame[:num_frames]
    if numbers is None:
        numbers = tuple(range(len(cameras)))
        if len(cameras) == num_frames != ingested.num_source_frames:
            wanted = range(num_frames)
    elif calibration.has_film_frames:
        pass
    elif ingested.file_numbers:
        wanted = [ingested.file_numbers[frame] for frame in wanted]
    elif numbers[0] != 0:
        # Frames that were taken out of a video are numbered from 0 or from 1.
        log.info(
            "%s: images are numbered from %d; number 1 is taken as the film's first frame", where, numbers[0]
        )
        wanted = [frame + 1 for frame in wanted]
    by_number = dict(zip(numbers, cameras, strict=True))
    missing = [number for number in wanted if number not in by_number]
    if missing:
        raise InputError(
            f"{where}: expected a pose for each of {num_frames} frames, got {len(cameras)} poses and none "
            f"for the camera's frame {missing[0]}: calibrate all frames, shorten num_frames in the scene "
            "file, or give one pose if the camera stands still"
        )
    chosen = tuple(by_number[number] for number in wanted)
    return chosen[:1] if all(_is_same(chosen[0], camera) for camera in chosen) else chosen


def _is_same(a: Camera, b: Camera) -> bool:
    return a.size == b.size and all(
        np.array_equal(getattr(a, key), getattr(b, key)) for key in ("K", "R", "t", "distortion")
    )


def _at_size(camera: Camera, ingested: IngestedCamera, where: str) -> Camera:
    """The camera at the size of its frames; they may be smaller copies of the calibrated images."""
    if camera.size == ingested.size:
        return camera
    (width, height), (got_width, got_height) = camera.size, ingested.size
    if abs(got_width * height / (got_height * width) - 1) > MAX_ASPECT_DIFFERENCE:
        raise InputError(
            f"{where}: calibrated at {width}x{height}, but the frames of {ingested.path} are "
            f"{got_width}x{got_height}, another shape: crop or rotate the frames as for the calibration, or "
            "calibrate again"
        )
    return camera.resized(ingested.size)


def _points_of_inputs(calibration: ImportedCameras, inputs_in_file: set[str]) -> np.ndarray:
    """(N, 3) the calibration's points that at least two images of input cameras saw."""
    if calibration.points is None:
        return np.zeros((0, 3))
    if not calibration.num_observations:
        return calibration.points
    seen = np.zeros(len(calibration.points), dtype=np.int64)
    for name, counts in calibration.num_observations.items():
        if name in inputs_in_file:
            seen += counts
    return calibration.points[seen >= 2]
