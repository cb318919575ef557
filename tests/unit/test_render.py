import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from fourd import cli, io, render, views
from fourd.camera import Camera
from fourd.composition import CascadeOptions
from fourd.composition.checkpoint import save_torch
from fourd.composition.model import CompositionNet
from fourd.errors import InputError
from fourd.video import read_video_frames
from tests.unit.fuse_scene import change_archive

SIZE = (48, 32)
FRAMES = (0, 1, 2, 5)
SCHEMA = Path(__file__).resolve().parents[2] / "config" / "schemas" / "render.schema.yaml"


def make_estimates(folder: Path, name: str = "film", size=SIZE) -> None:
    """View file, foreground and background archives; frames 2 and 5 share one background."""
    K = np.array([[50.0, 0, 23.5], [0, 50, 15.5], [0, 0, 1]])
    camera = Camera(K, np.eye(3), np.zeros(3), SIZE)
    entries = tuple(views.ViewFrame(frame, 3, camera) for frame in FRAMES)
    views.write_view(folder / f"{name}.json", views.View(name, "virtual", SIZE, entries))
    shape = (size[1], size[0])
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    with io.ArchiveWriter(folder / "foreground.npz", {"view": name}) as writer:
        for frame in FRAMES:
            rgb = np.stack([4 * x, 6 * y, np.full(shape, 40 * frame)], -1).astype(np.uint8)
            writer.add_frame(frame, consensus_rgb=rgb, consensus_valid=x < 20)
    same_as = {"5": 2}
    with io.ArchiveWriter(folder / "background.npz", {"view": name, "same_as": same_as}) as writer:
        for frame in FRAMES[:3]:
            rgb = np.full((*shape, 3), 10 * frame + 90, np.uint8)
            writer.add_frame(frame, farthest_rgb=rgb, farthest_valid=(x < 40) | (y < 8))


def make_models(folder: Path, num_levels: int = 2, streams: str = "paper") -> list[Path]:
    torch.manual_seed(0)
    paths = []
    for level in range(num_levels):
        network = {"num_filters": 2, "unet_width": 1, "depth": 2, "head": "blend", "level": level}
        network["streams"] = streams
        document = {"level": level, "num_levels": num_levels, "network": network}
        state = CompositionNet(**network).state_dict()
        paths.append(folder / f"level{level}.pt")
        save_torch(paths[-1], {**document, "state_dict": state})
    return paths


@pytest.fixture
def estimates(tmp_path):
    make_estimates(tmp_path)
    return tmp_path


def frames_command(folder: Path, models, output: Path, frames=FRAMES, extra=()) -> list[str]:
    return [
        *("frames", "--view-file", str(folder / "film.json"), "--models", *map(str, models)),
        *("--foreground", str(folder / "foreground.npz"), "--background", str(folder / "background.npz")),
        *("--frames", *map(str, frames), "--device", "cpu", *extra, "--output", str(output)),
    ]


def test_schema_and_options_agree():
    properties = yaml.safe_load(SCHEMA.read_text())["properties"]
    expected = {field.name: field.default for field in dataclasses.fields(render.RenderOptions)}
    assert {key: entry["default"] for key, entry in properties.items()} == expected
    assert {field.name for field in dataclasses.fields(CascadeOptions)} == set(expected)


def test_frames_are_pasted_by_an_untrained_blend(estimates):
    output = estimates / "render" / "000000-000005"
    render.main(frames_command(estimates, make_models(estimates, 1), output))
    assert sorted(p.name for p in output.iterdir()) == [f"{f:06d}.png" for f in FRAMES] + ["holes.csv"]
    for frame, shared in zip(FRAMES, (0, 1, 2, 2), strict=True):
        image = io.read_image(output / f"{frame:06d}.png")
        assert image[5, 10].tolist() == [40, 30, 40 * frame]
        assert image[5, 30].tolist() == [10 * shared + 90] * 3


def test_holes_are_reported_per_frame_and_level(estimates):
    output = estimates / "out"
    render.main(frames_command(estimates, make_models(estimates, 2), output))
    with (output / "holes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(int(r["frame"]), int(r["level"])) for r in rows] == [
        (f, level) for f in FRAMES for level in (0, 1)
    ]
    fine = [r for r in rows if r["level"] == "1"]
    assert all(float(r["hole_share"]) == pytest.approx(8 * 24 / (48 * 32)) for r in fine)
    assert all(float(r["filled_share"]) == float(r["hole_share"]) for r in fine)


def test_options_reach_the_cascade(estimates):
    output = estimates / "out"
    extra = ("--min-hole-share", "0.9", "--min-largest-hole-share", "0.9")
    render.main(frames_command(estimates, make_models(estimates, 2), output, extra=extra))
    with (output / "holes.csv").open() as file:
        assert {row["level"] for row in csv.DictReader(file)} == {"1"}


def test_same_input_gives_the_same_bytes_and_replaces_old_output(estimates):
    models = make_models(estimates)
    output = estimates / "out"
    render.main(frames_command(estimates, models, output))
    first = {p.name: p.read_bytes() for p in output.iterdir()}
    (output / "000099.png").write_bytes(b"old")
    (estimates / ".out.tmp").mkdir()
    render.main(frames_command(estimates, models, output))
    assert {p.name: p.read_bytes() for p in output.iterdir()} == first
    assert not list(estimates.glob(".*tmp*"))


