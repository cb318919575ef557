"""What a training shows while it runs, and when that makes it stop."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from fourd import io
from fourd.composition import data
from fourd.composition.checkpoint import read_torch
from fourd.composition.infer import compose_frame, estimates_read, load_models
from fourd.composition.model import TEST_STREAMS
from fourd.composition.validation import Composed, draw_validation, is_stale, measure
from fourd.config import SCHEMA_FOLDER, load_yaml
from fourd.errors import InputError
from tests.composition_scene import FRAMES, SIZE, TINY, smooth_image, train_model, write_scene

ON_CAMERA = dataclasses.replace(TINY, validation_camera="cam01", validation_samples=2)


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    torch.set_num_threads(1)
    return write_scene(tmp_path_factory.mktemp("scene"))


def sample_ids(*cams, num_frames=5):
    return [data.SampleId(cam, f, Path("f"), Path("b")) for cam in cams for f in range(num_frames)]


def test_validation_camera_is_not_trained_on_at_all():
    training, apart = data.split_validation(sample_ids("a", "b", "c"), 2, "b")
    assert {sample.cam for sample in training} == {"a", "c"} and len(training) == 10
    assert [(sample.cam, sample.frame) for sample in apart] == [("b", 1), ("b", 3)]
    assert len(data.split_validation(sample_ids("a", "b"), 99, "b")[1]) == 5


@pytest.mark.parametrize(("ids", "cam"), [(sample_ids("a", "b"), "z"), (sample_ids("a"), "a")])
def test_validation_camera_has_to_be_one_of_several(ids, cam):
    with pytest.raises(InputError, match=f"one of several input cameras, got '{cam}' of"):
        data.split_validation(ids, 2, cam)


@pytest.mark.parametrize(
    ("values", "patience", "expected"),
    [
        ([20, 21, 22], 1, False),
        ([20, 21, 21], 1, True),
        ([20, 21, 21.005], 1, True),
        ([20, 22, 21, 21.9], 2, True),
        ([20, 22, 21, 22.1], 2, False),
        ([22, 21, 21], 3, False),
        ([22, 21, 20, 19], None, False),
        (["", "", ""], 1, False),
    ],
)
def test_training_is_stale_when_the_last_epochs_gain_nothing(values, patience, expected):
    assert is_stale([{"validation_psnr_db": value} for value in values], patience) is expected


def test_training_stops_when_it_gains_nothing(sources, tmp_path):
    """Steps too small to change a grey level: the second epoch is already the last."""
    options = dataclasses.replace(ON_CAMERA, epochs=50, patience=2, learning_rate=1e-12)
    train_model(sources, tmp_path, options)
    assert read_torch(tmp_path / "model.pt", ("step",))["step"] == 2 * len(FRAMES)
    assert [row["epoch"] for row in io.read_csv(tmp_path / "train.csv")] == ["0", "1", "2"]


def test_numbers_are_means_over_samples_that_have_pixels():
    truth, valid = np.full((4, 6, 3), 100, np.uint8), np.ones((4, 6), bool)
    good, bad = Composed(truth + 20, truth + 10, truth, valid), Composed(truth, truth, truth, ~valid)
    assert measure([good, bad]) == measure([good])
    assert measure([good])["validation_psnr_db"] == pytest.approx(20 * np.log10(25.5))
    assert measure([bad]) == {}


def test_picture_has_a_row_per_sample_of_at_most_480_px():
    image = np.zeros((540, 960, 3), np.uint8)
    sample = Composed(image, image, image + 255, np.ones((540, 960), bool))
    sheet = draw_validation([sample, sample], 7)
    assert sheet.shape == (18 + 2 * 270 + 4, 3 * 480 + 4, 3)
    assert (sheet[-270:, -480:] == 255).all() and (sheet[-270:, :960] == 0)[:, :480].all()


@pytest.mark.parametrize("options", [ON_CAMERA, TINY])
def test_training_leaves_a_picture_whether_or_not_frames_are_kept_apart(sources, tmp_path, options):
    train_model(sources, tmp_path, options)
    picture = np.asarray(Image.open(tmp_path / "validation.png"))
    num_rows = max(options.validation_samples, 1)
    assert picture.shape == (18 + num_rows * (SIZE[1] + 2), 3 * SIZE[0] + 4, 3)
    # The last column is the camera's own frame, to the bit.
    frame = smooth_image(10 + 2) if options is ON_CAMERA else smooth_image(0)
    np.testing.assert_array_equal(picture[-SIZE[1] :, -SIZE[0] :], frame)
    assert (io.read_csv(tmp_path / "train.csv")[-1]["validation_psnr_db"] != "") == (options is ON_CAMERA)


def test_events_are_written_or_the_extra_is_named(sources, tmp_path):
    options = dataclasses.replace(TINY, tensorboard=True, epochs=1)
    if importlib.util.find_spec("tensorboard") is None:
        with pytest.raises(InputError, match=r"package tensorboard.*fourd\[tensorboard\]"):
            train_model(sources, tmp_path, options)
        return
    train_model(sources, tmp_path, options)
    assert list((tmp_path / "events").glob("events.out.tfevents*"))


def test_the_papers_network_from_training_to_a_frame(sources, tmp_path):
    """Its preset, with fewer filters: at test it reads the consensus and the static background alone."""
    preset = load_yaml(SCHEMA_FOLDER / "composition.schema.yaml")["presets"]["paper"]
    options = dataclasses.replace(TINY, num_filters=(16,), epochs=20, **preset)
    train_model(sources, tmp_path, options)
    rows = io.read_csv(tmp_path / "train.csv")
    assert all(float(row[name]) > 0 for row in rows[1:] for name in ("adversarial", "discriminator"))
    assert float(rows[-1]["reconstruction"]) < 0.8 * float(rows[1]["reconstruction"])
    models = load_models([tmp_path / "model.pt"])
    assert models[0].head == "direct" and models[0].test_streams == TEST_STREAMS["paper"]
    arrays = []
    for kind, paths in (("foreground", sources.foreground), ("background", sources.background)):
        names = estimates_read(models, kind)
        whole = io.Archive(paths[0]).frame(1)
        arrays.append({name: whole[name] for name in names})
    assert [sorted(found) for found in arrays] == [
        ["consensus_rgb", "consensus_valid"],
        ["farthest_rgb", "farthest_valid"],
    ]
    image, rows = compose_frame(models, 1, *arrays)
    assert image.shape == (SIZE[1], SIZE[0], 3) and image.std() > 5
    assert rows[0]["level"] == 0
