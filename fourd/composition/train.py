"""Fits one level's network to a scene: every input camera's own frames are its targets."""

import copy
import functools
import logging
import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from fourd import metrics
from fourd.composition import CompositionOptions, data, losses
from fourd.composition.checkpoint import Checkpoint, Progress, StopRequest
from fourd.composition.model import CompositionNet, Discriminator, autocast
from fourd.composition.perceptual import PerceptualLoss
from fourd.composition.validation import Report, compose_samples, is_stale, measure
from fourd.errors import InputError

log = logging.getLogger("fourd.composition")

MAX_SKIPPED_IN_A_ROW = 3
# The average of the weights reaches back over about a ninth of the steps so far, whatever their number.
AVERAGE_POWER = 8
LOSSES = ("reconstruction", "frequency", "perceptual", "adversarial", "discriminator", "train_psnr_db")
COLUMNS = ("epoch", "step", "seconds", *LOSSES, "validation_psnr_db", "paste_psnr_db", "skipped_steps")


class Trainer:
    """Networks, optimisers and counters of one level: everything that a checkpoint holds."""

    def __init__(self, level: int, options: CompositionOptions, device: str) -> None:
        if level >= len(options.num_filters):
            raise InputError(
                f"expected num_filters for level {level}, got {len(options.num_filters)} values "
                f"{options.num_filters}: give one per level, coarsest first"
            )
        self.network_arguments: dict[str, Any] = {
            "num_filters": options.num_filters[level],
            "unet_width": options.unet_width,
            "depth": options.depth,
            "head": options.head,
            "level": level,
            "streams": options.streams,
        }
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(options.seed)
            generator, discriminator = CompositionNet(**self.network_arguments), Discriminator()
        nhwc: Any = {"device": device, "memory_format": torch.channels_last}
        self.generator, self.discriminator = generator.to(**nhwc), discriminator.to(**nhwc)
        # The average starts at the first step, so what the copy holds until then does not count.
        self.average = (
            copy.deepcopy(self.generator).requires_grad_(False) if options.average_weights else None
        )
        self.perceptual_loss = (
            PerceptualLoss(options.lpips_weights, device) if options.perceptual_weight > 0 else None
        )
        rate = options.learning_rate
        self.generator_optimizer = torch.optim.Adam(self.generator.parameters(), lr=rate, fused=True)
        self.discriminator_optimizer = torch.optim.Adam(self.discriminator.parameters(), lr=rate, fused=True)
        self.counters: dict[str, Any] = {
            "step": 0, "skipped": 0, "skipped_in_a_row": 0, "elapsed_s": 0.0, "rows": [], "sums": {}
        }  # fmt: skip

    @property
    def network(self) -> CompositionNet:
        """The one to use: the average of the weights so far, or the weights as they are."""
        return self.average or self.generator

    def set_learning_rate(self, rate: float) -> None:
        for optimizer in (self.generator_optimizer, self.discriminator_optimizer):
            for group in optimizer.param_groups:
                group["lr"] = rate

    def update_average(self, step: int) -> None:
        """Take the weights after a step, counted from 1, into their average."""
        if self.average is None:
            return
        share = min((AVERAGE_POWER + 1) / (AVERAGE_POWER + step), 1.0)
        with torch.no_grad():
            for mean, now in zip(self.average.parameters(), self.generator.parameters(), strict=True):
                mean.lerp_(now, share)

    def _parts(self) -> dict[str, Any]:
        names = ("generator", "discriminator", "generator_optimizer", "discriminator_optimizer", "average")
        return {name: part for name in names if (part := getattr(self, name)) is not None}

    def state(self) -> dict[str, Any]:
        return {name: part.state_dict() for name, part in self._parts().items()} | {"counters": self.counters}

    def restore(self, state: Mapping[str, Any]) -> None:
        for name, part in self._parts().items():
            part.load_state_dict(state[name])
        self.counters = dict(state["counters"])


