import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.io import read_image
from fourd.sfm.importers import read_calibration
from fourd.sfm.importers.imported import assign_image_names
from fourd.sfm.sparse import detect_features, epipolar_error_px, match_descriptors
from tests.unit.sfm_rig import LENS, SIZE, as_tracks, assert_same_views, make_rig, moved_rig, write_native

SHARED_DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"


def opengl_frame(name: str, camera: Camera) -> dict:
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = camera.R.T @ np.diag([1, -1, -1])
    world_from_cam[:3, 3] = camera.center
    return {"file_path": name, "transform_matrix": world_from_cam.tolist()}


def nerfstudio_intrinsics(camera: Camera) -> dict:
    (fx, _, cx), (_, fy, cy), _ = camera.K
    k1, k2, p1, p2, k3 = camera.distortion.tolist()
    width, height = camera.size
    pinhole = {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "w": width, "h": height}
    return {**pinhole, "k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3}


def write_transforms(folder: Path, frames: list[dict], **shared) -> Path:
    path = folder / "transforms.json"
    path.write_text(json.dumps({"camera_model": "OPENCV", **shared, "frames": frames}))
    return path


def test_convention_nerfstudio_axes_are_opengl(tmp_path):
    # A camera at the origin with the identity matrix looks along -z and has +y up.
    frame = {"file_path": "images/cam00.png", "transform_matrix": np.eye(4).tolist()}
    path = write_transforms(tmp_path, [frame], fl_x=100, fl_y=100, cx=160, cy=120, w=320, h=240)
    camera = read_calibration(path).cameras["cam00"][0]
    pixel, depth = camera.project(np.array([1.0, 2.0, -10.0]))
    assert depth == pytest.approx(10)
    # The middle of the 320 px wide image is at 159.5.
    np.testing.assert_allclose(pixel, [159.5 + 10, 119.5 - 20])


def test_nerfstudio_round_trips_with_intrinsics_per_frame(tmp_path):
    cameras = make_rig(3, distortion=[-0.1, 0.02, 1e-3, -1e-3, 0.003])
    frames = [
        {**opengl_frame(f"./images/{n}.jpg", c), **nerfstudio_intrinsics(c)} for n, c in cameras.items()
    ]
    assert_same_views(read_calibration(write_transforms(tmp_path, frames)).cameras, as_tracks(cameras))


def test_nerfstudio_shared_intrinsics_folders_and_applied_transform(tmp_path):
    tracks = {
        n: tuple(dataclasses.replace(c, K=np.diag([300.0, 300, 1])) for c in t)
        for n, t in moved_rig(3).items()
    }
    shared = nerfstudio_intrinsics(tracks["cam00"][0])
    frames = [opengl_frame(f"{n}/frame_{i:05d}.png", c) for n, t in tracks.items() for i, c in enumerate(t)]
    path = write_transforms(tmp_path, frames, **shared, applied_transform=np.eye(4)[:3].tolist())
    imported = read_calibration(tmp_path)
    assert imported.path == path
    assert_same_views(imported.cameras, tracks)
    assert any("applied_transform" in note for note in imported.notes)


def test_nerfstudio_accepts_an_opening_angle(tmp_path):
    frame = opengl_frame("cam00.png", make_rig(2)["cam00"])
    path = write_transforms(tmp_path, [frame], camera_angle_x=2 * np.arctan(0.5), w=320, h=240)
    np.testing.assert_allclose(
        read_calibration(path).cameras["cam00"][0].K, [[320, 0, 159.5], [0, 320, 119.5], [0, 0, 1]]
    )


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            {"camera_model": "OPENCV_FISHEYE"},
            r"cam00\.png: expected a perspective camera model.*OPENCV_FISHEYE",
        ),
        ({"k4": 0.1}, r"cam00\.png: expected a perspective camera model.*k4"),
        ({"w": None}, r"cam00\.png: expected w, h, fl_x"),
        ({"transform_matrix": [[1, 0], [0, 1]]}, r"cam00\.png: expected w, h, fl_x"),
        ({"transform_matrix": 1.0}, r"cam00\.png: expected w, h, fl_x"),
        ({"w": float("inf")}, r"cam00\.png: expected w, h, fl_x"),
        ({"transform_matrix": (2 * np.eye(4)).tolist()}, r"cam00\.png: R must be a rotation"),
        ({"file_path": ""}, "expected a `file_path` of its own"),
    ],
)
def test_unusable_nerfstudio_frames_are_refused(tmp_path, change, sentence):
    camera = make_rig(2)["cam00"]
    frame = {**opengl_frame("cam00.png", camera), **nerfstudio_intrinsics(camera), **change}
    with pytest.raises(InputError, match=sentence):
        read_calibration(write_transforms(tmp_path, [frame]))


