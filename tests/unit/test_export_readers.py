"""Exports read by the programs they are meant for, where these are installed: none is a dependency."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fourd.export.event import Event
from fourd.export.formats import last_number_first, write_format
from tests.unit.export_event import ORIGIN, POINTS, SCALE, make_event

SOURCE_POINTS = POINTS * SCALE + ORIGIN
# Programs that keep doubles must agree to rounding.
TOLERANCE_PX = 1e-6


@pytest.fixture(scope="module")
def event(tmp_path_factory: pytest.TempPathFactory) -> Event:
    return make_event(tmp_path_factory.mktemp("event"))


def program(name: str) -> Any:
    """A program's module; the test is skipped where it, or what it needs, is not installed."""
    return pytest.importorskip(name, reason=f"{name} is not installed", exc_type=ImportError)


def assert_projects_alike(event: Event, name: str, pixels: Any) -> None:
    expected = event.held(name).project(SOURCE_POINTS)[0]
    np.testing.assert_allclose(np.reshape(pixels, (-1, 2)), expected, atol=TOLERANCE_PX)


def project(K: Any, rotation: Any, t: Any, distortion: Any) -> np.ndarray:
    rotation, t, K, distortion = (np.asarray(value, np.float64) for value in (rotation, t, K, distortion))
    return cv2.projectPoints(SOURCE_POINTS, rotation, t, K, distortion)[0]


def test_cameras_stand_in_the_order_of_pose2sim(event: Event, tmp_path: Path) -> None:
    """It takes the n-th camera of the file for the n-th folder of poses, sorted by the last number."""
    names = ["cam10", "b", "cam2", "a", "7th_cam1"]
    assert sorted(names, key=last_number_first) == ["7th_cam1", "cam2", "cam10", "a", "b"]
    write_format(event, "pose2sim", tmp_path)
    lines = [line for line in (tmp_path / "Calib.toml").read_text().splitlines() if line.startswith("[")]
    assert event.names == ("cam00", "cam02", "cam01")
    assert lines == ["[cam00]", "[cam01]", "[cam02]", "[metadata]"]


def test_aniposelib_projects_alike(event: Event, tmp_path: Path) -> None:
    cameras = program("aniposelib.cameras")
    write_format(event, "anipose", tmp_path)
    group = cameras.CameraGroup.load(str(tmp_path / "calibration.toml"))
    assert group.get_names() == ["cam00", "cam01", "cam02"]
    for camera in group.cameras:
        assert_projects_alike(event, camera.get_name(), camera.project(SOURCE_POINTS))


def test_caliscope_projects_alike(event: Event, tmp_path: Path) -> None:
    arrays = program("caliscope.cameras.camera_array")
    write_format(event, "caliscope", tmp_path)
    read = arrays.CameraArray.from_toml(tmp_path / "camera_array.toml")
    assert list(read.posed_cameras) == [0, 1, 2]
    for number, camera in read.cameras.items():
        pixels = project(camera.matrix, camera.rotation, camera.translation, camera.distortions)
        assert_projects_alike(event, f"cam{number:02d}", pixels)


def test_pose2sim_projects_alike(event: Event, tmp_path: Path) -> None:
    common = program("Pose2Sim.common")
    write_format(event, "pose2sim", tmp_path)
    for number, matrix in enumerate(common.computeP(tmp_path / "Calib.toml")):
        pixels = [common.reprojection([matrix], np.append(point, 1)) for point in SOURCE_POINTS]
        assert_projects_alike(event, f"cam{number:02d}", pixels)


def test_pose2sim_converts_calibrations_of_qualisys_and_easymocap(event: Event, tmp_path: Path) -> None:
    calibration = program("Pose2Sim.calibration")
    for name in ("qualisys", "easyvolcap"):
        write_format(event, name, tmp_path)
    storages = [str(tmp_path / "extri.yml"), str(tmp_path / "intri.yml")]
    converted = [
        calibration.calib_qca_fun(str(tmp_path / "event.qca.txt")),
        calibration.calib_easymocap_fun(storages),
    ]
    assert converted[0][2][0] == [64, 48]
    for _, names, _, distortions, matrices, rotations, translations in converted:
        assert sorted(names) == sorted(event.names)
        for name, K, rotation, t, lens in zip(
            names, matrices, rotations, translations, distortions, strict=True
        ):
            assert_projects_alike(event, name, project(K, rotation, t, lens))


def test_nerfbaselines_reads_the_poses_of_llff(event: Event, tmp_path: Path) -> None:
    loader = program("nerfbaselines.datasets.llff")
    write_format(event, "n3dv", tmp_path)
    (tmp_path / "sparse").mkdir()
    for index in range(3):
        (tmp_path / "images_4").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "images_4" / f"{index}.png"), np.zeros((12, 16, 3), np.uint8))
    for split in ("train", "test"):
        read = loader.load_llff_dataset(tmp_path, split, None)
        cameras = read["cameras"]
        for i, path in enumerate(read["image_paths"]):
            pose = np.asarray(cameras.poses[i], dtype=np.float64)
            # Pictures a quarter as large, pixel centres at 0.5.
            fx, fy, cx, cy = 4 * np.asarray(cameras.intrinsics[i], dtype=np.float64)
            x, y, z = ((SOURCE_POINTS - pose[:3, 3]) @ pose[:3, :3]).T
            pixels = np.stack([fx * x / z + cx - 0.5, fy * y / z + cy - 0.5], axis=-1)
            assert_projects_alike(event, f"cam0{Path(path).stem}", pixels)
