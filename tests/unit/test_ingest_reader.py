from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fourd.align.sampling import match_frames
from fourd.errors import InputError
from fourd.image import difference_of
from fourd.ingest import IngestOptions, open_camera, open_source, read_ingest
from fourd.ingest.__main__ import run
from fourd.io import ArchiveWriter, read_json, write_json, write_png
from fourd.tone import identity_table

SIZE = (160, 120)


def picture(index: int) -> np.ndarray:
    """A still wall with a disc that walks 8 px per frame."""
    noise = np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    image = np.ascontiguousarray(cv2.GaussianBlur(noise, (0, 0), 1.5))
    cv2.circle(image, (30 + 8 * index, 60), 12, (250, 40, 40), -1)
    return image


def write_camera(folder: Path, start_s: float = 0.0, num_frames: int = 6, **changes: Any) -> Path:
    """frames/cam00.json of ten pictures at 30 fps."""
    for index in range(10):
        write_png(folder / f"images/{index}.png", picture(index))
    run("cam00", folder / "images", 30.0, folder / "i.json", folder / "i.csv", IngestOptions(verify=False))
    ingested = read_json(folder / "i.json")
    source_frame, dt_s = match_frames(np.array(ingested["pts_s"]), 30, num_frames, start_s)
    document = {
        "camera": "cam00", "ingest": ingested, "status": "ok", "offset_s": 0.0, "rate_ppm": 0.0,
        "sigma_s": 0.0, "method": "given", "fps": 30, "num_frames": num_frames,
        "source_frame": source_frame.tolist(), "dt_s": dt_s.tolist(), **changes,
    }  # fmt: skip
    write_json(folder / "cam00.json", document)
    return folder / "cam00.json"


def test_scene_frames_are_read(tmp_path):
    with open_camera(write_camera(tmp_path, start_s=0.1)) as reader:
        assert (reader.camera, reader.size, reader.num_frames, reader.status) == ("cam00", SIZE, 6, "ok")
        for frame in (0, 5, 2):
            np.testing.assert_array_equal(reader.read(frame), picture(frame + 3))
            assert reader.source_frame(frame) == frame + 3
            assert reader.dt_s(frame) == pytest.approx(0, abs=1e-12)
        for method in (reader.read, reader.dt_s, reader.source_frame):
            with pytest.raises(InputError, match=r"cam00: expected a scene frame in 0\.\.5, got 6"):
                method(6)


def test_a_camera_that_is_left_out_says_why(tmp_path):
    path = write_camera(tmp_path, status="its sound fits no other camera", source_frame=[], dt_s=[])
    with open_camera(path) as reader:
        assert reader.num_frames == 0
        with pytest.raises(InputError, match=r"cam00: .*cam00\.json says: its sound fits no other camera"):
            reader.read(0)


def test_tone_is_applied_and_raw_is_untouched(tmp_path):
    table = identity_table()
    table[0] = 255 - table[0]
    tone = {"frames": [0], "tables": [table.tolist()]}
    with open_camera(write_camera(tmp_path, tone=tone, compensation=None)) as reader:
        expected = picture(2)
        expected[..., 0] = 255 - expected[..., 0]
        np.testing.assert_array_equal(reader.read(2), expected)
        np.testing.assert_array_equal(reader.read(2, is_raw=True), picture(2))


def test_pixels_that_motion_changes_come_from_the_archive(tmp_path):
    document = read_json(write_camera(tmp_path))
    moved = picture(2)
    moved[5:9, 7:11] = (1, 2, 3)
    where, rgb = difference_of(picture(2), moved)
    with ArchiveWriter(tmp_path / "cam00.npz", {**document, "tone": None}) as writer:
        writer.add_frame(2, where=where, rgb=rgb)
    with open_camera(tmp_path / "cam00.npz") as reader:
        np.testing.assert_array_equal(reader.read(2), moved)
        np.testing.assert_array_equal(reader.read(1), picture(1))
        for plain in ({"is_raw": True}, {"is_compensated": False}):
            np.testing.assert_array_equal(reader.read(2, **plain), picture(2))


@pytest.mark.parametrize(
    "change",
    [
        {"camera": 3},
        {"size": [160]},
        {"size": [160, 0]},
        {"size": 7},
        {"pts_s": [0.0, 0.1]},
        {"pts_s": [0.1] * 10},
        {"pts_s": []},
        {"files": None},
        {"kind": "sound"},
        {"sha256": ""},
    ],
)
def test_damaged_ingest_documents_are_refused(tmp_path, change):
    write_camera(tmp_path)
    write_json(tmp_path / "i.json", {**read_json(tmp_path / "i.json"), **change})
    for read in (read_ingest, open_source):
        with pytest.raises(InputError, match=r"expected the output of the stage ingest in .*i\.json"):
            read(tmp_path / "i.json")


@pytest.mark.parametrize(
    "change", [{"source_frame": None}, {"ingest": {}}, {"ingest": None}, {"dt_s": [0.0]}]
)
def test_foreign_documents_are_refused(tmp_path, change):
    with pytest.raises(InputError, match="expected the output of the stage frames or align in"):
        open_camera(write_camera(tmp_path, **change))
    (tmp_path / "empty.json").write_text("{}")
    with pytest.raises(InputError, match="frames or align"):
        open_camera(tmp_path / "empty.json")
