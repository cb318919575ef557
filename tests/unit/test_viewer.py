"""The page's parts: what is rendered for it, how it is packed, what it says."""

import base64
import dataclasses
import io
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from fourd.errors import InputError
from fourd.geometry import look_at
from fourd.provenance import CONTINUED, HULL, NOTHING, STATIC
from fourd.viewer import ViewerOptions
from fourd.viewer.__main__ import main
from fourd.viewer.lattice import bytes_of, choose_lattice, fit_width
from fourd.viewer.manifest import describe_scene, find_outside, thin_points
from fourd.viewer.maps import FIRST_CAMERA, ORIGINS, map_origins, write_maps
from fourd.viewer.pack import RUN_LENGTH, encode_map, encode_within, pack_runs
from fourd.viewer.page import ASSETS, SHELL, draw_page, find_nearest
from tests.conftest import REPOSITORY
from tests.unit import viewer_scene
from tests.unit.report_scene import picture

SOURCE = REPOSITORY / "viewer"


@given(
    st.sampled_from([(480, 270), (1080, 1920), (1920, 1080), (97, 53)]),
    st.integers(1, 2000),
    st.integers(2, 40),
    st.integers(0, 3),
    st.sampled_from([20.0, 80.0]),
)
@settings(max_examples=80, deadline=None)
def test_lattice_fits_into_its_bytes(
    size: tuple[int, int], num_frames: int, num_inputs: int, num_heldout: int, max_mb: float
) -> None:
    options = ViewerOptions(max_mb=max_mb)
    lattice = choose_lattice(size, num_frames, num_inputs, num_inputs + num_heldout, options)
    assert lattice.forecast_mb <= max_mb
    assert len(lattice.views) >= 3
    positions = [spec["position"] for spec in lattice.views.values()]
    assert (positions[0], positions[-1]) == (0, 1)
    assert positions == sorted(set(positions))
    assert len(lattice.frames) == len(set(lattice.frames)) <= num_frames
    assert lattice.frames == tuple(sorted(lattice.frames))
    assert lattice.size[0] <= 640


def test_lattice_of_the_demo_shows_every_frame() -> None:
    lattice = choose_lattice((480, 270), 30, 7, 9, ViewerOptions())
    assert lattice.frames == tuple(range(30))
    assert lattice.size == (480, 270)
    assert len(lattice.views) > 2 * 6


def test_views_go_before_moments_and_size_before_those() -> None:
    roomy, tight = (choose_lattice((480, 270), 30, 7, 9, ViewerOptions(max_mb=mb)) for mb in (60, 12))
    assert len(roomy.views) == 19 > len(tight.views)
    assert roomy.frames == tight.frames
    long = choose_lattice((1920, 1080), 900, 15, 15, ViewerOptions())
    assert long.size[0] < 640 and len(long.frames) >= 48
    fixed = choose_lattice((480, 270), 30, 7, 9, ViewerOptions(num_views=40))
    assert len(fixed.views) == 40


@pytest.mark.parametrize("num_frames", [900, 9000])
@pytest.mark.parametrize(("max_mb", "width", "num_moments"), [(20, 320, 72), (100, 640, 91), (200, 640, 182)])
def test_a_long_clip_costs_no_more_than_it_may(
    num_frames: int, max_mb: float, width: int, num_moments: int
) -> None:
    """Fifteen cameras: however long the clip is, views go down to two for three cameras, then sizes."""
    lattice = choose_lattice((1920, 1080), num_frames, 15, 15, ViewerOptions(max_mb=max_mb))
    assert (len(lattice.views), lattice.size[0], len(lattice.frames)) == (10, width, num_moments)
    assert 0.97 * max_mb < lattice.forecast_mb <= max_mb
    # Evenly through the whole clip.
    gaps = np.diff(lattice.frames)
    assert gaps.max() - gaps.min() <= 1 and lattice.frames[-1] >= num_frames - gaps.max()


def test_too_few_bytes_are_refused_with_what_would_do() -> None:
    with pytest.raises(InputError, match=r"set max_mb to (\d+) or more") as refusal:
        choose_lattice((1920, 1080), 900, 30, 30, ViewerOptions(max_mb=1))
    enough = float(str(refusal.value).split("set max_mb to ")[1].split()[0])
    assert choose_lattice((1920, 1080), 900, 30, 30, ViewerOptions(max_mb=enough)).forecast_mb <= enough


def test_width_keeps_the_aspect() -> None:
    assert fit_width((1920, 1080), 640) == (640, 360)
    assert fit_width((480, 270), 640) == (480, 270)
    assert bytes_of((200, 100), 4)[0] == pytest.approx(2 * bytes_of((100, 100), 4)[0])


