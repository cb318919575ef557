"""Which moments the page shows from which places: a lattice of times and views, chosen by its bytes."""

import dataclasses
import math
from typing import Any

from fourd.errors import InputError
from fourd.trajectory import scene_frames
from fourd.viewer import ViewerOptions

# Bytes per pixel of a picture at the default quality, and of the map of its origins, which is smaller
# by MAP_REDUCTION on each side: high values of rendered events (docs/viewer.md).
PICTURE_BYTES_PER_PIXEL = 0.19
MAP_BYTES_PER_PIXEL = 0.36
MAP_REDUCTION = 3
# Real pictures stand beside the render, at a smaller size.
REAL_SHARE = 2 / 3
# Files are text, four characters for three bytes, and the page needs some for itself.
TEXT_BYTES_PER_BYTE = 4 / 3
PAGE_BYTES = 250_000
# Where the budget allows it, this many views per gap between two cameras.
VIEWS_PER_GAP = 3
# Pictures become smaller by these shares of the wanted width until so many moments fit.
WIDTH_SHARES = (1.0, 0.75, 0.5)
MIN_MOMENTS = 48


@dataclasses.dataclass(frozen=True)
class Lattice:
    """views: name -> trajectory, a held view that shows the chosen moments of the clip

    frames: of the scene, the moments;  size: (width, height) of a picture, px
    forecast_mb: of the whole page
    """

    views: dict[str, dict[str, Any]]
    frames: tuple[int, ...]
    size: tuple[int, int]
    forecast_mb: float


def choose_lattice(
    size: tuple[int, int], num_frames: int, num_inputs: int, num_cameras: int, options: ViewerOptions
) -> Lattice:
    """Places along the cameras' path, and moments of the clip, that fit into the bytes of the page.

    size: of the films, (width, height) px;  num_frames: of the clip
    num_inputs: cameras that the path leads through;  num_cameras: those and the held-out ones
    Where bytes are few, views go first, down to two for three input cameras; then pictures become
    smaller until MIN_MOMENTS fit; what remains is fewer moments.
    Raises InputError when not even two moments from two places fit.
    """
    budget = (options.max_mb * 1e6 - PAGE_BYTES) / TEXT_BYTES_PER_BYTE
    wanted = VIEWS_PER_GAP * (num_inputs - 1) + 1
    least = max(3, -(-2 * num_inputs // 3))
    num_times = num_views = 0
    for share in WIDTH_SHARES:
        picture = fit_width(size, max(16, round(options.width * share)))
        per_picture, per_moment = bytes_of(picture, num_cameras)
        fitting = int((budget / num_frames - per_moment) / per_picture)
        num_views = options.num_views or max(least, min(wanted, fitting))
        num_times = min(num_frames, int(budget / (per_moment + num_views * per_picture)))
        if num_times >= min(num_frames, MIN_MOMENTS):
            break
    if num_times < min(2, num_frames):
        needed = 2 * (per_moment + num_views * per_picture) * TEXT_BYTES_PER_BYTE + PAGE_BYTES
        raise InputError(
            f"viewer: expected room for at least two moments of {num_views} views, but max_mb "
            f"{options.max_mb:g} holds {num_times}: set max_mb to {math.ceil(needed / 1e6)} or more"
        )
    shares = [round(i / (num_views - 1), 6) for i in range(num_views)]
    views = {
        f"lattice-{i:02d}": {"kind": "hold", "position": share, "num_frames": num_times}
        for i, share in enumerate(shares)
    }
    frames = tuple(scene_frames(views["lattice-00"], num_frames))
    total = num_times * (per_moment + num_views * per_picture) * TEXT_BYTES_PER_BYTE + PAGE_BYTES
    return Lattice(views, frames, picture, total / 1e6)


def bytes_of(picture: tuple[int, int], num_cameras: int) -> tuple[float, float]:
    """Bytes of one rendered picture with its map, and of all real pictures of a moment, to expect."""
    pixels = picture[0] * picture[1]
    rendered = pixels * (PICTURE_BYTES_PER_PIXEL + MAP_BYTES_PER_PIXEL / MAP_REDUCTION**2)
    return rendered, num_cameras * pixels * REAL_SHARE**2 * PICTURE_BYTES_PER_PIXEL


def fit_width(size: tuple[int, int], width: int) -> tuple[int, int]:
    """The size, made smaller to at most that many columns, with the same aspect."""
    if size[0] <= width:
        return size
    return width, max(1, round(size[1] * width / size[0]))