def write_llff(path: Path, cameras: list[Camera], bounds=(2.0, 50.0)) -> Path:
    rows = []
    for camera in cameras:
        right, down, forward = camera.R
        axes = np.stack([down, right, -forward, camera.center], axis=1)
        size = [camera.size[1], camera.size[0], camera.focal_px]
        rows.append([*np.column_stack([axes, size]).ravel(), *bounds])
    np.save(path, np.array(rows))
    return path


def centered(camera: Camera) -> Camera:
    K = np.array([[300.0, 0, (SIZE[0] - 1) / 2], [0, 300, (SIZE[1] - 1) / 2], [0, 0, 1]])
    return dataclasses.replace(camera, K=K)


def test_llff_round_trips_and_names_by_row(tmp_path):
    cameras = {name: centered(camera) for name, camera in make_rig(3).items()}
    imported = read_calibration(write_llff(tmp_path / "poses_bounds.npy", list(cameras.values())))
    assert_same_views(imported.cameras, as_tracks(cameras))
    bounds = imported.bounds["cam01"]
    assert (bounds.near, bounds.far, bounds.are_percentiles) == (2.0, 50.0, True)


def test_llff_names_by_the_files_beside_it(tmp_path):
    for name in ("cam07.mp4", "cam03.mp4"):
        (tmp_path / name).touch()
    cameras = [centered(camera) for camera in make_rig(2).values()]
    write_llff(tmp_path / "poses_bounds.npy", cameras)
    assert_same_views(read_calibration(tmp_path).cameras, {"cam03": (cameras[0],), "cam07": (cameras[1],)})


def test_llff_rounded_to_four_decimals_is_made_orthonormal(tmp_path):
    cameras = [centered(camera) for camera in make_rig(2).values()]
    path = write_llff(tmp_path / "poses_bounds.npy", cameras)
    np.save(path, np.load(path).round(4))
    imported = read_calibration(path).cameras
    np.testing.assert_allclose(imported["cam00"][0].R @ imported["cam00"][0].R.T, np.eye(3), atol=1e-12)
    assert_same_views(imported, {"cam00": (cameras[0],), "cam01": (cameras[1],)}, atol=0.1)


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        (np.zeros((4, 15)), r"expected numbers of shape \(N, 17\).*\(4, 15\)"),
        (np.zeros((4, 17), int), r"expected numbers of shape \(N, 17\).*int64"),
        (np.full((1, 17), np.nan), "camera cam00: expected finite numbers"),
        (
            np.array([[0, 1, 0, 0, 9, 1, 0, 0, 0, 9, 0, 0, -1, 0, 9, 5, 2.0]]),
            "expected depths 0 < near < far",
        ),
        (
            np.array([[0, 3, 0, 0, 9, 1, 0, 0, 0, 9, 0, 0, -1, 0, 9, 1, 2.0]]),
            "camera cam00: R must be a rotation",
        ),
    ],
)
def test_unusable_llff_tables_are_refused(tmp_path, table, sentence):
    np.save(tmp_path / "poses_bounds.npy", table)
    with pytest.raises(InputError, match=sentence):
        read_calibration(tmp_path / "poses_bounds.npy")


def test_native_round_trips(tmp_path):
    tracks = moved_rig(2, distortion=LENS)
    path = write_native(tmp_path / "calibration.json", tracks, up=[0, 0, 2])
    imported = read_calibration(path)
    assert_same_views(imported.cameras, tracks)
    np.testing.assert_array_equal(imported.up, [0, 0, 1])


def test_native_size_at_the_top_and_bounds(tmp_path):
    camera = make_rig(2)["cam00"]
    entry = {"frames": [{"frame": 0, "time_s": 0.0, **camera.to_dict()}], "near": 2, "far": None}
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({"width": 320, "height": 240, "cameras": {"a": entry, "b": camera.to_dict()}}))
    imported = read_calibration(path)
    assert_same_views(imported.cameras, {"a": (camera,), "b": (camera,)})
    assert (imported.bounds["a"].near, imported.bounds["a"].far) == (2.0, float("inf"))
    assert not imported.bounds["a"].are_percentiles and "b" not in imported.bounds


