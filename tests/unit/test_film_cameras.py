import json

import numpy as np
import pytest

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.film_cameras import FilmCamera, FilmCameras, read_film_cameras, write_film_cameras
from fourd.sfm.importers import read_calibration


def camera(x: float) -> Camera:
    K = np.array([[100.0, 0, 31.5], [0, 100, 23.5], [0, 0, 1]])
    return Camera(K, np.eye(3), np.array([x, 0, 0]), (64, 48), np.array([0.01, 0, 0, 0, 0]))


def make_films() -> FilmCameras:
    moving = FilmCamera("cam00", (64, 48), np.array([3, 4, 7]), (camera(0), camera(1), camera(2)))
    still = FilmCamera("cam01", (64, 48), np.array([0]), (camera(5),), True, reprojection_error_px=0.4)
    lost = FilmCamera("cam02", (64, 48), np.zeros(0, np.int64), (), status="nothing in it matches")
    cameras = {film.name: film for film in (moving, still, lost)}
    return FilmCameras(cameras, np.arange(6.0).reshape(2, 3), np.array([0, -1.0, 0]), 1.5, ("two models",))


@pytest.fixture
def path(tmp_path):
    write_film_cameras(tmp_path / "film_cameras.json", make_films())
    return tmp_path / "film_cameras.json"


def test_films_read_back_equal(path):
    films, again = make_films(), read_film_cameras(path)
    assert (again.notes, again.metres_per_unit) == (films.notes, 1.5)
    np.testing.assert_array_equal(again.points, films.points)
    for name, film in films.cameras.items():
        found = again.cameras[name]
        assert (found.status, found.is_static, found.size) == (film.status, film.is_static, film.size)
        np.testing.assert_array_equal(found.source_frames, film.source_frames)
        for a, b in zip(found.cameras, film.cameras, strict=True):
            assert all(np.array_equal(getattr(a, k), getattr(b, k)) for k in ("K", "R", "t", "distortion"))


def test_a_moving_camera_is_known_only_where_it_was_found(path):
    films = read_film_cameras(path).cameras
    known = films["cam00"].at(4)
    assert known is not None and known.t[0] == 1
    assert films["cam00"].at(5) is None and films["cam00"].at(8) is None
    still = films["cam01"].at(1000)
    assert still is not None and still.t[0] == 5


def test_the_file_is_a_calibration_with_frame_numbers_of_the_film(path):
    found = read_calibration(path)
    assert found.image_numbers["cam00"] == (3, 4, 7)
    assert len(found.cameras["cam01"]) == 1
    assert found.points is not None and len(found.points) == 2


def test_other_files_are_refused(path):
    path.write_text(json.dumps({**json.loads(path.read_text()), "points": [[1, 2]]}))
    with pytest.raises(InputError, match="expected film_cameras.json of the stage sfm"):
        read_film_cameras(path)
