import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from fourd.cli import run_stage
from fourd.errors import InputError
from fourd.ingest.__main__ import main as ingest_main
from fourd.io import Archive, write_png
from fourd.sfm import SfmOptions, read_cameras, write_cameras
from fourd.sfm.__main__ import main, parse_camera_names, parse_depth_range
from fourd.sfm.assemble import read_ingested, select_cameras, split_cameras
from fourd.sfm.importers import ImportedCameras, read_calibration
from fourd.sfm.normalize import CENTER_STEP
from tests.unit.sfm_rig import (
    POINTS,
    SIZE,
    make_rig,
    make_texture,
    moved_rig,
    render_planes,
    transform_world,
    wall_and_box,
    write_ingest,
    write_native,
)
from tests.unit.test_sfm_colmap import write_colmap

SCHEMA_PATH = Path(__file__).resolve().parents[2] / "config" / "schemas" / "sfm.schema.yaml"


def import_arguments(folder: Path, calibration: Path, names, heldout=(), num_frames=1, extra=()) -> list[str]:
    return [
        *["import", "--calibration", str(calibration), "--camera", *names, "--heldout", *heldout],
        *["--num-frames", str(num_frames), "--fps", "30", "--films"],
        *[str(folder / f"{name.partition('=')[0]}.json") for name in names],
        *["--output-cameras", str(folder / "sfm" / "cameras.json")],
        *["--output-points", str(folder / "sfm" / "points.npz"), *extra],
    ]


def import_native(folder: Path, tracks, heldout=(), num_frames=1, extra=(), names=None):
    names = list(names or tracks)
    for name in names:
        write_ingest(folder, name.partition("=")[0], num_frames=num_frames)
    main(
        import_arguments(
            folder, write_native(folder / "calib.json", tracks), names, heldout, num_frames, extra
        )
    )
    return read_cameras(folder / "sfm" / "cameras.json")


def still(cameras):
    return {name: (camera,) for name, camera in cameras.items()}


def test_options_and_schema_agree():
    schema = yaml.safe_load(SCHEMA_PATH.read_text())
    defaults = {key: entry["default"] for key, entry in schema["properties"].items()}
    assert defaults == dataclasses.asdict(SfmOptions())
    assert schema["additionalProperties"] is False
    assert all(len(entry["description"]) > 20 for entry in schema["properties"].values())


def project_from_exact_centre(scene, name, frame, source):
    """Pixels of POINTS in a camera of the scene, put back by the half step or less that its centre moved."""
    camera = scene.tracks[name].at(frame)
    center = (source.center - scene.origin) / scene.scale
    np.testing.assert_allclose(camera.center, center, atol=0.5001 * CENTER_STEP)
    exact = dataclasses.replace(camera, t=-camera.R @ center)
    return exact.project((POINTS - scene.origin) / scene.scale)[0]


def test_native_import_keeps_the_images(tmp_path):
    rig = moved_rig(3)
    scene = import_native(tmp_path, rig, ["cam02"], 3, ["--depth-range", "2", "none"])
    assert (scene.fps, scene.num_frames) == (30, 3)
    assert (scene.inputs, scene.heldout) == (("cam00", "cam01", "cam03"), ("cam02",))
    for name, track in rig.items():
        assert scene.tracks[name].near == pytest.approx(2 / scene.scale)
        assert scene.tracks[name].far == float("inf")
        assert scene.depth_range_from[name] == "given"
        for frame, camera in enumerate(track):
            pixels = project_from_exact_centre(scene, name, frame, camera)
            np.testing.assert_allclose(pixels, camera.project(POINTS)[0])
    assert Archive(tmp_path / "sfm" / "points.npz")["points"].shape == (0, 3)
    assert json.loads((tmp_path / "sfm" / "cameras.json").read_text())["cameras"]["cam00"]["far"] is None


