import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd.camera import Camera
from fourd.demo import (
    DemoOptions,
    FrozenScene,
    camera_at,
    camera_names,
    camera_tracks,
    clip_times,
    middle_time,
)
from fourd.demo.cameras import MAX_SHAKE_SIGMA
from fourd.demo.canvas import Canvas, pack_textures
from fourd.demo.figures import (
    BALL,
    FIGURE1,
    FIGURE2,
    MAN,
    SPEED_M_S,
    WOMAN,
    _ankle,
    ball_center,
    bounce_times,
    path_length,
    path_point,
    walked_distance,
)
from fourd.demo.options import check_options
from fourd.demo.primitives import Builder, bounding_corners, camera_tiles, frame_around
from fourd.demo.raycast import intersect
from fourd.demo.shading import trace_depth
from fourd.errors import InputError
from fourd.geometry import angle_deg, look_at

TINY = DemoOptions(num_cameras=4, num_frames=6, width=96, height=54)
SMALL = dataclasses.replace(TINY, width=240, height=135)
NAMES = camera_names(TINY)


@pytest.fixture(scope="module")
def middle() -> FrozenScene:
    return FrozenScene(middle_time(TINY), TINY)


def _builder() -> Builder:
    return Builder({"any": 0})


def _trace(builder: Builder, camera: Camera) -> np.ndarray:
    geometry = builder.geometry()
    tiles = camera_tiles(bounding_corners(geometry), camera.K, camera.R, camera.t, camera.size)
    depth = np.empty(camera.size[::-1], np.float32)
    label = np.empty(camera.size[::-1], np.uint8)
    trace_depth(geometry, tiles, camera.K, np.ascontiguousarray(camera.R.T), camera.center, depth, label)
    return depth


def _camera(center: tuple[float, float, float], target: tuple[float, float, float]) -> Camera:
    R, t = look_at(np.array(center, float), np.array(target, float), np.array([0, 0, 1.0]))
    return Camera(np.array([[60, 0, 32], [0, 60, 24], [0, 0, 1.0]]), R, t, (65, 49))


def test_schema_has_the_options_and_their_defaults() -> None:
    path = Path(__file__).resolve().parents[2] / "config" / "schemas" / "demo.schema.yaml"
    schema = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert schema["additionalProperties"] is False
    in_scene_file = {"num_cameras", "num_frames", "fps", "width", "height"}
    wanted = {k: v for k, v in dataclasses.asdict(DemoOptions()).items() if k not in in_scene_file}
    assert {k: v["default"] for k, v in schema["properties"].items()} == wanted
    for name, entry in schema["properties"].items():
        for bound, beyond in (("minimum", -1), ("maximum", 1)):
            with pytest.raises(InputError, match=name):
                check_options(dataclasses.replace(DemoOptions(), **{name: entry[bound] + beyond}))


def test_depth_of_a_sphere_at_its_centre_is_distance_less_radius() -> None:
    builder = _builder()
    builder.ellipsoid((1, 5, 2), (0.5, 0.5, 0.5), "any")
    depth = _trace(builder, _camera((1, 0, 2), (1, 5, 2)))
    assert depth[24, 32] == pytest.approx(4.5, abs=1e-6)
    assert np.isinf(depth[0, 0])


def test_depth_of_a_plane_is_z_not_ray_length() -> None:
    builder = _builder()
    builder.rectangle((0, 4, 0), (50, 50), (1, 0, 0), (0, 0, 1), "any")
    np.testing.assert_allclose(_trace(builder, _camera((0, 0, 0), (0, 4, 0))), 4.0, rtol=1e-6)


def test_depth_of_the_square_is_the_ground_plane(middle: FrozenScene) -> None:
    for name in NAMES:
        camera = camera_at(name, middle_time(TINY), TINY)
        depth, label = middle.trace(camera)
        u = np.arange(TINY.width, dtype=np.float64)
        pixels = np.stack([u, np.full_like(u, TINY.height - 1)], axis=-1)
        world = camera.unproject(pixels, depth[-1].astype(np.float64))
        assert np.abs(world[label[-1] == 0, 2]).max() < 1e-5
        assert (label[-1] == 0).sum() > 40


