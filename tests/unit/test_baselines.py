"""Methods of the table: closed forms on a plane, occlusion, and reasons of those that cannot run."""

import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from fourd.baselines import METHODS, Unavailable
from fourd.baselines.nearest import FilmIndex, describe_image, nearest_name
from fourd.baselines.sfm import draw_points, fill_nearest
from fourd.baselines.warp import find_visible, warp_inputs
from tests.unit.baseline_evidence import DEPTH, SIZE, VIEW, film, input_camera, make_evidence, paint

SHAPE = (SIZE[1], SIZE[0])


def texture(seed: int) -> np.ndarray:
    import cv2

    noise = np.random.default_rng(seed).integers(0, 256, (*SHAPE, 3)).astype(np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2.5)


def test_warped_inputs_show_what_the_view_shows():
    evidence = make_evidence(num_inputs=4)
    image = METHODS["ibr"](evidence)
    covered = evidence.warp.num_seen > 0
    assert covered.all()
    assert np.abs(image.astype(int) - evidence.truth).max() <= 3
    # The view's left border lies in the pictures of the two cameras on the left only.
    assert set(np.unique(evidence.warp.num_seen[:, 2])) == {2}
    assert set(np.unique(evidence.warp.num_seen[:, 48])) == {4}


def test_the_two_nearest_cameras_are_blended_by_each_others_angle():
    depth = np.full(SHAPE, DEPTH, np.float32)
    known = np.ones(SHAPE, bool)
    colours, offsets = (40, 100, 250), (0.1, -0.3, 0.9)
    inputs = [
        (np.full((*SHAPE, 3), colour, np.uint8), known, input_camera(x))
        for colour, x in zip(colours, offsets, strict=True)
    ]
    image = warp_inputs(depth, VIEW, inputs).image
    angles = np.arctan(np.array([0.1, 0.3]) / DEPTH)
    expected = (40 * angles[1] + 100 * angles[0]) / angles.sum()
    assert abs(int(image[31, 47, 0]) - expected) <= 1
    one = warp_inputs(depth, VIEW, inputs[2:])
    assert (one.image[one.num_seen == 1] == 250).all() and not one.image[one.num_seen == 0].any()
    same = warp_inputs(depth, VIEW, [(inputs[0][0], known, VIEW), (inputs[1][0], known, VIEW)])
    assert (same.image == 70).all()


def test_a_near_surface_hides_what_lies_behind_it_from_the_side():
    depth = np.full(SHAPE, 6.0, np.float32)
    depth[20:44, 40:56] = 2.0
    side = input_camera(1.0)
    seen = warp_inputs(depth, VIEW, [(np.zeros((*SHAPE, 3), np.uint8), np.ones(SHAPE, bool), side)]).num_seen
    # Seen from the right, the near block shifts by 90 (1 / 2 - 1 / 6) = 30 px against the wall.
    assert (seen[24:40, 14:22] == 0).mean() > 0.8
    assert (seen[24:40, 48:54] == 1).all()
    assert (seen[24:40, 62:90] == 1).all()
    assert (seen[:16, 20:] == 1).all()


def test_nothing_is_seen_without_depth_outside_a_picture_or_behind_a_camera():
    depth = np.full(SHAPE, DEPTH, np.float32)
    depth[:, :10] = np.nan
    known = np.ones(SHAPE, bool)
    known[:, 60:] = False
    warp = warp_inputs(depth, VIEW, [(np.full((*SHAPE, 3), 9, np.uint8), known, VIEW)])
    expected = np.zeros(SHAPE, np.uint8)
    expected[:, 10:60] = 1
    np.testing.assert_array_equal(warp.num_seen, expected)
    assert not find_visible(np.array([[0.0, 0, -1]]), VIEW, known)[1].any()
    sky = warp_inputs(
        np.full(SHAPE, np.inf, np.float32), VIEW, [(film(VIEW), ~known | True, input_camera(1.0))]
    )
    np.testing.assert_array_equal(sky.image, film(VIEW))


def test_image_based_rendering_fills_what_nobody_sees_with_the_mean():
    evidence = make_evidence(far=np.arange(96)[None, :] * np.ones((64, 1)) >= 40)
    image = METHODS["ibr"](evidence)
    shown = evidence.warp.num_seen > 0
    mean = np.floor(image[shown].mean(axis=0) + 0.5)
    assert (image[:, :40] == mean).all()
    assert not METHODS["ibr"](make_evidence(far=np.zeros(SHAPE, bool))).any()


