"""All that is known about a held-out view, frame by frame: what methods may use, and the truth."""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from fourd.baselines import METHODS, Evidence, InputPicture
from fourd.baselines.evidence import surface_depth
from fourd.baselines.nearest import FALLBACK_FEATURE, NETWORK_FEATURE, FilmIndex, describe_image
from fourd.camera import Camera
from fourd.config import spread_frames
from fourd.errors import InputError
from fourd.evaluate import EvaluateOptions
from fourd.evaluate.depth import CONSENSUS, SURFACE, fit_scale, read_true_depth
from fourd.evaluate.people import read_people, see_input
from fourd.evaluate.regions import StillPicture, find_dynamic_pixels, read_dynamic_mask
from fourd.image import undistort
from fourd.ingest import open_camera
from fourd.io import Archive, read_image
from fourd.metrics_lpips import load_network, missing_weights
from fourd.render import BackgroundReader, list_frames, read_arrays
from fourd.sfm import SceneCameras, read_cameras
from fourd.views import View, ViewFrame, read_view

FOREGROUND_KEYS = ("consensus_rgb", "consensus_valid", "depth", "num_cameras")
BACKGROUND_KEYS = ("farthest_rgb", "farthest_valid", "depth", "filled")
STILL_FRAMES = 15
# Columns of the contact sheet and rows of the table that are no methods.
RESERVED_NAMES = ("truth", "error", "masks", CONSENSUS, SURFACE)


@dataclasses.dataclass(frozen=True)
class Sources:
    """Files of one held-out camera (docs/formats.md); `films` maps camera names to their files.

    labels: folder of its true masks;  points: sfm/points.npz, without which there are no sparse points
    people: of `fourd.evaluate.people`
    is_recovered: cameras were found from the films alone, so the unit of depth is not known
    """

    view: Path
    cameras: Path
    films: Mapping[str, Path]
    rendered: tuple[Path, ...]
    foreground: tuple[Path, ...]
    background: tuple[Path, ...]
    labels: Path | None = None
    points: Path | None = None
    people: Path | None = None
    is_recovered: bool = False


