"""Cameras of other programs' calibration files: round trips, and each format's own rule of projection."""

import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.export.cameras import (
    READERS,
    TOML_FLAVOURS,
    qualisys_text,
    write_easymocap,
    write_opencv,
    write_toml,
)
from fourd.export.formats import native_document, read_format
from fourd.geometry import look_at
from fourd.io import write_json
from fourd.sfm.importers import read_calibration

POINTS = np.array([[0.3, -0.2, 1.4], [-0.5, 0.4, 0.8], [0.1, 0.9, 1.0]])


def cameras(has_lens: bool = True) -> dict[str, Camera]:
    made = {}
    for i, azimuth in enumerate(np.radians([-30, 5, 40])):
        center = np.array([5 * np.cos(azimuth), 5 * np.sin(azimuth), 1.5 + 0.1 * i])
        R, t = look_at(center, np.array([0.0, 0, 1]), np.array([0.0, 0, 1]))
        K = np.array([[900.0 + i, 0, 633.3 + i], [0, 905.5, 361.7], [0, 0, 1]])
        lens = np.array([-0.11, 0.02, 1e-3, -2e-3, 0.0]) if has_lens else np.zeros(5)
        made[f"cam{i:02d}"] = Camera(K, R, t, (1280, 720), lens)
    return made


def write(folder: Path, name: str, given: dict[str, Camera]) -> Path:
    folder.mkdir(exist_ok=True)
    if name in TOML_FLAVOURS:
        write_toml(folder / "calibration.toml", given, name)
        return folder / "calibration.toml"
    if name == "qualisys":
        (folder / "a.qca.txt").write_text(qualisys_text(given))
        return folder / "a.qca.txt"
    if name == "opencv":
        write_opencv(folder, given)
    else:
        write_easymocap(folder, given, dict.fromkeys(given, (1.0, 9.0)))
    return folder


