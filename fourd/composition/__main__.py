"""`python -m fourd.composition train`: one level's network from archives and the cameras' own frames."""

import argparse
import dataclasses
import logging
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from fourd import cli, io
from fourd.composition import STAGE_VERSION, CompositionOptions, data
from fourd.composition.checkpoint import Checkpoint, StopRequest, save_torch
from fourd.composition.forecast import plan_memory
from fourd.composition.model import HEADS, TEST_STREAMS, resolve_precision
from fourd.composition.train import COLUMNS, Trainer, train
from fourd.composition.validation import epoch_report
from fourd.errors import InputError
from fourd.image import undistort
from fourd.ingest import open_camera
from fourd.sfm import read_cameras
from fourd.views import LEFT_OUT, View, read_view

log = logging.getLogger("fourd.composition")

# What may change between a run and its continuation without changing the weights at a step.
# The weights of LPIPS are the same ones in whatever folder they lie.
NOT_IN_FINGERPRINT = (
    "epochs", "patience", "max_minutes", "checkpoint_s", "cache_mb", "tensorboard", "lpips_weights",
)  # fmt: skip

# Below it, resampling would skip pixels.
MIN_SCALE = 0.5


@dataclasses.dataclass(frozen=True)
class Sources:
    """Files of one training: see docs/formats.md. `films` maps a camera's name to its file."""

    views: tuple[Path, ...]
    foreground: tuple[Path, ...]
    background: tuple[Path, ...]
    films: Mapping[str, Path]
    cameras: Path

    def files(self) -> list[Path]:
        """All of them, in an order that does not depend on the command line's."""
        paths = {*self.views, *self.foreground, *self.background, *self.films.values(), self.cameras}
        return sorted(paths)


def read_training_views(paths: Sequence[Path]) -> dict[str, View]:
    """Views of input cameras by name; one that was left out has no frames to train on.

    Raises InputError for a held-out or virtual one.
    """
    views = {}
    for path in paths:
        view = read_view(path)
        if view.role == LEFT_OUT:
            continue
        if view.role != "input":
            raise InputError(
                f"expected the view of an input camera in {path}, got role {view.role!r}: held-out and "
                "virtual views are never trained on; take the file out of --views"
            )
        views[view.name] = view
    return views


def target_reader(sources: Sources) -> data.ReadTarget:
    """A function (cam, frame) -> the camera's own frame as its ideal pinhole sees it, and validity."""
    tracks = read_cameras(sources.cameras).tracks
    views = read_training_views(sources.views)
    for known, where in ((set(tracks), sources.cameras), (set(sources.films), "--films")):
        if missing := sorted(set(views) - known):
            raise InputError(
                f"expected camera {missing[0]} of --views in {where}, got {sorted(known)}: add it"
            )
    videos = {name: open_camera(sources.films[name]) for name in views}

    def read_target(cam: str, frame: int) -> tuple[np.ndarray, np.ndarray]:
        if cam not in views:
            raise InputError(
                f"expected the view of camera {cam} in --views, got {sorted(views)}: give views/{cam}.json"
            )
        shown = views[cam].at(frame)
        return undistort(videos[cam].read(shown.scene_frame), tracks[cam].at(shown.scene_frame), shown.camera)

    return read_target


