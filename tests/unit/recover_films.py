"""Films of a textured room, drawn frame by frame, for the tests of camera recovery."""

import dataclasses

import cv2
import numpy as np

from fourd.camera import Camera
from fourd.geometry import look_at
from fourd.sfm.recover.films import Film
from tests.unit.sfm_rig import make_texture, render_planes

SIZE = (320, 240)
FOCAL_PX = 290.0
TARGET = np.array([0.0, 0.0, 1.0])
TEXTURES = [make_texture(512, seed) for seed in range(5)]


def room():
    """A back wall, a floor and three boards in front: depth in every part of the picture."""
    return [
        ([-5, 3, 4], [10.0, 0, 0], [0, 0, -6.0]),
        ([-5, 3, -0.6], [10.0, 0, 0], [0, -6.0, 0]),
        ([-2.2, 1.6, 2.2], [1.5, 0.4, 0], [0, 0, -2.0]),
        ([0.9, 1.2, 2.0], [1.4, -0.3, 0], [0, 0, -1.9]),
        ([-0.5, 0.3, 1.4], [1.1, 0.1, 0], [0, 0, -1.2]),
    ]


def draw(camera: Camera, planes, textures=TEXTURES) -> np.ndarray:
    """(H, W, 3) uint8, drawn at twice the size so that edges are smooth."""
    large = camera.resized((2 * camera.size[0], 2 * camera.size[1])).without_distortion()
    image = np.full((large.size[1], large.size[0], 3), 30, np.uint8)
    for plane, texture in zip(planes, textures, strict=False):
        layer = render_planes(large, [plane], texture)
        image = np.where(layer.any(axis=2, keepdims=True), layer, image)
    image = cv2.resize(image, camera.size, interpolation=cv2.INTER_AREA)
    if not camera.is_distorted:
        return image
    u, v = np.meshgrid(np.arange(camera.size[0]), np.arange(camera.size[1]))
    rays = camera.rays(np.stack([u, v], axis=-1).astype(np.float64))
    source = (rays @ camera.K.T)[..., :2].astype(np.float32)
    return cv2.remap(image, source[..., 0], source[..., 1], cv2.INTER_CUBIC)


def make_cameras(name_index: int, num_frames: int, shake: float = 0.02, radial=0.0) -> list[Camera]:
    """One phone on an arc of 12 degrees between neighbours, shaking smoothly."""
    angle = np.radians(12.0 * (name_index - 1.5))
    rng = np.random.default_rng(name_index)
    phase = rng.uniform(0, 2 * np.pi, (2, 3))
    focal = FOCAL_PX + 8 * name_index
    K = np.array([[focal, 0, (SIZE[0] - 1) / 2], [0, focal, (SIZE[1] - 1) / 2], [0, 0, 1]])
    cameras = []
    for frame in range(num_frames):
        sway = shake * np.sin(0.5 * frame + phase)
        center = TARGET + [4 * np.sin(angle), -4 * np.cos(angle), 0.3] + sway[0]
        R, t = look_at(center, TARGET + sway[1], np.array([0.0, 0, 1]))
        cameras.append(Camera(K, R, t, SIZE, np.array([radial, 0, 0, 0, 0])))
    return cameras


@dataclasses.dataclass
class DrawnFilm:
    """A film whose pictures are drawn once each; `change` is applied to every picture."""

    pictures: list[np.ndarray]

    @property
    def size(self) -> tuple[int, int]:
        return (self.pictures[0].shape[1], self.pictures[0].shape[0])

    @property
    def pts_s(self) -> np.ndarray:
        return np.arange(len(self.pictures)) / 30

    def read(self, source_frame: int) -> np.ndarray:
        return self.pictures[source_frame]


def film_of(name: str, pictures: list[np.ndarray], wanted=None) -> Film:
    source = DrawnFilm(pictures)
    return Film(name, source, np.arange(len(pictures)), 0.85 * max(source.size), wanted)


def first_frames(films: dict[str, Film], names, count: int) -> dict[str, Film]:
    """The beginnings of drawn films."""
    return {name: film_of(name, films[name].source.pictures[:count]) for name in names}


def draw_films(num_cameras=4, num_frames=5, shake=0.02, radial=0.0, planes=None, textures=TEXTURES):
    """Films by name and their true cameras (name -> list)."""
    truth = {f"cam{i:02d}": make_cameras(i, num_frames, shake, radial) for i in range(num_cameras)}
    films = {
        name: film_of(name, [draw(camera, planes or room(), textures) for camera in track])
        for name, track in truth.items()
    }
    return films, truth
