"""Between the films' own frames and the scene: the command `films`, and cameras that are left out."""

import json
from pathlib import Path

import numpy as np
import pytest

from fourd.film_cameras import FilmCamera, FilmCameras, read_film_cameras, write_film_cameras
from fourd.sfm import read_cameras
from fourd.sfm.__main__ import main
from tests.unit.sfm_rig import POINTS, SIZE, make_rig, moved_rig, write_ingest, write_native
from tests.unit.test_sfm_stage import fail, import_arguments, import_native


def write_films(folder: Path, tracks, refused=None, **extra) -> Path:
    """film_cameras.json of `tracks`, with the cameras of `refused` (name -> reason) left out."""
    films = {
        name: FilmCamera(name, SIZE, np.arange(len(track)), tuple(track), len(track) == 1)
        for name, track in tracks.items()
    }
    for name, reason in (refused or {}).items():
        films[name] = FilmCamera(name, SIZE, np.zeros(0, np.int64), (), status=reason)
    write_film_cameras(folder / "film_cameras.json", FilmCameras(films, POINTS, **extra))
    return folder / "film_cameras.json"


BLANK = "the picture is constant: leave the camera out"
SILENT = "no sound and no common motion with the others"


def test_cameras_that_a_stage_has_given_up_are_left_out_with_the_reason(tmp_path, caplog):
    path = write_films(tmp_path, moved_rig(3, num_cameras=5), {"cam01": BLANK})
    names = ["cam00", "cam01", "cam02", "cam03", "cam04"]
    for name in names:
        write_ingest(tmp_path, name, num_frames=3)
    for name in ("cam02", "cam04"):
        write_ingest(tmp_path, name, num_frames=3, status=SILENT, source_frame=[])
    with caplog.at_level("WARNING"):
        main(import_arguments(tmp_path, path, names, ["cam04"], 3))
    scene = read_cameras(tmp_path / "sfm" / "cameras.json")
    assert (scene.inputs, scene.heldout) == (("cam00", "cam03"), ())
    assert scene.left_out == {"cam01": BLANK, "cam02": SILENT, "cam04": SILENT}
    assert list(scene.tracks) == ["cam00", "cam03"]
    assert f"camera cam01 is left out: {BLANK}" in caplog.text
    # The order of the scene's cameras and what is left out do not move the others.
    (tmp_path / "alone").mkdir()
    alone = import_native(
        tmp_path / "alone",
        {n: moved_rig(3, num_cameras=5)[n] for n in scene.inputs},
        (),
        3,
        ["--depth-range", "2", "9"],
    )
    for name in scene.inputs:
        np.testing.assert_array_equal(scene.tracks[name].at(1).t, alone.tracks[name].at(1).t)


def test_fewer_than_two_inputs_that_remain_are_refused_with_all_reasons(tmp_path, capsys):
    names = ["cam00", "cam01", "cam02"]
    path = write_films(
        tmp_path, {"cam00": moved_rig(2)["cam00"], "cam02": moved_rig(2)["cam02"]}, {"cam01": BLANK}
    )
    for name in names:
        write_ingest(tmp_path, name, num_frames=2)
    write_ingest(tmp_path, "cam02", num_frames=2, status=SILENT, source_frame=[])
    message = fail(capsys, import_arguments(tmp_path, path, names, num_frames=2))
    assert "at least 2 input cameras, but 1 of them remain" in message
    assert f"cam01: {BLANK}; cam02: {SILENT}" in message
    assert not (tmp_path / "sfm").exists()


def write_source(folder: Path, name: str, num_frames: int, size=SIZE, files=()) -> Path:
    """ingest/{cam}.json, as far as it is checked."""
    document = {
        "camera": name, "source": f"{name}.mp4", "kind": "images" if files else "video", "sha256": name,
        "size": list(size), "num_source_frames": num_frames, "files": list(files),
        "pts_s": [frame / 30 for frame in range(num_frames)],
    }  # fmt: skip
    path = folder / f"{name}.json"
    path.write_text(json.dumps(document))
    return path