def _shape(kind: str) -> tuple[Builder, object]:
    """A primitive and its implicit function, negative inside."""
    builder = _builder()
    if kind == "sphere":
        builder.ellipsoid((0.1, -0.2, 0.3), (0.9, 0.5, 0.7), "any")
        return builder, lambda p: np.linalg.norm((p - [0.1, -0.2, 0.3]) / [0.9, 0.5, 0.7], axis=-1) - 1
    if kind == "box":
        builder.box((0.1, 0, 0), (0.5, 0.3, 0.8), "any")
        return builder, lambda p: np.max(np.abs(p - [0.1, 0, 0]) - [0.5, 0.3, 0.8], axis=-1)
    a, axis, height = np.array([0.1, 0.2, -0.5]), np.array([0.36, 0.48, 0.8]), 1.1

    def split(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        z = (p - a) @ axis
        return z, np.linalg.norm(p - a - z[..., None] * axis, axis=-1)

    if kind == "frustum":
        builder.frustum(a, a + height * axis, (0.5, 0.2), "any")

        def frustum(p: np.ndarray) -> np.ndarray:
            z, radial = split(p)
            return np.maximum(radial - (0.5 - 0.3 * z / height), np.maximum(-z, z - height))

        return builder, frustum
    builder.limb(a, a + height * axis, (0.5, 0.2), "any")

    def limb(p: np.ndarray) -> np.ndarray:
        # The union of the balls whose centres and radii are interpolated from a to b.
        steps = np.linspace(0, 1, 2001)
        z, radial = split(p)
        gaps = np.hypot(radial[..., None], z[..., None] - steps * height) - (0.5 - 0.3 * steps)
        return gaps.min(axis=-1)

    return builder, limb


@pytest.mark.parametrize("kind", ["sphere", "box", "frustum", "limb"])
@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**31))
def test_hits_lie_on_the_surface_and_nothing_lies_before(kind: str, seed: int) -> None:
    builder, implicit = _shape(kind)
    geometry = builder.geometry()
    rng = np.random.default_rng(seed)
    origin = rng.standard_normal(3)
    origin *= 4 / np.linalg.norm(origin)
    direction = (rng.uniform(-0.9, 0.9, 3) - origin) * rng.uniform(0.1, 3)
    t = intersect(geometry, 0, *origin, *direction, 1e-6)
    if np.isfinite(t):
        assert abs(implicit(origin + t * direction)) < 1e-5
    before = np.linspace(0, min(t, 4 / np.linalg.norm(direction) * 2) * 0.999, 400)[:, None]
    assert implicit(origin + before * direction).min() > -1e-6


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6))
def test_frames_are_rotations_along_their_axis(values: list[float]) -> None:
    axis, front = np.array(values[:3]), np.array(values[3:])
    if np.linalg.norm(axis) < 1e-3:
        axis = np.array([0, 0, 1.0])
    frame = frame_around(axis, front)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame) == pytest.approx(1)
    np.testing.assert_allclose(frame[2], axis / np.linalg.norm(axis), atol=1e-12)


def test_tiles_lose_no_primitive(middle: FrozenScene) -> None:
    camera = camera_at("cam01", middle_time(TINY), TINY)
    depth, _ = middle.trace(camera)
    geometry = middle.geometry
    rng = np.random.default_rng(0)
    for row, column in zip(rng.integers(0, TINY.height, 60), rng.integers(0, TINY.width, 60), strict=True):
        ray = camera.rays(np.array([column, row], float)) @ camera.R
        hits = [intersect(geometry, i, *camera.center, *ray, 1e-6) for i in range(len(geometry.kind))]
        assert min(hits) == pytest.approx(float(depth[row, column]), rel=1e-6)


def test_ball_centre_projects_onto_the_ball_or_behind_what_hides_it() -> None:
    seen = 0
    for time_s in (-0.2, *clip_times(SMALL)):
        scene = FrozenScene(float(time_s), SMALL)
        center = ball_center(float(time_s))
        for name in NAMES:
            camera = camera_at(name, float(time_s), SMALL)
            depth, label = scene.trace(camera)
            pixel, z = camera.project(center)
            column, row = np.rint(pixel).astype(int)
            if label[row, column] == BALL:
                seen += 1
                assert abs(depth[row, column] - z) < 0.13
            else:
                assert depth[row, column] < z
    assert seen > 12