def assert_equal(a: Camera, b: Camera) -> None:
    assert a.size == b.size
    for key in ("K", "R", "t", "distortion"):
        np.testing.assert_allclose(getattr(a, key), getattr(b, key), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", READERS)
def test_what_is_written_is_read_back(tmp_path: Path, name: str) -> None:
    given = cameras()
    read = READERS[name](write(tmp_path, name, given))
    assert list(read) == list(given)
    for key, camera in given.items():
        assert_equal(read[key], camera)


@pytest.mark.parametrize("name", READERS)
def test_a_calibration_of_ours_is_made_of_every_format(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, name, cameras())
    write_json(tmp_path / "cameras.json", native_document(read_format(path, name)))
    imported = read_calibration(tmp_path / "cameras.json")
    for key, camera in cameras().items():
        assert_equal(imported.cameras[key][0], camera)


@pytest.mark.parametrize("name", TOML_FLAVOURS)
def test_convention_toml_projects_as_opencv_does(tmp_path: Path, name: str) -> None:
    """As Pose2Sim and anipose use the file: cv2.projectPoints with what it says."""
    document = tomllib.loads(write(tmp_path, name, cameras()).read_text())
    tables = (
        document["cameras"] if name == "caliscope" else {k: v for k, v in document.items() if k != "metadata"}
    )
    assert len(tables) == 3
    for (key, entry), camera in zip(tables.items(), cameras().values(), strict=True):
        pixels = cv2.projectPoints(
            POINTS,
            np.array(entry["rotation"]),
            np.array(entry["translation"]),
            np.array(entry["matrix"]),
            np.array(entry["distortions"]),
        )[0][:, 0]
        np.testing.assert_allclose(pixels, camera.project(POINTS)[0], atol=1e-8)
        if name == "caliscope":
            assert entry["cam_id"] == int(key)


def test_convention_qualisys_is_turned_half_around_x_in_millimetres(tmp_path: Path) -> None:
    """A point by the rule of Qualisys: axes right, up, backward as rows, centre in mm, pixels in 64 parts."""
    import xml.etree.ElementTree as ElementTree

    root = ElementTree.fromstring(write(tmp_path, "qualisys", cameras(False)).read_text())
    for tag, camera in zip(root.findall("cameras/camera"), cameras(False).values(), strict=True):
        pose, lens = tag.find("transform"), tag.find("intrinsic")
        axes = np.array([[float(pose.get(f"r{i}{j}")) for j in (1, 2, 3)] for i in (1, 2, 3)])
        center = np.array([float(pose.get(k)) for k in "xyz"])
        right, up, back = ((1000 * POINTS - center) @ axes.T).T
        u = (float(lens.get("centerPointU")) + float(lens.get("focalLengthU")) * right / -back) / 64
        v = (float(lens.get("centerPointV")) - float(lens.get("focalLengthV")) * up / -back) / 64
        np.testing.assert_allclose(np.stack([u, v], axis=-1), camera.project(POINTS)[0], atol=1e-9)
        assert (tag.find("fov_video").get("right"), tag.find("fov_video").get("bottom")) == ("1279", "719")


def test_qualisys_lenses_are_not_in_parts_of_pixels(tmp_path: Path) -> None:
    """Numbers of the kind that Qualisys writes for a camera of 1920 x 1088 px behind a mild barrel lens."""
    text = (
        '<calibration><cameras><camera serial="26580">'
        '<fov_video left="0" top="0" right="1919" bottom="1087"/>'
        '<transform x="0" y="0" z="3000" r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" '
        'r33="1"/><intrinsic focalLengthU="107872" focalLengthV="107880" centerPointU="60827" '
        'centerPointV="32684" skew="0" radialDistortion1="-0.0455" radialDistortion2="0.1396" '
        'radialDistortion3="0" tangentalDistortion1="0.0006" tangentalDistortion2="-0.0004"/>'
        "</camera></cameras></calibration>"
    )
    (tmp_path / "a.qca.txt").write_text(text)
    camera = READERS["qualisys"](tmp_path / "a.qca.txt")["26580"]
    assert camera.size == (1920, 1088)
    np.testing.assert_allclose(camera.distortion, [-0.0455, 0.1396, 0.0006, -0.0004, 0])
    np.testing.assert_allclose(camera.focal_px, 107872 / 64, rtol=1e-3)
    np.testing.assert_allclose(camera.center, [0, 0, 3], atol=1e-12)


def test_easymocap_is_read_by_opencv_and_sizes_may_be_missing(tmp_path: Path) -> None:
    folder = write(tmp_path, "easymocap", cameras())
    storage = cv2.FileStorage(str(folder / "extri.yml"), cv2.FILE_STORAGE_READ)
    np.testing.assert_allclose(storage.getNode("Rot_cam01").mat(), cameras()["cam01"].R)
    np.testing.assert_allclose(
        cv2.Rodrigues(storage.getNode("R_cam01").mat())[0], cameras()["cam01"].R, atol=1e-12
    )
    storage.release()
    text = (folder / "intri.yml").read_text()
    lines = [line for line in text.splitlines() if not line.startswith(("H_", "W_"))]
    (folder / "intri.yml").write_text("\n".join(lines) + "\n")
    assert READERS["easymocap"](folder)["cam00"].size == (round(2 * 633.3 + 1), round(2 * 361.7 + 1))


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("damage", ["cut", "empty", "words"])
def test_damaged_files_are_named(tmp_path: Path, name: str, damage: str) -> None:
    path = write(tmp_path, name, cameras())
    for file in [path] if path.is_file() else list(path.iterdir()):
        text = file.read_text()
        file.write_text({"cut": text[: len(text) // 2], "empty": "", "words": "no calibration\n"}[damage])
    with pytest.raises(InputError) as error:
        READERS[name](path)
    assert str(tmp_path) in str(error.value)


def test_a_lens_without_counterpart_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, "anipose", cameras())
    path.write_text(path.read_text().replace("fisheye = false", "fisheye = true"))
    with pytest.raises(InputError, match="fisheye"):
        READERS["anipose"](path)
    with pytest.raises(InputError, match="found nothing"):
        read_format(tmp_path / "nowhere", "opencv")
