"""Inputs of fusion by scene frame: disparities of all pairs, pictures and cameras of that instant."""

import logging
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fourd.camera import Camera
from fourd.errors import InputError, explain_faults
from fourd.fuse.geometry import PairFrame
from fourd.ingest import FrameReader, open_camera
from fourd.io import Archive
from fourd.sfm.cameras import SceneCameras
from fourd.stereo.files import read_disparity_frame

log = logging.getLogger(__name__)

# More open files than this are refused by common limits of 1024 per process.
_OPEN_ARCHIVES = 256
# A virtual camera may come closer to the scene than any that films; a share of the nearest of these.
CLOSER = 0.25


def read_pair_frame(archive: Archive, frame: int) -> PairFrame:
    """One pair at one frame. Raises InputError if the file does not have it."""
    found = read_disparity_frame(archive, frame)
    geometry = found.rectification
    return PairFrame(
        archive.meta["left"], archive.meta["right"], geometry.K_left, geometry.K_right,
        geometry.R_left, geometry.R_right, geometry.center_left, geometry.center_right,
        geometry.disparity_at_infinity, geometry.inverse_depth_per_px, found.left_disparity,
        found.right_disparity, found.left_confidence, found.right_confidence, found.sigma_px,
    )  # fmt: skip


class DisparityFiles:
    """The disparity files of any number of pairs and chunks; opened when a frame is asked for.

    pairs: names `LEFT-RIGHT` that can be used;  refused: pair -> reason
    """

    def __init__(self, paths: Sequence[Path], view: str) -> None:
        """view: pairs with a camera of this name are left out: they know what is to be predicted.

        Raises InputError for a file that is no disparity.
        """
        self.pairs: list[str] = []
        self.refused: dict[str, str] = {}
        self._files: dict[tuple[str, int], Path] = {}
        self._frames: dict[str, set[int]] = {}
        self._open: OrderedDict[Path, Archive] = OrderedDict()
        for path in paths:
            self._index(path, view)

    def _index(self, path: Path, view: str) -> None:
        with Archive(path) as archive, explain_faults(f"a disparity file at {path}"):
            left, right = archive.meta["left"], archive.meta["right"]
            status, frames = archive.meta["status"], archive.frames()
        pair = f"{left}-{right}"
        if view in (left, right):
            self.refused[pair] = f"contains the target camera {view}"
            return
        if status != "ok":
            self.refused[pair] = status
            return
        if pair not in self._frames:
            self.pairs.append(pair)
        self._frames.setdefault(pair, set()).update(frames)
        self._files.update({(pair, frame): path for frame in frames})

    def frames(self) -> list[int]:
        """Scene frames that every usable pair has, rising."""
        return sorted(set.intersection(*self._frames.values())) if self._frames else []

    def read(self, pair: str, frame: int) -> PairFrame:
        """One pair at one scene frame. Raises InputError if no file has it."""
        path = self._files.get((pair, frame))
        if path is None:
            known = sorted(self._frames[pair])
            span = f"frames {known[0]} to {known[-1]}" if known else "no frame"
            raise InputError(
                f"expected the disparity of {pair} at scene frame {frame}, the files given have {span}: "
                "give the chunk that holds it with --disparity"
            )
        if path not in self._open:
            self._open[path] = Archive(path)
            if len(self._open) > _OPEN_ARCHIVES:
                self._open.popitem(last=False)[1].close()
        self._open.move_to_end(path)
        return read_pair_frame(self._open[path], frame)

    def close(self) -> None:
        for archive in self._open.values():
            archive.close()
        self._open.clear()

    def at(self, frame: int, memory_mb: int) -> "PairFrames":
        """All usable pairs at a scene frame, at most `memory_mb` of them kept in memory."""
        return PairFrames(self, frame, memory_mb)


