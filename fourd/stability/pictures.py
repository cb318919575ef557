"""Files that are broken, frames of one colour, motion of nothing and of everything."""

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from fourd import metrics
from fourd.flow import CompensationOptions, compensate_motion
from fourd.frames.fit import fit_colours
from fourd.frames.observations import ColourPairs
from fourd.image import apply_difference, crop, difference_of, pad_to_multiple, uint8_from_float
from fourd.ingest.__main__ import main as ingest
from fourd.ingest.reader import open_source
from fourd.io import Archive, ArchiveWriter, read_image, read_json, write_png
from fourd.stability import rig
from fourd.stability.case import Outcome, judge, judge_refusal, make_cases, reason_of, relative_difference
from fourd.tone import apply_tone, identity_table
from fourd.video.encode import encode_video
from fourd.video.probe import probe_video
from fourd.video.reader import VideoReader

SHAPE = (rig.SIZE[1], rig.SIZE[0], 3)
GAP_S = 1 / 30


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def _picture() -> np.ndarray:
    return rig.render(rig.on_arc(0))


def _flat(level: int) -> np.ndarray:
    return np.full(SHAPE, level, np.uint8)


def _film(path: Path, pictures: list[np.ndarray]) -> Path:
    encode_video(path, pictures, 30)
    return path


def empty_picture_file() -> Outcome:
    """Refused: the file is named."""
    with _folder() as folder:
        (folder / "000000.png").write_bytes(b"")
        return judge_refusal(reason_of(read_image, folder / "000000.png"), "000000.png")


def truncated_picture_in_a_folder() -> Outcome:
    """Refused: the picture is named, and no half picture is used."""
    with _folder() as folder:
        for frame in range(3):
            write_png(folder / f"film/{frame:06d}.png", _picture())
        broken = folder / "film/000001.png"
        broken.write_bytes(broken.read_bytes()[:-4000])
        facts = folder / "facts.json"
        words = ["--camera", "cam00", "--source", str(folder / "film"), "--fps", "30"]
        words += ["--output-json", str(facts), "--output-table", str(folder / "facts.csv")]

        def read() -> None:
            ingest(words)
            with open_source(facts) as reader:
                for frame in range(reader.num_frames):
                    reader.read(frame)

        return judge_refusal(reason_of(read), "000001.png")


def truncated_film() -> Outcome:
    """Refused: the file is named."""
    with _folder() as folder:
        path = _film(folder / "film.mp4", [_picture()] * 5)
        path.write_bytes(path.read_bytes()[:-200])
        return judge_refusal(reason_of(_read_all, path), "film.mp4")


def _read_all(path: Path) -> list[np.ndarray]:
    info = probe_video(path)
    with VideoReader(path, info) as reader:
        return [reader.read(frame) for frame in range(len(info.pts_s))]


def film_with_damaged_bytes() -> Outcome:
    """Refused: the frame is named, and no smeared picture is used."""
    with _folder() as folder:
        path = _film(folder / "film.mp4", [np.roll(_picture(), 2 * i, axis=1) for i in range(6)])
        data = bytearray(path.read_bytes())
        middle = len(data) // 2
        data[middle : middle + 40] = b"\xaa" * 40
        path.write_bytes(data)
        return judge_refusal(reason_of(_read_all, path), "damaged", "frame")


def film_of_black_frames() -> Outcome:
    """Every frame, all of them black."""
    with _folder() as folder:
        frames = _read_all(_film(folder / "film.mp4", [_flat(0)] * 12))
    worst = max(int(frame.max()) for frame in frames)
    return judge(len(frames) == 12 and worst <= 1, f"{len(frames)} frames, up to level {worst}")


def film_of_one_frame() -> Outcome:
    """The frame and a rate above 0."""
    with _folder() as folder:
        path = _film(folder / "film.mp4", [_picture()])
        info, frames = probe_video(path), _read_all(path)
    return judge(len(frames) == 1 and info.fps > 0, f"{len(frames)} frame, {info.fps:g} fps")


def archive_cut_short() -> Outcome:
    """Refused: the file is named."""
    with _folder() as folder:
        path = folder / "000000-000001.npz"
        with ArchiveWriter(path) as writer:
            writer.add_frame(0, depth=np.ones((20, 20), np.float32))
        path.write_bytes(path.read_bytes()[:-100])
        return judge_refusal(reason_of(Archive, path), "000000-000001.npz")


def json_that_ends_early() -> Outcome:
    """Refused: the file is named."""
    with _folder() as folder:
        (folder / "cameras.json").write_text('{"cameras": {')
        return judge_refusal(reason_of(read_json, folder / "cameras.json"), "cameras.json")


def nothing_moves_between_pictures() -> Outcome:
    """The picture, bit for bit."""
    image = _picture()
    found = compensate_motion(image, image, 0.5 * GAP_S, GAP_S, CompensationOptions())
    return judge(np.array_equal(found, image), "the picture")


def everything_moves_between_pictures() -> Outcome:
    """The picture, bit for bit: what all moves alike is the camera."""
    image = _picture()
    shifted = np.roll(image, 3, axis=1)
    found = compensate_motion(image, shifted, 0.5 * GAP_S, GAP_S, CompensationOptions())
    changed = float((found != image).any(axis=2).mean())
    return judge(changed < 0.01, f"{changed:.1%} of the pixels changed")


def pictures_of_two_scenes() -> Outcome:
    """The picture, bit for bit: there is nothing to follow."""
    image = _picture()
    found = compensate_motion(image, image[::-1].copy(), 0.5 * GAP_S, GAP_S, CompensationOptions())
    return judge(np.array_equal(found, image), "the picture")


