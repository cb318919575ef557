"""Films of every codec: what is read back, and that bytes repeat."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from fourd.errors import InputError
from fourd.io import write_png
from fourd.render import CODEC_NAMES, main, run_video
from fourd.video import encode_video, probe_video, read_video_frames
from fourd.video.encode import CODECS

# Largest mean difference, grey levels, of a smooth moving picture.
TOLERANCE = {"h264": 2.0, "hevc": 2.0, "av1": 2.5, "prores": 1.0, "ffv1": 0.0}

WRITE = """
import sys
import numpy as np
from fourd.errors import InputError
from fourd.io import write_png
from fourd.render import CODEC_NAMES, main, run_video
from fourd.video import encode_video
texture = np.random.default_rng(0).integers(0, 256, (23, 50, 3)).repeat(8, 0).repeat(8, 1).astype(np.uint8)
frames = (np.roll(texture, (2 * i, 5 * i), (0, 1))[:180, :320] for i in range(16))
encode_video(sys.argv[1], frames, 30, sys.argv[2])
"""


def pictures(count: int = 5, size: tuple[int, int] = (96, 64)) -> list[np.ndarray]:
    x, y = np.meshgrid(np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1]))
    waves = [np.stack([x, y, np.sin(3 * x + 0.3 * i) ** 2], axis=-1) for i in range(count)]
    return [(40 + 160 * wave).astype(np.uint8) for wave in waves]


def policies() -> set[int]:
    return {os.sched_getscheduler(int(task.name)) for task in Path("/proc/self/task").iterdir()}


@pytest.mark.parametrize("codec", CODECS)
def test_encoders_leave_the_scheduling_of_threads_alone(tmp_path: Path, codec: str) -> None:
    """SVT-AV1 as root would make a real-time process of this one, and of all that it starts."""
    before, seen = policies(), []

    def frames():
        for picture in pictures():
            seen.append(policies())
            yield picture

    encode_video(tmp_path / f"film{CODECS[codec].suffix}", frames(), 25, codec)
    assert [*seen, policies()] == 6 * [before]


@pytest.mark.parametrize("codec", CODECS)
def test_every_codec_is_read_back(tmp_path: Path, codec: str) -> None:
    path = tmp_path / f"film{CODECS[codec].suffix}"
    encode_video(path, pictures(), 25, codec)
    info = probe_video(path)
    assert (info.codec.removeprefix("lib"), info.size, len(info.pts_s)) == (
        codec if codec != "av1" else info.codec,
        (96, 64),
        5,
    )
    assert info.fps == pytest.approx(25, rel=2e-3)
    for (_, read), picture in zip(read_video_frames(path, range(5)), pictures(), strict=True):
        assert np.abs(read.astype(int) - picture).mean() <= TOLERANCE[codec]


def test_lossless_means_every_level_of_every_size(tmp_path: Path) -> None:
    frames = [np.random.default_rng(i).integers(0, 256, (33, 47, 3)).astype(np.uint8) for i in range(3)]
    encode_video(tmp_path / "film.mkv", frames, 30, "ffv1")
    for (_, read), frame in zip(read_video_frames(tmp_path / "film.mkv", range(3)), frames, strict=True):
        assert np.array_equal(read, frame)


@pytest.mark.parametrize("codec", CODECS)
def test_no_byte_depends_on_memory_nobody_wrote(tmp_path: Path, codec: str) -> None:
    contents = set()
    for fill in ("0", "85", "170"):
        path = tmp_path / f"{fill}{CODECS[codec].suffix}"
        environment = {**os.environ, "MALLOC_PERTURB_": fill}
        subprocess.run([sys.executable, "-c", WRITE, str(path), codec], check=True, env=environment)
        contents.add(path.read_bytes())
    assert len(contents) == 1


def test_container_must_fit_the_codec(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"ends in \.mov"):
        encode_video(tmp_path / "film.mp4", pictures(), 25, "prores")


def test_film_schema_and_codecs_agree() -> None:
    schema = Path(__file__).resolve().parents[2] / "config" / "schemas" / "film.schema.yaml"
    properties = yaml.safe_load(schema.read_text())["properties"]
    assert tuple(CODECS) == CODEC_NAMES
    stored = [*properties["codec"]["enum"], *properties["master"]["enum"]]
    assert sorted({*stored} - {"none"}) == sorted(CODECS)


def test_eyes_are_put_side_by_side(tmp_path: Path) -> None:
    for eye, level in (("left", 40), ("right", 200)):
        for frame in (3, 4):
            write_png(tmp_path / eye / f"{frame:06d}.png", np.full((32, 48, 3), level + frame, np.uint8))
    flags = ["--frames-dir", str(tmp_path / "left"), "--right-frames-dir", str(tmp_path / "right")]
    main(["video", *flags, "--fps", "30", "--codec", "ffv1", "--output", str(tmp_path / "film.mkv")])
    frames = [image for _, image in read_video_frames(tmp_path / "film.mkv", [0, 1])]
    assert [image[5, [10, 60], 0].tolist() for image in frames] == [[43, 203], [44, 204]]
    (tmp_path / "right" / "000004.png").unlink()
    with pytest.raises(InputError, match="both eyes to have the same frames, got 2 and 1"):
        run_video([tmp_path / "left"], 30, tmp_path / "film.mp4", right_folders=[tmp_path / "right"])
