"""Pictures and maps as small files that a page can load from the disk: WebP inside scripts.

A page opened from the disk may not read files, but it may run scripts that lie beside it. A script
hands over a run of pictures as text. Each picture is a file of its own in there, so that every moment is
found exactly, whatever was decoded before.
"""

import base64
import io
import json
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from PIL import Image

from fourd.errors import InputError

# Pictures in one script: small enough to come quickly, large enough not to be many.
RUN_LENGTH = 32
# The quality is lowered by this until the page is small enough.
QUALITY_STEP = 5
MIN_QUALITY = 20
# The slower methods of the encoder gain 4 % for two and a half times the work.
ENCODER_METHOD = 4


def encode_picture(image: np.ndarray, quality: int) -> bytes:
    """(H, W, 3) uint8 RGB as lossy WebP."""
    return _webp(image, quality=quality)


def encode_map(inverse_depth: np.ndarray, origin: np.ndarray, inverse_depth_max: float) -> bytes:
    """Lossless WebP: red is inverse depth in 255ths of `inverse_depth_max`, green is the origin.

    inverse_depth: (h, w) float32, clipped to the maximum;  origin: (h, w) uint8
    """
    red = np.clip(np.rint(inverse_depth * (255 / inverse_depth_max)), 0, 255).astype(np.uint8)
    return _webp(np.dstack([red, origin, np.zeros_like(red)]), lossless=True, exact=True)


def _webp(image: np.ndarray, **settings: int | bool) -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "WEBP", method=ENCODER_METHOD, **settings)
    return file.getvalue()


def script_of_run(kind: str, name: str, first: int, pictures: Sequence[bytes]) -> str:
    """A script that hands pictures `first`, `first` + 1, ... of a sequence to the page.

    kind: `view`, `map` or `camera`
    """
    words = [base64.b64encode(picture).decode("ascii") for picture in pictures]
    return f"fourd.receive({json.dumps([kind, name, first])},{json.dumps(words, separators=(',', ':'))})\n"


def pack_runs(kind: str, name: str, pictures: Sequence[bytes]) -> dict[str, str]:
    """File name -> script, RUN_LENGTH pictures each."""
    return {
        f"{kind}-{name}-{first // RUN_LENGTH}.js": script_of_run(
            kind, name, first, pictures[first : first + RUN_LENGTH]
        )
        for first in range(0, len(pictures), RUN_LENGTH)
    }


def encode_within(
    read: Mapping[str, Callable[[int], np.ndarray]], num_moments: int, quality: int, max_bytes: float
) -> tuple[dict[str, list[bytes]], int]:
    """All pictures of all sequences, at the highest quality up to the wanted one that fits.

    read: sequence -> function from moment to (H, W, 3) uint8;  max_bytes: of all pictures together
    Returns sequence -> pictures, and the quality. Raises InputError if even the lowest does not fit.
    """
    while True:
        encoded: dict[str, list[bytes]] = {name: [] for name in read}
        total = 0
        for name, picture_at in read.items():
            for moment in range(num_moments):
                encoded[name].append(encode_picture(picture_at(moment), quality))
                total += len(encoded[name][-1])
            if total > max_bytes:
                break
        if total <= max_bytes:
            return encoded, quality
        if quality - QUALITY_STEP < MIN_QUALITY:
            raise InputError(
                f"viewer: expected all pictures in {max_bytes / 1e6:.1f} MB, but at quality {quality} they "
                "are larger: raise max_mb, or set num_views or width to less"
            )
        quality -= QUALITY_STEP


def picture_address(picture: bytes) -> str:
    """A picture as an address that holds it."""
    return "data:image/webp;base64," + base64.b64encode(picture).decode("ascii")
