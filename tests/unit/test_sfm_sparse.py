import dataclasses

import numpy as np
import pytest

from fourd.camera import Camera
from fourd.sfm import SfmOptions
from fourd.sfm.depth_range import (
    choose_depth_ranges,
    depths_in_view,
    range_from_geometry,
    range_from_points,
)
from fourd.sfm.importers import DepthBounds
from fourd.sfm.normalize import Similarity, estimate_similarity
from fourd.sfm.sparse import (
    detect_features,
    epipolar_error_px,
    find_sparse_points,
    match_descriptors,
    select_pairs,
    sparse_frames,
    triangulate_matches,
)
from tests.unit.sfm_rig import (
    LENS,
    POINTS,
    SIZE,
    TARGET,
    make_rig,
    make_texture,
    render_planes,
    transform_world,
    wall_and_box,
)

OPTIONS = SfmOptions()
ORIGIN = Similarity(TARGET, 4.0, True)


def normalized_rig(**arguments) -> dict[str, Camera]:
    return {name: ORIGIN.apply(camera) for name, camera in make_rig(**arguments).items()}


def test_sparse_frames_are_the_middles_of_equal_parts():
    assert sparse_frames(30, 2) == [7, 22]
    assert sparse_frames(30, 1) == [15]
    assert sparse_frames(3, 10) == [0, 1, 2]
    assert sparse_frames(1, 2) == [0]


def test_pairs_are_the_nearest_that_look_the_same_way():
    cameras = normalized_rig(num_cameras=6, spread_deg=100)
    one_each = select_pairs(cameras, dataclasses.replace(OPTIONS, num_neighbors=1))
    assert ("cam00", "cam01") in one_each and ("cam00", "cam02") not in one_each
    # 20 degrees apart: the second next camera is 40 degrees away, too far however many are asked for.
    many = select_pairs(cameras, dataclasses.replace(OPTIONS, num_neighbors=5))
    assert many == [(f"cam{i:02d}", f"cam{i + 1:02d}") for i in range(5)]


def test_cameras_in_one_place_make_no_pair():
    camera = normalized_rig()["cam00"]
    assert select_pairs({"a": camera, "b": camera}, OPTIONS) == []


def test_features_lie_where_the_blobs_are():
    # A blob's middle must not be off by the half pixel of another convention or of image doubling.
    rows, columns = np.mgrid[:120, :160]
    middles = np.array([[30.3, 40.7], [80.0, 60.0], [121.6, 88.2]])
    image = np.full((120, 160), 60.0)
    for (x, y), sigma in zip(middles, (3, 4, 5), strict=True):
        image += 120 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
    pixels, descriptors = detect_features(np.repeat(image.astype(np.uint8)[..., None], 3, axis=2), 100)
    assert descriptors.dtype == np.float32 and pixels.dtype == np.float64
    nearest = np.abs(pixels[:, None] - middles).max(axis=2).min(axis=0)
    assert (nearest < 0.1).all()


def test_images_without_features_give_empty_arrays():
    for value in (0, 128, 255):
        pixels, descriptors = detect_features(np.full((60, 80, 3), value, np.uint8), 100)
        assert pixels.shape == (0, 2) and descriptors.shape == (0, 128)
        assert match_descriptors(descriptors, descriptors, 0.8).shape == (0, 2)


def test_matches_are_mutual_and_distinct():
    rng = np.random.default_rng(0)
    a = rng.integers(0, 160, (50, 128)).astype(np.float32)
    order = rng.permutation(50)
    b = np.clip(a[order] + rng.integers(-3, 4, (50, 128)), 0, 255).astype(np.float32)
    matches = match_descriptors(a, b, 0.8)
    assert len(matches) == 50
    np.testing.assert_array_equal(order[matches[:, 1]], matches[:, 0])
    # A descriptor that has a twin is ambiguous, in either image.
    assert 7 not in match_descriptors(a, np.concatenate([b, b[order == 7]]), 0.8)[:, 0]
    assert 7 not in match_descriptors(np.concatenate([a, a[7:8]]), b, 0.8)[:, 0]


