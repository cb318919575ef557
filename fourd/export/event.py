"""What every format is made of: pinholes in the calibration's world, and pictures, masks and depths."""

import dataclasses
import os
import shutil
from pathlib import Path

import numpy as np

from fourd.camera import Camera, CameraTrack
from fourd.errors import InputError
from fourd.export import ExportOptions
from fourd.io import Archive, read_image
from fourd.sfm.cameras import SceneCameras
from fourd.trajectory.arc_path import average_track
from fourd.views import physical_view


def distance_of(track: CameraTrack) -> float:
    """The depth, world units, at which most of a camera's parallax is gone: harmonic mean of near and far."""
    near = track.near if track.near > 0 else 1.0
    return 2 / (1 / near + (1 / track.far if np.isfinite(track.far) else 0.0))


def own_pinhole(scene: SceneCameras, name: str, frame: int, size: tuple[int, int] | None) -> Camera:
    """The ideal pinhole of a camera at a scene frame, in the scene's world; size: None is its own."""
    return physical_view(scene, name, [frame], size).frames[0].camera


def held_pinhole(scene: SceneCameras, name: str, size: tuple[int, int] | None) -> Camera:
    """One ideal pinhole for the whole film of a camera, in the scene's world.

    It stands at the camera's mean place; its pixels are square and the principal point is central,
    because some formats know nothing else.
    """
    camera = average_track(scene.tracks[name])
    steady = dataclasses.replace(scene.tracks[name], cameras=(camera,))
    still = dataclasses.replace(scene, tracks={**scene.tracks, name: steady})
    pinhole = own_pinhole(still, name, 0, size)
    width, height = pinhole.size
    focal = pinhole.focal_px
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return dataclasses.replace(pinhole, K=K)


def held_residual_px(scene: SceneCameras, name: str, size: tuple[int, int] | None) -> float:
    """Largest shift, px, of a point at the nearest depth in a held film, because the camera moved.

    Points at `distance_of` stay in place; what is nearer or farther moves by parallax.
    """
    track = scene.tracks[name]
    if track.is_static:
        return 0.0
    held = held_pinhole(scene, name, size)
    shake = max(float(np.linalg.norm(camera.center - held.center)) for camera in track.cameras)
    near, far = track.near or 1.0, track.far
    distance = distance_of(track)
    worst = max(1 / near - 1 / distance, 1 / distance - (1 / far if np.isfinite(far) else 0.0))
    return held.focal_px * shake * worst


@dataclasses.dataclass(frozen=True, eq=False)
class Event:
    """A scene ready to be written. scene: in its own world;  options: of the stage

    pictures: folder of `CAM/000012.png`, `CAM/masks/000012.png` and `CAM/held.mp4`
    depth: folder of `CAM.npz`, archives of `depth` per scene frame, scene units, 0 where unknown
    """

    scene: SceneCameras
    options: ExportOptions
    pictures: Path
    depth: Path

    @property
    def names(self) -> tuple[str, ...]:
        """All cameras that could be placed."""
        return (*self.scene.inputs, *self.scene.heldout)

    @property
    def size(self) -> tuple[int, int] | None:
        """The size that was asked for."""
        return (self.options.size[0], self.options.size[1]) if self.options.size else None

    @property
    def frames(self) -> range:
        """Scene frames."""
        return range(self.scene.num_frames)

    def world(self, points: np.ndarray) -> np.ndarray:
        """(..., 3) points of the scene's world in the export's: the import's similarity undone."""
        return (points * self.scene.scale + self.scene.origin) * self.options.scale

    def length(self, lengths: np.ndarray | float):
        """Lengths of the scene's world in the export's."""
        return lengths * (self.scene.scale * self.options.scale)

    def moved(self, camera: Camera) -> Camera:
        """A camera of the scene's world in the export's."""
        return dataclasses.replace(camera, t=-camera.R @ self.world(camera.center))

    def camera(self, name: str, frame: int) -> Camera:
        """The pinhole of a picture, in the export's world."""
        return self.moved(own_pinhole(self.scene, name, frame, self.size))

    def held(self, name: str) -> Camera:
        """The pinhole of a held film, in the export's world."""
        return self.moved(held_pinhole(self.scene, name, self.size))

    def common_size(self, what: str) -> tuple[int, int]:
        """The size of all pictures. Raises InputError if they differ, naming the format that needs one."""
        sizes = {name: self.held(name).size for name in self.names}
        if len(set(sizes.values())) > 1:
            listed = ", ".join(f"{name} {size[0]} x {size[1]}" for name, size in sizes.items())
            raise InputError(
                f"export {what}: expected pictures of one size, got {listed}: set one, for example "
                "--config 'export={size: [1280, 720]}'"
            )
        return next(iter(sizes.values()))

    def picture_path(self, name: str, frame: int) -> Path:
        return self.pictures / name / f"{frame:06d}.png"

    def mask_path(self, name: str, frame: int) -> Path:
        return self.pictures / name / "masks" / f"{frame:06d}.png"

    def held_path(self, name: str) -> Path:
        return self.pictures / name / "held.mp4"

    def depths(self, name: str) -> Archive | None:
        """The depths of a camera, None of a held-out one."""
        return Archive(self.depth / f"{name}.npz") if name in self.scene.inputs else None

    def cloud(self, frame: int, max_points: int) -> "Cloud":
        """Points of a scene frame from the depths of all input cameras, evenly thinned."""
        parts = []
        for index, name in enumerate(self.scene.inputs):
            archive = self.depths(name)
            assert archive is not None
            depth = archive[f"{frame:06d}/depth"].astype(np.float64)
            archive.close()
            rows, columns = np.nonzero(depth > 0)
            camera = own_pinhole(self.scene, name, frame, self.size)
            xyz = camera.unproject(
                np.stack([columns, rows], axis=-1).astype(np.float64), depth[rows, columns]
            )
            rgb = read_image(self.picture_path(name, frame))[rows, columns]
            moves = read_image(self.mask_path(name, frame))[rows, columns, 0] == MOVING
            parts.append((self.world(xyz), rgb, np.full(len(rows), index, np.uint8), moves))
        xyz, rgb, source, moves = (np.concatenate(column) for column in zip(*parts, strict=True))
        # Evenly over all cameras, the same points in every run.
        chosen = np.linspace(0, len(xyz) - 1, min(max_points, len(xyz))).round().astype(np.int64)
        return Cloud(xyz[chosen], rgb[chosen], source[chosen], moves[chosen])

    def seed_points(self) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3) points and (N, 3) uint8 colours to begin a reconstruction with: the first frame's cloud."""
        cloud = self.cloud(0, self.options.max_points)
        return cloud.xyz, cloud.rgb


# Values of masks.
OUTSIDE, STILL, MOVING = 0, 128, 255


@dataclasses.dataclass(frozen=True, eq=False)
class Cloud:
    """xyz: (N, 3) float64, export's world;  rgb: (N, 3) uint8;  source: (N,) uint8 index of the input camera
    whose depth it is;  moves: (N,) bool
    """

    xyz: np.ndarray
    rgb: np.ndarray
    source: np.ndarray
    moves: np.ndarray


def place_file(source: Path, target: Path) -> None:
    """The same file under another name, without a second copy where the disk allows it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
