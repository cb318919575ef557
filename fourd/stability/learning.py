"""Losses, network and training at the ends of their number range; torch is loaded by the first case."""

import copy
import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from fourd.composition import CompositionOptions
from fourd.stability.case import Outcome, judge, judge_refusal, make_cases, reason_of, relative_difference

OPTIONS = CompositionOptions(num_filters=(3,), depth=1, learning_rate=1e-3)
# Untrained, the other head gives exactly the paste, whatever the layers before it do.
DIRECT = dataclasses.replace(OPTIONS, head="direct")
SIZE = (24, 40)
# One behind the other: 3 of a stream, 7 of the U-Net, 2 of the head in bfloat16.
NUM_LAYERS = 12


def _sample(height: int, width: int, batch: int = 1, seed: int = 0) -> tuple[Any, Any, Any]:
    """Streams (B, 6, 4, H, W), target (B, 3, H, W) and validity, partly blank."""
    import torch

    generator = torch.Generator().manual_seed(seed)
    streams = torch.rand((batch, 6, 4, height, width), generator=generator)
    streams[:, :, 3] = (streams[:, :, 3] > 0.4).float()
    streams[:, :, :3] *= streams[:, :, 3:]
    target = torch.rand((batch, 3, height, width), generator=generator)
    return streams, target, torch.ones((batch, 1, height, width), dtype=torch.bool)


def _trainer(options: CompositionOptions = OPTIONS) -> Any:
    import torch

    from fourd.composition.train import Trainer

    torch.set_num_threads(1)
    return Trainer(0, options, "cpu")


def _in_both_precisions(loss: Callable[..., Any], *images: Any) -> tuple[float, float]:
    """A loss in float32, and its relative difference from the loss in float64."""
    single = float(loss(*(x if x.dtype == _bool() else x.float() for x in images)))
    double = float(loss(*(x if x.dtype == _bool() else x.double() for x in images)))
    return single, relative_difference(np.array(single), np.array(double))


def _bool() -> Any:
    import torch

    return torch.bool


def discriminator_that_is_certain() -> Outcome:
    """-log 1 is 0 and -log 0 grows with the logit, gradients are finite."""
    import torch

    from fourd.composition import losses

    logits = torch.tensor([-1e4, 1e4], requires_grad=True)
    terms = [losses.generator_loss(logits[i : i + 1]) for i in range(2)]
    terms.append(losses.discriminator_loss(logits[1:], logits[:1]))
    terms.append(losses.discriminator_loss(logits[:1], logits[1:]))
    torch.stack(terms).sum().backward()
    values = [float(term.detach()) for term in terms]
    finite = logits.grad is not None and bool(torch.isfinite(logits.grad).all())
    error = relative_difference(np.array(values), np.array([1e4, 0, 0, 2e4]))
    return judge(finite and error < 1e-6, f"losses {values}", error)


def discriminator_that_knows_nothing() -> Outcome:
    """-2 log 0.5."""
    import torch

    from fourd.composition import losses

    zero = torch.zeros(4)
    value, error = _in_both_precisions(losses.discriminator_loss, zero, zero)
    return judge(abs(value - 2 * np.log(2)) < 1e-6, f"{value:.6f}", error)


def spectrum_of_a_constant() -> Outcome:
    """The closed form: difference over the root of the number of pixels."""
    import torch

    from fourd.composition import losses

    height, width = 37, 53
    ones = torch.ones((1, 3, height, width))
    valid = torch.ones((1, 1, height, width), dtype=torch.bool)
    value, error = _in_both_precisions(losses.frequency_loss, ones, 0 * ones, valid)
    expected = 1 / np.sqrt(height * width)
    return judge(abs(value / expected - 1) < 1e-4, f"{value:.6f}, closed form {expected:.6f}", error)


def spectrum_of_nothing() -> Outcome:
    """Loss and gradient are 0 where output and target are equal, not NaN."""
    import torch

    from fourd.composition import losses

    _, target, valid = _sample(*SIZE)
    output = target.clone().requires_grad_(True)
    loss = losses.frequency_loss(output, target, valid) + losses.reconstruction_loss(output, target, valid)
    loss.backward()
    gradient = output.grad
    is_right = float(loss.detach()) == 0 and gradient is not None and bool(torch.isfinite(gradient).all())
    return judge(is_right, f"loss {float(loss.detach()):g}")


def losses_in_single_precision() -> Outcome:
    """Reconstruction and frequency loss of float32 as of float64, within 1e-5."""
    from fourd.composition import losses

    _, target, valid = _sample(540, 960)
    output = target.flip(3)
    errors = [
        _in_both_precisions(loss, output, target, valid)[1]
        for loss in (losses.reconstruction_loss, losses.frequency_loss)
    ]
    return judge(max(errors) < 1e-5, f"within {max(errors):.1g}", max(errors))


