import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from fourd import cli, io
from fourd.camera import Camera, CameraTrack
from fourd.composition import CompositionOptions, data
from fourd.composition.__main__ import Sources, main, parse, read_training_views, run
from fourd.composition.checkpoint import Checkpoint, StopRequest, read_torch
from fourd.composition.infer import compose_frame, load_models, paste
from fourd.composition.model import PRECISIONS, resolve_precision
from fourd.composition.train import Trainer, train, update
from fourd.errors import InputError
from fourd.sfm import SceneCameras, write_cameras
from tests.films import put_on_clock

ROOT = Path(__file__).resolve().parents[2]
SIZE = (32, 24)
FRAMES = (0, 1, 2)
CAMS = ("cam00", "cam01")
TINY = CompositionOptions(
    num_filters=(3, 3, 3),
    depth=1,
    epochs=2,
    crop=16,
    learning_rate=1e-3,
    validation_samples=0,
    checkpoint_s=1e9,
)


def smooth_image(seed):
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    phase = np.random.default_rng(seed).uniform(0, 6, 3)
    return (128 + 80 * np.sin(x[..., None] / 4 + y[..., None] / 6 + phase)).astype(np.uint8)


def write_scene(folder):
    """Two cameras, three frames: the estimates are the truth with noise and blanks."""
    camera = Camera(np.array([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]]), np.eye(3), np.zeros(3), SIZE)
    rng = np.random.default_rng(0)
    frames = [{"frame": f, "scene_frame": f, **camera.to_dict()} for f in FRAMES]
    for number, cam in enumerate(CAMS):
        truth = [smooth_image(10 * number + f) for f in FRAMES]
        for f in FRAMES:
            io.write_png(folder / f"images/{cam}/{f:06d}.png", truth[f])
        put_on_clock(folder / f"images/{cam}", cam, folder / f"films/{cam}.json", 30, len(FRAMES))
        io.write_json(folder / f"views/{cam}.json", {"role": "input", "size": list(SIZE), "frames": frames})
        for kind, keys in (("foreground", ("consensus", "closest", "median", "farthest")),
                           ("background", ("farthest", "median"))):  # fmt: skip
            with io.ArchiveWriter(folder / f"{kind}/{cam}/000000-000002.npz", {"view": cam}) as writer:
                for f in FRAMES:
                    for key in keys:
                        noisy = np.clip(truth[f] + rng.normal(0, 25, truth[f].shape), 0, 255).astype(np.uint8)
                        valid = rng.random(truth[f].shape[:2]) < 0.7
                        noisy[~valid] = 0
                        writer.add_frame(f, **{f"{key}_rgb": noisy, f"{key}_valid": valid})
    tracks = {cam: CameraTrack(cam, (camera,), 0.5, 10.0) for cam in CAMS}
    scene = SceneCameras(30.0, 3, CAMS, (), tracks, np.zeros(3), 1.0, np.array([0, -1.0, 0]), {})
    write_cameras(folder / "sfm/cameras.json", scene)
    return Sources(
        tuple(folder / f"views/{cam}.json" for cam in CAMS),
        tuple(folder / f"foreground/{cam}/000000-000002.npz" for cam in CAMS),
        tuple(folder / f"background/{cam}/000000-000002.npz" for cam in CAMS),
        {cam: folder / f"films/{cam}.json" for cam in CAMS},
        folder / "sfm/cameras.json",
    )


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    torch.set_num_threads(1)
    return write_scene(tmp_path_factory.mktemp("scene"))


def train_model(sources, folder, options=TINY, level=0, num_levels=1):
    run(sources, level, num_levels, folder / "model.pt", folder / "train.csv", options, "cpu")
    return torch.load(folder / "model.pt", weights_only=True)["state_dict"]


def are_equal(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)


def command_line(sources, folder, options):
    words = ["train", "--level", "0", "--num-levels", "1", "--threads", "1", "--device", "cpu"]
    words += ["--views", *map(str, sources.views), "--foreground", *map(str, sources.foreground)]
    words += ["--background", *map(str, sources.background), "--cameras", str(sources.cameras)]
    words += ["--films", *(f"{cam}={path}" for cam, path in sources.films.items())]
    words += ["--output-model", str(folder / "model.pt"), "--output-log", str(folder / "train.csv")]
    for key, value in dataclasses.asdict(options).items():
        values = value if isinstance(value, tuple) else ["none" if value is None else value]
        words += ["--" + key.replace("_", "-"), *map(str, values)]
    return words


