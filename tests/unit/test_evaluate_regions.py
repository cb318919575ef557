"""Regions of a held-out frame: what moves, what the inputs see, what is inferred."""

import dataclasses

import cv2
import numpy as np

from fourd import metrics
from fourd.camera import Camera
from fourd.evaluate import EvaluateOptions, regions
from fourd.evaluate.regions import find_outside_hull
from fourd.image import undistort
from tests.unit.baseline_evidence import VIEW, make_evidence

SIZE = (96, 64)


def texture(seed: int, size=SIZE) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3)).astype(np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2.5)


def test_dynamic_pixels_ignore_small_shifts_and_blanks():
    place = texture(2)
    valid = np.ones((64, 96), bool)
    valid[:, 80:] = False
    shifted = np.roll(place, 2, axis=1)
    options = EvaluateOptions()
    assert not regions.find_dynamic_pixels(shifted, [(place, valid)], options)[:, 4:].any()
    moved = place.copy()
    moved[20:40, 30:50] = 255 - moved[20:40, 30:50] // 4
    moved[:, 80:] = 255
    found = regions.find_dynamic_pixels(moved, [(place, valid)], options)
    truth = np.zeros_like(found)
    truth[20:40, 30:50] = True
    assert (found & truth).sum() / (found | truth).sum() > 0.8
    assert not found[:, 81:].any()


def test_either_still_picture_explains_a_pixel():
    place, torn = texture(2), texture(2)
    torn[40:60, 60:90] = 0
    valid = np.ones((64, 96), bool)
    moved = place.copy()
    moved[10:30, 10:40] = 255
    options = EvaluateOptions()
    assert regions.find_dynamic_pixels(moved, [(torn, valid)], options)[40:60, 60:90].mean() > 0.5
    found = regions.find_dynamic_pixels(moved, [(torn, valid), (place, valid)], options)
    assert not found[40:60, 60:90].any() and found[12:28, 12:38].all()
    unknown = [(place, np.zeros_like(valid))]
    assert not regions.find_dynamic_pixels(moved, unknown, options).any()


def test_still_picture_leaves_out_movers_and_follows_the_rotation():
    K = np.array([[90.0, 0, 47.5], [0, 90, 31.5], [0, 0, 1]])
    wide = Camera(np.array([[90.0, 0, 79.5], [0, 90, 55.5], [0, 0, 1]]), np.eye(3), np.zeros(3), (160, 112))
    place = texture(4, (160, 112))
    frames, cameras = [], []
    for i, angle in enumerate(np.radians([-4, -2, 0, 2, 4])):
        R = cv2.Rodrigues(np.array([angle / 2, angle, 0]))[0]
        camera = Camera(K, R, -R @ np.array([0.01 * i, 0, 0]), SIZE)
        image, valid = undistort(place, dataclasses.replace(wide, t=-camera.center), camera)
        assert valid.all()
        image[20:36, 10 + 16 * i : 26 + 16 * i] = 255
        frames.append((image, camera))
        cameras.append(camera)
    rgb, valid = regions.StillPicture(frames).seen_from(cameras[0])
    truth, _ = undistort(place, dataclasses.replace(wide, t=-cameras[0].center), cameras[0])
    inner = np.zeros_like(valid)
    inner[4:-4, 4:-4] = True
    assert valid.mean() > 0.8
    assert metrics.psnr(rgb, truth, valid & inner) > 35


def test_regions_of_the_surface_come_from_depth_agreement_and_fill():
    near, far, filled = (np.zeros((64, 96), bool) for _ in range(3))
    near[:16], far[16:], filled[48:] = True, True, True
    agreed = np.zeros((64, 96), np.uint8)
    agreed[:8] = 2
    # The background lies behind all cameras' far side but for the view's own: nobody else sees it.
    evidence = make_evidence(near=near, far=far, filled=filled, num_cameras=agreed, num_inputs=0)
    found = regions.surface_regions(evidence)
    np.testing.assert_array_equal(found["seen_2"], agreed == 2)
    np.testing.assert_array_equal(found["seen_1"], agreed >= 1)
    np.testing.assert_array_equal(found["inferred"], filled)


def plane_camera(x: float, y: float = 0.0) -> Camera:
    return dataclasses.replace(VIEW, t=np.array([-x, -y, 0.0]))


def test_outside_the_hull_is_the_angle_to_the_cone_of_the_inputs():
    depth = np.full((64, 96), 10.0, np.float32)
    # Seen from (0, 0, 10), cameras at +-1 span +-5.7 degrees in x and nothing in y.
    centers = [np.array([-1.0, 0, 0]), np.array([1.0, 0, 0])]
    for x, y, is_outside in ((0, 0, False), (1.5, 0, False), (2.5, 0, True), (0, 0.7, False), (0, 1.4, True)):
        found = find_outside_hull(depth, plane_camera(x, y), centers)
        assert found.shape == depth.shape and found[32, 48] == is_outside, (x, y)
        assert found.all() == is_outside
    assert find_outside_hull(depth, plane_camera(0, 1.4), [*centers, np.array([0.0, 3, 0])]).sum() == 0


def test_pixels_without_depth_and_the_sky_are_not_outside():
    depth = np.full((64, 96), np.nan, np.float32)
    depth[:, :48] = np.inf
    assert not find_outside_hull(depth, plane_camera(30.0), [np.zeros(3), np.ones(3)]).any()
    depth[:, :48] = 10
    found = find_outside_hull(depth, plane_camera(30.0), [np.zeros(3), np.ones(3)])
    np.testing.assert_array_equal(found, ~np.isnan(depth))


def test_a_view_behind_the_scene_is_outside():
    R = np.diag([-1.0, 1, -1])
    behind = dataclasses.replace(VIEW, R=R, t=-R @ np.array([0, 0, 20.0]))
    assert find_outside_hull(np.full((64, 96), 10.0, np.float32), behind, [np.zeros(3), np.ones(3)]).all()


def test_masks_are_compared_by_their_pixels():
    found, true = np.zeros((10, 10), bool), np.zeros((10, 10), bool)
    found[:4], true[2:6] = True, True
    assert regions.compare_masks(found, true) == {
        "mask_iou": 20 / 60,
        "mask_precision": 0.5,
        "mask_recall": 0.5,
    }
    nothing = regions.compare_masks(np.zeros((10, 10), bool), true)
    assert nothing["mask_iou"] == 0 and np.isnan(nothing["mask_precision"])