def test_written_cameras_are_read_back(tmp_path):
    scene = import_native(tmp_path, moved_rig(2), ["cam00"], 2, ["--depth-range", "2", "70"])
    write_cameras(tmp_path / "again.json", scene)
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "sfm" / "cameras.json").read_bytes()
    (tmp_path / "again.json").write_text('{"schema_version": 1, "fps": 30}')
    with pytest.raises(InputError, match=r"expected cameras\.json of this workflow in .*again\.json"):
        read_cameras(tmp_path / "again.json")
    for change in (
        {"inputs": ["cam09"]},
        {"num_frames": 3},
        {"up": [0, 1]},
        {"left_out": 7},
        {"cameras": 7},
        {"cameras": {"cam00": 7}},
        {"cameras": {"cam00": {"size": [1], "frames": []}}},
        {"cameras": {"cam00": {"size": [64, 48], "near": 2, "far": 1, "frames": [{}]}}},
    ):
        write_cameras(tmp_path / "again.json", scene)
        document = json.loads((tmp_path / "again.json").read_text())
        (tmp_path / "again.json").write_text(json.dumps({**document, **change}))
        with pytest.raises(InputError, match=r"^expected .* in .*again\.json.* delete it and run again"):
            read_cameras(tmp_path / "again.json")
    (tmp_path / "again.json").write_text('{"schema_version": 99}')
    with pytest.raises(InputError, match="expected schema_version 1, got 99"):
        read_cameras(tmp_path / "again.json")


def test_heldout_cameras_do_not_move_the_world(tmp_path):
    rig = make_rig()
    far_away = dataclasses.replace(rig["cam03"], t=rig["cam03"].t + [5, 5, 50])
    extra = ["--depth-range", "2", "none"]
    before = import_native(tmp_path, still(rig), ["cam03"], extra=extra)
    after = import_native(tmp_path, still({**rig, "cam03": far_away}), ["cam03"], extra=extra)
    assert after.scale == before.scale
    np.testing.assert_array_equal(after.origin, before.origin)
    np.testing.assert_array_equal(after.up, before.up)


def test_names_in_the_file_and_stated_up(tmp_path):
    rig = make_rig(2)
    path = write_native(
        tmp_path / "calib.json", {"left eye": (rig["cam00"],), "cam01": (rig["cam01"],)}, up=[0, 0, 3]
    )
    for name in ("cam00", "cam01"):
        write_ingest(tmp_path, name)
    main(import_arguments(tmp_path, path, ["cam00=left eye", "cam01"], extra=["--depth-range", "1", "9"]))
    scene = read_cameras(tmp_path / "sfm" / "cameras.json")
    assert scene.inputs == ("cam00", "cam01")
    np.testing.assert_array_equal(scene.up, [0, 0, 1])


def test_identical_poses_of_a_list_become_one(tmp_path):
    camera, moving = make_rig()["cam00"], moved_rig(4)["cam01"]
    scene = import_native(tmp_path, {"a": (camera,) * 4, "b": moving}, (), 4, ["--depth-range", "2", "none"])
    assert scene.tracks["a"].is_static and not scene.tracks["b"].is_static