class EvidenceReader:
    """All that is known about one held-out view, frame by frame. Close after use."""

    def __init__(self, sources: Sources, options: EvaluateOptions | None = None) -> None:
        self.view = read_view(sources.view)
        self._options = EvaluateOptions() if options is None else options
        self._scene = read_cameras(sources.cameras)
        _check_heldout(self.view, self._scene, sources)
        self._labels = sources.labels
        self._is_recovered = sources.is_recovered
        self._people, self._no_people = read_people(sources.people, self._options.humans)
        self._points = _read_points(sources.points)
        self.others = _list_others(self._options.other, self.view)
        self._readers = {
            name: open_camera(sources.films[name]) for name in (self.view.name, *self._scene.inputs)
        }
        self._rendered = list_frames(sources.rendered)
        self._archives = [Archive(path) for path in (*sources.foreground, *sources.background)]
        self._foreground: dict[int, Archive] = {}
        self._background: dict[int, BackgroundReader] = {}
        for archive in self._archives[: len(sources.foreground)]:
            self._foreground |= dict.fromkeys(archive.frames(), archive)
        for archive in self._archives[len(sources.foreground) :]:
            reader = BackgroundReader(archive, BACKGROUND_KEYS)
            self._background |= dict.fromkeys(reader.frames(), reader)
        self._still = self._make_still_picture()

    def close(self) -> None:
        for resource in (*self._readers.values(), *self._archives):
            resource.close()

    def read(self, entry: ViewFrame) -> tuple[Evidence, np.ndarray]:
        """What the methods may use for one frame, and (H, W) bool where the truth was filmed."""
        frame = entry.frame
        for found, what in (
            (self._rendered, "--rendered"),
            (self._foreground, "--foreground"),
            (self._background, "--background"),
        ):
            if frame not in found:
                raise InputError(
                    f"view {self.view.name}: expected frame {frame} in the files of {what}, found none: "
                    "give the files of all chunks"
                )
        truth, valid = self._see_truth(entry)
        foreground = read_arrays(self._foreground[frame], frame, FOREGROUND_KEYS)
        background = self._background[frame].read(frame)
        rendered = read_image(self._rendered[frame])
        for image in (foreground["consensus_rgb"], background["farthest_rgb"], rendered):
            if image.shape != truth.shape:
                raise InputError(
                    f"view {self.view.name}, frame {frame}: expected pictures of {self.view.size} px, got "
                    f"{image.shape[1::-1]}: delete the older results and run again"
                )
        return Evidence(
            foreground,
            background,
            rendered,
            {name: self._input_picture(name, entry.scene_frame) for name in self._scene.inputs},
            truth,
            entry.camera,
            self._points,
            self.films,
            self._describe(truth),
            {name: read_image(files[frame]) for name, files in self.others.items()},
            None if self._no_people else self._people.get(entry.scene_frame),
            self._no_people or f"nobody was looked for at frame {entry.scene_frame}",
            self._options.humans,
        ), valid

    def read_moves(self, entry: ViewFrame) -> np.ndarray | None:
        """(H, W) bool, where something moves by the true masks; None without them."""
        if self._labels is None:
            return None
        camera = self._scene.tracks[self.view.name].at(entry.scene_frame)
        shown = self._readers[self.view.name].source_frame(entry.scene_frame)
        return read_dynamic_mask(self._labels, shown, camera, entry.camera)

    def read_depth(self, entry: ViewFrame) -> np.ndarray | None:
        """(H, W) float32 true z in world units, NaN where nobody knows; None where the frame has none."""
        true = self._read_true_depth(entry)
        return None if true is None else true / np.float32(self._depth_unit)

    def _read_true_depth(self, entry: ViewFrame) -> np.ndarray | None:
        if not self._options.depths:
            return None
        camera = self._scene.tracks[self.view.name].at(entry.scene_frame)
        shown = self._readers[self.view.name].source_frame(entry.scene_frame)
        return read_true_depth(Path(self._options.depths) / self.view.name, shown, camera, entry.camera)

    @functools.cached_property
    def _depth_unit(self) -> float:
        """Units of the true depth in a world unit: the calibration's, or those that fit best."""
        return fit_scale(self._depth_pairs()) if self._is_recovered else self._scene.scale

    def _depth_pairs(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for entry in self.view.frames:
            true = self._read_true_depth(entry)
            if true is not None:
                keys = ("consensus_valid", "depth")
                foreground = read_arrays(self._foreground[entry.frame], entry.frame, keys)
                yield surface_depth(foreground, self._background[entry.frame].read(entry.frame)), true

    def find_moves(self, entry: ViewFrame, evidence: Evidence) -> np.ndarray:
        """(H, W) bool, where something moves by what no still picture explains."""
        background = evidence.background
        pictures = [(background["farthest_rgb"], background["farthest_valid"])]
        if self._still is not None:
            pictures.append(self._still.seen_from(entry.camera))
        return find_dynamic_pixels(evidence.truth, pictures, self._options)

    @property
    def region_source(self) -> str:
        """Where the dynamic region comes from: `truth` or `pipeline`."""
        return "pipeline" if self._labels is None else "truth"

    def dt_s(self, entry: ViewFrame) -> float:
        """When the true picture was taken after the moment that is rendered, seconds."""
        return self._readers[self.view.name].dt_s(entry.scene_frame)

    def _make_still_picture(self) -> StillPicture | None:
        """None where there are too few frames for a median to leave out what moves."""
        frames = spread_frames(self._scene.num_frames, STILL_FRAMES)
        if len(frames) < 3:
            return None
        name = self.view.name
        return StillPicture([(self._readers[name].read(f), self._scene.tracks[name].at(f)) for f in frames])

    @functools.cached_property
    def films(self) -> FilmIndex:
        """Features of all inputs at the evaluated frames and at others, evenly spread over the event."""
        frames = {entry.scene_frame for entry in self.view.frames}
        frames |= set(spread_frames(self._scene.num_frames, self._options.neighbour_frames))
        keys = [(name, frame) for name in self._scene.inputs for frame in sorted(frames)]
        features = np.stack([self._describe(self._see_input(*key)[0]) for key in keys])
        has_network = missing_weights(self._options.lpips_weights, "alex") is None
        feature_name = NETWORK_FEATURE if has_network else FALLBACK_FEATURE
        return FilmIndex(keys, features, lambda name, frame: self._see_input(name, frame)[0], feature_name)

    @functools.cached_property
    def _describe(self) -> Callable[[np.ndarray], np.ndarray]:
        if missing_weights(self._options.lpips_weights, "alex") is not None:
            return describe_image
        return load_network(self._options.lpips_weights, "alex").describe

    def _input_picture(self, name: str, scene_frame: int) -> InputPicture:
        image, valid, camera = self._see_input(name, scene_frame)
        return InputPicture(image, valid, camera, self.films.feature_of(name, scene_frame))

    def _see_truth(self, entry: ViewFrame) -> tuple[np.ndarray, np.ndarray]:
        # The truth is what was filmed: nothing in it is moved to the common time.
        name = self.view.name
        image = self._readers[name].read(entry.scene_frame, is_compensated=False)
        return undistort(image, self._scene.tracks[name].at(entry.scene_frame), entry.camera)

    def _see_input(self, name: str, scene_frame: int) -> tuple[np.ndarray, np.ndarray, Camera]:
        return see_input(self._readers[name], self._scene, name, scene_frame, self.view.size)


def _read_points(path: Path | None) -> np.ndarray:
    """(N, 3) float64 sparse points, none without a file."""
    if path is None:
        return np.zeros((0, 3))
    archive = Archive(path)
    try:
        return archive["points"].astype(np.float64)
    finally:
        archive.close()


def _list_others(words: tuple[str, ...], view: View) -> dict[str, dict[int, Path]]:
    """Frames of other programs by method and output frame.

    words: `NAME=FOLDER`, with `FOLDER/CAMERA/000012.png`
    Raises InputError for a word of another form, a name in use, or a frame that is missing or of
    another size.
    """
    others: dict[str, dict[int, Path]] = {}
    for word in words:
        name, _, folder = word.partition("=")
        if not name or not folder or name in (*METHODS, *RESERVED_NAMES, *others):
            raise InputError(
                f"evaluate other: expected NAME=FOLDER with a new name, got {word!r}; names in use are "
                f"{', '.join([*METHODS, *RESERVED_NAMES, *others])}"
            )
        files = list_frames([Path(folder) / view.name])
        for entry in view.frames:
            if entry.frame not in files:
                path = Path(folder) / view.name / f"{entry.frame:06d}.png"
                raise InputError(
                    f"evaluate other {name}: expected every evaluated frame of {view.name}, but {path} is "
                    "missing: render it with that program"
                )
            size = read_image(files[entry.frame]).shape[1::-1]
            if size != view.size:
                raise InputError(
                    f"evaluate other {name}: expected pictures of {view.size} px, got {size} in "
                    f"{files[entry.frame]}: render at the size of the view"
                )
        others[name] = files
    return others


def _check_heldout(view: View, scene: SceneCameras, sources: Sources) -> None:
    if view.role != "heldout" or view.name not in scene.heldout:
        raise InputError(
            f"{sources.view}: expected the view of a held-out camera ({', '.join(scene.heldout) or 'none'}), "
            f"got {view.name} with role {view.role}: a camera that the result is made from proves nothing"
        )
    missing = [name for name in (view.name, *scene.inputs) if name not in sources.films]
    if missing:
        raise InputError(f"expected camera {missing[0]} in --films, got {', '.join(sources.films)}: add it")