class PairFrames(Sequence[PairFrame]):
    """The usable pairs at one frame, read on access; the first ones are kept as far as memory goes."""

    def __init__(self, files: DisparityFiles, frame: int, memory_mb: int) -> None:
        self._disparities = files
        self._frame = frame
        self._free_bytes = memory_mb * 2**20
        self._kept: dict[int, PairFrame] = {}

    def __len__(self) -> int:
        return len(self._disparities.pairs)

    def __getitem__(self, index):  # type: ignore[override]
        if index not in self._kept:
            pair = self._disparities.read(self._disparities.pairs[index], self._frame)
            size = 2 * (pair.left_disparity.nbytes + pair.left_confidence.nbytes)
            if size > self._free_bytes:
                return pair
            self._free_bytes -= size
            self._kept[index] = pair
        return self._kept[index]


class Pictures:
    """Original pictures and cameras of the input cameras by scene frame."""

    def __init__(self, films: Sequence[str], scene: SceneCameras, exclude: str) -> None:
        """films: paths of frames/cameras/{cam}.npz, or CAMERA=PATH;  exclude: the target camera's name.

        Raises InputError for a camera that is not calibrated.
        """
        self._scene = scene
        self._readers: dict[str, FrameReader] = {}
        for entry in films:
            # A path may hold an equals sign too.
            name, _, path = ("", "", entry) if Path(entry).exists() else entry.partition("=")
            reader = open_camera(path)
            name = name or reader.camera
            if name != exclude and name not in scene.left_out:
                self._readers[name] = reader
        unknown = [name for name in self._readers if name not in scene.tracks]
        if unknown:
            raise InputError(
                f"expected calibrated cameras {', '.join(scene.tracks)}, got pictures of "
                f"{', '.join(unknown)}: calibrate them or leave them out"
            )
        # The scene's order, whatever the order of arguments: ties between cameras are broken by it.
        self.names = tuple(name for name in scene.tracks if name in self._readers)

    def at(self, frame: int) -> tuple[Mapping[str, np.ndarray], Mapping[str, Camera]]:
        """name -> (H, W, 3) uint8 RGB and name -> Camera, at a scene frame."""
        images = {name: self._readers[name].read(frame) for name in self.names}
        return images, {name: self._scene.tracks[name].at(frame) for name in self.names}

    def close(self) -> None:
        for reader in self._readers.values():
            reader.close()


class Silhouettes:
    """Silhouettes of the input cameras by scene frame.

    status: camera -> why it has none
    """

    def __init__(self, paths: Sequence[Path], exclude: str) -> None:
        """paths: silhouettes/{chunk}.npz;  exclude: the target camera's name.

        Raises InputError for a file that holds no silhouettes.
        """
        self.status: dict[str, str] = {}
        self._archives: list[tuple[Archive, list[str], frozenset[int]]] = []
        for path in paths:
            archive = Archive(path)
            cameras = archive.meta.get("cameras")
            if not isinstance(cameras, dict):
                raise InputError(
                    f"expected silhouettes at {path}, its meta lacks `cameras`: delete it and run again"
                )
            self.status |= {name: status for name, status in cameras.items() if status != "ok"}
            names = [name for name, status in cameras.items() if status == "ok" and name != exclude]
            self._archives.append((archive, names, frozenset(archive.frames())))

    def at(self, frame: int) -> dict[str, np.ndarray]:
        """name -> (H, W) uint8 mask, 255 moving, 0 background, 128 unknown, at a scene frame."""
        for archive, names, frames in self._archives:
            if frame in frames:
                return {name: archive.read(f"{frame:06d}/{name}", np.uint8, (None, None)) for name in names}
        return {}

    def close(self) -> None:
        for archive, _, _ in self._archives:
            archive.close()


def hull_depth_range(scene: SceneCameras) -> tuple[float, float]:
    """Depths that a hull is looked for at, world units: it has no far end of its own."""
    return CLOSER * min(track.near for track in scene.tracks.values()), float("inf")


class Progress:
    """A log line per finished item with the time that is left."""

    def __init__(self, what: str, total: int, clock) -> None:
        self._what, self._total, self._clock = what, total, clock
        self._start = clock()
        self._done = 0

    def step(self, text: str) -> None:
        """One more item is done."""
        self._done += 1
        spent = self._clock() - self._start
        left = spent / self._done * (self._total - self._done)
        log.info("%s %d of %d, %s, %.0f s left", self._what, self._done, self._total, text, left)