def losses_of_half_precision_pictures() -> Outcome:
    """The losses of float32: sums over a picture do not end at 65504."""
    from fourd.composition import losses

    _, target, valid = _sample(270, 480)
    output = target.flip(3)
    errors = []
    for loss in (losses.reconstruction_loss, losses.frequency_loss):
        half = float(loss(output.half(), target.half(), valid))
        errors.append(relative_difference(np.array(half), np.array(float(loss(output, target, valid)))))
    return judge(max(errors) < 2e-3, f"within {max(errors):.1g}", max(errors))


def nothing_valid() -> Outcome:
    """A loss of 0 with a gradient of 0: nothing to learn from."""
    import torch

    from fourd.composition import losses

    _, target, valid = _sample(*SIZE)
    output = target.flip(3).requires_grad_(True)
    loss = losses.reconstruction_loss(output, target, ~valid) + losses.frequency_loss(output, target, ~valid)
    loss.backward()
    gradient = output.grad
    is_right = float(loss.detach()) == 0 and gradient is not None and bool(torch.all(gradient == 0))
    return judge(is_right, f"loss {float(loss.detach()):g}")


def target_that_is_no_number() -> Outcome:
    """Refused where it counts."""
    from fourd.composition import losses

    _, target, valid = _sample(*SIZE)
    broken = target.clone()
    broken[0, 1, 2, 3] = float("nan")
    return judge_refusal(reason_of(losses.frequency_loss, target, broken, valid), "NaN")


def target_that_is_no_number_where_invalid() -> Outcome:
    """Left out: the loss of the rest."""
    from fourd.composition import losses

    _, target, valid = _sample(*SIZE)
    broken, masked = target.clone(), valid.clone()
    broken[0, 1, 2, 3] = float("nan")
    masked[0, 0, 2, 3] = False
    output = target.flip(3)
    values = [float(losses.frequency_loss(output, t, masked)) for t in (broken, target)]
    return judge(values[0] == values[1] and np.isfinite(values[0]), f"{values[0]:.4f}")


def batch_of_one() -> Outcome:
    """A sample's output does not depend on the others in its batch."""
    import torch

    network = _trainer(DIRECT).generator.eval()
    streams, _, _ = _sample(*SIZE, batch=3)
    with torch.inference_mode():
        together, alone = network(streams), network(streams[1:2])
    error = relative_difference(together[1:2].numpy(), alone.numpy())
    return judge(error < 1e-5, f"within {error:.1g}", error)


def pictures_of_odd_sizes() -> Outcome:
    """An output of the input's size at 1 x 1, 7 x 5, 37 x 53 and 270 x 481 px."""
    import torch

    network = _trainer(DIRECT).generator.eval()
    sizes = ((1, 1), (7, 5), (37, 53), (270, 481))
    with torch.inference_mode():
        outputs = [network(_sample(*size)[0]) for size in sizes]
    shapes = all(tuple(o.shape[-2:]) == size for o, size in zip(outputs, sizes, strict=True))
    return judge(shapes and all(bool(torch.isfinite(o).all()) for o in outputs), "as asked for, finite")


def all_inputs_blank() -> Outcome:
    """A finite picture."""
    import torch

    network = _trainer(DIRECT).generator.eval()
    with torch.inference_mode():
        output = network(torch.zeros((1, 6, 4, *SIZE)))
    return judge(
        bool(torch.isfinite(output).all()), f"{float(output.min()):.2g} to {float(output.max()):.2g}"
    )


def invalid_input_of_great_weight() -> Outcome:
    """The weights of the valid inputs add up to 1 whatever the invalid ones would weigh."""
    import torch

    from fourd.composition.model import blend

    streams = torch.zeros((1, 6, 4, 4, 4))
    streams[:, 0] = 0.5
    streams[:, 0, 3] = 1
    decoded = torch.zeros((1, 10, 4, 4))
    decoded[:, 3] = 200.0
    decoded[:, 6] = 1
    error = float((blend(streams, decoded) - 0.5).abs().max())
    return judge(error < 1e-6, f"the only valid input within {error:.2g}")


def network_in_single_precision() -> Outcome:
    """The output of float32 as of float64, within 1e-4."""
    import torch

    network = _trainer(DIRECT).generator.eval()
    streams, _, _ = _sample(*SIZE)
    with torch.inference_mode():
        single = network(streams).numpy()
        double = copy.deepcopy(network).double()(streams.double()).numpy()
    error = relative_difference(single, double)
    return judge(error < 1e-4, f"within {error:.1g}", error)


def network_in_half_precision() -> Outcome:
    """The output of bfloat16 convolutions as of float32, within a rounding of 1/256 per layer."""
    import torch

    network = _trainer(DIRECT).generator.eval()
    streams, _, _ = _sample(*SIZE)
    with torch.inference_mode():
        half, single = network(streams, "bfloat16"), network(streams)
    error = relative_difference(half.numpy(), single.numpy())
    return judge(half.dtype == torch.float32 and error < NUM_LAYERS / 256, f"within {error:.1g}")