def test_smaller_copies_of_the_images_rescale_K(tmp_path):
    rig = make_rig(2)
    path = write_native(tmp_path / "calib.json", still(rig))
    half = (SIZE[0] // 2, SIZE[1] // 2)
    for name in rig:
        write_ingest(tmp_path, name, size=half)
    main(import_arguments(tmp_path, path, list(rig), extra=["--depth-range", "1", "9"]))
    scene = read_cameras(tmp_path / "sfm" / "cameras.json")
    pixels = project_from_exact_centre(scene, "cam00", 0, rig["cam00"])
    assert scene.tracks["cam00"].size == half
    np.testing.assert_allclose((pixels + 0.5) * 2 - 0.5, rig["cam00"].project(POINTS)[0])


def test_colmap_points_give_near_and_heldout_observations_do_not_count(tmp_path):
    rig = make_rig(4)
    model = write_colmap(tmp_path / "model", {f"{n}.png": c for n, c in rig.items()}, "PINHOLE", False)
    for name in rig:
        write_ingest(tmp_path, name)
    # Every fourth point was seen by cam00 and cam01 alone, so without cam00 one image is left of it.
    main(import_arguments(tmp_path, model, list(rig), ["cam00"], extra=["--min-points", "20"]))
    scene = read_cameras(tmp_path / "sfm" / "cameras.json")
    points = Archive(tmp_path / "sfm" / "points.npz")["points"]
    kept = POINTS[np.arange(len(POINTS)) % 4 != 0]
    np.testing.assert_allclose(points * scene.scale + scene.origin, kept, atol=1e-9)
    assert set(scene.depth_range_from.values()) == {"sparse points"}
    for name, track in scene.tracks.items():
        depth = rig[name].project(kept)[1].min() / scene.scale
        assert 0.5 * depth < track.near < depth


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("filmed")
    rig, texture = make_rig(3, spread_deg=24), make_texture()
    for name, camera in rig.items():
        write_png(folder / "frames" / name / "000000.png", render_planes(camera, wall_and_box(), texture))
        source, output = str(folder / "frames" / name), str(folder / f"{name}.json")
        flags = ["--camera", name, "--source", source, "--fps", "30", "--output-json", output]
        ingest_main([*flags, "--output-table", str(folder / f"{name}.csv")])
        film = {"camera": name, "status": "ok", "rate_ppm": 0.0, "source_frame": [0], "dt_s": [0.0]}
        ingest = json.loads((folder / f"{name}.json").read_text())
        (folder / f"{name}.json").write_text(json.dumps({"schema_version": 1, **film, "ingest": ingest}))
    return folder, rig


def test_near_comes_from_the_films_of_the_input_cameras(filmed):
    folder, rig = filmed
    path = write_native(folder / "calib.json", still(rig))
    # A held-out film that cannot be opened shows that nobody looks at it.
    (folder / "frames" / "cam02" / "000000.png").unlink()
    main(import_arguments(folder, path, list(rig), ["cam02"]))
    scene = read_cameras(folder / "sfm" / "cameras.json")
    assert set(scene.depth_range_from.values()) == {"sparse points"}
    for track in scene.tracks.values():
        # The board's depth is 3 from cameras 4 away, the wall's 6.
        assert 1.5 < track.near * scene.scale < 3
    once = (folder / "sfm" / "cameras.json").read_bytes(), (folder / "sfm" / "points.npz").read_bytes()
    main(import_arguments(folder, path, list(rig), ["cam02"]))
    assert once == (
        (folder / "sfm" / "cameras.json").read_bytes(),
        (folder / "sfm" / "points.npz").read_bytes(),
    )


def test_too_few_points_fall_back_to_geometry_and_say_so(filmed, caplog):
    folder, rig = filmed
    path = write_native(folder / "calib.json", still(rig))
    with caplog.at_level("WARNING"):
        main(import_arguments(folder, path, ["cam00", "cam01"], extra=["--min-points", "100000"]))
    scene = read_cameras(folder / "sfm" / "cameras.json")
    assert set(scene.depth_range_from.values()) == {"camera geometry"}
    assert "too few sparse points in cam00, cam01" in caplog.text


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_source_world_leaves_no_trace_in_the_cameras(tmp_path, scale):
    rig = moved_rig(2)
    shift = np.array([1e7, -2e6, 5e6]) * scale
    moved = {n: tuple(transform_world(c, scale, shift) for c in track) for n, track in rig.items()}
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    a = import_native(tmp_path / "a", rig, (), 2, ["--depth-range", "2", "50"])
    b = import_native(tmp_path / "b", moved, (), 2, ["--depth-range", str(2 * scale), str(50 * scale)])
    for name in rig:
        for frame in (0, 1):
            np.testing.assert_allclose(a.tracks[name].at(frame).t, b.tracks[name].at(frame).t, atol=1e-6)
        assert a.tracks[name].near == pytest.approx(b.tracks[name].near, rel=1e-6)


def pose_numbers(track, expected_track) -> list[int]:
    return [next(i for i, e in enumerate(expected_track) if e is camera) for camera in track]


@pytest.mark.parametrize(
    ("num_poses", "changes", "numbers", "expected"),
    [
        (6, {"num_source_frames": 6, "source_frame": [2, 3, 5]}, None, [2, 3, 5]),
        (3, {"num_source_frames": 6, "source_frame": [2, 3, 5]}, None, [0, 1, 2]),
        (4, {"num_source_frames": 6, "source_frame": [0, 1, 3]}, None, [0, 1, 3]),
        (3, {"num_source_frames": 3, "files": ["a_10.png", "a_12.png", "a_14.png"]}, (10, 12, 14), [0, 1, 2]),
        (3, {"num_source_frames": 4, "source_frame": [0, 1, 1]}, (1, 2, 3), [0, 1, 1]),
        (3, {"num_source_frames": 3}, (0, 1, 2), [0, 1, 2]),
    ],
)
def test_a_scene_frame_takes_the_pose_of_the_picture_it_shows(
    tmp_path, num_poses, changes, numbers, expected
):
    track = moved_rig(num_poses, num_cameras=2)["cam00"]
    image_numbers = {"cam00": numbers} if numbers else {}
    calibration = ImportedCameras(tmp_path, {"cam00": track}, image_numbers)
    ingested = read_ingested(write_ingest(tmp_path, "cam00", num_frames=3, **changes))
    selected = select_cameras([calibration], {"cam00": "cam00"}, ["cam00"], {"cam00": ingested}, 3)
    assert pose_numbers(selected.tracks["cam00"], track) == expected


@pytest.mark.parametrize("numbers", [(0, 1, 3, 4), (2, 3, 4, 5), None])
def test_a_frame_without_a_pose_is_refused(tmp_path, numbers):
    track = moved_rig(4, num_cameras=2)["cam00"]
    calibration = ImportedCameras(tmp_path, {"cam00": track}, {"cam00": numbers} if numbers else {})
    ingested = read_ingested(write_ingest(tmp_path, "cam00", num_frames=5))
    with pytest.raises(
        InputError, match="camera cam00: expected a pose for each of 5 frames, got 4 poses and none"
    ):
        select_cameras([calibration], {"cam00": "cam00"}, ["cam00"], {"cam00": ingested}, 5)


def fail(capsys, arguments) -> str:
    assert run_stage(main, arguments) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ") and "Traceback" not in message
    return message


def test_too_few_input_cameras_are_refused(tmp_path, capsys):
    rig = make_rig(2)
    path = write_native(tmp_path / "calib.json", still(rig))
    for name in rig:
        write_ingest(tmp_path, name)
    assert "at least 2 input cameras besides the 0 held out, got 1 (cam00)" in fail(
        capsys, import_arguments(tmp_path, path, ["cam00"])
    )
    assert "got 0" in fail(capsys, import_arguments(tmp_path, path, []))
    assert "got 0" in fail(capsys, import_arguments(tmp_path, path, list(rig), list(rig)))
    assert split_cameras(["a", "b", "c"], ["b"]) == ("a", "c")
    assert not (tmp_path / "sfm").exists()


@pytest.mark.parametrize(
    ("names", "heldout", "extra", "sentence"),
    [
        (["cam00", "cam01", "cam07"], [], [], "camera cam07: expected 'cam07' in "),
        (["cam00", "cam01", "cam07"], [], [], "found only cam00, cam01, cam02: set calibration_name"),
        (["cam00", "cam01", "cam02"], ["camX"], [], "scene's cameras (cam00, cam01, cam02), got camX"),
        (["cam00", "cam01", "cam02=cam01"], [], [], "cameras cam01 and cam02 are both 'cam01'"),
        (["cam00", "cam00"], [], [], "expected each camera once"),
        (["cam00", "cam01"], [], ["--depth-range", "3", "2"], "expected 0 < NEAR < FAR"),
        (["cam00", "cam01"], [], ["--depth-range", "inf", "none"], "expected 0 < NEAR < FAR"),
        (["cam00", "cam01"], [], ["--depth-range", "a", "2"], "expected 0 < NEAR < FAR"),
        (["cam00", "cam01"], [], ["--num-frames", "9"], "expected 9 scene frames, got 1"),
        (["cam00", "cam01"], [], ["--num-frames", "0"], "expected num_frames >= 1"),
        (
            ["cam00", "cam01"],
            [],
            ["--films"],
            "expected a file of align for every camera, got none for cam00, cam01",
        ),
    ],
)
def test_scenes_that_do_not_fit_are_refused(tmp_path, capsys, names, heldout, extra, sentence):
    path = write_native(tmp_path / "calib.json", still(make_rig(3)))
    for name in names:
        write_ingest(tmp_path, name.partition("=")[0])
    assert sentence in fail(capsys, import_arguments(tmp_path, path, names, heldout, extra=extra))


def test_a_name_in_two_files_is_refused(tmp_path, capsys):
    path = write_native(tmp_path / "calib.json", still(make_rig(2)))
    arguments = import_arguments(tmp_path, path, ["cam00", "cam01"])
    arguments.insert(3, str(write_native(tmp_path / "other.json", still(make_rig(2)))))
    for name in ("cam00", "cam01"):
        write_ingest(tmp_path, name)
    message = fail(capsys, arguments)
    assert "camera cam00: expected 'cam00' in one file" in message and "other.json" in message


def test_another_shape_of_frames_is_refused_with_both_sizes(tmp_path, capsys):
    path = write_native(tmp_path / "calib.json", still(make_rig(2)))
    for name in ("cam00", "cam01"):
        write_ingest(tmp_path, name, size=(240, 320))
    message = fail(capsys, import_arguments(tmp_path, path, ["cam00", "cam01"]))
    assert "calibrated at 320x240" in message and "are 240x320, another shape" in message


def test_cameras_that_cannot_be_used_are_refused_by_file_and_name(tmp_path, capsys):
    rig = make_rig(2)
    broken = dataclasses.replace(rig["cam01"], R=2 * rig["cam01"].R)
    path = write_native(tmp_path / "calib.json", still({**rig, "cam01": broken}))
    for name in rig:
        write_ingest(tmp_path, name)
    message = fail(capsys, import_arguments(tmp_path, path, list(rig)))
    assert "calib.json, camera cam01, frame 0: R must be a rotation" in message


def test_two_cameras_in_one_place_are_allowed(tmp_path):
    camera = make_rig(2)["cam00"]
    scene = import_native(tmp_path, {"a": (camera,), "b": (camera,)}, extra=["--depth-range", "1", "none"])
    assert scene.scale == 1.0
    np.testing.assert_allclose(scene.tracks["a"].at(0).center, 0, atol=1e-12)


def test_flags():
    assert parse_camera_names(["a=b=c.png", "d"]) == {"a": "b=c.png", "d": "d"}
    assert parse_depth_range(None) is None
    assert parse_depth_range(["0.5", "inf"]) == (0.5, float("inf"))


def test_a_file_that_is_no_ingest_file_is_refused(tmp_path):
    (tmp_path / "cam00.json").write_text('{"size": [1]}')
    with pytest.raises(InputError, match=r"expected status, source_frame .*cam00\.json"):
        read_ingested(tmp_path / "cam00.json")


def test_reading_cameras_loads_no_importer():
    code = "import sys, fourd.sfm; print([m for m in sys.modules if 'pycolmap' in m or 'importers' in m])"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


def test_our_own_cameras_are_a_calibration_too(tmp_path):
    scene = import_native(tmp_path, moved_rig(2), (), 2, ["--depth-range", "2", "50"])
    imported = read_calibration(tmp_path / "sfm" / "cameras.json")
    assert imported.bounds["cam00"].near == scene.tracks["cam00"].near
    np.testing.assert_allclose(imported.up, scene.up)
    for name, track in scene.tracks.items():
        np.testing.assert_array_equal(imported.cameras[name][1].t, track.at(1).t)
