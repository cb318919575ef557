import csv
import dataclasses
import json
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import yaml
from PIL import Image

from fourd.cli import run_stage
from fourd.errors import InputError
from fourd.ingest import IngestOptions, list_images, open_source, probe_source
from fourd.ingest.__main__ import main
from fourd.io import read_json, write_png
from fourd.video import encode_video, read_video_frames
from tests.unit.film_files import click, constant_ticks, write_sounding_film, write_video

SIZE = (48, 32)
REPOSITORY = Path(__file__).resolve().parents[2]


def picture(index: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    image = np.full((size[1], size[0], 3), 10 * index, np.uint8)
    image[: size[1] // 2, : size[0] // 2] = (255, 0, 0)
    return image


def image_folder(folder: Path, numbers, size=SIZE, prefix: str = "") -> Path:
    for index, number in enumerate(numbers):
        write_png(folder / f"{prefix}{number:06d}.png", picture(index, size))
    return folder


def film(path: Path, num_frames: int, fps: float = 30) -> Path:
    encode_video(path, [picture(i) for i in range(num_frames)], fps)
    return path


def ingest(source: Path, output: Path, *, fps: float | None = 30, **options) -> Path:
    flags = [word for key, value in options.items() for word in ("--" + key.replace("_", "-"), str(value))]
    clock = [] if fps is None else ["--fps", str(fps)]
    main(
        ["--camera", "cam03", "--source", str(source), *clock, "--output-json", str(output)]
        + ["--output-table", str(output.with_suffix(".csv")), *flags]
    )
    return output


def test_options_and_schema_agree():
    schema = yaml.safe_load((REPOSITORY / "config/schemas/ingest.schema.yaml").read_text())
    defaults = {key: entry["default"] for key, entry in schema["properties"].items()}
    assert defaults == dataclasses.asdict(IngestOptions())


def test_folder_is_described_and_read(tmp_path):
    folder = image_folder(tmp_path / "cam", range(7, 15), prefix="take2_")
    document = read_json(ingest(folder, tmp_path / "cam03.json"))
    assert (document["kind"], document["source"], document["size"]) == ("images", str(folder), [48, 32])
    assert (document["num_source_frames"], document["fps"], document["rotation_deg"]) == (8, 30, 0)
    assert (document["has_audio"], document["audio_start_s"]) == (False, None)
    np.testing.assert_allclose(document["pts_s"], np.arange(8) / 30)
    with open_source(tmp_path / "cam03.json") as reader:
        assert (reader.size, reader.num_frames, reader.fps, reader.camera) == (SIZE, 8, 30, "cam03")
        for frame in (4, 0, 2, 2, 7):
            np.testing.assert_array_equal(reader.read(frame), picture(frame))


def test_names_are_sorted_by_number_not_by_text(tmp_path):
    for index, name in enumerate(["f8.png", "f9.png", "f10.png", "f11.png"]):
        write_png(tmp_path / name, picture(index))
    (tmp_path / "notes.txt").write_text("not an image")
    files, positions = list_images(tmp_path)
    assert [file.name for file in files] == ["f8.png", "f9.png", "f10.png", "f11.png"]
    np.testing.assert_array_equal(positions, [0, 1, 2, 3])


def test_video_frames_are_those_of_the_file(tmp_path):
    source = film(tmp_path / "cam.mp4", 20)
    document = read_json(ingest(source, tmp_path / "cam03.json", fps=None))
    assert (document["kind"], document["codec"], document["num_source_frames"]) == ("video", "h264", 20)
    expected = dict(read_video_frames(source, range(20)))
    with open_source(tmp_path / "cam03.json") as reader:
        for frame in (6, 7, 8, 15, 10, 0):
            np.testing.assert_array_equal(reader.read(frame), expected[frame])


def test_document_and_table_are_complete(tmp_path):
    sound = click(48000, 48000, 0.5)[None]
    source = write_sounding_film(tmp_path / "a.mov", sound, "pcm_s16le", audio_start_s=0.1, video_start_s=0.3)
    document = read_json(ingest(source, tmp_path / "cam03.json"))
    wanted = (
        "camera source kind files size rotation_deg pixel_aspect fps num_source_frames pts_s start_s codec "
        "pixel_format bit_depth transfer is_counted keyframes has_audio audio_start_s audio_duration_s "
        "focal_35mm_mm make model flags is_constant num_bytes sha256 notes"
    )
    assert set(wanted.split()) <= set(document)
    assert document["start_s"] == pytest.approx(0.3, abs=1e-3) and document["pts_s"][0] == 0
    assert document["audio_start_s"] == pytest.approx(-0.2, abs=1e-3)
    assert document["audio_duration_s"] == pytest.approx(1.0, abs=1e-3)
    with (tmp_path / "cam03.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == list(range(30))
    assert [float(row["pts_s"]) for row in rows] == document["pts_s"]
    assert {row["flags"] for row in rows} == {""}


def test_missing_frames_and_pauses_are_flagged_and_named(tmp_path):
    ticks = [3000 * i for i in (*range(5), *range(7, 12))] + [3000 * i + 90000 for i in range(12, 15)]
    document = read_json(ingest(write_video(tmp_path / "a.mp4", ticks), tmp_path / "cam03.json"))
    assert document["flags"]["dropped_before"] == [5] and document["flags"]["pause_before"] == [10]
    assert "about 2 frames are missing at 1 places" in document["notes"]
    assert "the film pauses for 1.03 s before frame 10, at 0.37 s" in document["notes"]
    with (tmp_path / "cam03.csv").open(newline="") as file:
        words = {int(row["frame"]): row["flags"] for row in csv.DictReader(file) if row["flags"]}
    assert words == {5: "dropped_before", 10: "pause_before"}


def test_repeated_pictures_are_flagged_in_folders_too(tmp_path):
    rng = np.random.default_rng(0)
    for index in range(20):
        if index != 9:
            noise = rng.integers(0, 256, (32, 48, 3), dtype=np.uint8)
        write_png(tmp_path / "cam" / f"{index}.png", noise)
    document = read_json(ingest(tmp_path / "cam", tmp_path / "cam03.json"))
    assert document["flags"]["duplicate"] == [9]
    assert "1 of 20 frames repeat the picture before them" in document["notes"]
    unchecked = read_json(ingest(tmp_path / "cam", tmp_path / "b.json", verify=False))
    assert unchecked["flags"]["duplicate"] == []


def test_constant_picture_is_named(tmp_path):
    encode_video(tmp_path / "a.mp4", [picture(5)] * 10, 30)
    document = read_json(ingest(tmp_path / "a.mp4", tmp_path / "cam03.json"))
    assert document["is_constant"] and "the picture never changes" in document["notes"][0]
    assert not read_json(ingest(film(tmp_path / "b.mp4", 10), tmp_path / "b.json"))["is_constant"]


def test_single_image_or_frame_is_valid_and_named(tmp_path):
    write_png(tmp_path / "still.png", picture(3))
    for source in (tmp_path / "still.png", film(tmp_path / "one.mp4", 1)):
        document = read_json(ingest(source, tmp_path / "cam03.json"))
        assert document["num_source_frames"] == 1 and not document["is_constant"]
        assert "a single frame" in document["notes"][0]
        with open_source(tmp_path / "cam03.json") as reader:
            assert reader.read(0).shape == (32, 48, 3)
            with pytest.raises(InputError, match=r"a frame of .* in 0\.\.0, got 1"):
                reader.read(1)


def test_slow_motion_that_hides_its_rate_is_named(tmp_path):
    metadata = {"com.android.capture.fps": "240.0"}
    source = write_video(tmp_path / "a.mp4", constant_ticks(10), metadata=metadata)
    [note] = read_json(ingest(source, tmp_path / "cam03.json"))["notes"]
    assert note.startswith(
        "slow motion: taken at 240 fps and stored to play at 30 fps, so its clock runs 8 times"
    )


def test_focal_length_make_and_model_are_read_from_images(tmp_path):
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Canon", "EOS R5"
    exif.get_ifd(0x8769)[0xA405] = 35
    for index in range(2):
        Image.fromarray(picture(index)).save(tmp_path / f"{index}.jpg", exif=exif)
    info = probe_source(tmp_path, 30).info
    assert (info.focal_35mm_mm, info.make, info.model) == (35.0, "Canon", "EOS R5")
    write_png(tmp_path / "plain" / "0.png", picture(0))
    info = probe_source(tmp_path / "plain", 30).info
    assert (info.focal_35mm_mm, info.make, info.model) == (None, None, None)


def test_square_pixels_may_be_left_to_the_calibration(tmp_path):
    source = write_video(tmp_path / "a.mp4", constant_ticks(3), pixel_aspect=Fraction(4, 3))
    for square_pixels, size in ((True, [85, 48]), (False, [64, 48])):
        path = ingest(source, tmp_path / "cam03.json", square_pixels=square_pixels)
        assert read_json(path)["size"] == size
        with open_source(path) as reader:
            assert reader.read(2).shape == (size[1], size[0], 3)


def test_reader_hands_out_copies(tmp_path):
    ingest(image_folder(tmp_path / "cam", range(5)), tmp_path / "cam03.json")
    with open_source(tmp_path / "cam03.json") as reader:
        reader.read(1)[:] = 0
        np.testing.assert_array_equal(reader.read(1), picture(1))


def test_same_source_gives_the_same_bytes_and_another_hash_after_a_change(tmp_path):
    folder = image_folder(tmp_path / "cam", range(5))
    first = ingest(folder, tmp_path / "a.json").read_bytes()
    assert ingest(folder, tmp_path / "b.json").read_bytes() == first
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
    write_png(folder / "000004.png", picture(9))
    assert read_json(ingest(folder, tmp_path / "c.json"))["sha256"] != json.loads(first)["sha256"]


def test_copies_of_one_film_have_one_hash(tmp_path):
    data = film(tmp_path / "a.mp4", 5).read_bytes()
    (tmp_path / "b.mp4").write_bytes(data)
    hashes = {read_json(ingest(tmp_path / n, tmp_path / "x.json"))["sha256"] for n in ("a.mp4", "b.mp4")}
    assert len(hashes) == 1


def test_missing_number_leaves_a_hole_in_time_and_numbers_may_rise_by_a_step(tmp_path):
    holed = read_json(ingest(image_folder(tmp_path / "a", [0, 1, 2, 4, 5, 6]), tmp_path / "a.json"))
    np.testing.assert_allclose(np.array(holed["pts_s"]) * 30, [0, 1, 2, 4, 5, 6])
    assert holed["flags"]["dropped_before"] == [3]
    stepped = read_json(ingest(image_folder(tmp_path / "b", range(0, 50, 10)), tmp_path / "b.json"))
    np.testing.assert_allclose(np.array(stepped["pts_s"]) * 30, np.arange(5))


def test_images_of_unequal_size_are_refused(tmp_path):
    folder = image_folder(tmp_path / "cam", range(5))
    write_png(folder / "000003.png", picture(3, (40, 32)))
    with pytest.raises(
        InputError, match=r"every image to be 48 x 32 like the first, .*000003\.png is 40 x 32"
    ):
        ingest(folder, tmp_path / "cam03.json")


@pytest.mark.parametrize("extension", [".png", ".jpg"])
def test_truncated_image_is_refused(tmp_path, extension):
    for index in range(5):
        noise = np.random.default_rng(index).integers(0, 255, (32, 48, 3), dtype=np.uint8)
        assert cv2.imwrite(str(tmp_path / f"{index}{extension}"), noise)
    ingest(tmp_path, tmp_path / "whole.json")
    data = (tmp_path / f"2{extension}").read_bytes()
    (tmp_path / f"2{extension}").write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(InputError, match=rf"2\{extension}"):
        ingest(tmp_path, tmp_path / "cut.json")


def test_damage_inside_a_film_stops_here_unless_not_verified(tmp_path):
    path = write_video(tmp_path / "film.mp4", constant_ticks(30), gop=10, size=(128, 96), options={"bf": "0"})
    with av.open(str(path)) as container:
        entry = container.streams.video[0].index_entries[14]
    data = bytearray(path.read_bytes())
    data[entry.pos + 4 : entry.pos + entry.size] = b"\xaa" * (entry.size - 4)
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"frame 14 at .*damaged, copy it again or cut the damaged part off"):
        ingest(path, tmp_path / "cam03.json")
    assert not (tmp_path / "cam03.json").exists() and not (tmp_path / "cam03.csv").exists()
    with open_source(ingest(path, tmp_path / "cam03.json", verify=False)) as reader:
        assert reader.read(20).shape == (96, 128, 3)


def test_folder_without_usable_names_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected images .* found none"):
        ingest(tmp_path, tmp_path / "cam03.json")
    write_png(tmp_path / "a1.png", picture(0))
    write_png(tmp_path / "b1.png", picture(0))
    with pytest.raises(InputError, match=r"one image per number .*a1\.png and b1\.png"):
        ingest(tmp_path, tmp_path / "cam03.json")
    (tmp_path / "b1.png").rename(tmp_path / "last.png")
    with pytest.raises(InputError, match=r"a number in the name of every image, got .*last\.png"):
        ingest(tmp_path, tmp_path / "cam03.json")


def test_bad_sources_end_with_one_sentence_and_status_2(tmp_path, capsys):
    whole = film(tmp_path / "whole.mp4", 8).read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.mp4").write_bytes(b"")
    (tmp_path / "text.mp4").write_text("no film")
    for name in ("cut.mp4", "empty.mp4", "text.mp4", "missing.mp4"):
        arguments = ["--camera", "cam03", "--source", str(tmp_path / name)]
        outputs = [
            "--output-json",
            str(tmp_path / "cam03.json"),
            "--output-table",
            str(tmp_path / "cam03.csv"),
        ]
        assert run_stage(main, [*arguments, *outputs]) == 2
        error = capsys.readouterr().err.strip().splitlines()[-1]
        assert error.startswith("error: ") and name in error
    assert not (tmp_path / "cam03.json").exists()


@pytest.mark.parametrize("fps", [None, 0, -30, float("nan"), float("inf")])
def test_images_need_a_rate(tmp_path, fps):
    folder = image_folder(tmp_path / "cam", range(5))
    with pytest.raises(InputError, match="expected fps above 0 for the images of .*cam"):
        ingest(folder, tmp_path / "cam03.json", fps=fps)


def test_replaced_or_missing_source_is_noticed(tmp_path):
    folder = image_folder(tmp_path / "cam", range(5))
    ingest(folder, tmp_path / "folder.json")
    video = film(tmp_path / "cam.mp4", 5)
    ingest(video, tmp_path / "video.json")
    film(video, 6)
    with pytest.raises(InputError, match=r"cam03: expected \d+ bytes .*replaced"):
        open_source(tmp_path / "video.json")
    (folder / "000002.png").unlink()
    with pytest.raises(InputError, match=r"expected the source .*000002\.png .*found nothing"):
        open_source(tmp_path / "folder.json")
    video.unlink()
    with pytest.raises(InputError, match=r"expected the source .*cam\.mp4 .*found nothing"):
        open_source(tmp_path / "video.json")


@pytest.mark.parametrize("text", ['{"camera": "cam03"}', '{"camera": "cam03", "size": 4}'])
def test_foreign_json_is_refused(tmp_path, text):
    (tmp_path / "cam03.json").write_text(text)
    with pytest.raises(InputError, match="expected the output of the stage ingest"):
        open_source(tmp_path / "cam03.json")