def test_matching_is_exact_in_any_order_of_summation():
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, 180, (2, 40, 128)).astype(np.float32)
    exact = ((a[:, None].astype(np.int64) - b[None].astype(np.int64)) ** 2).sum(axis=2)
    found = (a * a).sum(1)[:, None] + (b * b).sum(1)[None] - 2 * (a @ b.T)
    np.testing.assert_array_equal(found, exact)


@pytest.mark.parametrize("lens", [None, LENS])
def test_epipolar_error_is_the_distance_across_the_line(lens):
    left, right = list(make_rig(2, distortion=lens).values())
    seen = left.project(POINTS)[0], right.project(POINTS)[0]
    np.testing.assert_allclose(epipolar_error_px(left, right, *seen), 0, atol=1e-7)
    aside = epipolar_error_px(left, right, seen[0], seen[1] + [0, 3.0])
    assert (aside > 2.5).all() and (aside < 3.6).all()
    swapped = epipolar_error_px(right, left, seen[1] + [0, 3.0], seen[0])
    np.testing.assert_allclose(swapped, aside, atol=1e-7)


def test_epipolar_error_of_rectified_cameras_is_the_row_difference():
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    left, right = (Camera(K, np.eye(3), np.array([-x, 0, 0]), SIZE) for x in (0.0, 0.5))
    pixels = np.array([[10.0, 20], [200, 100]]), np.array([[5.0, 22.5], [100, 99]])
    np.testing.assert_allclose(epipolar_error_px(left, right, *pixels), [2.5, 1])
    assert np.isnan(epipolar_error_px(left, left, *pixels)).all()


def test_only_matches_that_hold_up_become_points():
    left, right = list(normalized_rig(num_cameras=2).values())
    points = ORIGIN.world_from_source(POINTS)
    seen = np.stack([left.project(points)[0], right.project(points)[0]])
    np.testing.assert_allclose(triangulate_matches(left, right, *seen, OPTIONS), points, atol=1e-9)
    off_line = seen.copy()
    off_line[1, ::2, 1] += 4
    np.testing.assert_allclose(triangulate_matches(left, right, *off_line, OPTIONS), points[1::2], atol=1e-9)
    assert len(triangulate_matches(left, right, seen[0] + [0, 40], seen[1], OPTIONS)) == 0
    assert triangulate_matches(left, right, *seen[:, :0], OPTIONS).shape == (0, 3)


def test_points_behind_or_without_parallax_are_left_out():
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    left, right = (Camera(K, np.eye(3), np.array([-x, 0, 0]), SIZE) for x in (0.0, 0.1))
    # Disparities 30, 1, 0 and -30: a point at 1, one whose rays meet at 0.2 degrees, infinity, behind.
    left_pixels = np.full((4, 2), 160.0)
    right_pixels = left_pixels - [[30, 0], [1, 0], [0, 0], [-30, 0]]
    points = triangulate_matches(left, right, left_pixels, right_pixels, OPTIONS)
    np.testing.assert_allclose(points, [[0, (160 - 120) / 300, 1]], atol=1e-9)


@pytest.fixture(scope="module")
def rendered():
    rig, texture = make_rig(3, spread_deg=24), make_texture()
    return rig, {name: render_planes(camera, wall_and_box(), texture) for name, camera in rig.items()}


def test_points_of_a_rendered_scene_lie_on_its_surfaces(rendered):
    rig, images = rendered
    points = find_sparse_points(lambda frame: rig, lambda name, frame: images[name], [0], OPTIONS)
    assert len(points) > 100
    to_surface = np.minimum(np.abs(points[:, 1] - TARGET[1] - 2), np.abs(points[:, 1] - TARGET[1] + 1))
    assert np.median(to_surface) < 0.02
    assert (to_surface < 0.15).mean() > 0.97
    again = find_sparse_points(lambda frame: rig, lambda name, frame: images[name], [0], OPTIONS)
    np.testing.assert_array_equal(points, again)


