from pathlib import Path

import numpy as np
import pytest
import yaml

from fourd.cli import run_stage
from fourd.config import load_config, load_scene
from fourd.errors import InputError
from fourd.init import SceneDraft, film_size, main, scene_text
from fourd.io import write_json, write_png
from fourd.video import encode_video


def make_film(path: Path, num_frames: int, fps: float = 30, size: tuple[int, int] = (48, 32)) -> str:
    encode_video(
        path, [np.full((size[1], size[0], 3), 20 * i % 255, np.uint8) for i in range(num_frames)], fps
    )
    return str(path)


def make_folder(path: Path, num_frames: int) -> str:
    for index in range(num_frames):
        write_png(path / f"{index:03d}.png", np.zeros((32, 48, 3), np.uint8))
    return str(path)


def make_calibration(path: Path, names) -> str:
    pose = {
        "K": [[80, 0, 48], [0, 80, 27], [0, 0, 1]],
        "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "t": [0, 0, 0],
    }
    write_json(path, {"cameras": {name: {"size": [96, 54], "frames": [pose]} for name in names}})
    return str(path)


def init(tmp_path: Path, *arguments: str, name: str = "street") -> dict:
    main([name, *arguments, "--scenes", str(tmp_path / "scenes")])
    return yaml.safe_load((tmp_path / "scenes" / f"{name}.yaml").read_text())


def test_videos_make_a_scene(tmp_path, capsys):
    films = [
        make_film(tmp_path / n, k, f) for n, k, f in [("a.mp4", 20, 30), ("b.mp4", 60, 60), ("c.mp4", 18, 30)]
    ]
    scene = init(tmp_path, *films)
    assert (scene["fps"], scene["num_frames"], scene["size"]) == (30, 18, [48, 32])
    assert scene["cameras"] == {f"cam{i:02d}": {"source": film} for i, film in enumerate(films)}
    assert scene["heldout"] == []
    assert "snakemake --cores 2 render_all --config scene=street" in capsys.readouterr().out


def test_written_scene_is_accepted_by_the_workflow(tmp_path):
    films = [make_film(tmp_path / f"my film {n}.mp4", 5) for n in range(3)]
    calibration = make_calibration(tmp_path / "cameras.json", ["left", "mid: 2", "right"])
    init(tmp_path, *films, "--calibration", calibration, "--heldout", "cam01")
    scene, settings = load_scene("street", tmp_path / "scenes")
    assert [camera.source for camera in scene.cameras.values()] == films
    assert [camera.calibration_name for camera in scene.cameras.values()] == ["left", "mid: 2", "right"]
    assert (scene.heldout, scene.calibration) == (("cam01",), (calibration,))
    load_config({}, settings, "street")


def test_folders_take_the_default_rate_or_the_given_one(tmp_path):
    folders = [make_folder(tmp_path / "left", 12), make_folder(tmp_path / "right", 9)]
    scene = init(tmp_path, *folders)
    assert (scene["fps"], scene["num_frames"]) == (30, 9)
    scene = init(tmp_path, *folders, "--fps", "25", "--num-frames", "4", "--force")
    assert (scene["fps"], scene["num_frames"]) == (25, 4)


def test_folder_beside_videos_has_one_picture_per_frame_of_the_clock(tmp_path):
    sources = [make_folder(tmp_path / "left", 40), make_film(tmp_path / "right.mp4", 20, fps=60)]
    scene = init(tmp_path, *sources)
    assert (scene["fps"], scene["num_frames"]) == (60, 20)


def test_ntsc_rate_keeps_its_fraction(tmp_path):
    films = [make_film(tmp_path / f"{n}.mp4", 10, fps=30000 / 1001) for n in "ab"]
    assert init(tmp_path, *films)["fps"] == pytest.approx(30000 / 1001, abs=1e-6)


def test_calibration_names_follow_the_stems(tmp_path):
    films = [make_film(tmp_path / f"{n}.mp4", 5) for n in ("door", "roof")]
    calibration = make_calibration(tmp_path / "cameras.json", ["roof", "door", "other"])
    cameras = init(tmp_path, *films, "--calibration", calibration)["cameras"]
    assert [camera["calibration_name"] for camera in cameras.values()] == ["door", "roof"]