def test_two_cameras_agree_on_depth_and_labels() -> None:
    scene = FrozenScene(0.1, SMALL)
    a, b = (camera_at(name, 0.1, SMALL) for name in ("cam01", "cam02"))
    (depth_a, label_a), (depth_b, label_b) = scene.trace(a), scene.trace(b)
    rows, columns = np.nonzero(np.isfinite(depth_a))
    world = a.unproject(
        np.stack([columns, rows], axis=-1).astype(float), depth_a[rows, columns].astype(float)
    )
    pixels, z = b.project(world)
    column, row = np.rint(np.nan_to_num(pixels, nan=-9)).astype(int).T
    inside = (z > 0) & (column >= 0) & (column < SMALL.width) & (row >= 0) & (row < SMALL.height)
    found, wanted = depth_b[row[inside], column[inside]], z[inside]
    same = np.abs(found - wanted) < 0.03 * wanted
    # What b sees elsewhere must lie before the point: nothing may be missing along b's ray.
    assert (same | (found < wanted)).mean() > 0.97
    assert same.mean() > 0.6
    labels = label_a[rows, columns][inside][same], label_b[row[inside], column[inside]][same]
    assert (labels[0] == labels[1]).mean() > 0.98


def test_same_options_give_the_same_bytes_and_no_blank() -> None:
    camera = camera_at("cam02", 0.07, TINY)
    first, depth, label = FrozenScene(0.07, TINY).render(camera)
    again, depth_again, label_again = FrozenScene(0.07, TINY).render(camera)
    assert first.tobytes() == again.tobytes()
    assert depth.tobytes() == depth_again.tobytes() and label.tobytes() == label_again.tobytes()
    assert first.dtype == np.uint8 and depth.dtype == np.float32 and label.dtype == np.uint8
    assert not np.isnan(depth).any() and depth.min() > 1
    assert set(np.unique(label)) <= {0, 1, 2, 3}
    traced, traced_label = FrozenScene(0.07, TINY).trace(camera)
    assert traced.tobytes() == depth.tobytes() and traced_label.tobytes() == label.tobytes()
    other = FrozenScene(0.07, dataclasses.replace(TINY, seed=8)).render(camera)[0]
    assert (other != first).mean() > 0.3


def test_pictures_are_exposed_and_detailed(middle: FrozenScene) -> None:
    for name in NAMES:
        picture, depth, _ = middle.render(camera_at(name, middle_time(TINY), TINY))
        assert 70 < picture.mean() < 170 and picture.std() > 30
        assert (picture >= 254).mean() < 0.02 and (picture <= 2).mean() < 0.02
        assert np.isinf(depth).mean() < 0.15
        assert 2 < depth.min() < 4.5


def test_shadows_darken_the_ground() -> None:
    time_s = middle_time(SMALL)
    camera = camera_at("cam01", time_s, SMALL)
    full, depth, label = FrozenScene(time_s, SMALL).render(camera)
    empty, empty_depth, empty_label = FrozenScene(time_s, SMALL, (FIGURE1, FIGURE2, BALL)).render(camera)
    assert empty_label.max() == 0
    ground = (label == 0) & (depth == empty_depth)
    change = full.astype(int).mean(axis=2) - empty.mean(axis=2)
    assert (change[ground] < -25).sum() > 200
    assert (change[ground] < 3).mean() > 0.99


def test_left_out_labels_are_gone_and_the_rest_stays() -> None:
    time_s = middle_time(SMALL)
    # The camera in the middle of the arc sees the first figure before the second.
    options = dataclasses.replace(SMALL, num_cameras=5)
    camera = camera_at("cam02", time_s, options)
    depth, label = FrozenScene(time_s, options).trace(camera)
    without, revealed = FrozenScene(time_s, options, (FIGURE1,)).trace(camera)
    assert (label == FIGURE1).sum() > 300 and (revealed == FIGURE1).sum() == 0
    assert (revealed == FIGURE2).sum() > (label == FIGURE2).sum() + 100
    assert np.array_equal(depth[label != FIGURE1], without[label != FIGURE1])


def test_convention_poses_are_cam_from_world_rotations() -> None:
    for name, track in camera_tracks(TINY).items():
        assert track.name == name and len(track.cameras) == TINY.num_frames
        for camera in track.cameras:
            np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(camera.R) == pytest.approx(1)
            assert camera.project(np.array([0, 0, 1.0]))[1] == pytest.approx(TINY.distance_m, abs=0.6)
            assert camera.K[0, 2] == (TINY.width - 1) / 2
            assert 72 <= camera.focal_px <= 92