def estimates() -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Six columns: nothing, background, filled background, hull, two cameras; three px each."""
    shape = (3, 18)
    column = np.repeat(np.arange(6), 3)[None].repeat(3, axis=0)
    foreground = {
        "consensus_valid": column >= 3,
        "depth": np.where(column >= 3, 2.0, np.nan).astype(np.float32),
        "source": np.select([column == 4, column == 5, column == 3], [0, 6, 2], 255).astype(np.uint8),
        "depth_source": np.where(column == 3, 2, np.where(column > 3, 1, 0)).astype(np.uint8),
    }
    background = {
        "farthest_valid": column >= 1,
        "depth": np.where(column == 1, 4.0, np.where(column == 2, np.inf, np.nan)).astype(np.float32),
        "filled": column == 2,
    }
    assert foreground["depth"].shape == shape
    return foreground, background


def test_origins_and_depths_of_every_kind() -> None:
    inverse_depth, origin = map_origins(*estimates())
    numbers = [ORIGINS[kind] for kind in (NOTHING, STATIC, CONTINUED, HULL)]
    assert origin.tolist() == [[*numbers, FIRST_CAMERA, FIRST_CAMERA + 6]]
    np.testing.assert_allclose(inverse_depth, [[0, 0.25, 0, 0.5, 0.5, 0.5]])


def test_maps_of_two_views_do_not_mix(tmp_path: Path) -> None:
    from fourd.io import Archive, ArchiveWriter

    foreground, background = estimates()
    for name, arrays, view in (("fg", foreground, "a"), ("bg", background, "a"), ("other", background, "b")):
        with ArchiveWriter(tmp_path / f"{name}.npz", {"view": view, "cameras": ["cam00"]}) as writer:
            writer.add_frame(0, **arrays)
    words = ["maps", "--foreground", str(tmp_path / "fg.npz")]
    main([*words, "--background", str(tmp_path / "bg.npz"), "--output", str(tmp_path / "map.npz")])
    assert Archive(tmp_path / "map.npz").frames() == [0]
    with pytest.raises(InputError, match="expected one view, got a in"):
        write_maps(tmp_path / "fg.npz", tmp_path / "other.npz", tmp_path / "no.npz")


def decoded(text: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(text))).convert("RGB"))


def test_maps_come_back_to_the_bit_and_depth_to_half_a_step() -> None:
    rng = np.random.default_rng(0)
    inverse_depth = rng.uniform(0, 1.4, (36, 64)).astype(np.float32)
    origin = rng.integers(0, 12, (36, 64)).astype(np.uint8)
    data = encode_map(inverse_depth, origin, 1.2)
    read = decoded(base64.b64encode(data).decode())
    np.testing.assert_array_equal(read[..., 1], origin)
    np.testing.assert_allclose(
        read[..., 0] / 255 * 1.2, np.minimum(inverse_depth, 1.2), atol=1.2 / 510 + 1e-6
    )
    assert encode_map(inverse_depth, origin, 1.2) == data


def test_scripts_hold_all_pictures_in_runs() -> None:
    pictures = [bytes([i % 256]) * 5 for i in range(2 * RUN_LENGTH + 1)]
    files = pack_runs("view", "lattice-00", pictures)
    assert sorted(files) == [f"view-lattice-00-{i}.js" for i in range(3)]
    found = []
    for i in range(3):
        key, words = json.loads(
            "[" + files[f"view-lattice-00-{i}.js"].split("(", 1)[1].rsplit(")", 1)[0] + "]"
        )
        assert key == ["view", "lattice-00", i * RUN_LENGTH]
        found += [base64.b64decode(word) for word in words]
    assert found == pictures


def test_quality_gives_way_to_bytes() -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (64, 64, 3)).astype(np.uint8)
    read = {"view/a": lambda moment: noise, "camera/b": lambda moment: noise[::2, ::2]}
    wide, best = encode_within(read, 3, 80, 1e9)
    total = sum(len(data) for pictures in wide.values() for data in pictures)
    fitting, lower = encode_within(read, 3, 80, 0.7 * total)
    assert (best, lower < 80) == (80, True)
    assert sum(len(data) for pictures in fitting.values() for data in pictures) <= 0.7 * total
    assert [len(pictures) for pictures in fitting.values()] == [3, 3]
    with pytest.raises(InputError, match="raise max_mb"):
        encode_within(read, 3, 80, 100)


def test_manifest_places_points_where_the_cameras_do() -> None:
    scene = viewer_scene.make_scene()
    views = viewer_scene.lattice_views(scene)
    manifest = describe_scene("event", scene, views, ["cam00", "cam02"], 0.5, np.zeros((9, 3)), 640)
    assert manifest["frames"] == list(viewer_scene.FRAMES)
    point = np.array([0.3, -0.4, 0.2])
    for view, entry in zip(views, manifest["views"], strict=True):
        fx, fy, cx, cy = entry["intrinsics"]
        x, y, z = np.reshape(entry["R"], (3, 3)) @ point + entry["t"]
        expected, _ = view.frames[0].camera.project(point)
        np.testing.assert_allclose([fx * x / z + cx, fy * y / z + cy], expected, atol=0.01)
    assert manifest["way"][::8] == [
        {key: entry[key] for key in ("intrinsics", "R", "t")} for entry in manifest["views"]
    ]
    cameras = {camera["name"]: camera for camera in manifest["cameras"]}
    assert [cameras[name]["is_heldout"] for name in viewer_scene.NAMES] == [False, True, False]
    assert cameras["cam00"]["picture"] == [128, 72]


def test_places_that_no_camera_can_know_are_named() -> None:
    scene = viewer_scene.make_scene()
    inside = scene.tracks["cam00"].at(0)
    away = dataclasses.replace(inside, t=inside.t + inside.R @ np.array([0.0, 100.0, 0.0]))
    back = dataclasses.replace(inside, R=np.diag([-1.0, 1.0, -1.0]) @ inside.R, t=inside.t)
    frames = list(viewer_scene.FRAMES)
    everywhen = list(range(len(frames)))
    assert find_outside([inside, away, back], scene, frames) == [[], everywhen, everywhen]


def test_far_points_are_left_out_and_many_thinned() -> None:
    scene = viewer_scene.make_scene()
    points = np.concatenate([np.random.default_rng(0).normal(0, 1, (5000, 3)), np.full((10, 3), 1e6)])
    thin = thin_points(points, np.zeros(3), scene)
    assert 500 < len(thin) <= 1500
    assert np.abs(thin).max() < 100


def test_nearest_is_not_one_stray_point() -> None:
    depth = np.full((100, 100), 0.5, np.float32)
    depth[0, 0] = 900
    assert find_nearest([depth]) == pytest.approx(0.5)
    assert find_nearest([np.zeros((4, 4))]) == 1.0


def test_names_cannot_end_the_page() -> None:
    shell = {"page.html": "<style>[[STYLE]]</style>[[POSTER]]<script>[[MANIFEST]]</script>[[PROGRAM]]"}
    page = draw_page({"scene": "</script><b>"}, picture(1), 75, {**shell, "viewer.css": "", "viewer.js": ""})
    assert "</script><b>" not in page
    assert page.count("</script>") == 1


def test_page_keeps_within_its_bytes_and_is_the_same_again(tmp_path: Path) -> None:
    words = viewer_scene.write_event(tmp_path / "event")
    for name in ("one", "two"):
        main([*words, "--max-mb", "1", "--output", str(tmp_path / name / "viewer")])
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*.*"))
    assert len(files) == 1 + 2 * viewer_scene.NUM_VIEWS + 3
    for path in files:
        text = (tmp_path / "two" / path).read_bytes().replace(b'"scene":"two"', b'"scene":"one"')
        assert (tmp_path / "one" / path).read_bytes() == text, path
    assert sum((tmp_path / "one" / path).stat().st_size for path in files) <= 1e6
    shutil.rmtree(tmp_path / "event" / "lattice" / "render" / "lattice-03")
    with pytest.raises(InputError, match=r"view lattice-03: expected pictures of frames 0..5"):
        main([*[word for word in words if "render/lattice-03" not in word], "--output", str(tmp_path / "no")])


def test_known_depth_carries_a_view_onto_its_neighbour() -> None:
    """The small event is what the test of the page takes it for."""
    scene = viewer_scene.make_scene()
    first, second = (view.frames[0].camera for view in viewer_scene.lattice_views(scene)[1:3])
    R, t = look_at(first.center, np.zeros(3), viewer_scene.UP)
    assert np.linalg.norm(first.center - second.center) > 0.3
    np.testing.assert_allclose(R[2] @ first.R[2], 1, atol=0.01)
    depth, is_board = viewer_scene.depth_at(first, 0)
    assert 0.02 < is_board.mean() < 0.3 and np.isfinite(depth).mean() > 0.95


def test_built_program_is_that_of_the_source(tmp_path: Path) -> None:
    if shutil.which("node") is None or not (SOURCE / "node_modules").is_dir():
        pytest.skip("needs node and `npm ci` in viewer/ to build the page's program")
    command = ["npx", "vite", "build", "--outDir", str(tmp_path / "assets"), "--logLevel", "error"]
    subprocess.run(command, cwd=SOURCE, check=True, timeout=120)
    for name in SHELL:
        built = (tmp_path / "assets" / name).read_text(encoding="utf-8")
        assert built == (ASSETS / name).read_text(encoding="utf-8"), f"{name}: `npm run build` in viewer/"


def test_lock_file_names_no_host() -> None:
    lock = json.loads((SOURCE / "package-lock.json").read_text(encoding="utf-8"))
    assert all("integrity" in entry for name, entry in lock["packages"].items() if name)
    assert not any("resolved" in entry for entry in lock["packages"].values())


def test_files_of_the_front_end_are_small() -> None:
    for path in [*SOURCE.glob("src/*"), *SOURCE.glob("tests/*"), *SOURCE.glob("public/*")]:
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 400, path