def test_sources_named_like_cameras_keep_their_names(tmp_path):
    films = [make_film(tmp_path / f"cam0{n}.mp4", 5) for n in (1, 2, 4)]
    calibration = make_calibration(tmp_path / "cameras.json", ["cam01", "cam02", "cam04"])
    scene = init(tmp_path, *films, "--calibration", calibration, "--heldout", "cam02")
    assert scene["cameras"] == {Path(film).stem: {"source": film} for film in films}
    assert scene["heldout"] == ["cam02"]


def test_heldout_may_be_named_by_the_stem(tmp_path):
    films = [make_film(tmp_path / f"{n}.mp4", 5) for n in ("door", "roof", "tree")]
    assert init(tmp_path, *films, "--heldout", "roof", "cam02")["heldout"] == ["cam01", "cam02"]


@pytest.mark.parametrize(
    "size, expected",
    [((480, 270), (480, 270)), ((1920, 1080), (960, 540)), ((2160, 3840), (540, 960)), ((47, 31), (48, 32))],
)
def test_first_films_are_small_and_even(size, expected):
    assert film_size(size) == expected


def test_existing_scene_is_kept_unless_forced(tmp_path):
    films = [make_film(tmp_path / f"{n}.mp4", 5) for n in "ab"]
    init(tmp_path, *films)
    with pytest.raises(InputError, match=r"street\.yaml.*--force"):
        init(tmp_path, *films, "--num-frames", "3")
    assert init(tmp_path, *films, "--num-frames", "3", "--force")["num_frames"] == 3


@pytest.mark.parametrize("name", ["Street", "2nd", "a-b", "../up", "", "a.b"])
def test_bad_names_are_refused(tmp_path, name):
    with pytest.raises(InputError, match="expected a scene name"):
        init(tmp_path, make_film(tmp_path / "a.mp4", 3), make_film(tmp_path / "b.mp4", 3), name=name)


def test_bad_inputs_are_refused(tmp_path):
    good = [make_film(tmp_path / f"{n}.mp4", 5) for n in "ab"]
    (tmp_path / "text.mp4").write_text("no film")
    calibration = make_calibration(tmp_path / "cameras.json", ["one"])
    for arguments, message in [
        ([], "expected 2 or more videos .* got 0"),
        (good[:1], "expected 2 or more videos .* got 1"),
        ([*good, str(tmp_path / "none.mp4")], r"found nothing at .*none\.mp4"),
        ([*good, str(tmp_path / "text.mp4")], r"expected a whole video file at .*text\.mp4"),
        ([*good, "--heldout", "cam07"], "--heldout to name one camera of cam00, cam01"),
        ([*good, "--num-frames", "6"], r"expected --num-frames in 1\.\.5"),
        ([*good, "--fps", "0"], "expected --fps above 0"),
        ([*good, "--calibration", calibration], "a calibrated camera for each of 2 sources"),
        ([*good, "--calibration", str(tmp_path / "none.json")], "expected a calibration at"),
    ]:
        with pytest.raises(InputError, match=message):
            init(tmp_path, *arguments)
    assert run_stage(main, ["street", *good[:1]]) == 2
    assert not (tmp_path / "scenes").exists()


def test_films_without_sound_get_a_guess_that_is_named_as_one(tmp_path, capsys):
    films = [make_film(tmp_path / f"{n}.mp4", count) for n, count in (("a", 9), ("b", 5))]
    scene = init(tmp_path, *films)
    assert scene["num_frames"] == 5 and "clock" not in scene and "calibration" not in scene
    assert f"num_frames is a guess: 5, as many as {films[1]}, the shortest" in capsys.readouterr().out


def test_every_key_is_explained():
    text = scene_text("street", SceneDraft(30, 9, (480, 270), {"cam00": ("a.mp4", None)}, (), ("c.json",)))
    lines = text.splitlines()
    for number, line in enumerate(lines):
        if line and line[0].isalpha():
            assert lines[number - 1].startswith("#"), line
