"""Stage frames: corrections that are needed are found, others are not invented, films are prepared."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from fourd.camera import CameraTrack
from fourd.cli import run_stage
from fourd.frames import FramesOptions
from fourd.frames.__main__ import main
from fourd.frames.colour import LEVELS, describe_colour, match_colours
from fourd.frames.fit import fit_colours
from fourd.frames.observations import ColourPairs, make_sample
from fourd.ingest.source import hash_source, probe_source
from fourd.io import Archive, read_json, write_json, write_png
from fourd.sfm import SceneCameras, write_cameras
from fourd.tone import apply_tone, identity_table, table_at
from tests.conftest import REPOSITORY
from tests.unit.sfm_rig import SIZE, TARGET, make_texture, moved_rig, render_planes

NUM_FRAMES = 4
NAMES = [f"cam{i:02d}" for i in range(5)]
HELDOUT = "cam04"
WALL = (TARGET + [-1.6, 0.5, -1.2], [3.2, 0.6, 0.0], [0.0, 0.1, 2.4])
BOX = (TARGET + [-0.3, -0.4, -0.3], [0.5, 0.1, 0.0], [0.0, 0.0, 0.6])
OPTIONS = FramesOptions(num_colour_frames=2)
GAIN, GAMMA = np.array([0.8, 1.1, 0.9]), np.array([1.1, 0.9, 1.0])


def disturb(image: np.ndarray, gain=GAIN, gamma=GAMMA) -> np.ndarray:
    return np.clip(np.rint(255 * gain * (image / 255.0) ** gamma), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def event() -> tuple[SceneCameras, dict[tuple[str, int], np.ndarray]]:
    """Hand-held cameras in front of a wall and a box, and their pictures."""
    rig = moved_rig(NUM_FRAMES, num_cameras=len(NAMES))
    texture = np.clip(0.45 * make_texture(seed=4).astype(float) + 60, 0, 255).astype(np.uint8)
    pictures = {
        (name, frame): render_planes(camera, [WALL, BOX], texture)
        for name, cameras in rig.items()
        for frame, camera in enumerate(cameras)
    }
    scene = SceneCameras(
        fps=30.0,
        num_frames=NUM_FRAMES,
        inputs=tuple(name for name in NAMES if name != HELDOUT),
        heldout=(HELDOUT,),
        tracks={name: CameraTrack(name, cameras, 1.0, 10.0) for name, cameras in rig.items()},
        origin=np.zeros(3),
        scale=1.0,
        up=np.array([0.0, 0.0, 1.0]),
        depth_range_from={},
    )
    return scene, pictures


def matched(event, changed=(), names=NAMES, change=disturb, options=OPTIONS):
    scene, pictures = event

    def read(name: str, frame: int) -> np.ndarray:
        picture = pictures[name, frame]
        return change(picture) if name in changed else picture

    return match_colours(scene, names, read, options)


def test_colours_that_agree_are_left_alone(event):
    frames, reference, colours = matched(event)
    assert frames == (1, 3) and reference in event[0].inputs
    for colour in colours.values():
        assert (colour.status, colour.is_needed) == ("ok", False)
        assert colour.num_matches > 100
        assert describe_colour(colour, frames)["tone"] is None


@pytest.mark.parametrize("name", ["cam01", HELDOUT])
def test_a_changed_camera_is_brought_back_and_no_other(event, name):
    frames, reference, colours = matched(event, changed=[name])
    assert [n for n in NAMES if colours[n].is_needed] == [name]
    assert reference != name
    tone = describe_colour(colours[name], frames)["tone"]
    original = event[1][name, 3]
    table = table_at(tone, 3)
    assert table is not None
    error = apply_tone(disturb(original), table).astype(float) - original
    before = disturb(original).astype(float) - original
    assert np.sqrt((error**2).mean()) < min(2.0, 0.2 * np.sqrt((before**2).mean()))


def test_the_colours_of_most_cameras_win(event):
    _, reference, colours = matched(event, changed=["cam00"])
    assert reference != "cam00"
    assert colours["cam00"].is_needed


def test_nothing_of_an_input_depends_on_a_heldout_camera(event):
    frames, reference, alone = matched(event, names=NAMES[:-1])
    assert HELDOUT not in alone
    for change in (disturb, lambda picture: 255 - picture):
        _, same_reference, together = matched(event, [HELDOUT], change=change)
        assert same_reference == reference
        for name in NAMES[:-1]:
            assert describe_colour(together[name], frames) == describe_colour(alone[name], frames)


def test_a_camera_without_common_points_is_named_and_passed(event):
    scene, pictures = event
    noise = np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    _, _, colours = match_colours(
        scene, NAMES, lambda name, frame: noise if name == "cam02" else pictures[name, frame], OPTIONS
    )
    assert "static points" in colours["cam02"].status and not colours["cam02"].is_needed
    assert colours["cam01"].status == "ok"


def test_without_two_comparable_cameras_nothing_happens(event):
    _, reference, colours = matched(event, names=["cam00", HELDOUT])
    assert reference is None
    assert not any(colour.is_needed for colour in colours.values())


def test_a_drift_is_followed(event):
    scene, pictures = event
    drift = [0.8, 0.85, 0.9, 0.95]

    def read(name: str, frame: int) -> np.ndarray:
        picture = pictures[name, frame]
        return disturb(picture, drift[frame], 1.0) if name == "cam02" else picture

    frames, _, colours = match_colours(scene, NAMES, read, OPTIONS)
    tables = colours["cam02"].tables()
    for index, frame in enumerate(frames):
        wanted = LEVELS / drift[frame]
        found = tables[index][:, LEVELS.astype(int)]
        assert np.abs(found - wanted)[:, wanted < 200].max() < 4


def noisy_pairs(gain: float, gamma: float, noise: float, count: int = 4000) -> ColourPairs:
    rng = np.random.default_rng(1)
    level = rng.uniform(30, 200, (count, 3))
    right = 255 * gain * (level / 255) ** gamma
    return ColourPairs("a", "b", 0, *(v * np.exp(noise * rng.normal(size=v.shape)) for v in (level, right)))


@pytest.mark.parametrize("gain, gamma", [(1.0, 1.0), (1.3, 0.8), (0.7, 1.25)])
def test_fit_is_the_inverse_and_noise_does_not_shrink_it(gain, gamma):
    fixed = {"a": (np.zeros((1, 3)), np.ones(3))}
    for noise, tolerance in ((0.0, 0.003), (0.1, 0.02)):
        model = fit_colours([noisy_pairs(gain, gamma, noise)], ["a", "b"], [0], fixed)
        np.testing.assert_allclose(model.gamma[1], 1 / gamma, atol=tolerance)
        np.testing.assert_allclose(model.log_gain[1], -np.log(gain) / gamma, atol=tolerance)
        np.testing.assert_array_equal(model.log_gain[0], 0)


def test_fit_survives_wrong_matches_and_says_how_sure_it_is():
    fixed = {"a": (np.zeros((1, 3)), np.ones(3))}
    pairs = noisy_pairs(0.8, 1.0, 0.05, 400)
    wrong = pairs.right_levels.copy()
    wrong[::5] = np.random.default_rng(2).uniform(20, 230, wrong[::5].shape)
    model = fit_colours([dataclasses.replace(pairs, right_levels=wrong)], ["a", "b"], [0], fixed)
    error = model.corrected(1, LEVELS[:20])[0] - LEVELS[:20] / 0.8
    sigma = model.sigma_levels(1, LEVELS[:20])[0]
    assert np.abs(error).max() < 5
    assert 0.2 < np.sqrt((error**2).mean()) / np.sqrt((sigma**2).mean()) < 4
    more = fit_colours([noisy_pairs(0.8, 1.0, 0.05, 6400)], ["a", "b"], [0], fixed)
    assert (more.sigma_levels(1, LEVELS) < model.sigma_levels(1, LEVELS)).all()


def test_clipped_patches_and_those_outside_say_nothing(event):
    camera = event[0].tracks["cam00"].at(0)
    image = np.full((SIZE[1], SIZE[0], 3), 128, np.uint8)
    image[100, 150] = (255, 128, 2)
    sample = make_sample(image, camera, 100)
    colours = sample.colours(np.array([[150.0, 100], [50, 50], [1, 50], [np.nan, 3]]), np.ones(4))
    np.testing.assert_array_equal(np.isfinite(colours[0]), [False, True, False])
    np.testing.assert_array_equal(colours[1], [128, 128, 128])
    assert not np.isfinite(colours[2:]).any()


def write_film(folder: Path, name: str, pictures: list[np.ndarray], status: str = "ok") -> Path:
    """align/cameras/{cam}.json of a folder of images on the common clock."""
    source = folder / "images" / name
    for index, picture in enumerate(pictures):
        write_png(source / f"{index:06d}.png", picture)
    probed = probe_source(source, 30.0, True)
    ingest = {
        "camera": name,
        "source": str(source),
        "kind": "images",
        **dataclasses.asdict(probed.info),
        "pts_s": probed.info.pts_s.tolist(),
        "start_s": 0.0,
        "files": list(probed.files),
        "num_bytes": probed.num_bytes,
        "num_source_frames": len(pictures),
        "sha256": hash_source(source, probed.files),
    }
    count = len(pictures) if status == "ok" else 0
    path = folder / "align" / f"{name}.json"
    write_json(
        path,
        {
            "camera": name, "ingest": ingest, "status": status, "offset_s": 0.0, "rate_ppm": 0.0,
            "sigma_s": 0.0, "method": "given", "fps": 30.0, "num_frames": len(pictures),
            "source_frame": list(range(count)), "dt_s": [0.0] * count,
        },
    )  # fmt: skip
    return path


@pytest.fixture
def files(event, tmp_path) -> dict[str, Path]:
    """cameras.json and the films; cam01 is too dark, cam03 could not be placed in time."""
    scene, pictures = event
    kept = {name: track for name, track in scene.tracks.items() if name != "cam03"}
    write_cameras(
        tmp_path / "cameras.json",
        dataclasses.replace(scene, tracks=kept, inputs=("cam00", "cam01", "cam02"), left_out={"cam03": "no"}),
    )
    paths = {"cameras": tmp_path / "cameras.json"}
    for name in NAMES:
        shown = [pictures[name, frame] for frame in range(NUM_FRAMES)]
        shown = [disturb(picture) for picture in shown] if name == "cam01" else shown
        status = "its clock is not known" if name == "cam03" else "ok"
        paths[name] = write_film(tmp_path, name, shown, status)
    return paths


def run_colour(files: dict[str, Path], output: Path, *flags: str) -> int:
    films = [str(files[name]) for name in NAMES]
    arguments = ["colour", "--cameras", str(files["cameras"]), "--films", *films, "--output", str(output)]
    return run_stage(main, [*arguments, "--num-colour-frames", "2", *flags])


def run_prepare(files: dict[str, Path], name: str, colour: Path, output: Path, *flags: str) -> int:
    arguments = ["prepare", "--film", str(files[name]), "--colour", str(colour), "--output", str(output)]
    return run_stage(main, [*arguments, *flags])


def test_films_are_prepared_from_the_command_line(files, tmp_path):
    colour = tmp_path / "colour.json"
    assert run_colour(files, colour) == 0
    document = read_json(colour)
    assert document["reference"] in ("cam00", "cam02") and document["frames"] == [1, 3]
    assert {n: e["tone"] is not None for n, e in document["cameras"].items()} == {
        n: n == "cam01" for n in NAMES
    }
    assert document["cameras"]["cam03"]["status"] == "its clock is not known"
    for name in NAMES:
        prepared = tmp_path / f"{name}.npz"
        assert run_prepare(files, name, colour, prepared) == 0
        film, original = Archive(prepared).meta, read_json(files[name])
        assert {k: film[k] for k in original} == original
        assert film["tone"] == document["cameras"][name]["tone"]
        if name == "cam03":
            assert film["compensation"] is None
        else:
            assert film["compensation"] == dataclasses.asdict(FramesOptions().compensation)


def test_both_can_be_switched_off(files, tmp_path):
    colour, prepared = tmp_path / "colour.json", tmp_path / "prepared.npz"
    assert run_colour(files, colour, "--match-colours", "false") == 0
    assert {entry["status"] for entry in read_json(colour)["cameras"].values()} == {"switched off"}
    assert run_prepare(files, "cam01", colour, prepared, "--compensate", "false") == 0
    assert (Archive(prepared).meta["tone"], Archive(prepared).meta["compensation"]) == (None, None)


def test_same_films_give_the_same_bytes(files, tmp_path):
    assert run_colour(files, tmp_path / "a.json") == run_colour(files, tmp_path / "b.json") == 0
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


def test_files_that_do_not_fit_end_with_one_sentence(files, tmp_path, capsys):
    (tmp_path / "other.json").write_text('{"camera": "cam00"}')
    colour = tmp_path / "colour.json"
    assert run_colour({**files, "cam00": tmp_path / "other.json"}, colour) == 2
    assert "expected a film on the common clock" in capsys.readouterr().err
    assert run_colour({**files, "cam00": files["cam01"]}, colour) == 2
    assert f"every camera in {files['cameras']}, got none for cam00" in capsys.readouterr().err
    assert not colour.exists()
    colour.write_text('{"cameras": {}}')
    assert run_prepare(files, "cam00", colour, tmp_path / "out.json") == 2
    assert "expected camera cam00 in" in capsys.readouterr().err


def test_schema_defaults_equal_option_defaults():
    schema = yaml.safe_load((REPOSITORY / "config/schemas/frames.schema.yaml").read_text())
    assert {k: v["default"] for k, v in schema["properties"].items()} == dataclasses.asdict(FramesOptions())


def test_the_reference_stays_even_where_every_change_counts(event):
    _, reference, colours = matched(event, options=dataclasses.replace(OPTIONS, min_colour_change=0.0))
    assert reference is not None
    np.testing.assert_array_equal(colours[reference].tables()[0], identity_table())
    assert not colours[reference].is_needed