GOOD_FRAME = {"K": [[300, 0, 160], [0, 300, 120], [0, 0, 1]], "R": np.eye(3).tolist(), "t": [0, 0, 0]}


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"frames": [GOOD_FRAME]}, r"camera left: expected `size` \[width, height\]"),
        ({"size": [320, "x"], "frames": [GOOD_FRAME]}, "camera left: expected `size`"),
        ({"size": [320, 240], "frames": []}, "camera left: expected a list of frames"),
        (
            {"size": [320, 240], "frames": [{**GOOD_FRAME, "frame": i} for i in (2, 2)]},
            "expected rising frame numbers from 0, got 2, 2",
        ),
        (
            {"size": [320, 240], "frames": [{**GOOD_FRAME, "t": [0, 0, float("nan")]}]},
            "left, frame 0: K, R, t must be finite",
        ),
        (
            {"size": [320, 240], "frames": [{**GOOD_FRAME, "K": np.zeros((3, 3)).tolist()}]},
            "positive focal lengths",
        ),
        (
            {"size": [320, 240], "frames": [{**GOOD_FRAME, "R": np.ones((3, 3)).tolist()}]},
            "R must be a rotation",
        ),
        ({"size": [320, 240], "frames": [GOOD_FRAME], "near": 3, "far": 2}, "0 < near < far"),
    ],
)
def test_unusable_native_cameras_are_refused(tmp_path, entry, sentence):
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({"cameras": {"left": entry}}))
    with pytest.raises(InputError, match=sentence) as caught:
        read_calibration(path)
    assert "calibration.json" in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{}", b"[1, 2]", b"\xff\xd8\xff\xe0 picture", b"left 1 2 3"])
def test_unknown_formats_are_refused_with_the_known_ones(tmp_path, content):
    path = tmp_path / "calibration"
    path.write_bytes(content)
    with pytest.raises(
        InputError, match=r"format of this calibration is not known.*colmap.*nerfstudio.*llff"
    ):
        read_calibration(path)


def test_missing_and_empty_calibrations_are_refused(tmp_path):
    with pytest.raises(InputError, match="found nothing"):
        read_calibration(tmp_path / "nowhere.json")
    with pytest.raises(InputError, match="expected a calibration in folder"):
        read_calibration(tmp_path)
    with pytest.raises(InputError, match="expected a file in format llff"):
        read_calibration(tmp_path, "llff")
    (tmp_path / "short.npy").write_bytes(b"\x93NUMPY")
    with pytest.raises(InputError, match="expected a numpy array"):
        read_calibration(tmp_path / "short.npy")


def test_image_names_become_cameras_and_frames():
    one_folder = assign_image_names(["images/000.png", "images/001.png"], "file")
    assert one_folder == {"images/000.png": ("000", 0), "images/001.png": ("001", 0)}
    many = assign_image_names(["a/000012.png", "b\\frame_7.jpg", "still.png", "c/odd.png"], "file")
    assert many == {
        "a/000012.png": ("a", 12),
        "b\\frame_7.jpg": ("b", 7),
        "still.png": ("still", 0),
        "c/odd.png": ("odd", 0),
    }
    with pytest.raises(InputError, match=r"file: expected one image per camera and frame.*for camera x"):
        assign_image_names(["a/x.png", "b/x.png"], "file")


def test_real_poses_bounds_obey_epipolar_geometry():
    folder = SHARED_DATA / "balloon1_nvidia" / "Balloon1"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not here")
    imported = read_calibration(folder)
    cameras = {name: track[0] for name, track in imported.cameras.items()}
    features = {
        n: detect_features(read_image(folder / "images" / f"{n}.png"), 2000) for n in ("000", "001", "002")
    }
    for left, right in (("000", "001"), ("001", "002")):
        matches = match_descriptors(features[left][1], features[right][1], 0.8)
        pixels = (features[left][0][matches[:, 0]], features[right][0][matches[:, 1]])
        error = epipolar_error_px(cameras[left], cameras[right], *pixels)
        assert len(error) > 200
        assert np.median(error) < 0.5
