"""Frames of the scene as edits read them: ideal pinholes, depths, and what moves."""

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fourd.camera import Camera
from fourd.edit.carry import Instant
from fourd.edit.moving import find_moving, times_to_compare
from fourd.errors import InputError
from fourd.fuse.files import Pictures
from fourd.image import undistort
from fourd.io import Archive
from fourd.sfm.cameras import SceneCameras

# Of the sampled times, every so many-th is asked in all cameras, not only in the own one.
_ALL_CAMERAS_EVERY = 3
_RECENT = 3


class Instants:
    """Loads the instants of a scene."""

    def __init__(
        self, scene: SceneCameras, films: Sequence[str], depths: Sequence[Path], num_times: int
    ) -> None:
        """films: frames/cameras/{cam}.npz;  depths: edit/depth/{chunk}.npz of the whole clip

        Raises InputError where a depth is missing.
        """
        self._scene = scene
        self._pictures = Pictures(films, scene, "")
        self._depths = {frame: archive for archive in map(Archive, depths) for frame in archive.frames()}
        self.frames = sorted(self._depths)
        self.names = self._pictures.names
        if not self.frames:
            raise InputError("expected depths of at least one frame to carry a mark through, got none")
        self._times = [self.frames[i] for i in times_to_compare(-1, len(self.frames), num_times)]
        self._sampled: dict[tuple[str, int], np.ndarray] = {}
        kept = len(self._times) + _RECENT
        self._pictures_at = functools.lru_cache(kept)(self._pictures_uncached)
        self._moving = functools.lru_cache(kept * len(self.names))(self._moving_uncached)

    def close(self) -> None:
        """Let go of the films and files."""
        self._pictures.close()
        for archive in set(self._depths.values()):
            archive.close()

    def camera(self, name: str, frame: int) -> Camera:
        """The ideal pinhole of a camera at a frame."""
        return self._scene.tracks[name].at(frame).without_distortion()

    @property
    def times(self) -> list[int]:
        """The sampled frames."""
        return list(self._times)

    def pinholes(self, frame: int) -> tuple[dict[str, Camera], dict[str, np.ndarray]]:
        """Ideal pinholes of all cameras at a frame, and what they see, (H, W, 3) uint8."""
        images, cameras = self._pictures_at(frame)
        return cameras, images

    def depth(self, name: str, frame: int) -> np.ndarray:
        """(H, W) float32 z. Raises InputError if no file has the frame."""
        if frame not in self._depths:
            raise InputError(f"expected the depths of frame {frame}, the files given have {self.frames}")
        return self._depths[frame][f"{frame:06d}/{name}"]

    def at(self, frame: int) -> Instant:
        """Everything about one frame."""
        images, cameras = self._pictures_at(frame)
        depths = {name: self.depth(name, frame) for name in self.names}
        told = {name: self._moving(name, frame) for name in self.names}
        return Instant(
            cameras, images, depths,
            {name: moving for name, (moving, _) in told.items()},
            {name: untold for name, (_, untold) in told.items()},
            {name: self.still(name, frame) for name in self.names},
        )  # fmt: skip

    def still(self, name: str, frame: int) -> list[tuple[Camera, np.ndarray, np.ndarray]]:
        """What a camera films at the sampled times other than a frame, for `plate_of`."""
        views = []
        for time in self._times:
            if time != frame:
                moving, untold = self._moving(name, time)
                depth = np.where(moving | untold, np.nan, self._kept_depth(name, time)).astype(np.float32)
                views.append((self.camera(name, time), self._pictures_at(time)[0][name], depth))
        return views

    def _pictures_uncached(self, frame: int) -> tuple[dict[str, np.ndarray], dict[str, Camera]]:
        pictures, distorted = self._pictures.at(frame)
        cameras = {name: camera.without_distortion() for name, camera in distorted.items()}
        return {n: undistort(pictures[n], distorted[n], cameras[n])[0] for n in self.names}, cameras

    def _moving_uncached(self, name: str, frame: int) -> tuple[np.ndarray, np.ndarray]:
        times = [time for time in self._times if time != frame]
        views = [(name, time) for time in times]
        views += [(o, time) for time in times[::_ALL_CAMERAS_EVERY] for o in self.names if o != name]
        others = [(self.camera(o, time), self._kept_depth(o, time)) for o, time in views]
        return find_moving(self.camera(name, frame), self.depth(name, frame), others)

    def _kept_depth(self, name: str, frame: int) -> np.ndarray:
        if (name, frame) not in self._sampled:
            self._sampled[name, frame] = self.depth(name, frame)
        return self._sampled[name, frame]
