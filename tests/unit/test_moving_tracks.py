"""What moves in a film whose camera is known: a textured square before a textured wall."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fourd.align.moving_tracks import no_tracks, read_tracks, track_motion, write_tracks
from fourd.align.vision_options import VisionOptions
from fourd.camera import Camera
from fourd.errors import InputError
from fourd.film_cameras import FilmCamera
from tests.unit.sfm_rig import make_texture, render_planes

SIZE = (240, 160)
NUM_FRAMES = 24


class Film:
    """A camera that shakes by a degree films a square that crosses the picture."""

    size = SIZE

    def __init__(self, moves: bool = True) -> None:
        self.pts_s = np.arange(NUM_FRAMES) / 30
        self._moves = moves
        self._texture = make_texture(256, seed=3)
        K = np.array([[220.0, 0, 119.5], [0, 220, 79.5], [0, 0, 1]])
        shake = np.random.default_rng(0).uniform(-1, 1, (NUM_FRAMES, 3)).cumsum(axis=0) * 0.15
        turns = Rotation.from_euler("xyz", shake, degrees=True).as_matrix()
        self.cameras = tuple(Camera(K, R, np.zeros(3), SIZE) for R in turns)

    def square(self, frame: int) -> np.ndarray:
        """(3,) corner of the square, world."""
        return np.array(
            [-0.8 + (0.05 * frame if self._moves else 0.3), -0.3 + 0.01 * frame * self._moves, 3.0]
        )

    def read(self, source_frame: int) -> np.ndarray:
        wall = (np.array([-4.0, -3, 5]), np.array([8.0, 0, 0]), np.array([0, 6.0, 0]))
        square = (self.square(source_frame), np.array([0.6, 0, 0]), np.array([0, 0.6, 0]))
        return render_planes(self.cameras[source_frame], [wall, square], self._texture)

    def film(self) -> FilmCamera:
        return FilmCamera("cam00", SIZE, np.arange(NUM_FRAMES), self.cameras)


def test_points_of_the_mover_are_followed_where_they_go():
    film = Film()
    motion = track_motion(film, film.film(), VisionOptions())
    assert motion.status == "ok" and motion.num_tracks >= 10
    # Every observation of one track is the same point of the square.
    errors = []
    for track in range(motion.num_tracks):
        at = motion.track == track
        spots = []
        for frame, pixel in zip(motion.frame[at], motion.pixels[at], strict=True):
            ray = film.cameras[frame].rays(pixel) @ film.cameras[frame].R
            spots.append((ray * 3 / ray[2] - film.square(int(frame)))[:2])
        errors.append(np.abs(np.array(spots) - np.median(spots, axis=0)).max() * 220 / 3)
    assert np.median(errors) < 0.7
    assert motion.own_s == pytest.approx(motion.frame / 30)
    assert np.linalg.norm(motion.descriptors, axis=1) == pytest.approx(1, abs=1e-5)


def test_film_in_which_nothing_moves_has_no_tracks_and_says_so():
    film = Film(moves=False)
    motion = track_motion(film, film.film(), VisionOptions())
    assert motion.num_tracks == 0
    assert "nothing in it moves" in motion.status


@pytest.mark.parametrize(
    ("film", "expected"),
    [
        (
            FilmCamera("cam00", SIZE, np.zeros(0, np.int64), (), status="it matches nothing"),
            "it matches nothing",
        ),
        (FilmCamera("cam00", SIZE, np.arange(3), Film().cameras[:3]), "3 frames"),
    ],
)
def test_films_that_cannot_tell_have_the_reason(film, expected):
    motion = track_motion(Film(), film, VisionOptions())
    assert expected in motion.status and motion.num_tracks == 0


def test_motion_reads_back_equal(tmp_path):
    film = Film()
    motion = track_motion(film, film.film(), VisionOptions())
    for given in (motion, no_tracks("cam01", "nothing in it moves")):
        write_tracks(tmp_path / "motion.npz", given)
        again = read_tracks(tmp_path / "motion.npz")
        assert (again.name, again.status, again.span_s) == (given.name, given.status, given.span_s)
        for key in ("track", "frame", "own_s", "pixels", "descriptors", "descriptor_track"):
            np.testing.assert_array_equal(getattr(again, key), getattr(given, key))


def test_same_film_gives_the_same_bytes(tmp_path):
    for name in ("a.npz", "b.npz"):
        film = Film()
        write_tracks(tmp_path / name, track_motion(film, film.film(), VisionOptions()))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "motion.npz"
    path.write_bytes(b"no archive")
    with pytest.raises(InputError, match="expected a whole archive"):
        read_tracks(path)