def update(
    trainer: Trainer, streams: Tensor, target: Tensor, valid: Tensor, options: CompositionOptions
) -> tuple[dict[str, float], Tensor] | None:
    """One step of discriminator and generator on a sample.

    Arguments as `data.streams_from_images`, `data.target_from_images` give them.
    Returns the losses, unweighted, and the generator's output; None, with the generator unchanged,
    if a loss or a gradient is not finite.
    """
    generator, discriminator = trainer.generator, trainer.discriminator
    cast = functools.partial(autocast, streams.device.type, options.precision)
    output = generator(streams, options.precision)
    terms = {
        "reconstruction": losses.reconstruction_loss(output, target, valid),
        "frequency": losses.frequency_loss(output, target, valid),
    }
    loss = options.l1_weight * terms["reconstruction"] + options.frequency_weight * terms["frequency"]
    if trainer.perceptual_loss is not None:
        with cast():
            terms["perceptual"] = trainer.perceptual_loss(output, target, valid)
        loss = loss + options.perceptual_weight * terms["perceptual"]
    if not torch.isfinite(loss):
        return None
    if options.adversarial_weight > 0:
        real, fake = (torch.where(valid, image, torch.zeros_like(image)) for image in (target, output))
        with cast():
            logits = discriminator(real), discriminator(fake.detach())
        terms["discriminator"] = losses.discriminator_loss(*logits)
        if not descend(trainer.discriminator_optimizer, terms["discriminator"]):
            return None
        discriminator.requires_grad_(False)
        with cast():
            logit = discriminator(fake)
        terms["adversarial"] = losses.generator_loss(logit)
        discriminator.requires_grad_(True)
        loss = loss + options.adversarial_weight * terms["adversarial"]
    if not descend(trainer.generator_optimizer, loss):
        return None
    return {name: float(term.detach()) for name, term in terms.items()}, output.detach()


