"""Stage `render`: frames of a view through the trained generators, and a film of them.

`frames` reads the estimates of one view and chunk and writes a folder of `000012.png` and
`holes.csv`; `video` joins such folders into a film. Section 4.1 of the paper.
"""

import argparse
import contextlib
import dataclasses
import logging
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from fourd import cli
from fourd.composition import CascadeOptions
from fourd.errors import InputError, explain_faults
from fourd.io import Archive, atomic_folder, read_image, write_csv, write_png
from fourd.views import read_view

STAGE_VERSION = 3
HOLES_COLUMNS = ("frame", "level", "hole_share", "largest_hole_share", "filled_share", "reason")
PROGRESS_INTERVAL_S = 2.0
# As in `fourd.video.encode`, which need not be loaded to render.
CODEC_NAMES = ("h264", "hevc", "av1", "prores", "ffv1")

# Type and channels of an estimate's arrays by the last word of their names; the others are bytes.
_FORMS = {"rgb": (np.uint8, (3,)), "valid": (bool, ()), "filled": (bool, ()), "depth": (np.float32, ())}

logger = logging.getLogger(__name__)
ItemT = TypeVar("ItemT")


@dataclasses.dataclass(frozen=True)
class RenderOptions(CascadeOptions):
    """When coarser levels help a frame, as in `CascadeOptions`; a change renders again, trains nothing."""


class BackgroundReader:
    """Arrays of `background/{view}/{chunk}.npz` by output frame; frames that share a picture read it once."""

    def __init__(self, archive: Archive, keys: Sequence[str]) -> None:
        self._archive = archive
        self._keys = tuple(keys)
        with explain_faults(f"frames with the same picture in the meta of {archive.path}"):
            same_as = archive.meta.get("same_as", {})
            self._same_as = {int(frame): int(kept) for frame, kept in same_as.items()}
        self._last: tuple[int, dict[str, np.ndarray]] | None = None

    def frames(self) -> list[int]:
        """Sorted output frames that can be read."""
        return sorted({*self._archive.frames(), *self._same_as})

    def read(self, frame: int) -> dict[str, np.ndarray]:
        """The asked-for arrays of one frame. Raises InputError if the file has none."""
        kept = self._same_as.get(frame, frame)
        if self._last is None or self._last[0] != kept:
            self._last = (kept, read_arrays(self._archive, kept, self._keys))
        return self._last[1]


def read_arrays(archive: Archive, frame: int, keys: Sequence[str]) -> dict[str, np.ndarray]:
    """Some arrays of one frame, the others unread.

    Raises InputError if the archive lacks one, or holds one of another type or size than the others.
    """
    missing = [key for key in keys if f"{frame:06d}/{key}" not in archive]
    if missing:
        raise InputError(
            f"expected {missing[0]} of frame {frame} in {archive.path}, found none: "
            "delete the file and run again"
        )
    arrays: dict[str, np.ndarray] = {}
    height, width = None, None
    for key in keys:
        dtype, channels = _FORMS.get(key.split("_")[-1], (np.uint8, ()))
        arrays[key] = archive.read(f"{frame:06d}/{key}", dtype, (height, width, *channels))
        height, width = arrays[key].shape[:2]
    return arrays


def with_progress(items: Sequence[ItemT], what: str) -> Iterator[ItemT]:
    """The items, with a line about how many are done and how long the rest takes every few seconds."""
    start = last = time.monotonic()
    for i, item in enumerate(items):
        yield item
        now = time.monotonic()
        if now - last >= PROGRESS_INTERVAL_S or i + 1 == len(items):
            left_s = (now - start) / (i + 1) * (len(items) - i - 1)
            logger.info("%s: %d of %d done, about %.0f s left", what, i + 1, len(items), left_s)
            last = now


def run_frames(
    view_path: Path,
    model_paths: Sequence[Path],
    foreground_path: Path,
    background_path: Path,
    frames: Sequence[int],
    output: Path,
    options: RenderOptions,
    device: str = "auto",
) -> None:
    """Render output frames of a view into a folder, which appears when it is complete.

    Raises InputError if a file is missing, broken, or is of another view or size.
    """
    # Torch takes seconds to import, and a film is encoded without it.
    from fourd.composition.infer import compose_frame, estimates_read, load_models

    view = read_view(view_path)
    frames = view.frames_of(frames)
    for frame in frames:
        view.at(frame)
    models = load_models(list(model_paths), cli.choose_torch_device(device))
    with (
        contextlib.closing(Archive(foreground_path)) as foreground,
        contextlib.closing(Archive(background_path)) as background,
    ):
        _check_same_view(view.name, (foreground, background))
        backgrounds = BackgroundReader(background, estimates_read(models, "background"))
        keys = estimates_read(models, "foreground")
        rows = []
        with atomic_folder(output) as folder:
            for frame in with_progress(frames, f"render {view.name}"):
                estimates = read_arrays(foreground, frame, keys)
                _check_size(view.size, estimates["consensus_rgb"], foreground_path)
                image, levels = compose_frame(models, frame, estimates, backgrounds.read(frame), options)
                write_png(folder / f"{frame:06d}.png", image)
                rows.extend(levels)
            write_csv(folder / "holes.csv", HOLES_COLUMNS, rows)


