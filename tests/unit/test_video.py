import os
import subprocess
import sys
from fractions import Fraction

import av
import numpy as np
import pytest

from fourd.errors import InputError
from fourd.video import (
    VideoReader,
    encode_video,
    nominal_fps,
    probe_video,
    read_video_frames,
)
from tests.unit.film_files import constant_ticks, index_of, numbered_picture, write_video

COLOURS = [(255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255), (0, 0, 0), (200, 120, 40), (10, 200, 180)]


def variable_ticks(num_frames: int) -> list[int]:
    return np.cumsum(np.random.default_rng(3).integers(1500, 6000, num_frames)).tolist()


@pytest.mark.parametrize("ticks", [constant_ticks(20), variable_ticks(20)], ids=["constant", "variable"])
@pytest.mark.parametrize("encoder, codec", [("libx264", "h264"), ("libx265", "hevc"), ("libvpx-vp9", "vp9")])
def test_frame_times_are_exact(tmp_path, ticks, encoder, codec):
    info = probe_video(write_video(tmp_path / "film.mp4", ticks, encoder))
    expected = np.array(ticks) / 90000
    assert info.codec == codec
    assert info.size == (64, 48)
    np.testing.assert_allclose(np.diff(info.pts_s), np.diff(expected), atol=1e-6)
    assert abs(info.pts_s[0] - expected[0]) < 1e-3


def test_matroska_times_are_exact_to_its_millisecond(tmp_path):
    ticks = variable_ticks(20)
    info = probe_video(write_video(tmp_path / "film.mkv", ticks))
    np.testing.assert_allclose(info.pts_s, np.array(ticks) / 90000, atol=1e-3)


@pytest.mark.parametrize("encoder", ["libx264", "libx265", "libvpx-vp9"])
@pytest.mark.parametrize("order", [[0, 1, 2, 3, 19], [19, 0, 10, 11, 9, 8, 16, 7], [12, 12, 17, 3]])
def test_frames_are_read_in_any_order(tmp_path, encoder, order):
    path = write_video(tmp_path / "film.mp4", variable_ticks(20), encoder)
    read = list(read_video_frames(path, order))
    assert [index for index, _ in read] == order
    assert [index_of(picture) for _, picture in read] == order


def test_open_gop_is_read_right(tmp_path):
    path = write_video(
        tmp_path / "film.mp4", constant_ticks(24), gop=6, options={"x264-params": "open-gop=1:bframes=3"}
    )
    info = probe_video(path)
    with VideoReader(path, info) as reader:
        assert [index_of(reader.read(i)) for i in (23, 5, 6, 11, 12, 4)] == [23, 5, 6, 11, 12, 4]


def test_jump_equals_sequential_decoding(tmp_path):
    path = write_video(tmp_path / "film.mp4", constant_ticks(24), gop=6)
    sequential = [picture for _, picture in read_video_frames(path, range(24))]
    for index in (23, 6, 13, 5):
        [(_, picture)] = read_video_frames(path, [index])
        np.testing.assert_array_equal(picture, sequential[index])