def descend(optimizer: torch.optim.Optimizer, loss: Tensor) -> bool:
    """One optimiser step; False, and no step, if the loss or a gradient is not finite."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    gradients = [p.grad for group in optimizer.param_groups for p in group["params"]]
    # One number to look at: it is not finite as soon as one gradient is not.
    if not bool(torch.isfinite(loss) & torch.isfinite(torch.nn.utils.get_total_norm(gradients))):
        return False
    optimizer.step()
    return True


def train(
    trainer: Trainer,
    samples: data.SampleSet,
    split: tuple[Sequence[data.SampleId], Sequence[data.SampleId]],
    options: CompositionOptions,
    save: Checkpoint,
    stop: StopRequest,
    report: Report | None = None,
) -> list[dict[str, Any]]:
    """Train until the last epoch, `patience` epochs without gain, `max_minutes` or a request to stop.

    split: the samples to train on and those kept apart;  report: called with every new row of the log
    Returns the rows of the log. Raises SystemExit after a signal, with everything saved.
    """
    training = split[0]
    counters = trainer.counters
    total = options.epochs * len(training)
    progress = Progress(total, counters["step"])
    started = time.monotonic() - counters["elapsed_s"]
    log_epoch = functools.partial(_log_row, trainer, samples, split, options, report)
    num_rows = len(counters["rows"])
    if not counters["rows"] and counters["step"] == 0:
        # What the untrained network gives: without it nobody could tell what training added.
        counters["rows"].append(log_epoch(0))
    while counters["step"] < total and not _is_over(options, started, counters["rows"]):
        terms = train_step(trainer, samples, training, options)
        counters["elapsed_s"] = time.monotonic() - started
        step, epoch = counters["step"], (counters["step"] - 1) // len(training)
        if terms is not None:
            progress.report(step, epoch, options.epochs, terms)
        if counters["step"] % len(training) == 0:
            counters["rows"].append(log_epoch(epoch + 1))
            counters["sums"] = {}
            save(trainer)
        elif stop.signal_number is not None or save.is_due(options.checkpoint_s):
            save(trainer)
        if stop.signal_number is not None:
            log.info("stopped by a signal at step %d of %d: run again to continue", step, total)
            raise SystemExit(128 + stop.signal_number)
    save(trainer)
    if counters["step"] % len(training) != 0:
        return [*counters["rows"], log_epoch(counters["step"] // len(training) + 1)]
    if len(counters["rows"]) == num_rows:
        # Trained to the end before: the log is known, but its picture may be gone.
        log_epoch(counters["rows"][-1]["epoch"])
    return counters["rows"]


def train_step(
    trainer: Trainer,
    samples: data.SampleSet,
    training: Sequence[data.SampleId],
    options: CompositionOptions,
    order: Sequence[int] = data.TRAINING_STREAMS,
) -> dict[str, float] | None:
    """The next step, on the sample whose turn it is, counted in `trainer.counters`.

    training: the samples to train on;  order: which estimate feeds each stream
    Returns the losses, unweighted; None if the step was skipped. Raises InputError after too many of these.
    """
    counters, device = trainer.counters, next(trainer.generator.parameters()).device
    step = counters["step"]
    epoch, position = divmod(step, len(training))
    trainer.set_learning_rate(options.learning_rate * min(1.0, (step + 1) / max(options.warmup_steps, 1)))
    sample = training[data.sample_order(len(training), epoch, options.seed)[position]]
    scales = options.min_scale, options.max_scale
    images = data.augment(samples.images(sample), options.crop, scales, options.seed, step)
    streams = data.streams_from_images(images, order).to(device)
    target, valid = (tensor.to(device) for tensor in data.target_from_images(images))
    result = update(trainer, streams, target, valid, options)
    counters["step"] = step + 1
    if result is None:
        _count_skipped(counters, sample)
        return None
    trainer.update_average(step + 1)
    counters["skipped_in_a_row"] = 0
    terms = result[0] | {"train_psnr_db": _psnr(result[1], target, valid)}
    for name, value in terms.items():
        total, count = counters["sums"].get(name, (0.0, 0))
        counters["sums"][name] = (total + value, count + 1)
    return terms


def _is_over(options: CompositionOptions, started: float, rows: Sequence[Mapping[str, Any]]) -> bool:
    if options.max_minutes is not None and time.monotonic() - started >= 60 * options.max_minutes:
        return True
    if is_stale(rows, options.patience):
        log.info("stopping: the frames kept apart have not improved for %d epochs", options.patience)
        return True
    return False


def _count_skipped(counters: dict[str, Any], sample: data.SampleId) -> None:
    counters["skipped"] += 1
    counters["skipped_in_a_row"] += 1
    log.warning("step %d skipped: a loss or gradient is not finite", counters["step"])
    if counters["skipped_in_a_row"] >= MAX_SKIPPED_IN_A_ROW:
        raise InputError(
            f"expected finite losses, got NaN or infinity in {MAX_SKIPPED_IN_A_ROW} steps in a row, last for "
            f"camera {sample.cam}, frame {sample.frame}, of {sample.foreground}: lower learning_rate or the "
            "loss weights, delete checkpoint.pt and train again"
        )


def _psnr(output: Tensor, target: Tensor, valid: Tensor) -> float:
    if not bool(valid.any()):
        return 0.0
    difference = (output.clamp(0, 1) - target) * valid
    mse = float(difference.square().sum() / (valid.sum() * target.shape[1]))
    return metrics.psnr_from_mse(max(mse, 1e-10) * metrics.DATA_RANGE**2)


def _log_row(
    trainer: Trainer,
    samples: data.SampleSet,
    split: tuple[Sequence[data.SampleId], Sequence[data.SampleId]],
    options: CompositionOptions,
    report: Report | None,
    epoch: int,
) -> dict[str, Any]:
    """A row of train.csv: means over the epoch, and quality at test-time inputs on samples kept apart."""
    counters, (training, apart) = trainer.counters, split
    row = {name: total / count for name, (total, count) in counters["sums"].items()}
    row |= {"epoch": epoch, "step": counters["step"], "seconds": round(counters["elapsed_s"], 1)}
    # Where nothing is kept apart there is still something to look at, but nothing to measure.
    found = compose_samples(trainer.network, samples, apart or training[:1], options.precision)
    row |= {"skipped_steps": counters["skipped"]} | (measure(found) if apart else {})
    row = {name: row.get(name, "") for name in COLUMNS}
    if report is not None:
        report(row, found)
    return row
