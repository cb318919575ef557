import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from fourd import cli, io
from fourd.composition import CompositionOptions, data
from fourd.composition.__main__ import main, parse, read_training_views
from fourd.composition.checkpoint import read_torch
from fourd.composition.infer import compose_frame, load_models, paste
from fourd.composition.model import PRECISIONS, resolve_precision
from fourd.composition.train import AVERAGE_POWER, Trainer, train_step, update
from fourd.errors import InputError
from tests.composition_scene import (
    CAMS,
    FRAMES,
    TINY,
    are_equal,
    command_line,
    smooth_image,
    train_model,
    write_scene,
)

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    torch.set_num_threads(1)
    return write_scene(tmp_path_factory.mktemp("scene"))


def test_options_equal_the_schema():
    schema = yaml.safe_load((ROOT / "config/schemas/composition.schema.yaml").read_text())
    defaults = {key: entry["default"] for key, entry in schema["properties"].items()}
    options = dataclasses.asdict(CompositionOptions())
    assert defaults == options | {"num_filters": list(options["num_filters"])}
    assert not schema["additionalProperties"]
    assert all(entry["description"] for entry in schema["properties"].values())


def test_preset_of_the_paper_undoes_every_departure_from_it():
    schema = yaml.safe_load((ROOT / "config/schemas/composition.schema.yaml").read_text())
    paper = CompositionOptions(**schema["presets"]["paper"])
    assert (paper.head, paper.streams, paper.num_filters) == ("direct", "paper", (28, 23, 13))
    assert (paper.l1_weight, paper.adversarial_weight, paper.frequency_weight) == (100, 1, 100)
    assert (paper.learning_rate, paper.warmup_steps, paper.average_weights) == (2e-4, 0, False)
    assert (paper.epochs, paper.crop, paper.min_scale, paper.max_scale) == (10, None, 1, 1.5)


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


def test_used_network_is_the_weighted_mean_of_all_steps():
    """Weights of step s in the average after n steps are as (s + 1) ... (s + power - 1): late steps count."""
    trainer, sample = Trainer(0, TINY, "cpu"), one_sample()
    seen = []
    for step in range(1, 7):
        update(trainer, *sample, TINY)
        trainer.update_average(step)
        seen.append([p.detach().clone() for p in trainer.generator.parameters()])
    shares = np.array([np.prod(np.arange(s, s + AVERAGE_POWER, dtype=float)) for s in range(1, 7)])
    shares /= shares.sum()
    for number, mean in enumerate(trainer.network.parameters()):
        expected = sum(share * weights[number] for share, weights in zip(shares, seen, strict=True))
        torch.testing.assert_close(mean, expected, rtol=1e-5, atol=1e-6)
    last = dataclasses.replace(TINY, average_weights=False)
    assert Trainer(0, last, "cpu").network.training
    assert "average" not in Trainer(0, last, "cpu").state()


def test_step_size_grows_to_its_value_and_stays(sources):
    samples = data.SampleSet(
        sources.foreground,
        sources.background,
        lambda cam, f: (smooth_image(f), np.ones((24, 32), bool)),
        1,
        8,
    )
    for warmup, expected in ((4, [0.25, 0.5, 0.75, 1, 1]), (0, [1, 1, 1, 1, 1])):
        options = dataclasses.replace(TINY, warmup_steps=warmup)
        trainer, rates = Trainer(0, options, "cpu"), []
        for _ in range(5):
            train_step(trainer, samples, samples.ids, options)
            rates.append(trainer.generator_optimizer.param_groups[0]["lr"] / options.learning_rate)
        assert rates == pytest.approx(expected)


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


def test_time_limit_stops_early_and_still_gives_a_model(sources, tmp_path):
    train_model(sources, tmp_path, dataclasses.replace(TINY, epochs=10**5, max_minutes=0.01))
    assert 0 < read_torch(tmp_path / "model.pt", ("step",))["step"] < 6 * 10**5
    assert float(io.read_csv(tmp_path / "train.csv")[-1]["seconds"]) < 60


def test_outputs_that_are_gone_come_back_from_a_finished_training(sources, tmp_path):
    names = "model.pt", "train.csv", "validation.png"
    train_model(sources, tmp_path)
    before = [(tmp_path / name).read_bytes() for name in names]
    for name in names:
        (tmp_path / name).unlink()
    train_model(sources, tmp_path)
    assert [(tmp_path / name).read_bytes() for name in names] == before


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
        ({"min_scale": 0.4}, "min_scale of at least 0.5"),
        ({"min_scale": 1.2}, "at most max_scale, got 1.2 and 1.0"),
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