@pytest.mark.parametrize("rotation", [90, 180, -90])
def test_convention_rotation_metadata_turns_counterclockwise(tmp_path, rotation):
    path = write_video(tmp_path / "film.mp4", constant_ticks(3), rotation=rotation)
    upright = write_video(tmp_path / "upright.mp4", constant_ticks(3))
    info = probe_video(path)
    assert info.rotation_deg == rotation % 360
    assert info.size == ((64, 48) if rotation == 180 else (48, 64))
    [(_, turned)] = read_video_frames(path, [1])
    [(_, stored)] = read_video_frames(upright, [1])
    np.testing.assert_array_equal(turned, np.rot90(stored, rotation // 90))


def test_mirrored_film_is_mirrored(tmp_path):
    path = write_video(tmp_path / "film.mp4", constant_ticks(3), hflip=True)
    upright = write_video(tmp_path / "upright.mp4", constant_ticks(3))
    [(_, mirrored)] = read_video_frames(path, [2])
    [(_, stored)] = read_video_frames(upright, [2])
    np.testing.assert_array_equal(mirrored, stored[:, ::-1])


def test_avi_without_times_is_counted(tmp_path):
    path = tmp_path / "film.avi"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25, options={"qmin": "1", "qmax": "2", "b_qfactor": "1"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.max_b_frames = 2
        for index in range(20):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(numbered_picture(index))))
        container.mux(stream.encode(None))
    info = probe_video(path)
    assert info.is_counted
    np.testing.assert_allclose(info.pts_s, np.arange(len(info.pts_s)) / 25)
    with VideoReader(path, info) as reader:
        first = index_of(reader.read(0))
        assert [index_of(reader.read(i)) - first for i in (7, 3, 15)] == [7, 3, 15]


@pytest.mark.parametrize("size", [(64, 48), (63, 47), (17, 16)])
def test_film_round_trip(tmp_path, size):
    rng = np.random.default_rng(0)
    coarse = np.repeat(rng.integers(100, 156, (5, 4, 4, 1)), 3, axis=-1)
    pictures = [
        np.kron(c, np.ones((size[1] // 4 + 1, size[0] // 4 + 1, 1)))[: size[1], : size[0]] for c in coarse
    ]
    pictures = [p.astype(np.uint8) for p in pictures]
    path = tmp_path / "film.mp4"
    encode_video(path, iter(pictures), fps=Fraction(30000, 1001))
    info = probe_video(path)
    assert info.size == (size[0] + size[0] % 2, size[1] + size[1] % 2)
    np.testing.assert_allclose(info.pts_s, np.arange(5) * 1001 / 30000, atol=1e-6)
    assert info.fps == pytest.approx(30000 / 1001)
    for (_, read), picture in zip(read_video_frames(path, range(5)), pictures, strict=True):
        assert np.abs(read[: size[1], : size[0]].astype(int) - picture).mean() < 3


def test_odd_size_repeats_the_edge(tmp_path):
    picture = np.full((15, 21, 3), 60, np.uint8)
    picture[:, 16:] = 200
    encode_video(tmp_path / "film.mp4", [picture], fps=30)
    [(_, read)] = read_video_frames(tmp_path / "film.mp4", [0])
    assert read.shape == (16, 22, 3)
    assert np.abs(read[:, 21].astype(int) - 200).max() < 12


@pytest.mark.parametrize("colour", COLOURS)
def test_flat_colours_survive(tmp_path, colour):
    picture = np.broadcast_to(np.array(colour, np.uint8), (48, 64, 3))
    encode_video(tmp_path / "film.mp4", [picture] * 2, fps=30)
    for _, read in read_video_frames(tmp_path / "film.mp4", [0, 1]):
        assert np.abs(read.astype(int) - colour).max() <= 3


@pytest.mark.parametrize("matrix", [1, 5, 9], ids=["bt709", "bt601", "bt2020"])
@pytest.mark.parametrize("value_range", [1, 2], ids=["limited", "full"])
def test_colour_tags_are_obeyed(tmp_path, matrix, value_range):
    path, colour = tmp_path / "film.mp4", (200, 60, 20)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "4"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.codec_context.colorspace, stream.codec_context.color_range = matrix, value_range
        kr, kb = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 9: (0.2627, 0.0593)}[matrix]
        red, green, blue = np.array(colour) / 255
        luma = kr * red + (1 - kr - kb) * green + kb * blue
        chroma = [(blue - luma) / (2 - 2 * kb), (red - luma) / (2 - 2 * kr)]
        if value_range == 1:
            planes = [16 + 219 * luma, *(128 + 224 * c for c in chroma)]
        else:
            planes = [255 * luma, *(128 + 255 * c for c in chroma)]
        shapes = [(48, 64), (24, 32), (24, 32)]
        flat = np.concatenate(
            [np.full(np.prod(s), round(v), np.uint8) for s, v in zip(shapes, planes, strict=True)]
        )
        frame = av.VideoFrame.from_ndarray(flat.reshape(72, 64), format="yuv420p")
        frame.colorspace, frame.color_range = matrix, value_range
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    [(_, read)] = read_video_frames(path, [0])
    assert np.abs(read.astype(int) - colour).max() <= 3


def test_films_play_everywhere_and_are_reproducible(tmp_path):
    pictures = [numbered_picture(i) for i in range(6)]
    for name in ("a.mp4", "b.mp4"):
        encode_video(tmp_path / name, pictures, fps=24)
    data = (tmp_path / "a.mp4").read_bytes()
    assert data == (tmp_path / "b.mp4").read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")
    with av.open(str(tmp_path / "a.mp4")) as container:
        context = container.streams.video[0].codec_context
        tags = (context.color_primaries, context.color_trc, context.colorspace, context.color_range)
        assert (context.name, context.pix_fmt, tags) == ("h264", "yuv420p", (1, 1, 1, 1))


def test_no_byte_of_a_film_comes_from_memory_nobody_wrote(tmp_path):
    """x264 with its macroblock tree fails this: 320 columns are not a multiple of 256."""
    code = """
import sys
import numpy as np
from fourd.video import encode_video
texture = np.random.default_rng(0).integers(0, 256, (23, 50, 3)).repeat(8, 0).repeat(8, 1).astype(np.uint8)
encode_video(sys.argv[1], (np.roll(texture, (2 * i, 5 * i), (0, 1))[:180, :320] for i in range(32)), 30)
"""
    contents = set()
    for fill in ("0", "55", "170"):
        path = tmp_path / f"{fill}.mp4"
        environment = {**os.environ, "MALLOC_PERTURB_": fill}
        subprocess.run([sys.executable, "-c", code, str(path)], check=True, env=environment)
        contents.add(path.read_bytes())
    assert len(contents) == 1


def test_film_appears_whole_or_not_at_all(tmp_path):
    def breaks_off():
        yield numbered_picture(0)
        raise RuntimeError("no more frames")

    with pytest.raises(RuntimeError, match="no more frames"):
        encode_video(tmp_path / "film.mp4", breaks_off(), fps=30)
    assert list(tmp_path.iterdir()) == []


def test_film_needs_frames_of_one_size(tmp_path):
    with pytest.raises(InputError, match="at least one frame"):
        encode_video(tmp_path / "film.mp4", [], fps=30)
    with pytest.raises(ValueError, match="frame 1 is"):
        encode_video(tmp_path / "film.mp4", [numbered_picture(0), numbered_picture(1, (32, 32))], fps=30)
    with pytest.raises(ValueError, match="expected a codec"):
        encode_video(tmp_path / "film.mp4", [numbered_picture(0)], fps=30, codec="theora")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("share", [0.3, 0.6, 0.95])
@pytest.mark.parametrize("faststart", [False, True])
def test_truncated_file_is_refused(tmp_path, share, faststart):
    data = write_video(tmp_path / "film.mp4", constant_ticks(20), faststart=faststart).read_bytes()
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match=r"cut\.mp4.*truncated"):
        probe_video(cut)


@pytest.mark.parametrize("content", [b"", b"no film, only words\n" * 50], ids=["empty", "text"])
def test_no_video_is_refused(tmp_path, content):
    path = tmp_path / "film.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"expected a (whole )?video file at .*film\.mp4"):
        probe_video(path)


def test_missing_file_and_sound_without_pictures_are_refused(tmp_path):
    with pytest.raises(InputError, match="found nothing"):
        probe_video(tmp_path / "film.mp4")
    with av.open(str(tmp_path / "sound.m4a"), "w") as container:
        stream = container.add_stream("aac", rate=48000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 4096), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 48000
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with pytest.raises(InputError, match="without pictures"):
        probe_video(tmp_path / "sound.m4a")


def test_damage_inside_is_named_and_ends_at_the_next_keyframe(tmp_path):
    path = write_video(tmp_path / "film.mp4", constant_ticks(30), gop=10, size=(128, 96), options={"bf": "0"})
    info = probe_video(path)
    with av.open(str(path)) as container:
        entry = container.streams.video[0].index_entries[14]
    data = bytearray(path.read_bytes())
    data[entry.pos + 4 : entry.pos + entry.size] = b"\xaa" * (entry.size - 4)
    path.write_bytes(data)
    with VideoReader(path, info) as reader:
        for index in range(14, 20):
            with pytest.raises(InputError, match=f"expected frame {index} at .*damaged"):
                reader.read(index)
        assert [index_of(reader.read(i)) for i in (13, 20, 29, 0)] == [13, 20, 29, 0]


def test_index_outside_the_clip_is_refused(tmp_path):
    path = write_video(tmp_path / "film.mp4", constant_ticks(5))
    for index in (-1, 5):
        with pytest.raises(InputError, match=f"expected a frame in 0..4, got {index}"):
            list(read_video_frames(path, [index]))


@pytest.mark.parametrize("fps", [24000 / 1001, 25, 30000 / 1001, 30, 60, 7.25])
def test_nominal_rate_ignores_drops_and_rounding(fps):
    times = np.arange(100) / fps
    dropped = np.delete(times, [10, 11, 40, 77])
    assert nominal_fps(dropped) == pytest.approx(fps, abs=1e-5)
    if fps in (25, 30, 60):
        assert nominal_fps(np.round(dropped, 3)) == pytest.approx(fps, rel=0.001)
    assert nominal_fps(times[:1]) == 1.0