def run(
    sources: Sources,
    level: int,
    num_levels: int,
    model_path: Path,
    log_path: Path,
    picture_path: Path,
    options: CompositionOptions,
    device: str,
) -> None:
    """Train one level, continuing from `checkpoint.pt` beside the model if it is the same work."""
    check_options(options)
    # Resolved here, so that a checkpoint is continued only in the precision that it was made in.
    options = dataclasses.replace(options, precision=resolve_precision(options.precision, device))
    factor = data.reduction_factor(level, num_levels)
    facts = {k: v for k, v in dataclasses.asdict(options).items() if k not in NOT_IN_FINGERPRINT}
    facts |= {"level": level, "num_levels": num_levels, "stage": STAGE_VERSION, "torch": torch.__version__}
    fingerprint = data.fingerprint(facts, sources.files())
    samples = data.SampleSet(
        sources.foreground, sources.background, target_reader(sources), factor, options.cache_mb
    )
    split = data.split_validation(samples.ids, options.validation_samples, options.validation_camera)
    trainer = Trainer(level, options, device)
    save = Checkpoint(model_path.with_name("checkpoint.pt"), fingerprint)
    save.restore(trainer, options.epochs * len(split[0]))
    log.info("%d samples to train on, %d kept apart; reading them", *map(len, split))
    num_cached = samples.fill_cache()
    height, width = samples.images(samples.ids[0]).shape[1:3]
    size = (min(height, options.crop or height), min(width, options.crop or width))
    trainer.generator.is_recomputed, line = plan_memory(
        trainer.network_arguments, size, options.precision, device
    )
    log.info(line)
    num_parameters = sum(p.numel() for p in trainer.generator.parameters())
    log.info(
        "%d samples in memory; %d parameters, on %s in %s",
        num_cached,
        num_parameters,
        device,
        options.precision,
    )
    events = model_path.with_name("events") if options.tensorboard else None
    report = epoch_report(picture_path, events, trainer.counters["step"])
    with StopRequest() as stop:
        rows = train(trainer, samples, split, options, save, stop, report)
    io.write_csv(log_path, COLUMNS, rows)
    save_torch(
        model_path,
        {
            "schema_version": io.SCHEMA_VERSION,
            "stage_version": STAGE_VERSION,
            "level": level,
            "num_levels": num_levels,
            "network": trainer.network_arguments,
            "options": dataclasses.asdict(options),
            "step": trainer.counters["step"],
            "state_dict": trainer.network.state_dict(),
        },
    )


def check_options(options: CompositionOptions) -> None:
    """Raise InputError for values that no training can use."""
    positive = {name: getattr(options, name) for name in ("epochs", "unet_width", "learning_rate")}
    for name, value in positive.items():
        if value <= 0:
            raise InputError(f"expected {name} above 0, got {value}: change it in the configuration")
    if options.head not in HEADS:
        raise InputError(f"expected head to be one of {', '.join(HEADS)}, got {options.head!r}")
    if not MIN_SCALE <= options.min_scale <= options.max_scale:
        raise InputError(
            f"expected min_scale of at least {MIN_SCALE} and at most max_scale, got {options.min_scale} and "
            f"{options.max_scale}: change them in the configuration"
        )
    if options.streams not in TEST_STREAMS:
        raise InputError(f"expected streams to be one of {', '.join(TEST_STREAMS)}, got {options.streams!r}")


def parse(argv: Sequence[str] | None) -> argparse.Namespace:
    """The command line of this stage."""
    parser = argparse.ArgumentParser(prog="python -m fourd.composition", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("train", help="train one level")
    command.add_argument("--level", type=int, required=True, help="0 is the coarsest")
    command.add_argument("--num-levels", type=int, required=True)
    command.add_argument(
        "--views", type=Path, nargs="+", required=True, help="views/CAM.json of input cameras"
    )
    command.add_argument("--foreground", type=Path, nargs="+", required=True, help="archives of these views")
    command.add_argument("--background", type=Path, nargs="+", required=True, help="archives of these views")
    command.add_argument("--films", type=cli.named_path, nargs="+", required=True, metavar="CAM=FILE")
    command.add_argument("--cameras", type=Path, required=True, help="sfm/cameras.json")
    command.add_argument("--output-model", type=Path, required=True)
    command.add_argument("--output-log", type=Path, required=True)
    command.add_argument("--output-picture", type=Path, required=True)
    command.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    cli.add_options(command, CompositionOptions)
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> None:
    """Train one level from files."""
    args = parse(argv)
    cli.set_num_threads(args.num_threads)
    device = cli.choose_torch_device(args.device)
    if device == "cuda":
        # Levels are jobs of their own: where there are several devices, they train at the same time.
        device = f"cuda:{args.level % torch.cuda.device_count()}"
    # cuBLAS is deterministic only with a fixed workspace, which is read when it starts.
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    torch.use_deterministic_algorithms(True, warn_only=device != "cpu")
    sources = Sources(
        tuple(args.views), tuple(args.foreground), tuple(args.background), dict(args.films), args.cameras
    )
    options = cli.options_from_args(CompositionOptions, args)
    outputs = args.output_model, args.output_log, args.output_picture
    run(sources, args.level, args.num_levels, *outputs, options, device)


if __name__ == "__main__":
    sys.exit(cli.run_stage(main))