def _estimates(valid: bool) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Foreground and background of a frame, grey where valid."""
    from fourd.composition.data import ESTIMATES

    rgb = np.full((*SIZE, 3), 90 if valid else 0, np.uint8)
    arrays: dict[str, dict[str, np.ndarray]] = {"foreground": {}, "background": {}}
    for kind, name in ESTIMATES:
        arrays[kind] |= {f"{name}_rgb": rgb, f"{name}_valid": np.full(SIZE, valid)}
    return arrays["foreground"], arrays["background"]


def frame_of_nothing_but_holes() -> Outcome:
    """The coarser level is asked, and a picture comes out all the same."""
    from fourd.composition.infer import compose_frame

    networks = [_trainer().generator.eval() for _ in range(2)]
    image, rows = compose_frame(networks, 0, *_estimates(False))
    levels = [row["level"] for row in rows]
    return judge(image.shape == (*SIZE, 3) and levels == [0, 1], f"levels {levels}")


def frame_without_holes() -> Outcome:
    """The finest level alone, and its colours are those of the inputs."""
    from fourd.composition.infer import compose_frame

    networks = [_trainer().generator.eval() for _ in range(2)]
    image, rows = compose_frame(networks, 0, *_estimates(True))
    levels = [row["level"] for row in rows]
    return judge(
        levels == [1] and bool((image == 90).all()), f"levels {levels}, {image.min()} to {image.max()}"
    )


def _is_unchanged(before: dict[str, Any], network: Any) -> bool:
    import torch

    return all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


def _skips(options: CompositionOptions, spoil: Callable[[Any], Any]) -> Outcome:
    """An update that cannot be right is left out, and the generator stays as it was."""
    from fourd.composition.train import update

    trainer = _trainer(options)
    before = copy.deepcopy(trainer.generator.state_dict())
    streams, target, valid = _sample(*SIZE)
    result = update(trainer, spoil(streams), target, valid, options)
    is_right = result is None and _is_unchanged(before, trainer.generator)
    return judge(is_right, "step left out" if result is None else f"losses {result[0]}")


def input_that_is_no_number() -> Outcome:
    """The step is left out and the network unchanged."""
    return _skips(OPTIONS, lambda streams: streams * float("nan"))


def loss_beyond_the_number_range() -> Outcome:
    """The step is left out and the network unchanged."""
    return _skips(
        dataclasses.replace(OPTIONS, l1_weight=1e38, frequency_weight=1e38), lambda streams: 1e3 * streams
    )


def sample_smaller_than_a_patch() -> Outcome:
    """A step with finite losses, or a refusal that names the size."""
    from fourd.composition.train import update

    trainer = _trainer()
    values: list[float] = []

    def step() -> None:
        result = update(trainer, *_sample(6, 10), OPTIONS)
        values.extend(result[0].values() if result is not None else [float("nan")])

    reason = reason_of(step)
    if reason is not None:
        return judge_refusal(reason, "px")
    return judge(bool(np.isfinite(values).all()), f"losses {[round(value, 3) for value in values]}")


def training_that_was_interrupted() -> Outcome:
    """The weights of an uninterrupted training, bit for bit."""
    from fourd.composition.checkpoint import Checkpoint
    from fourd.composition.train import update

    def run(trainer: Any, steps: range) -> None:
        for step in steps:
            update(trainer, *_sample(*SIZE, seed=step), OPTIONS)
            trainer.counters["step"] = step + 1

    whole, first, second = _trainer(), _trainer(), _trainer()
    run(whole, range(4))
    run(first, range(2))
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = Checkpoint(Path(folder) / "checkpoint.pt", "same work")
        checkpoint(first)
        checkpoint.restore(second, 4)
    run(second, range(second.counters["step"], 4))
    networks = (second.generator, whole.generator), (second.discriminator, whole.discriminator)
    same = all(_is_unchanged(b.state_dict(), a) for a, b in networks)
    return judge(same and second.counters["step"] == 4, "equal" if same else "different")


CASES = make_cases(
    "learning",
    discriminator_that_is_certain,
    discriminator_that_knows_nothing,
    spectrum_of_a_constant,
    spectrum_of_nothing,
    losses_in_single_precision,
    losses_of_half_precision_pictures,
    nothing_valid,
    target_that_is_no_number,
    target_that_is_no_number_where_invalid,
    batch_of_one,
    pictures_of_odd_sizes,
    all_inputs_blank,
    invalid_input_of_great_weight,
    network_in_single_precision,
    network_in_half_precision,
    frame_of_nothing_but_holes,
    frame_without_holes,
    input_that_is_no_number,
    loss_beyond_the_number_range,
    sample_smaller_than_a_patch,
    training_that_was_interrupted,
)