def _check_same_view(name: str, archives: Sequence[Archive]) -> None:
    for archive in archives:
        given = archive.meta.get("view")
        if given != name:
            raise InputError(
                f"expected the estimates of view {name} in {archive.path}, got {given}: check the paths"
            )


def _check_size(size: tuple[int, int], image: np.ndarray, path: Path) -> None:
    if image.shape[1::-1] != size:
        raise InputError(
            f"expected pictures of {size[0]} x {size[1]} px in {path}, got {image.shape[1]} x "
            f"{image.shape[0]}: fuse this view again"
        )


def list_frames(folders: Sequence[Path]) -> dict[int, Path]:
    """PNG files of rendered folders by output frame, rising.

    Raises InputError for a folder that is missing or a frame that two folders hold.
    """
    found: dict[int, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"expected a folder of rendered frames at {folder}, found none: render it first")
        for path in folder.glob("[0-9]*.png"):
            if int(path.stem) in found:
                raise InputError(
                    f"expected frame {int(path.stem)} once, got {found[int(path.stem)]} and {path}: fix it"
                )
            found[int(path.stem)] = path
    return dict(sorted(found.items()))


def run_video(
    folders: Sequence[Path],
    fps: float,
    output: Path,
    codec: str = "h264",
    right_folders: Sequence[Path] = (),
) -> None:
    """Encode the frames of all folders, which must follow on each other without a gap.

    right_folders: of the right eye, whose frames are put to the right of the others'
    Raises InputError if there is none, one is missing between the first and the last, or the eyes have
    different frames.
    """
    from fourd.video import encode_video

    left, right = _frames_in_a_row(folders), _frames_in_a_row(right_folders) if right_folders else {}
    if right and right.keys() != left.keys():
        raise InputError(
            f"expected both eyes to have the same frames, got {len(left)} and {len(right)} in "
            f"{', '.join(map(str, [*folders, *right_folders]))}: render both"
        )

    def picture(frame: int) -> np.ndarray:
        image = read_image(left[frame])
        return np.hstack([image, read_image(right[frame])]) if right else image

    frames = with_progress(list(left), output.name)
    encode_video(output, (picture(frame) for frame in frames), fps, codec)


def _frames_in_a_row(folders: Sequence[Path]) -> dict[int, Path]:
    found = list_frames(folders)
    if not found:
        raise InputError(
            f"expected rendered frames in {', '.join(map(str, folders))}, found none: render first"
        )
    missing = sorted(set(range(min(found), max(found) + 1)) - set(found))
    if missing:
        raise InputError(
            f"expected every frame from {min(found)} to {max(found)}, but frame {missing[0]} is missing in "
            f"{', '.join(map(str, folders))}: render it first"
        )
    return found


def main(argv: Sequence[str] | None = None) -> None:
    """Command line of the stage."""
    parser = argparse.ArgumentParser(prog="python -m fourd.render", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    frames = commands.add_parser("frames", help="render frames of one view")
    frames.add_argument("--view-file", type=Path, required=True)
    frames.add_argument("--models", type=Path, nargs="+", required=True, help="model.pt of every level")
    frames.add_argument("--foreground", type=Path, required=True)
    frames.add_argument("--background", type=Path, required=True)
    frames.add_argument("--frames", type=int, nargs="+", required=True, help="output frames")
    frames.add_argument("--device", default="auto", help="auto, cpu, cuda, cuda:1, ...")
    frames.add_argument("--threads", type=int, default=1)
    cli.add_options(frames, RenderOptions)
    video = commands.add_parser("video", help="join rendered frames into a film")
    video.add_argument("--frames-dir", type=Path, nargs="+", required=True)
    video.add_argument("--right-frames-dir", type=Path, nargs="*", default=[], help="of the right eye")
    video.add_argument("--fps", type=float, required=True, help="frames per second")
    video.add_argument("--codec", default="h264", choices=CODEC_NAMES)
    for command in (frames, video):
        command.add_argument("--output", type=Path, required=True)
    args = parser.parse_args(argv)
    if args.command == "video":
        run_video(args.frames_dir, args.fps, args.output, args.codec, args.right_frames_dir)
        return
    cli.set_num_threads(args.threads)
    options = cli.options_from_args(RenderOptions, args)
    run_frames(
        args.view_file,
        args.models,
        args.foreground,
        args.background,
        args.frames,
        args.output,
        options,
        args.device,
    )


if __name__ == "__main__":
    sys.exit(cli.run_stage(main))