def flat_pictures_between_times() -> Outcome:
    """The picture, bit for bit, black and saturated."""
    pairs = [(_flat(a), _flat(b)) for a, b in ((0, 0), (255, 255), (0, 255))]
    found = [compensate_motion(a, b, 0.5 * GAP_S, GAP_S, CompensationOptions()) for a, b in pairs]
    return judge(all(np.array_equal(f, a) for f, (a, _) in zip(found, pairs, strict=True)), "the pictures")


def colours_of_black_pictures() -> Outcome:
    """No correction: nothing to compare gives gain 1 and gamma 1."""
    model = fit_colours([], ("cam00", "cam01"), (0, 5), {"cam00": (np.zeros((2, 3)), np.ones(3))})
    gain = float(np.abs(model.log_gain).max())
    gamma = float(np.abs(model.gamma - 1).max())
    return judge(gain < 1e-9 and gamma < 1e-9, f"log gain {gain:.1g}, gamma off by {gamma:.1g}")


def colours_of_one_level() -> Outcome:
    """A finite correction near identity: one level does not tell gain from gamma."""
    levels = np.full((40, 3), 128.0)
    pairs = ColourPairs("cam00", "cam01", 0, levels, 1.1 * levels)
    model = fit_colours([pairs], ("cam00", "cam01"), (0,), {"cam00": (np.zeros((1, 3)), np.ones(3))})
    finite = bool(np.isfinite(model.log_gain).all() and np.isfinite(model.gamma).all())
    corrected = float(model.corrected(1, np.array([1.1 * 128.0]))[0, 0, 0])
    return judge(finite and abs(corrected - 128) < 2, f"level 141 becomes {corrected:.1f}")


def tone_at_the_ends() -> Outcome:
    """Black and white stay black and white under the identity."""
    found = [apply_tone(_flat(level), identity_table()) for level in (0, 255)]
    return judge(int(found[0].max()) == 0 and int(found[1].min()) == 255, "0 and 255")


def image_values_out_of_range() -> Outcome:
    """Clipped, infinities too."""
    found = uint8_from_float(np.array([-np.inf, -1e30, 0, 1, 1e30, np.inf], np.float32))
    return judge(found.tolist() == [0, 0, 0, 255, 255, 255], f"{found.tolist()}")


def image_values_that_are_no_numbers() -> Outcome:
    """Refused: a NaN has no grey level."""
    return judge_refusal(reason_of(uint8_from_float, np.array([0.5, np.nan])), "NaN")


def quality_of_equal_and_flat_pictures() -> Outcome:
    """Infinite PSNR and SSIM 1 of equal pictures, 0 dB of black against white."""
    same = metrics.psnr(_flat(7), _flat(7)), metrics.ssim(_flat(7), _flat(7))
    worst = metrics.psnr(_flat(0), _flat(255))
    is_right = same[0] == np.inf and abs(same[1] - 1) < 1e-12 and abs(worst) < 1e-12
    return judge(is_right, f"{same[0]} dB, {same[1]:.3f}, {worst:.3f} dB")


def quality_of_a_picture_with_holes() -> Outcome:
    """Refused: a NaN is no colour."""
    image = _flat(7).astype(np.float32)
    image[3, 4] = np.nan
    return judge_refusal(reason_of(metrics.psnr, image, _flat(7)), "finite")


def quality_in_single_precision() -> Outcome:
    """Structural similarity of float32 pictures as of float64, within 1e-9."""
    image, truth = _picture(), cv2.GaussianBlur(_picture(), (5, 5), 0)
    single = metrics.ssim(image.astype(np.float32), truth.astype(np.float32))
    double = metrics.ssim(image.astype(np.float64), truth.astype(np.float64))
    error = relative_difference(np.array(single), np.array(double))
    return judge(error < 1e-9, f"{single:.6f}", error)


def padding_of_odd_sizes() -> Outcome:
    """Cut back to the same picture from multiples of 32 and 64, from 1 x 1 px on."""
    for height, width in ((1, 1), (31, 33), (270, 481)):
        image = np.arange(height * width * 3, dtype=np.uint32).reshape(height, width, 3)
        for multiple in (32, 64):
            padded, window = pad_to_multiple(image, multiple)
            if padded.shape[0] % multiple or not np.array_equal(crop(padded, window), image):
                return judge(False, f"{width} x {height} px is not what it was")
    return judge(True, "the pictures")


def difference_of_equal_and_of_opposite_pictures() -> Outcome:
    """Nothing stored for equal ones, all of it for opposite ones; both give the picture back."""
    image = _picture()
    sizes = []
    for other in (image, 255 - image):
        where, rgb = difference_of(image, other)
        sizes.append(len(rgb))
        if not np.array_equal(apply_difference(image, where, rgb), other):
            return judge(False, "another picture")
    return judge(sizes[0] == 0, f"{sizes[0]} and {sizes[1]} pixels")


CASES = make_cases(
    "pictures",
    empty_picture_file,
    truncated_picture_in_a_folder,
    truncated_film,
    film_with_damaged_bytes,
    film_of_black_frames,
    film_of_one_frame,
    archive_cut_short,
    json_that_ends_early,
    nothing_moves_between_pictures,
    everything_moves_between_pictures,
    pictures_of_two_scenes,
    flat_pictures_between_times,
    colours_of_black_pictures,
    colours_of_one_level,
    tone_at_the_ends,
    image_values_out_of_range,
    image_values_that_are_no_numbers,
    quality_of_equal_and_flat_pictures,
    quality_of_a_picture_with_holes,
    quality_in_single_precision,
    padding_of_odd_sizes,
    difference_of_equal_and_of_opposite_pictures,
)