def test_sparse_points_take_the_nearest_cameras_colour_and_hide_each_other():
    points = np.array([[0.0, 0, DEPTH], [0.5, 0.2, DEPTH], [0.0, 0, 2 * DEPTH]])
    evidence = make_evidence(points=points)
    image, shown = draw_points(evidence, 0)
    assert shown.sum() == 2
    pixels, _ = VIEW.project(points)
    for x, y in np.floor(pixels[:2] + 0.5).astype(int):
        assert np.abs(image[y, x].astype(int) - evidence.truth[y, x]).max() <= 4
    assert METHODS["sfm"](evidence).any(axis=2).sum() == 2 * 9
    assert (METHODS["sfm_dense"](evidence) > 0).all()


def test_densified_points_are_the_nearest_ones():
    rng = np.random.default_rng(3)
    shown = rng.random(SHAPE) < 0.01
    image = rng.integers(1, 256, (*SHAPE, 3)).astype(np.uint8) * shown[..., None]
    filled = fill_nearest(image, shown)
    distance, (rows, columns) = ndimage.distance_transform_edt(~shown, return_indices=True)
    expected = image[rows, columns]
    # OpenCV's distances are off by up to 2 %, so ties and near ties may fall otherwise.
    assert (filled == expected).all(axis=2).mean() > 0.97
    np.testing.assert_array_equal(filled[shown], image[shown])
    assert distance.max() > 5


def test_methods_without_their_material_say_why():
    with pytest.raises(Unavailable, match="no sparse points"):
        METHODS["sfm"](make_evidence())
    with pytest.raises(Unavailable, match="no sparse point lies in the held-out view"):
        METHODS["sfm_dense"](make_evidence(points=np.array([[0.0, 0, -3]])))


def test_neighbour_feature_prefers_the_same_structure():
    query = texture(2)
    brighter = np.clip(query.astype(int) + 40, 0, 255).astype(np.uint8)
    features = {
        name: describe_image(i) for name, i in (("a", texture(1)), ("b", brighter), ("c", texture(3)))
    }
    assert nearest_name(features, describe_image(query)) == "b"
    assert np.linalg.norm(describe_image(query)) == pytest.approx(1)
    assert not describe_image(np.full((64, 96, 3), 9, np.uint8)).any()


def test_all_times_finds_at_least_as_near_a_picture_as_the_same_time():
    evidence = make_evidence()
    pictures = {
        ("cam0", 0): evidence.inputs["cam0"].image,
        ("cam0", 5): texture(1),
        ("cam1", 7): evidence.truth,
    }
    films = FilmIndex(
        list(pictures),
        np.stack([describe_image(image) for image in pictures.values()]),
        lambda name, frame: pictures[name, frame],
        "",
    )
    searched = dataclasses.replace(evidence, films=films)
    assert METHODS["nn_all_times"](searched) is evidence.truth
    assert METHODS["nn_same_time"](searched) is not evidence.truth
    np.testing.assert_array_equal(films.feature_of("cam0", 5), describe_image(texture(1)))
    with pytest.raises(ValueError):
        films.feature_of("cam1", 5)


def test_blanks_are_black_for_inst_and_mean_coloured_for_paste():
    colour = np.full((*SHAPE, 3), 100, np.uint8)
    near, far = np.zeros(SHAPE, bool), np.zeros(SHAPE, bool)
    near[:16], far[16:32] = True, True
    evidence = make_evidence(near=near, far=far)
    evidence.foreground["consensus_rgb"] = colour
    evidence.background["farthest_rgb"] = colour + 50
    rows = (8, 24, 40)
    assert [METHODS["inst"](evidence)[row, 0, 0] for row in rows] == [100, 0, 0]
    assert [METHODS["background"](evidence)[row, 0, 0] for row in rows] == [0, 150, 0]
    assert [METHODS["paste"](evidence)[row, 0, 0] for row in rows] == [100, 150, 125]


def test_the_scene_of_these_tests_is_what_it_says():
    assert (film(VIEW)[31, 47] == paint(VIEW.unproject(np.array([47.0, 31]), np.array(DEPTH)))).all()