def test_options_equal_the_schema():
    schema = yaml.safe_load((ROOT / "config/schemas/composition.schema.yaml").read_text())
    defaults = {key: entry["default"] for key, entry in schema["properties"].items()}
    options = dataclasses.asdict(CompositionOptions())
    assert defaults == options | {"num_filters": list(options["num_filters"])}
    assert not schema["additionalProperties"]
    assert all(entry["description"] for entry in schema["properties"].values())


def test_options_survive_the_command_line(sources, tmp_path):
    args = parse(command_line(sources, tmp_path, TINY))
    assert cli.options_from_args(CompositionOptions, args) == TINY
    assert dict(args.films) == sources.films


def one_sample(seed=0, side=16):
    rng = np.random.default_rng(seed)
    images = np.full((7, side, side, 4), 255, np.uint8)
    for i in range(7):
        images[i, ..., :3] = smooth_image(7 * seed + i)[:side, :side]
    images[0, :, :, 3] = 255 * (rng.random((side, side)) < 0.6)
    images[0] &= images[0, :, :, 3:]
    target, valid = data.target_from_images(images)
    return data.streams_from_images(images, data.TRAINING_STREAMS), target, valid


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("head", ["blend", "direct"])
def test_one_batch_is_overfitted(head, precision):
    torch.set_num_threads(1)
    options = dataclasses.replace(
        TINY, num_filters=(6,), depth=2, head=head, learning_rate=2e-3, precision=precision
    )
    trainer, sample, history = Trainer(0, options, "cpu"), one_sample(), []
    for _ in range(150):
        result = update(trainer, *sample, options)
        assert result is not None
        history.append(result[0]["reconstruction"])
    assert min(history[-10:]) < history[0] / 10


def test_half_precision_follows_full_precision():
    """Losses and picture of the first steps differ by the rounding of the convolutions only."""
    rows, images = [], []
    for precision in PRECISIONS:
        options = dataclasses.replace(TINY, num_filters=(6,), precision=precision)
        trainer, sample = Trainer(0, options, "cpu"), one_sample()
        for _ in range(3):
            terms, output = update(trainer, *sample, options)
            assert output.dtype == torch.float32
        assert all(p.dtype == torch.float32 for p in trainer.generator.parameters())
        rows.append(terms)
        images.append(output)
    assert rows[0] == pytest.approx(rows[1], rel=0.02)
    assert float((images[0] - images[1]).abs().max()) < 2 / 255
    assert not torch.equal(*images)


def test_automatic_precision_is_one_the_device_has():
    assert resolve_precision("auto", "cpu") in PRECISIONS
    assert resolve_precision("bfloat16", "cpu") == "bfloat16"
    with pytest.raises(InputError, match="float32 or bfloat16, got 'float8'"):
        resolve_precision("float8", "cpu")


def test_update_refuses_a_step_that_is_not_finite():
    options = dataclasses.replace(TINY, num_filters=(2,))
    trainer, (streams, target, valid) = Trainer(0, options, "cpu"), one_sample()
    before = {key: value.clone() for key, value in trainer.generator.state_dict().items()}
    assert update(trainer, streams * float("inf"), target, valid, options) is None
    assert are_equal(before, trainer.generator.state_dict())
    assert update(trainer, streams, target, valid, options) is not None
    assert not are_equal(before, trainer.generator.state_dict())


def test_without_adversary_the_discriminator_is_left_alone():
    options = dataclasses.replace(TINY, num_filters=(2,), adversarial_weight=0.0)
    trainer = Trainer(0, options, "cpu")
    before = {key: value.clone() for key, value in trainer.discriminator.state_dict().items()}
    terms, _ = update(trainer, *one_sample(), options)
    assert are_equal(before, trainer.discriminator.state_dict())
    assert "adversarial" not in terms


