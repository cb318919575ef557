"""Views rendered when somebody asks: the stages of one frame, in memory."""

import contextlib
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from fourd import config as fourd_config
from fourd.background import BackgroundOptions
from fourd.background.__main__ import read_samples
from fourd.background.estimate import estimate_backgrounds
from fourd.composition import CascadeOptions
from fourd.errors import InputError
from fourd.fuse import FuseOptions
from fourd.fuse.files import DisparityFiles, Pictures, Progress, Silhouettes, hull_depth_range
from fourd.fuse.hull import HullOptions
from fourd.fuse.view import fuse_view
from fourd.sfm.cameras import read_cameras
from fourd.trajectory import TrajectorySpec
from fourd.trajectory.presets import place_cameras
from fourd.viewer.lattice import fit_width

# Backgrounds of so many places are kept: turning back to one is quick.
MAX_BACKGROUNDS = 24
MIN_WIDTH, MAX_WIDTH = 64, 1280
# Of the time of a view: its background, and all before the network.
BACKGROUND_SHARE, FUSED_SHARE = 0.8, 0.95
# As the workflow reads it: below the scene's settings stand the defaults, above them this file.
CONFIG_FILE = Path("config/config.yaml")


class Cancelled(Exception):
    """Somebody has asked for another view since."""


class BackgroundSteps(Progress):
    """Tells how far a background is, by its sample frames; a newer wish ends it there."""

    def __init__(self, total: int, tell: Callable[[str, float], None]) -> None:
        super().__init__("image", total, time.monotonic)
        self._tell = tell

    def step(self, text: str) -> None:
        """One more sample is read."""
        super().step(text)
        self._tell("background", BACKGROUND_SHARE * self._done / self._total)


class LiveScene:
    """Everything that a view of a finished scene is rendered from.

    Raises InputError if the scene has not been worked on, or its disparities were not kept.
    """

    def __init__(self, name: str, results: Path) -> None:
        # Torch takes seconds to import.
        from fourd.cli import choose_torch_device
        from fourd.composition.infer import load_models

        folder = results / name
        scene_file, settings = fourd_config.load_scene(name)
        given = fourd_config.load_yaml(CONFIG_FILE) if CONFIG_FILE.is_file() else {}
        config = fourd_config.load_config(given, settings, name)
        self.scene = read_cameras(folder / "sfm" / "cameras.json")
        disparities = sorted((folder / "disparity").glob("*/*.npz"))
        if not any(path.stem != "samples" for path in disparities):
            raise InputError(
                f"scene {name}: expected disparities under {folder / 'disparity'}, found none: they are "
                "removed after their use unless keep_gb is large enough, raise it and run again"
            )
        self.fuse_options = _options(FuseOptions, config["fuse"])
        self.hull_options = _options(HullOptions, config["hull"])
        self.background_options = _options(BackgroundOptions, config["background"])
        self.cascade = _options(CascadeOptions, config["render"])
        self.size = scene_file.size
        films = [str(folder / "frames" / "cameras" / f"{cam}.npz") for cam in self.scene.inputs]
        chunks = [path for path in disparities if path.stem != "samples"]
        samples = [path for path in disparities if path.stem == "samples"]
        self.disparities = DisparityFiles(chunks, "live")
        self.pictures = Pictures(films, self.scene, "live")
        self.silhouettes = Silhouettes(sorted((folder / "silhouettes").glob("*-*.npz")), "live")
        self.samples = read_samples(
            DisparityFiles(samples, "live"), self.pictures, self.scene, self.background_options.num_samples
        )
        self.device = choose_torch_device("auto")
        self.models = load_models(sorted((folder / "composition").glob("*/model.pt")), self.device)
        self._backgrounds: OrderedDict[tuple[float, int], dict[str, np.ndarray]] = OrderedDict()

    def render(self, share: float, frame: int, width: int, tell: Callable[[str, float], None]) -> np.ndarray:
        """(H, W, 3) uint8 RGB of the path's place `share` (0 to 1) at a scene frame.

        tell: is told what is done next and the share that is done; it may raise Cancelled
        Raises InputError for a place, frame or width that there is not.
        """
        from fourd.composition.infer import compose_frame

        self._check(share, frame, width)
        size = fit_width(self.size, width)
        camera = place_cameras(TrajectorySpec(kind="hold", position=share, num_frames=1), self.scene, size)[0]
        tell("background", 0.0)
        background = self._background(share, size, camera, tell)
        tell("foreground", BACKGROUND_SHARE)
        fused = fuse_view(
            camera,
            self.disparities.at(frame, self.fuse_options.memory_mb),
            *self.pictures.at(frame),
            self.fuse_options,
            device=self.device,
            silhouettes=self.silhouettes.at(frame),
            depth_range=hull_depth_range(self.scene),
            hull_options=self.hull_options,
        )
        tell("composition", FUSED_SHARE)
        foreground = {f"{name}_rgb": rgb for name, rgb in fused.rgb.items()}
        foreground |= {f"{name}_valid": valid for name, valid in fused.valid.items()}
        image, _ = compose_frame(self.models, frame, foreground, background, self.cascade)
        return image

    def _check(self, share: float, frame: int, width: int) -> None:
        if not 0 <= share <= 1 or not 0 <= frame < self.scene.num_frames:
            raise InputError(
                f"expected a place from 0 to 1 and a frame from 0 to {self.scene.num_frames - 1}, got "
                f"{share:g} and {frame}: ask for another"
            )
        if not MIN_WIDTH <= width <= MAX_WIDTH:
            raise InputError(f"expected a width from {MIN_WIDTH} to {MAX_WIDTH} px, got {width}")

    def _background(
        self, share: float, size: tuple[int, int], camera: Any, tell: Callable[[str, float], None]
    ) -> dict[str, np.ndarray]:
        key = (share, size[0])
        if key in self._backgrounds:
            self._backgrounds.move_to_end(key)
            return self._backgrounds[key]
        progress = BackgroundSteps(len(self.samples.frames), tell)
        found = estimate_backgrounds(
            [camera], self.samples, self.fuse_options, self.background_options, progress
        )
        self._backgrounds[key] = found[0]
        while len(self._backgrounds) > MAX_BACKGROUNDS:
            self._backgrounds.popitem(last=False)
        return found[0]


