"""What a step of training and a rendered frame cost at the paper's three sizes: seconds and peak memory.

    python -m benches.composition_speed --output DIR [--device cpu|cuda] [--levels 0 1 2] [--settings ...]

Every row is a process of its own, one thread on a CPU, on random pictures of the level's size with the
paper's number of filters and its direct head. `straightforward` is the loop that one writes first: float32,
channels first, Adam parameter by parameter, all three losses. The others are this program's own step, also
with all three losses, so that ratios compare equal work; `default_losses` is without adversary. `compiled`
takes torch.compile, whose compilation (`setup_seconds`) comes before the first step. Writes
composition_speed.csv; `ratio` is the step over the straightforward one, `frames_per_s` is rendering with the
inputs in memory.

On a machine without CUDA nothing is said about one; the bench says so.
"""

import argparse
import dataclasses
import functools
import multiprocessing
import resource
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from fourd import cli, io
from fourd.composition import CompositionOptions, losses
from fourd.composition.model import CompositionNet, Discriminator, resolve_precision
from fourd.composition.train import Trainer, update

PAPER_LOSSES = {"head": "direct", "adversarial_weight": 1.0}
# How many steps count, after the first, which allocates.
STEPS = {"cpu": 3, "cuda": 20}
COLUMNS = (
    "setting", "device", "level", "num_filters", "width", "height", "precision", "setup_seconds",
    "step_seconds", "ratio", "peak_mb", "frames_per_s",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Setting:
    """Options of this program's step, and what is done to its network."""

    changes: dict[str, Any] = dataclasses.field(default_factory=lambda: dict(PAPER_LOSSES))
    is_recomputed: bool = False
    is_compiled: bool = False


SETTINGS = {
    "straightforward": None,
    "float32": Setting(PAPER_LOSSES | {"precision": "float32"}),
    "default": Setting(),
    "default_losses": Setting({"head": "direct"}),
    "recomputed": Setting(is_recomputed=True),
    "compiled": Setting(is_compiled=True),
}

Sample = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def random_sample(level: int, device: str) -> Sample:
    """Streams, target and validity at a level's size."""
    height, width = 270 * 2**level, 480 * 2**level
    generator = torch.Generator().manual_seed(0)
    streams = torch.rand(1, 6, 4, height, width, generator=generator)
    streams[:, :, 3] = (streams[:, :, 3] < 0.8).float()
    target = torch.rand(1, 3, height, width, generator=generator)
    valid = torch.ones(1, 1, height, width, dtype=torch.bool)
    return streams.to(device), target.to(device), valid.to(device)


def straightforward_step(options: CompositionOptions, level: int, device: str) -> Callable[[Sample], None]:
    """The loop that one writes first."""
    generator = CompositionNet(options.num_filters[level], 1, options.depth, "direct", level).to(device)
    discriminator = Discriminator().to(device)
    adam = functools.partial(torch.optim.Adam, lr=2e-4, foreach=False, fused=False)
    of_generator, of_discriminator = adam(generator.parameters()), adam(discriminator.parameters())

    def step(sample: Sample) -> None:
        streams, target, valid = sample
        output = generator(streams)
        of_discriminator.zero_grad()
        losses.discriminator_loss(discriminator(target), discriminator(output.detach())).backward()
        of_discriminator.step()
        loss = 100 * losses.reconstruction_loss(output, target, valid)
        loss = loss + 100 * losses.frequency_loss(output, target, valid)
        loss = loss + losses.generator_loss(discriminator(output))
        of_generator.zero_grad()
        loss.backward()
        of_generator.step()

    return step


def own_step(
    setting: Setting, options: CompositionOptions, level: int, device: str
) -> tuple[Callable[[Sample], None], CompositionNet]:
    trainer = Trainer(level, options, device)
    trainer.generator.is_recomputed = setting.is_recomputed
    if setting.is_compiled:
        trainer.generator.compile()

    def step(sample: Sample) -> None:
        update(trainer, *sample, options)
        trainer.update_average(1)

    return step, trainer.generator


def seconds_of(call: Callable[[], Any], times: int, device: str) -> float:
    """Mean time of a call: of the processor, or on a device by the clock."""
    clock = time.process_time if device == "cpu" else time.monotonic
    if device != "cpu":
        torch.cuda.synchronize()
    start = clock()
    for _ in range(times):
        call()
    if device != "cpu":
        torch.cuda.synchronize()
    return (clock() - start) / times


def peak_mb(device: str) -> float:
    if device == "cpu":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return torch.cuda.max_memory_allocated() / 2**20


def measure(name: str, level: int, device: str) -> dict[str, Any]:
    """One row, in a process that has done nothing else; on a CPU without what torch itself takes."""
    cli.set_num_threads(1)
    setting = SETTINGS[name]
    options = dataclasses.replace(CompositionOptions(), **(setting.changes if setting else {}))
    precision = resolve_precision(options.precision, device) if setting else "float32"
    options = dataclasses.replace(options, precision=precision)
    sample, before = random_sample(level, device), peak_mb(device)
    row: dict[str, Any] = {"setting": name, "device": device, "level": level, "precision": precision}
    row |= {"num_filters": options.num_filters[level], "width": 480 * 2**level, "height": 270 * 2**level}
    if setting is None:
        step, network = straightforward_step(options, level, device), None
    else:
        step, network = own_step(setting, options, level, device)
    row["setup_seconds"] = seconds_of(lambda: step(sample), 1, device)
    row["step_seconds"] = seconds_of(lambda: step(sample), STEPS[device], device)
    row["peak_mb"] = peak_mb(device) - (before if device == "cpu" else 0)
    if network is not None:
        with torch.inference_mode():
            render = functools.partial(network, sample[0], precision)
            render()
            row["frames_per_s"] = 1 / seconds_of(render, STEPS[device], device)
    return row


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--device", choices=("cpu", "cuda"), help="CUDA where there is one")
    parser.add_argument("--levels", type=int, nargs="+", choices=(0, 1, 2), help="all on CUDA, 0 on a CPU")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS), metavar="NAME")
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args(argv)
    device = args.device or ("cuda" if torch.cuda.is_available() else "cpu")
    if not torch.cuda.is_available():
        if device == "cuda":
            raise SystemExit("error: expected a CUDA device, torch finds none: use --device cpu")
        print("no CUDA device here: these are figures of a CPU, those of a GPU are not measured")
    rows = []
    for level in args.levels or ((0, 1, 2) if device == "cuda" else (0,)):
        base = None
        for name in args.settings:
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                row = pool.apply(measure, (name, level, device))
            base = row["step_seconds"] if name == "straightforward" else base
            row["ratio"] = row["step_seconds"] / base if base else ""
            rows.append({column: row.get(column, "") for column in COLUMNS})
            shown = (f"{v:.3g}" if isinstance(v, float) else str(v) for v in rows[-1].values())
            print("  ".join(shown), flush=True)
    io.write_csv(args.output / "composition_speed.csv", COLUMNS, rows)


if __name__ == "__main__":
    main()