def test_three_bad_steps_in_a_row_stop_with_a_sentence(sources, tmp_path):
    options = dataclasses.replace(TINY, learning_rate=1e30, epochs=5)
    with pytest.raises(InputError, match="3 steps in a row.*lower learning_rate"):
        train_model(sources, tmp_path, options)
    assert not (tmp_path / "model.pt").exists()


def test_same_seed_same_weights_and_same_file(sources, tmp_path):
    first = train_model(sources, tmp_path / "a")
    assert are_equal(first, train_model(sources, tmp_path / "b"))
    assert (tmp_path / "a/model.pt").read_bytes() == (tmp_path / "b/model.pt").read_bytes()
    assert not are_equal(first, train_model(sources, tmp_path / "c", dataclasses.replace(TINY, seed=1)))


def test_cache_does_not_change_the_weights(sources, tmp_path):
    first = train_model(sources, tmp_path / "a")
    assert are_equal(first, train_model(sources, tmp_path / "b", dataclasses.replace(TINY, cache_mb=0)))


def interrupted_training(sources, folder, options, num_interruptions):
    """Training that is stopped after each of its first steps, every time by a new process' objects."""
    for _ in range(num_interruptions):
        samples = data.SampleSet(
            sources.foreground,
            sources.background,
            lambda cam, f: (smooth_image(f), np.ones((24, 32), bool)),
            1,
            8,
        )
        trainer, save = Trainer(0, options, "cpu"), Checkpoint(folder / "checkpoint.pt", "same")
        save.restore(trainer, 10**6)
        stop = StopRequest()
        stop.signal_number = signal.SIGTERM if num_interruptions > 1 else None
        num_interruptions -= 1
        try:
            train(trainer, samples, (samples.ids, []), options, save, stop)
        except SystemExit as exit_request:
            assert exit_request.code == 128 + signal.SIGTERM
    return trainer.generator.state_dict(), trainer.counters


@pytest.mark.parametrize("precision", PRECISIONS)
def test_training_interrupted_at_every_step_equals_uninterrupted(sources, tmp_path, precision):
    options = dataclasses.replace(TINY, precision=precision)
    whole, counters = interrupted_training(sources, tmp_path / "a", options, 1)
    parts, counters_of_parts = interrupted_training(sources, tmp_path / "b", options, 9)
    assert counters["step"] == counters_of_parts["step"] == 12
    assert are_equal(whole, parts)
    timeless = [[{**row, "seconds": 0} for row in c["rows"]] for c in (counters, counters_of_parts)]
    assert timeless[0] == timeless[1]


def test_more_epochs_continue_a_finished_training(sources, tmp_path, caplog):
    caplog.set_level("INFO")
    whole = train_model(sources, tmp_path / "a", dataclasses.replace(TINY, epochs=3))
    train_model(sources, tmp_path / "b", dataclasses.replace(TINY, epochs=1))
    assert are_equal(whole, train_model(sources, tmp_path / "b", dataclasses.replace(TINY, epochs=3)))
    assert "continuing from" in caplog.text


def test_checkpoint_of_other_options_is_ignored_with_a_sentence(sources, tmp_path, caplog):
    caplog.set_level("INFO")
    train_model(sources, tmp_path / "a")
    other = dataclasses.replace(TINY, seed=5)
    again = train_model(sources, tmp_path / "a", other)
    assert "is ignored: it was made with other options" in caplog.text
    assert are_equal(again, train_model(sources, tmp_path / "b", other))
    train_model(sources, tmp_path / "a", dataclasses.replace(other, epochs=1))
    assert "is ignored: it is past the 6 steps" in caplog.text


def test_broken_checkpoint_is_named(sources, tmp_path):
    (tmp_path / "checkpoint.pt").write_bytes(b"half a file")
    with pytest.raises(InputError, match=r"checkpoint\.pt.*delete it"):
        train_model(sources, tmp_path)


def test_time_limit_stops_early_and_still_gives_a_model(sources, tmp_path):
    train_model(sources, tmp_path, dataclasses.replace(TINY, epochs=10**5, max_minutes=0.01))
    assert 0 < read_torch(tmp_path / "model.pt", ("step",))["step"] < 6 * 10**5
    assert float(io.read_csv(tmp_path / "train.csv")[-1]["seconds"]) < 60