def _options(options_class: Any, section: dict[str, Any]) -> Any:
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in section.items()}
    return options_class(**{key: value for key, value in values.items() if not isinstance(value, dict)})


class LiveQueue:
    """One view at a time, and the newest wish only: older ones that wait are cancelled.

    render: (share, frame, width, tell) -> (H, W, 3) uint8
    """

    def __init__(self, render: Callable[..., np.ndarray]) -> None:
        self._render = render
        self._lock = threading.Lock()
        self._busy = threading.Lock()
        self._newest = 0
        self.state: dict[str, Any] = {"step": "idle", "share": 1.0}

    def ask(self, share: float, frame: int, width: int) -> bytes:
        """PNG of a view, once it is rendered. Raises Cancelled when a newer wish came, InputError."""
        with self._lock:
            self._newest += 1
            ticket = self._newest

        def tell(step: str, done: float) -> None:
            if ticket != self._newest:
                raise Cancelled
            self.state = {"step": step, "share": done}

        with self._busy:
            try:
                tell("waiting", 0.0)
                image = self._render(share, frame, width, tell)
            finally:
                self.state = {"step": "idle", "share": 1.0}
        done, data = cv2.imencode(".png", np.ascontiguousarray(image[:, :, ::-1]))
        if not done:
            raise ValueError(f"cannot encode a picture of shape {image.shape}")
        return data.tobytes()

    def cancel(self) -> None:
        """Nobody waits for anything any more."""
        with self._lock:
            self._newest += 1


class LiveScenes:
    """Queues by scene, opened when first asked for."""

    def __init__(self, results: Path) -> None:
        self._results = results
        self._queues: dict[str, LiveQueue] = {}
        self._lock = threading.Lock()

    def queue(self, name: str) -> LiveQueue:
        """Raises InputError for a scene that cannot be rendered."""
        with self._lock:
            if name not in self._queues:
                self._queues[name] = LiveQueue(LiveScene(name, self._results).render)
            return self._queues[name]

    def state(self, name: str) -> dict[str, Any]:
        with contextlib.suppress(KeyError):
            return self._queues[name].state
        return {"step": "idle", "share": 1.0}
