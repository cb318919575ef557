"""A film on the common clock, by the command that the workflow calls."""

from pathlib import Path

import numpy as np
import pytest

from fourd.align.__main__ import main
from fourd.align.clock import CameraClock, Offsets, write_offsets
from fourd.cli import run_stage
from fourd.ingest import open_camera
from fourd.ingest.__main__ import main as ingest_main
from fourd.io import read_json
from fourd.video import encode_video

NUM_FRAMES = 12


@pytest.fixture(scope="module")
def ingested(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A film of twelve frames at 25 fps whose grey level tells the frame."""
    folder = tmp_path_factory.mktemp("film")
    frames = [np.full((32, 48, 3), 20 + 15 * i, np.uint8) for i in range(NUM_FRAMES)]
    encode_video(folder / "a.mp4", frames, 25)
    output = ["--output-json", str(folder / "cam00.json"), "--output-table", str(folder / "cam00.csv")]
    ingest_main(["--camera", "cam00", "--source", str(folder / "a.mp4"), *output])
    return folder / "cam00.json"


def sample(ingested: Path, output: Path, *words: str) -> dict:
    command = ["sample", "--ingest", str(ingested), "--output", str(output), *words]
    assert run_stage(main, command) == 0
    return read_json(output)


def test_pictures_nearest_in_time_and_their_residual(ingested, tmp_path):
    document = sample(ingested, tmp_path / "c.json", "--fps", "30", "--num-frames", "4", "--offset-s=-0.08")
    # Scene frame k is at k / 30 s, film frame n at n / 25 - 0.08 s.
    assert document["source_frame"] == [2, 3, 4, 4]
    assert document["dt_s"] == pytest.approx([0, 0.04 - 1 / 30, 0.08 - 2 / 30, 0.08 - 0.1], abs=1e-9)
    with open_camera(tmp_path / "c.json") as reader:
        assert abs(float(reader.read(1).mean()) - 65) < 3
        assert reader.source_frame(2) == 4
        assert reader.dt_s(3) == pytest.approx(-0.02)


def test_clock_of_a_file_and_its_start(ingested, tmp_path):
    clocks = {"cam00": CameraClock(1.0, rate_ppm=0.0, sigma_s=0.002, method="audio")}
    write_offsets(tmp_path / "offsets.json", Offsets("cam00", clocks, start_s=1.2))
    words = ["--offsets", str(tmp_path / "offsets.json"), "--fps", "25", "--num-frames", "3"]
    document = sample(ingested, tmp_path / "c.json", *words)
    assert document["source_frame"] == [5, 6, 7]
    assert (document["method"], document["sigma_s"]) == ("audio", 0.002)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--num-frames", "30"], "ends too early"),
        (["--num-frames", "3", "--offset-s=0.5"], "none of the wanted"),
        (["--num-frames", "3", "--max-dt-frames=0.1"], "no picture within 0.1 frames"),
    ],
)
def test_film_that_does_not_show_the_scene_is_left_out_with_the_reason(ingested, tmp_path, words, reason):
    document = sample(ingested, tmp_path / "c.json", "--fps", "30", *words)
    assert reason in document["status"]
    assert document["source_frame"] == []


def test_refused_camera_keeps_its_reason_and_is_not_read(ingested, tmp_path, capsys):
    clocks = {"cam00": CameraClock(0.0, status="it shows another event")}
    write_offsets(tmp_path / "offsets.json", Offsets("cam00", clocks, start_s=0.0))
    words = ["--offsets", str(tmp_path / "offsets.json"), "--fps", "25", "--num-frames", "3"]
    assert sample(ingested, tmp_path / "c.json", *words)["status"] == "it shows another event"
    with open_camera(tmp_path / "c.json") as reader, pytest.raises(Exception, match="it shows another event"):
        reader.read(0)


def test_offsets_without_the_camera_are_refused(ingested, tmp_path, capsys):
    write_offsets(tmp_path / "offsets.json", Offsets("cam09", {"cam09": CameraClock(0.0)}, start_s=0.0))
    words = ["--offsets", str(tmp_path / "offsets.json"), "--fps", "25", "--num-frames", "3"]
    assert run_stage(main, ["sample", "--ingest", str(ingested), "--output", "none", *words]) == 2
    assert "expected the clock of camera cam00" in capsys.readouterr().err
