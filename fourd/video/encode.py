"""Films that play everywhere."""

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import OutputContainer
from av.video.reformatter import ColorRange, Colorspace

from fourd.errors import InputError
from fourd.io import atomic_path
from fourd.video.colour import INTERPOLATION

ENCODERS = {"h264": "libx264"}
CONSTANT_RATE_FACTOR = 18
# What makes x264 give the same bytes for the same frames: its decisions depend on the number of
# threads, and its macroblock tree with B-frames reads memory that nobody wrote where a picture is
# not a multiple of 256 columns (seen with MALLOC_PERTURB_).
SAME_BYTES = {"threads": "1", "x264-params": "mbtree=0"}


def encode_video(
    path: Path | str, frames: Iterable[np.ndarray], fps: Fraction | float, codec: str = "h264"
) -> None:
    """Write (H, W, 3) uint8 RGB frames as an MP4 that plays everywhere (yuv420p, BT.709, faststart).

    Odd sizes grow by one repeated row or column, since chroma is stored at half the size. The
    same frames give the same bytes. The file appears whole or not at all.
    Raises InputError without frames, ValueError for an unknown codec or frames that differ in size.
    """
    if codec not in ENCODERS:
        raise ValueError(f"expected a codec of {', '.join(ENCODERS)}, got {codec!r}")
    rate = Fraction(fps).limit_denominator(1001)
    with (
        atomic_path(path) as temporary,
        av.open(str(temporary), "w", options={"movflags": "+faststart"}) as container,
    ):
        stream = None
        shape: tuple[int, ...] = ()
        for index, image in enumerate(frames):
            if stream is None:
                shape = image.shape
                stream = _add_stream(container, ENCODERS[codec], rate, shape)
            if image.shape != shape or image.dtype != np.uint8:
                raise ValueError(f"frame {index} is {image.shape} {image.dtype}, expected {shape} uint8")
            container.mux(stream.encode(_yuv_frame(image, index, rate)))
        if stream is None:
            raise InputError(
                f"expected at least one frame to write to {path}, got none: check the frame range"
            )
        container.mux(stream.encode(None))


def _add_stream(
    container: OutputContainer, encoder: str, rate: Fraction, shape: tuple[int, ...]
) -> av.VideoStream:
    options = {"crf": str(CONSTANT_RATE_FACTOR), "preset": "medium", **SAME_BYTES}
    stream = container.add_stream(encoder, rate=rate, options=options)
    assert isinstance(stream, av.VideoStream)
    height, width = shape[:2]
    stream.width, stream.height, stream.pix_fmt = width + width % 2, height + height % 2, "yuv420p"
    context = stream.codec_context
    context.color_primaries = context.color_trc = context.colorspace = 1
    context.color_range = ColorRange.MPEG
    return stream


def _yuv_frame(image: np.ndarray, index: int, rate: Fraction) -> av.VideoFrame:
    height, width = image.shape[:2]
    padded = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(padded), format="rgb24").reformat(
        format="yuv420p",
        dst_colorspace=Colorspace.ITU709,
        dst_color_range=ColorRange.MPEG,
        interpolation=INTERPOLATION,
        threads=1,
    )
    frame.pts, frame.time_base = index, 1 / rate
    return frame
