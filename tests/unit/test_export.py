"""Datasets of other programs: read back by our importers, by public readers, by each format's own rule."""

import dataclasses
import importlib.util
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from fourd.camera import CameraTrack
from fourd.cli import run_stage
from fourd.errors import InputError
from fourd.export import EVENT_FORMATS, FILM_FORMATS, READ_FORMATS, ExportOptions, chosen_formats
from fourd.export.__main__ import main
from fourd.export.cameras import READERS as STATIC_READERS
from fourd.export.datasets import depth_bounds
from fourd.export.depth import agree, inverse_depth_of_pair
from fourd.export.event import Event, held_pinhole, held_residual_px, own_pinhole
from fourd.export.formats import WRITERS, read_format, write_format
from fourd.export.pictures import warp_by_depth
from fourd.export.points import read_ply, write_ply
from fourd.fuse.geometry import PairFrame
from fourd.io import read_image, read_json
from fourd.sfm.importers import READERS as TRACK_READERS
from fourd.sfm.importers import read_calibration
from fourd.video import probe_video
from tests.unit.export_event import (
    NUM_FRAMES,
    ORIGIN,
    POINTS,
    SCALE,
    SIZE,
    colour_of,
    make_event,
    make_scene,
    plane_depth,
    source_camera,
)

SOURCE_POINTS = POINTS * SCALE + ORIGIN


@pytest.fixture(scope="module")
def event(tmp_path_factory: pytest.TempPathFactory) -> Event:
    return make_event(tmp_path_factory.mktemp("event"))