def test_log_has_a_row_per_epoch_with_every_column(sources, tmp_path):
    train_model(sources, tmp_path)
    rows = io.read_csv(tmp_path / "train.csv")
    assert [row["epoch"] for row in rows] == ["0", "1", "2"]
    assert [row["step"] for row in rows] == ["0", "6", "12"]
    assert rows[0]["reconstruction"] == ""
    assert all(float(row["reconstruction"]) > 0 and row["skipped_steps"] == "0" for row in rows[1:])


def test_trained_model_beats_the_paste_at_test_time_inputs(sources, tmp_path):
    options = dataclasses.replace(TINY, epochs=16, num_filters=(4,), learning_rate=5e-3)
    train_model(sources, tmp_path, options)
    models = load_models([tmp_path / "model.pt"])
    errors = []
    for number in range(len(CAMS)):
        archives = [io.Archive(p) for p in (sources.foreground[number], sources.background[number])]
        for f in FRAMES:
            arrays = [archive.frame(f) for archive in archives]
            pair = compose_frame(models, f, *arrays)[0], paste(*arrays)
            truth = smooth_image(10 * number + f).astype(float)
            errors.append([np.square(image - truth).mean() for image in pair])
    composed, pasted = np.mean(errors, axis=0)
    assert composed < 0.9 * pasted


def test_lower_level_trains_on_reduced_samples(sources, tmp_path):
    train_model(sources, tmp_path, dataclasses.replace(TINY, epochs=1, crop=None), level=0, num_levels=2)
    document = read_torch(tmp_path / "model.pt", ("network", "options"))
    assert (document["level"], document["num_levels"]) == (0, 2)
    assert document["network"]["num_filters"] == 3


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_sigterm_saves_and_the_next_run_continues_bit_for_bit(sources, tmp_path):
    options = dataclasses.replace(TINY, epochs=10**5, checkpoint_s=0.0)
    command = [sys.executable, "-m", "fourd.composition", *command_line(sources, tmp_path, options)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while (
        not (tmp_path / "checkpoint.pt").exists() and process.poll() is None and time.monotonic() < deadline
    ):
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, messages = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM, messages
    assert "run again to continue" in messages
    assert not (tmp_path / "model.pt").exists()
    done = read_torch(tmp_path / "checkpoint.pt", ("counters",))["counters"]["step"]
    rest = dataclasses.replace(options, epochs=done // 6 + 2)
    assert are_equal(train_model(sources, tmp_path, rest), train_model(sources, tmp_path / "whole", rest))


def test_heldout_view_is_never_trained_on(sources, tmp_path):
    view = io.read_json(sources.views[0]) | {"role": "heldout"}
    io.write_json(tmp_path / "cam00.json", view)
    with pytest.raises(InputError, match="input camera.*'heldout'"):
        read_training_views([tmp_path / "cam00.json"])


def test_camera_without_video_is_named(sources, tmp_path):
    with_one = dataclasses.replace(sources, films={"cam00": sources.films["cam00"]})
    with pytest.raises(InputError, match="camera cam01 of --views in --films"):
        train_model(with_one, tmp_path)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"epochs": 0}, "epochs above 0"),
        ({"max_scale": 0.5}, "max_scale of at least 1"),
        ({"streams": "some"}, "streams to be one of all, paper"),
        ({"num_filters": ()}, "num_filters for level 0"),
        ({"head": "softmax"}, "head"),
    ],
)
def test_unusable_options_are_refused(sources, tmp_path, change, sentence):
    with pytest.raises(InputError, match=sentence):
        train_model(sources, tmp_path, dataclasses.replace(TINY, **change))


def test_command_line_reports_bad_input_in_one_sentence(sources, tmp_path, capsys):
    gone = dataclasses.replace(sources, foreground=(tmp_path / "absent.npz",))
    assert cli.run_stage(main, command_line(gone, tmp_path, TINY)) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: expected")
    assert "absent.npz" in message
    torch.use_deterministic_algorithms(False)