def test_arc_has_the_angle_asked_for_and_even_steps() -> None:
    steady = dataclasses.replace(DemoOptions(), shake_m=0, shake_deg=0)
    flat = np.array([camera_at(n, 0.3, steady).center * (1, 1, 0) for n in camera_names(steady)])
    assert angle_deg(flat[0], flat[-1]) == pytest.approx(88.0)
    np.testing.assert_allclose(angle_deg(flat[1:], flat[:-1]), 11.0, rtol=1e-9)
    distances = np.linalg.norm(flat, axis=1)
    assert distances.min() > 4 and distances.max() < 5
    focal = [camera_at(n, 0, steady).focal_px for n in camera_names(steady)]
    assert min(focal) >= 360 and max(focal) <= 460 and np.ptp(focal) > 60


def test_shake_is_there_bounded_and_smooth() -> None:
    options = DemoOptions()
    steady = dataclasses.replace(options, shake_m=0, shake_deg=0)
    times = np.arange(-30, 90) / 120
    for name in ("cam00", "cam05"):
        shaken = [camera_at(name, t, options) for t in times]
        held = camera_at(name, 0, steady)
        move = np.array([c.center - held.center for c in shaken])
        turn = np.array([np.degrees(np.arccos((np.trace(c.R @ held.R.T) - 1) / 2)) for c in shaken])
        assert np.abs(move).max() <= MAX_SHAKE_SIGMA * options.shake_m and move.std() > 0.004
        assert turn.max() <= MAX_SHAKE_SIGMA * options.shake_deg * np.sqrt(3) and turn.max() > 0.3
        # Below 4 Hz a step of 1/120 s turns the phase by at most 12 degrees.
        assert np.abs(np.diff(move, axis=0)).max() < 0.25 * MAX_SHAKE_SIGMA * options.shake_m


def test_figures_walk_at_constant_speed_and_cross_in_the_middle() -> None:
    options, step = DemoOptions(), 1e-3
    middle_s = middle_time(options)
    for style, y in ((MAN, -0.95), (WOMAN, 0.95)):
        at = path_point(walked_distance(style, middle_s, middle_s))[0]
        np.testing.assert_allclose(at, [0, y, 0], atol=1e-6)
        for time_s in (-3.0, 0.4, 7.7):
            a, b = (path_point(walked_distance(style, t, middle_s))[0] for t in (time_s, time_s + step))
            assert np.linalg.norm(b - a) / step == pytest.approx(SPEED_M_S, rel=2e-3)


def test_planted_feet_do_not_slide() -> None:
    for side in (1, -1):
        low = [_ankle(MAN, s, side) for s in np.arange(0, 0.3, 0.01) + (0.0 if side > 0 else 0.56)]
        ankles = np.array([ankle for ankle, _, _ in low])
        assert np.ptp(ankles[:, :2], axis=0).max() < 1e-9
    walked = np.arange(0, path_length(), 0.004)
    ankles = np.array([_ankle(MAN, s, 1)[0] for s in walked])
    assert np.linalg.norm(np.diff(ankles, axis=0), axis=1).max() < 0.03


def test_ball_bounces_on_the_ground_and_never_meets_a_walker() -> None:
    for time_s in bounce_times(-2, 5):
        assert ball_center(float(time_s))[2] == pytest.approx(0.115, abs=1e-6)
    gaps = [
        np.linalg.norm((path_point(walked_distance(style, t, 0.5))[0] - ball_center(t))[:2])
        for t in np.arange(-1, 20, 0.02)
        for style in (MAN, WOMAN)
    ]
    assert min(gaps) > 0.4


def test_mipmaps_keep_the_mean() -> None:
    canvas = Canvas(1.0, 0.5, 64, (1, 2))
    picture = np.clip(0.5 + 0.2 * canvas.noise(0.1, 3), 0, 1)[:, :, None].repeat(3, axis=2)
    textures = pack_textures([picture], [(1.0, 0.5)])
    for offset, width, height in textures.levels[0]:
        texels = textures.texels[offset : offset + width * height].astype(float) / 255
        assert np.mean(texels**2) == pytest.approx(picture.mean(), rel=0.02)