@pytest.fixture(scope="module")
def written(event: Event, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with every format of the event."""
    folder = tmp_path_factory.mktemp("formats")
    for name in WRITERS:
        (folder / name).mkdir()
        write_format(event, name, folder / name)
    return folder


def pixels_of(event: Event, name: str, frame: int) -> np.ndarray:
    return own_pinhole(event.scene, name, frame, None).project(POINTS)[0]


def test_formats_have_names_and_all_are_written(written: Path) -> None:
    assert tuple(WRITERS) == EVENT_FORMATS
    assert {*TRACK_READERS, *STATIC_READERS, "easyvolcap", "n3dv", "dynamic3dg"} == {*READ_FORMATS}
    assert {*EVENT_FORMATS, "png16"} <= {*chosen_formats("all")} <= {*EVENT_FORMATS, *FILM_FORMATS}
    assert ("exr" in chosen_formats("all")) == (importlib.util.find_spec("OpenImageIO") is not None)
    assert chosen_formats("ply, glb") == ("ply", "glb")
    with pytest.raises(InputError, match="'plx', expected all, or some of colmap"):
        chosen_formats("plx")
    for name in WRITERS:
        facts = read_json(written / name / "export.json")
        assert facts["format"] == name and facts["cameras"]["cam01"]["role"] == "heldout"


def test_colmap_reopened_by_pycolmap_reprojects_alike(event: Event, written: Path) -> None:
    import pycolmap

    for folder in ("sparse/0", "sparse/text"):
        model = pycolmap.Reconstruction(str(written / "colmap" / folder))
        assert (model.num_images(), model.num_cameras()) == (9, 3)
        for image in model.images.values():
            name, frame = image.name.split("/")[0], int(Path(image.name).stem)
            pixels = np.stack([image.project_point(point) for point in SOURCE_POINTS])
            difference = pixels - 0.5 - pixels_of(event, name, frame)
            assert np.abs(difference).max() < 1e-6
            assert (written / "colmap" / "images" / image.name).is_file()
        xyz = np.stack([point.xyz for point in model.points3D.values()])
        rgb = np.stack([point.color for point in model.points3D.values()])
        assert np.abs(xyz[:, 2] - ORIGIN[2]).max() < 1e-3 * SCALE
        assert np.abs(rgb.astype(int) - colour_of((xyz - ORIGIN) / SCALE)).max() <= 2


def test_colmap_masks_leave_out_what_moves_and_what_is_blank(written: Path) -> None:
    mask = read_image(written / "colmap" / "masks" / "cam00" / "000001.png.png")[..., 0]
    assert set(np.unique(mask)) == {0, 255}
    assert (mask[10:20, 5:25] == 0).all() and (mask[:, 0] == 0).all() and mask[30, 30] == 255


@pytest.mark.parametrize("name", ["colmap", "nerfstudio", "dynamic3dg"])
def test_moving_cameras_come_back_frame_by_frame(event: Event, written: Path, name: str) -> None:
    read = read_format(written / name / ("transforms.json" if name == "nerfstudio" else ""), name)
    expected = event.scene.inputs if name == "dynamic3dg" else tuple(event.scene.tracks)
    assert set(read) == set(expected)
    for camera, poses in read.items():
        assert len(poses) == NUM_FRAMES
        for frame, pose in enumerate(poses):
            truth = source_camera(event.scene, camera, frame)
            np.testing.assert_allclose(pose.K, truth.K, atol=1e-9)
            np.testing.assert_allclose(pose.R, truth.R, atol=1e-9)
            np.testing.assert_allclose(pose.center, truth.center, atol=1e-9)


@pytest.mark.parametrize(
    "name", ["n3dv", "easyvolcap", "pose2sim", "anipose", "caliscope", "qualisys", "opencv"]
)
def test_held_cameras_come_back(event: Event, written: Path, name: str) -> None:
    file = {"pose2sim": "Calib.toml", "anipose": "calibration.toml", "caliscope": "camera_array.toml"}
    path = written / name / file.get(name, "event.qca.txt" if name == "qualisys" else "")
    read = read_format(path, name)
    assert sorted(read) == ["cam00", "cam01", "cam02"]
    for camera, (pose,) in read.items():
        held = event.held(camera)
        np.testing.assert_allclose(pose.project(SOURCE_POINTS)[0], held.project(SOURCE_POINTS)[0], atol=1e-6)
        assert pose.size == SIZE and not pose.is_distorted


def test_convention_nerfstudio_transforms_are_opengl(event: Event, written: Path) -> None:
    """Pixel (u, v) is seen along ((u + 0.5 - cx) / fl_x, -(v + 0.5 - cy) / fl_y, -1)."""
    document = read_json(written / "nerfstudio" / "transforms.json")
    assert len(document["frames"]) == 9
    for entry in document["frames"]:
        matrix = np.array(entry["transform_matrix"])
        right, up, back = ((SOURCE_POINTS - matrix[:3, 3]) @ matrix[:3, :3]).T
        u = entry["cx"] + entry["fl_x"] * right / -back - 0.5
        v = entry["cy"] - entry["fl_y"] * up / -back - 0.5
        expected = pixels_of(event, entry["camera"], entry["frame"])
        np.testing.assert_allclose(np.stack([u, v], axis=-1), expected, atol=1e-9)
        assert entry["time"] == entry["frame"] / (NUM_FRAMES - 1)


def test_nerfstudio_depths_masks_and_points(event: Event, written: Path) -> None:
    folder = written / "nerfstudio"
    document = read_json(folder / "transforms.json")
    assert len({entry["depth_file_path"] for entry in document["frames"]}) == 7
    for entry in document["frames"]:
        depth = cv2.imread(str(folder / entry["depth_file_path"]), cv2.IMREAD_ANYDEPTH)
        assert depth.dtype == np.uint16 and depth.shape == SIZE[::-1]
        if entry["camera"] == "cam01":
            assert not depth.any()
            continue
        truth = plane_depth(own_pinhole(event.scene, entry["camera"], entry["frame"], None)) * SCALE
        lengths = depth * document["depth_unit_scale_factor"]
        assert (depth[:4] == 0).all()
        np.testing.assert_allclose(lengths[4:], truth[4:], atol=0.51 * document["depth_unit_scale_factor"])
        assert read_image(folder / entry["mask_path"])[5, :2, 0].tolist() == [0, 255]
        assert read_image(folder / entry["dynamic_mask_path"])[15, 10, 0] == 255
    assert document["test_filenames"] == [f"images/cam01/{frame:06d}.png" for frame in range(NUM_FRAMES)]
    assert len(read_ply(folder / document["ply_file_path"])) > 1000


def test_n3dv_is_read_by_the_importer_and_holds_films(event: Event, written: Path) -> None:
    imported = read_calibration(written / "n3dv")
    assert sorted(imported.cameras) == ["cam00", "cam01", "cam02"]
    near, far = imported.bounds["cam00"].near, imported.bounds["cam00"].far
    assert (near, far) == pytest.approx(depth_bounds(event, "cam00"))
    assert (
        near == pytest.approx(0.6 * SCALE)
        and far > plane_depth(own_pinhole(event.scene, "cam00", 0, None)).max()
    )
    for name in event.names:
        info = probe_video(written / "n3dv" / f"{name}.mp4")
        assert (info.size, len(info.pts_s)) == (SIZE, NUM_FRAMES)
        assert (written / "videos" / f"{name}.mp4").is_file()
        assert (written / "easyvolcap" / "videos" / f"{name}.mp4").is_file()


def test_dynamic3dg_files_are_as_its_loader_wants_them(event: Event, written: Path) -> None:
    folder = written / "dynamic3dg"
    meta = json.loads((folder / "train_meta.json").read_text())
    assert np.array(meta["k"]).shape == (NUM_FRAMES, 2, 3, 3) and np.array(meta["w2c"]).shape == (
        NUM_FRAMES,
        2,
        4,
        4,
    )
    for names in meta["fn"]:
        for name in names:
            assert (folder / "ims" / name).is_file()
            seg = cv2.imread(str(folder / "seg" / name), cv2.IMREAD_GRAYSCALE)
            assert set(np.unique(seg)) == {0, 1} and seg[15, 10] == 1
    points = np.load(folder / "init_pt_cld.npz")["data"]
    assert points.shape[1] == 7 and points[:, 3:6].min() >= 0 and points[:, 3:6].max() <= 1
    assert set(np.unique(points[:, 6])) == {0, 1}
    assert json.loads((folder / "test_meta.json").read_text())["cam_id"] == [[2]] * NUM_FRAMES


def test_point_clouds_are_read_by_public_readers(event: Event, written: Path) -> None:
    path = written / "ply" / "000001.ply"
    table = read_ply(path)
    assert np.abs(table["z"] - ORIGIN[2]).max() < 1e-3 * SCALE
    assert set(np.unique(table["camera"])) == {0, 1} and 0 < table["moves"].mean() < 0.3
    plyfile = pytest.importorskip("plyfile", reason="the extra dev has it")
    vertices = plyfile.PlyData.read(str(path))["vertex"]
    for name in table.dtype.names:
        assert np.array_equal(np.asarray(vertices[name]), table[name])
    trimesh = pytest.importorskip("trimesh", reason="the extra dev has it")
    cloud = trimesh.load(str(path))
    np.testing.assert_allclose(cloud.vertices, np.stack([table[k] for k in "xyz"], axis=-1))
    assert np.array_equal(
        np.asarray(cloud.colors)[:, :3], np.stack([table[k] for k in ("red", "green", "blue")], -1)
    )


def test_ply_round_trip_and_damage(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    xyz, rgb = rng.normal(size=(5, 3)) + 1e6, rng.integers(0, 256, (5, 3)).astype(np.uint8)
    write_ply(tmp_path / "a.ply", xyz, rgb)
    assert np.array_equal(np.stack([read_ply(tmp_path / "a.ply")[k] for k in "xyz"], axis=-1), xyz)
    data = (tmp_path / "a.ply").read_bytes()
    for content in (data[:-9], data[:40], b"", b"ply\nformat ascii 1.0\nend_header\n"):
        (tmp_path / "a.ply").write_bytes(content)
        with pytest.raises(InputError, match=r"a\.ply"):
            read_ply(tmp_path / "a.ply")


def test_cloud_is_thinned_evenly_and_scaled(tmp_path: Path) -> None:
    event = make_event(tmp_path, ExportOptions(scale=0.5, max_points=100))
    cloud = event.cloud(0, 100)
    assert len(cloud.xyz) == 100 and 40 <= (cloud.source == 0).sum() <= 60
    np.testing.assert_allclose(cloud.xyz[:, 2], 0.5 * ORIGIN[2], atol=1e-3)
    assert event.camera("cam00", 0).center == pytest.approx(
        0.5 * source_camera(event.scene, "cam00", 0).center
    )


def test_pictures_of_one_size_are_asked_for_where_needed(event: Event) -> None:
    scene = event.scene
    camera = scene.tracks["cam01"].at(0).resized((80, 60))
    tracks = {**scene.tracks, "cam01": CameraTrack("cam01", (camera,), 0.6)}
    mixed = dataclasses.replace(event, scene=dataclasses.replace(scene, tracks=tracks))
    with pytest.raises(InputError, match=r"n3dv: expected pictures of one size, got .*cam01 80 x 60"):
        mixed.common_size("n3dv")
    asked = dataclasses.replace(mixed, options=ExportOptions(size=(32, 24)))
    assert asked.common_size("n3dv") == (32, 24)


def test_held_film_is_exact_at_its_distance_and_bounded_at_the_nearest() -> None:
    scene = make_scene()
    held, track = held_pinhole(scene, "cam00", None), scene.tracks["cam00"]
    assert held.K[0, 0] == held.K[1, 1] and held.K[:2, 2].tolist() == [31.5, 23.5]
    pixels = np.array([[10.0, 12], [50, 40], [31, 20]])
    nearest = held.unproject(pixels, np.full(3, 0.6))
    shifts = []
    for camera in track.cameras:
        ideal = camera.without_distortion()
        away = nearest - held.center
        there = held.center + away * (1.2 / 0.6)
        # What the film shows at a pixel is the point at the held distance along its ray.
        shifts.append(np.linalg.norm(ideal.project(there)[0] - ideal.project(nearest)[0], axis=1).max())
    assert 0 < max(shifts) <= 1.5 * held_residual_px(scene, "cam00", None)
    steady = dataclasses.replace(
        scene, tracks={**scene.tracks, "cam00": CameraTrack("cam00", (track.at(0),), 0.6)}
    )
    assert held_residual_px(steady, "cam00", None) == 0


@pytest.mark.parametrize("has_lens", [True, False])
def test_warp_by_depth_shows_the_plane_where_it_is(has_lens: bool) -> None:
    scene = make_scene((320, 240))
    given = scene.tracks["cam00"].at(0)
    K = given.K * [[5], [5], [1]]
    camera = (
        dataclasses.replace(given, K=K) if has_lens else dataclasses.replace(given.without_distortion(), K=K)
    )
    target = dataclasses.replace(camera.without_distortion(), t=camera.t + [0.01, -0.02, 0.01])
    grid = np.stack(np.meshgrid(np.arange(320), np.arange(240)), axis=-1).astype(np.float64)

    def picture(of):
        world = of.unproject(grid, np.full((240, 320), 1.0))
        if of is camera:
            # The plane at depth 1 of the target, seen by the camera.
            rays = camera.rays(grid) @ camera.R
            normal = target.R[2]
            world = (
                camera.center
                + rays * ((1 - normal @ (camera.center - target.center)) / (rays @ normal))[..., None]
            )
        return (127 + 100 * np.sin(12 * world)).astype(np.uint8)

    warped = warp_by_depth(picture(camera), camera, target, 1.0)
    inner = np.s_[30:-30, 30:-30]
    assert np.abs(warped[inner].astype(int) - picture(target)[inner]).mean() < 1


def test_depth_of_a_pair_is_that_of_the_plane() -> None:
    scene = make_scene()
    left, right = (scene.tracks[name].at(0).without_distortion() for name in ("cam00", "cam02"))
    across = right.center - left.center
    baseline = float(np.linalg.norm(across))
    x = across / baseline
    z = left.forward - (left.forward @ x) * x
    z /= np.linalg.norm(z)
    R = np.stack([x, np.cross(z, x), z])
    K = np.array([[70.0, 0, 120], [0, 70, 80], [0, 0, 1]])
    maps = []
    for camera in (left, right):
        rectified = dataclasses.replace(camera, K=K, R=R, t=-R @ camera.center, size=(240, 160))
        depth = plane_depth(rectified)
        maps.append(np.where(depth > 0, 70 * baseline / depth, np.nan).astype(np.float32))
    sure = np.ones((160, 240), np.float32)
    per_px = 1 / (70 * baseline)
    pair = PairFrame(
        "cam00", "cam02", K, K, R, R, left.center, right.center, (0.0, 0.0), (per_px, per_px),
        *maps, sure, sure, 0.1,
    )  # fmt: skip
    for name, camera in (("cam00", left), ("cam02", right)):
        inverse, sigma = inverse_depth_of_pair(pair, name, camera)
        known = np.isfinite(inverse)
        assert known.mean() > 0.9 and np.isfinite(sigma[known]).all()
        np.testing.assert_allclose(1 / inverse[known], plane_depth(camera)[known], rtol=0.02)
        both = agree(np.stack([inverse, inverse]), np.stack([sigma, sigma]), 2)
        np.testing.assert_allclose(both[known], 1 / inverse[known], rtol=1e-5)
        assert (agree(np.stack([inverse, 2 * inverse]), np.stack([sigma, sigma]) * 0.01, 2) == 0).all()


def test_agreement_takes_the_larger_group() -> None:
    inverse = np.array([1.0, 1.01, 2.0, 2.01, 2.02, np.nan], np.float32)[:, None, None]
    depth = agree(inverse, np.full_like(inverse, 0.02), 2)
    assert depth[0, 0] == pytest.approx(1 / 2.01, rel=1e-5)


@pytest.mark.parametrize(
    ("flags", "message"),
    [(["--size", "10", "10"], "size is"), (["--size", "100"], "size is"), (["--scale", "0"], "scale is")],
)
def test_unusable_options_are_named(tmp_path: Path, flags: list[str], message: str, capsys) -> None:
    command = [
        "write",
        "--format",
        "ply",
        "--cameras",
        "x",
        "--pictures",
        "x",
        "--depth",
        "x",
        "--output",
        "y",
    ]
    assert run_stage(main, [*command, *flags]) == 2
    assert message in capsys.readouterr().err