def test_near_of_a_rendered_scene_is_before_its_nearest_surface(rendered):
    rig, images = rendered
    points = find_sparse_points(lambda frame: rig, lambda name, frame: images[name], [0], OPTIONS)
    origin, x_edge, y_edge = wall_and_box()[1]
    corners = np.array([origin + a * np.array(x_edge) + b * np.array(y_edge) for a in (0, 1) for b in (0, 1)])
    for camera in rig.values():
        found = range_from_points([camera], points, OPTIONS)
        assert found is not None and found.far == float("inf")
        nearest = camera.project(corners)[1].min()
        assert 0.5 * nearest < found.near < nearest


def test_textureless_images_give_no_points():
    rig = make_rig(3)
    grey = np.full((240, 320, 3), 128, np.uint8)
    points = find_sparse_points(lambda frame: rig, lambda name, frame: grey, [0, 1], OPTIONS)
    assert points.shape == (0, 3)
    assert range_from_points([rig["cam00"]], points, OPTIONS) is None


def test_depths_in_view_are_those_inside_the_image():
    K = np.array([[100.0, 0, 159.5], [0, 100, 119.5], [0, 0, 1]])
    camera = Camera(K, np.eye(3), np.zeros(3), SIZE)
    points = np.array([[0, 0, 2.0], [1.599, 0, 1], [1.601, 0, 1], [0, -1.199, 1], [0, -1.201, 1], [0, 0, -2]])
    np.testing.assert_array_equal(depths_in_view(camera, points), [2, 1, 1])


def test_near_is_the_smallest_over_a_moving_cameras_poses():
    K = np.array([[100.0, 0, 159.5], [0, 100, 119.5], [0, 0, 1]])
    points = np.tile([0, 0, 10.0], (50, 1))
    approach = [Camera(K, np.eye(3), np.array([0, 0, -z]), SIZE) for z in (0.0, 2, 4, 1)]
    found = range_from_points(approach, points, OPTIONS)
    assert found is not None
    assert found.near == pytest.approx(6 * OPTIONS.near_margin)


def test_geometry_gives_a_share_of_the_way_to_what_is_filmed():
    cameras = list(normalized_rig().values())
    found = range_from_geometry(cameras, ORIGIN, OPTIONS)
    assert found.source == "camera geometry"
    assert found.near == pytest.approx(0.1 * min(c.t[2] for c in cameras))
    apart = dataclasses.replace(ORIGIN, converges=False)
    assert range_from_geometry(cameras, apart, OPTIONS).near == pytest.approx(0.1)


def test_who_knows_better_decides_the_range():
    tracks = {name: [camera] for name, camera in normalized_rig(num_cameras=2).items()}
    points = ORIGIN.world_from_source(np.tile(POINTS, (2, 1)))
    bounds = {"cam00": DepthBounds(2.0, 80.0), "cam01": DepthBounds(2.0, 80.0, are_percentiles=True)}

    def choose(given=None, bounds=bounds, points=points, options=OPTIONS):
        return choose_depth_ranges(tracks, given, bounds, points, ORIGIN, options)

    given = choose(given=(1.0, float("inf")))
    assert {(r.near, r.far, r.source) for r in given.values()} == {(0.25, float("inf"), "given")}
    stated, percentiles = choose().values()
    assert (stated.near, stated.far, stated.source) == (0.5, 20.0, "calibration")
    assert (percentiles.near, percentiles.far) == pytest.approx((0.5 * 0.7, 20.0 / 0.7))
    assert choose(options=dataclasses.replace(OPTIONS, use_far_bound=False))["cam00"].far == float("inf")
    mixed = choose(bounds={"cam00": bounds["cam00"]})
    assert [r.source for r in mixed.values()] == ["calibration", "sparse points"]
    bare = choose(bounds={}, points=np.zeros((0, 3)))
    assert {r.source for r in bare.values()} == {"camera geometry"}


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_ranges_scale_with_the_source_world(scale):
    def near_of(factor):
        rig = {n: transform_world(c, factor, np.zeros(3)) for n, c in make_rig().items()}
        similarity = estimate_similarity(list(rig.values()))
        points = similarity.world_from_source(np.tile(POINTS * factor, (2, 1)))
        tracks = {n: [similarity.apply(c)] for n, c in rig.items()}
        return [r.near for r in choose_depth_ranges(tracks, None, {}, points, similarity, OPTIONS).values()]

    np.testing.assert_allclose(near_of(scale), near_of(1.0), rtol=1e-9)