def films_arguments(folder: Path, calibration: Path, names, heldout=()) -> list[str]:
    paths = [str(folder / f"{name.partition('=')[0]}.json") for name in names]
    flags = ["films", "--calibration", str(calibration), "--camera", *names, "--heldout", *heldout]
    return [*flags, "--ingest", *paths, "--output", str(folder / "out.json")]


def test_known_cameras_are_put_on_the_films_own_frames(tmp_path):
    moving, still_camera = moved_rig(4)["cam00"], make_rig()["cam01"]
    path = write_native(tmp_path / "calib.json", {"left": moving, "cam01": (still_camera,)}, up=[0, 0, 2])
    write_source(tmp_path, "cam00", 4, (SIZE[0] // 2, SIZE[1] // 2))
    write_source(tmp_path, "cam01", 7)
    main(films_arguments(tmp_path, path, ["cam00=left", "cam01"]))
    found = read_film_cameras(tmp_path / "out.json")
    np.testing.assert_array_equal(found.up, [0, 0, 1])
    assert found.points.shape == (0, 3) and found.metres_per_unit is None
    film = found.cameras["cam00"]
    assert (film.size, film.is_static, film.source_frames.tolist()) == ((160, 120), False, [0, 1, 2, 3])
    for got, expected in zip(film.cameras, moving, strict=True):
        pixels = (got.project(POINTS)[0] + 0.5) * 2 - 0.5
        np.testing.assert_allclose(pixels, expected.project(POINTS)[0], atol=1e-9)
    static = found.cameras["cam01"]
    assert static.is_static and len(static.cameras) == 1
    assert static.at(6) is static.cameras[0]
    np.testing.assert_array_equal(static.cameras[0].t, still_camera.t)


def test_recovered_films_pass_through_films_unchanged(tmp_path):
    path = write_films(tmp_path, moved_rig(3, num_cameras=3), {"cam03": BLANK}, metres_per_unit=2.5)
    names = ["cam00", "cam01", "cam02", "cam03"]
    for name in names:
        write_source(tmp_path, name, 3)
    main(films_arguments(tmp_path, path, names, ["cam02"]))
    before, after = read_film_cameras(path), read_film_cameras(tmp_path / "out.json")
    assert after.cameras["cam03"].status == BLANK and after.cameras["cam03"].cameras == ()
    assert after.metres_per_unit == 2.5
    np.testing.assert_array_equal(after.points, before.points)
    for name in names[:3]:
        assert after.cameras[name].source_frames.tolist() == [0, 1, 2]
        for a, b in zip(after.cameras[name].cameras, before.cameras[name].cameras, strict=True):
            assert a.to_dict() == b.to_dict()


@pytest.mark.parametrize(
    ("num_frames", "names", "sentence"),
    [
        (2, ["cam00", "cam01"], "expected poses of frames below 2, which the film of"),
        (3, ["cam00", "cam09"], "camera cam09: expected 'cam09' in"),
        (3, ["cam00"], "at least 2 input cameras besides the 0 held out, got 1 (cam00)"),
    ],
)
def test_films_that_do_not_fit_the_calibration_are_refused(tmp_path, capsys, num_frames, names, sentence):
    path = write_films(tmp_path, moved_rig(3))
    for name in names:
        write_source(tmp_path, name, num_frames)
    assert sentence in fail(capsys, films_arguments(tmp_path, path, names))
    assert not (tmp_path / "out.json").exists()


def test_a_film_without_its_ingest_file_is_refused(tmp_path, capsys):
    arguments = films_arguments(tmp_path, write_films(tmp_path, moved_rig(3)), ["cam00", "cam01"])
    arguments.remove(str(tmp_path / "cam01.json"))
    assert "expected an ingest file for every camera, got none for cam01" in fail(capsys, arguments)
