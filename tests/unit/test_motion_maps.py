"""Motion maps: what moves is found, what the camera's own turning does is not."""

import dataclasses

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from fourd.align.motion_maps import map_motion, read_motion_maps, write_motion_maps
from fourd.camera import Camera
from fourd.errors import InputError
from fourd.film_cameras import FilmCamera
from fourd.io import ArchiveWriter

SIZE = (240, 136)
FPS = 30.0
K = np.array([[200.0, 0, 119.5], [0, 200, 67.5], [0, 0, 1]])


class Film:
    """Pictures in memory."""

    def __init__(self, pictures: list[np.ndarray]) -> None:
        self.pictures = pictures
        self.pts_s = np.arange(len(pictures)) / FPS
        self.size: tuple[int, int] = SIZE

    def read(self, source_frame: int) -> np.ndarray:
        return self.pictures[source_frame]


def make_film(num_frames=20, has_mover=True, shake_deg=1.0):
    """A far textured wall seen by a shaking camera, and a patterned square that walks across the picture."""
    rng = np.random.default_rng(0)
    wall = np.kron(rng.uniform(40, 200, (40, 60)), np.ones((8, 8)))
    coat = np.kron(rng.choice([0.0, 255.0], (10, 8)), np.ones((3, 3)))
    column, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    pixels = np.stack([column, row], axis=-1).astype(np.float64)
    cameras, pictures = [], []
    for frame in range(num_frames):
        angles = shake_deg * np.array([np.sin(frame / 5), np.cos(frame / 4), 0.3 * np.sin(frame / 3)])
        camera = Camera(K, Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), np.zeros(3), SIZE)
        rays = camera.rays(pixels) @ camera.R
        at = 200 * rays[..., :2] / rays[..., 2:] + [240, 160]
        grey = map_coordinates(wall, [at[..., 1], at[..., 0]], order=1, mode="nearest")
        if has_mover:
            left = 20 + 5 * frame
            grey[50:80, left : left + 24] = coat
        pictures.append(np.repeat(grey[..., None], 3, axis=2).round().astype(np.uint8))
        cameras.append(camera)
    return Film(pictures), FilmCamera("cam00", SIZE, np.arange(num_frames), tuple(cameras))


def test_the_mover_is_found_and_the_shaking_wall_is_not():
    reader, film = make_film()
    motion = map_motion(reader, film)
    assert motion.status == "ok"
    np.testing.assert_allclose(motion.own_s, np.arange(1, 19) / FPS)
    assert motion.maps.shape == (18, 68, 120)
    for index, values in enumerate(motion.maps):
        left = (20 + 5 * (index + 1)) / 2
        inside = np.zeros_like(values, dtype=bool)
        inside[24:41, round(left) - 1 : round(left) + 13] = True
        assert values[inside].mean() > 60
        assert values[~inside].mean() < 1


def test_a_wall_filmed_by_a_shaking_camera_does_not_move():
    motion = map_motion(*make_film(has_mover=False))
    assert len(motion.maps) == 0
    assert "nothing in it moves" in motion.status


def test_constant_picture_single_frame_and_unknown_cameras_are_named():
    reader, film = make_film()
    constant = Film([reader.pictures[0]] * 20)
    still = dataclasses.replace(film, cameras=film.cameras[:1], source_frames=np.array([0]), is_static=True)
    assert "nothing in it moves" in map_motion(constant, still).status
    assert "1 frames" in map_motion(Film(reader.pictures[:1]), still).status
    lost = dataclasses.replace(film, cameras=(), source_frames=np.zeros(0, np.int64), status="not registered")
    assert "not registered" in map_motion(reader, lost).status


def test_frames_beside_a_gap_in_the_cameras_have_no_map():
    reader, film = make_film()
    known = np.array([n for n in range(20) if n != 10])
    motion = map_motion(
        reader,
        dataclasses.replace(film, source_frames=known, cameras=tuple(film.cameras[n] for n in known)),
    )
    frames = np.round(motion.own_s * FPS).astype(int)
    assert set(range(1, 19)) - set(frames) == {9, 10, 11}


@pytest.mark.parametrize("has_mover", [True, False])
def test_written_maps_come_back(tmp_path, has_mover):
    motion = map_motion(*make_film(has_mover=has_mover))
    write_motion_maps(tmp_path / "a.npz", motion)
    back = read_motion_maps(tmp_path / "a.npz")
    assert (back.name, back.status) == (motion.name, motion.status)
    np.testing.assert_array_equal(back.maps, motion.maps)
    np.testing.assert_array_equal(back.own_s, motion.own_s)
    for one, other in zip(back.cameras, motion.cameras, strict=True):
        np.testing.assert_array_equal(one.K, other.K)
        np.testing.assert_array_equal(one.R, other.R)
        assert one.size == other.size


def test_an_archive_of_something_else_is_named(tmp_path):
    with ArchiveWriter(tmp_path / "a.npz", {"name": "cam00"}) as writer:
        writer.add("other", np.zeros(3))
    with pytest.raises(InputError, match="a.npz"):
        read_motion_maps(tmp_path / "a.npz")
