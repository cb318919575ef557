"""Films that play everywhere."""

import contextlib
import dataclasses
import os
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

# What makes x264 give the same bytes for the same frames: its decisions depend on the number of
# threads, and its macroblock tree with B-frames reads memory that nobody wrote where a picture is
# not a multiple of 256 columns (seen with MALLOC_PERTURB_).
SAME_BYTES = {"threads": "1", "x264-params": "mbtree=0"}


@dataclasses.dataclass(frozen=True)
class Codec:
    """How a film is stored. suffix: of the only container it goes into;  tag: what players know it by."""

    encoder: str
    suffix: str
    pixel_format: str
    options: dict[str, str]
    tag: str | None = None


# The rates of hevc and av1 give the luma error that x264 has at 18 (films of the demo, `benches.export`);
# the last two are for cutting and grading.
CODECS = {
    "h264": Codec("libx264", ".mp4", "yuv420p", {"crf": "18", "preset": "medium", **SAME_BYTES}),
    "hevc": Codec(
        "libx265",
        ".mp4",
        "yuv420p",
        {"crf": "21", "preset": "medium", "x265-params": "pools=none:frame-threads=1:log-level=error"},
        "hvc1",
    ),
    "av1": Codec("libsvtav1", ".mp4", "yuv420p", {"crf": "30", "preset": "6", "svtav1-params": "lp=1"}),
    "prores": Codec("prores_ks", ".mov", "yuv422p10le", {"profile": "hq", "threads": "1"}),
    "ffv1": Codec("ffv1", ".mkv", "bgr0", {"level": "3", "threads": "1"}),
}


def encode_video(
    path: Path | str, frames: Iterable[np.ndarray], fps: Fraction | float, codec: str = "h264"
) -> None:
    """Write (H, W, 3) uint8 RGB frames as a film; the default plays everywhere (MP4, yuv420p, BT.709).

    codec: of CODECS, which also says what the path must end in. ffv1 is lossless; of the others odd
    sizes grow by one repeated row or column, since chroma is stored at half the size.
    The same frames give the same bytes. The file appears whole or not at all.
    Raises InputError without frames, ValueError for an unknown codec, another suffix, or frames that
    differ in size.
    """
    if codec not in CODECS:
        raise ValueError(f"expected a codec of {', '.join(CODECS)}, got {codec!r}")
    if Path(path).suffix != CODECS[codec].suffix:
        raise ValueError(f"expected a path that ends in {CODECS[codec].suffix} for {codec}, got {path}")
    rate = Fraction(fps).limit_denominator(1001)
    # Matroska would number its segments at random.
    muxing = {"fflags": "+bitexact"} if codec == "ffv1" else {"movflags": "+faststart"}
    with atomic_path(path) as temporary, av.open(str(temporary), "w", options=muxing) as container:
        stream = None
        shape: tuple[int, ...] = ()
        for index, image in enumerate(frames):
            if stream is None:
                shape = image.shape
                stream = _add_stream(container, CODECS[codec], rate, shape)
            if image.shape != shape or image.dtype != np.uint8:
                raise ValueError(f"frame {index} is {image.shape} {image.dtype}, expected {shape} uint8")
            container.mux(stream.encode(_stored_frame(image, index, rate, CODECS[codec])))
        if stream is None:
            raise InputError(
                f"expected at least one frame to write to {path}, got none: check the frame range"
            )
        container.mux(stream.encode(None))


def _add_stream(
    container: OutputContainer, codec: Codec, rate: Fraction, shape: tuple[int, ...]
) -> av.VideoStream:
    stream = container.add_stream(codec.encoder, rate=rate, options=dict(codec.options))
    assert isinstance(stream, av.VideoStream)
    height, width = shape[:2] if codec.encoder == "ffv1" else (n + n % 2 for n in shape[:2])
    stream.width, stream.height, stream.pix_fmt = width, height, codec.pixel_format
    context = stream.codec_context
    if codec.tag is not None:
        context.codec_tag = codec.tag
    if codec.encoder != "ffv1":
        context.color_primaries = context.color_trc = context.colorspace = 1
        context.color_range = ColorRange.MPEG
    open_encoder(stream)
    return stream


def open_encoder(stream: av.VideoStream) -> None:
    """Open a stream's encoder, and leave the process scheduled as it was.

    Where it may, as root, SVT-AV1 makes its threads and the caller's real-time ones of the highest priority,
    and so every process that is started afterwards: nothing else runs on their cores any more.
    """
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    stream.codec_context.open(strict=False)
    for thread in Path("/proc/self/task").iterdir():
        # One that has just ended needs nothing.
        with contextlib.suppress(ProcessLookupError):
            os.sched_setscheduler(int(thread.name), policy, parameters)


def _stored_frame(image: np.ndarray, index: int, rate: Fraction, codec: Codec) -> av.VideoFrame:
    if codec.encoder == "ffv1":
        padded = np.concatenate([image[:, :, ::-1], np.zeros_like(image[:, :, :1])], axis=2)
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(padded), format="bgra").reformat(
            format=codec.pixel_format, threads=1
        )
    else:
        height, width = image.shape[:2]
        padded = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(padded), format="rgb24").reformat(
            format=codec.pixel_format,
            dst_colorspace=Colorspace.ITU709,
            dst_color_range=ColorRange.MPEG,
            interpolation=INTERPOLATION,
            threads=1,
        )
    frame.pts, frame.time_base = index, 1 / rate
    return frame