def test_failed_render_leaves_nothing(estimates):
    output = estimates / "out"
    with pytest.raises(InputError, match="expected one of its 4 frames, got 3"):
        render.main(frames_command(estimates, make_models(estimates), output, frames=(0, 3)))
    with io.ArchiveWriter(estimates / "background.npz", {"view": "film"}) as writer:
        writer.add_frame(
            0, farthest_rgb=np.zeros((32, 48, 3), np.uint8), farthest_valid=np.ones((32, 48), bool)
        )
    with pytest.raises(InputError, match="expected farthest_rgb of frame 1 in"):
        render.main(frames_command(estimates, make_models(estimates), output, frames=(0, 1)))
    assert not output.exists() and not list(estimates.glob(".*tmp*"))


def test_estimates_of_another_view_or_size_are_refused(estimates, tmp_path):
    models = make_models(estimates)
    with io.ArchiveWriter(estimates / "background.npz", {"view": "cam02"}):
        pass
    with pytest.raises(InputError, match="expected the estimates of view film in .*got cam02"):
        render.main(frames_command(estimates, models, estimates / "out"))
    make_estimates(estimates, size=(40, 32))
    with pytest.raises(InputError, match="expected pictures of 48 x 32 px"):
        render.main(frames_command(estimates, models, estimates / "out"))


@pytest.mark.parametrize(
    ("file", "arrays", "meta"),
    [
        ("foreground", {"000005/consensus_rgb": np.zeros(0, np.uint8)}, {}),
        ("foreground", {"000002/consensus_valid": np.ones((1, 48), bool)}, {}),
        ("foreground", {"000002/consensus_rgb": np.full((32, 48, 3), np.inf)}, {}),
        ("foreground", {"000001/consensus_valid": np.full((32, 48), "x")}, {}),
        ("background", {"000002/farthest_rgb": np.zeros((32, 48), np.uint8)}, {}),
        ("background", {}, {"same_as": [2]}),
        ("background", {}, {"same_as": {"5": None}}),
    ],
)
def test_damaged_estimates_are_named(estimates, file, arrays, meta):
    change_archive(estimates / f"{file}.npz", arrays, meta)
    with pytest.raises(InputError, match=rf"{file}\.npz"):
        render.main(frames_command(estimates, make_models(estimates), estimates / "out"))


@pytest.mark.parametrize(
    "change",
    [
        {"num_levels": None},
        {"level": ["a"]},
        {"network": {"level": "x"}},
        {"network": {"level": 0, "depth": "x"}},
        {"state_dict": 1.5},
    ],
)
def test_damaged_models_are_named(estimates, change):
    first, second = make_models(estimates)
    torch.save({**torch.load(first), **change}, first)
    with pytest.raises(InputError, match=r"level0\.pt"):
        render.main(frames_command(estimates, [first, second], estimates / "out"))


def test_a_model_without_finite_weights_is_refused(estimates):
    (path,) = make_models(estimates, 1)
    document = torch.load(path)
    next(iter(document["state_dict"].values())).view(-1)[0] = torch.nan
    torch.save(document, path)
    with pytest.raises(InputError, match="finite weights for level 0"):
        render.main(frames_command(estimates, [path], estimates / "out"))


def test_a_model_that_was_cut_off_is_named(estimates):
    (path,) = make_models(estimates, 1)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match=r"whole file of this training in .*level0\.pt"):
        render.main(frames_command(estimates, [path], estimates / "out"))


def test_missing_model_ends_in_one_sentence(estimates, capsys):
    status = cli.run_stage(render.main, frames_command(estimates, ["nothing.pt"], estimates / "out"))
    assert status == 2
    assert "nothing.pt" in capsys.readouterr().err


def test_film_has_the_frames_of_all_folders_in_order(tmp_path):
    grey = {0: 40, 1: 90, 2: 140, 3: 190}
    for chunk in ((0, 1), (2, 3)):
        for frame in chunk:
            io.write_png(
                tmp_path / str(chunk[0]) / f"{frame:06d}.png", np.full((32, 48, 3), grey[frame], np.uint8)
            )
    film = tmp_path / "film.mp4"
    render.main(
        [
            "video",
            "--frames-dir",
            str(tmp_path / "2"),
            str(tmp_path / "0"),
            "--fps",
            "30",
            "--output",
            str(film),
        ]
    )
    shown = [image.mean() for _, image in read_video_frames(film, range(4))]
    np.testing.assert_allclose(shown, list(grey.values()), atol=3)


def test_film_with_a_gap_is_refused(tmp_path):
    for frame in (0, 2):
        io.write_png(tmp_path / "a" / f"{frame:06d}.png", np.zeros((32, 48, 3), np.uint8))
    with pytest.raises(InputError, match="from 0 to 2, but frame 1 is missing"):
        render.run_video([tmp_path / "a"], 30, tmp_path / "film.mp4")
    with pytest.raises(InputError, match="expected a folder"):
        render.run_video([tmp_path / "none"], 30, tmp_path / "film.mp4")
    io.write_png(tmp_path / "b" / "000002.png", np.zeros((32, 48, 3), np.uint8))
    with pytest.raises(InputError, match="expected frame 2 once"):
        render.run_video([tmp_path / "a", tmp_path / "b"], 30, tmp_path / "film.mp4")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="found none"):
        render.run_video([tmp_path / "empty"], 30, tmp_path / "film.mp4")


def test_unknown_device_is_named():
    if torch.cuda.is_available():
        pytest.skip("this machine has a CUDA device")
    assert cli.choose_torch_device("auto") == "cpu"
    with pytest.raises(InputError, match="CUDA finds none"):
        cli.choose_torch_device("cuda:1")
