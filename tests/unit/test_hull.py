"""Visual hull: closed forms, votes, invariants, photo-consistency, messages."""

import dataclasses
import math

import cv2
import numpy as np
import pytest

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.fuse.hull import HullDepth, HullOptions, carve_view
from fourd.geometry import look_at

SIZE = (160, 120)
RADIUS = 0.8
RANGE = (2.0, 9.0)
UP = np.array([0.0, 1.0, 0.0])


def place(azimuth_deg: float, height: float = 0.4, distance: float = 4.8, target=(0.0, 0.0, 0.0)) -> Camera:
    a = math.radians(azimuth_deg)
    center = np.array([distance * math.sin(a), height, -distance * math.cos(a)])
    R, t = look_at(center, np.array(target), UP)
    return Camera(np.array([[180.0, 0, 79.5], [0, 180, 59.5], [0, 0, 1]]), R, t, SIZE)


def ring(count: int, first_deg: float = 17.0) -> dict[str, Camera]:
    return {f"cam{i:02d}": place(first_deg + 360 * i / count, (-1.0) ** i * 1.2) for i in range(count)}


def trace_sphere(camera: Camera) -> np.ndarray:
    """(H, W) z of a sphere around the origin, NaN beside it."""
    y, x = np.mgrid[: camera.size[1], : camera.size[0]].astype(float)
    ray = camera.rays(np.stack([x, y], -1)) @ camera.R
    center = camera.center
    a, b, c = (ray * ray).sum(-1), ray @ center, center @ center - RADIUS**2
    inside = b * b - a * c
    return np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.nan)


def sphere_masks(cameras: dict[str, Camera]) -> dict[str, np.ndarray]:
    return {n: np.isfinite(trace_sphere(c)).astype(np.uint8) * np.uint8(255) for n, c in cameras.items()}


def box_mask(camera: Camera, corners: np.ndarray) -> np.ndarray:
    pixels = camera.project(corners)[0]
    outline = cv2.convexHull(pixels.astype(np.float32)).round().astype(np.int32)
    return cv2.fillConvexPoly(np.zeros(SIZE[::-1], np.uint8), outline, 255)


def carve(target: Camera, cameras, masks, images=None, wanted=None, **changes) -> HullDepth:
    return carve_view(target, cameras, masks, images or {}, wanted, RANGE, HullOptions(**changes))


def inner(mask: np.ndarray, width: int = 1) -> np.ndarray:
    return cv2.erode(mask.astype(np.uint8), np.ones((2 * width + 1,) * 2, np.uint8)).astype(bool)


@pytest.mark.parametrize("count", [2, 4, 12])
def test_hull_contains_a_sphere(count: int) -> None:
    cameras, target = ring(count), place(0)
    hull, truth = carve(target, cameras, sphere_masks(cameras)), trace_sphere(target)
    inside = inner(np.isfinite(truth))
    assert hull.status == "ok"
    assert np.isfinite(hull.depth[inside]).all()
    # The front of the hull is before the surface, up to a pixel of a silhouette.
    flat = inner(np.isfinite(truth), 6)
    assert (hull.depth[flat] <= truth[flat] * 1.01).all()


def test_hull_of_many_cameras_is_the_sphere() -> None:
    cameras, target = ring(24), place(0)
    hull, truth = carve(target, cameras, sphere_masks(cameras)), trace_sphere(target)
    both = inner(np.isfinite(truth))
    # A pixel of a silhouette is 1/180 of the depth.
    assert np.median(np.abs(hull.depth[both] / truth[both] - 1)) < 1 / 180
    outside = ~cv2.dilate(np.isfinite(truth).astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    assert not np.isfinite(hull.depth[outside]).any()


def test_hull_contains_two_boxes_one_behind_the_other() -> None:
    unit = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    boxes = [unit * 0.3 + [0.0, 0, -0.9], unit * [0.5, 0.3, 0.2] + [0.3, 0.2, 1.2]]
    cameras, target = ring(8), place(0)
    masks = {n: np.maximum(*(box_mask(c, box) for box in boxes)) for n, c in cameras.items()}
    hull = carve(target, cameras, masks)
    seen = inner(np.maximum(*(box_mask(target, box) for box in boxes)) > 0, 2)
    assert np.isfinite(hull.depth[seen]).all()
    front = inner(box_mask(target, boxes[0]) > 0, 4)
    nearest = target.project(boxes[0])[1].min()
    assert (hull.depth[front] <= target.project(boxes[0])[1].max()).all()
    assert np.median(hull.depth[front]) == pytest.approx(nearest, rel=0.1)


def test_unknown_does_not_carve() -> None:
    cameras, target = ring(5), place(0)
    masks = sphere_masks(cameras)
    blind = {**masks, "cam02": np.full(SIZE[::-1], 128, np.uint8)}
    without = {name: mask for name, mask in masks.items() if name != "cam02"}
    a, b = carve(target, cameras, blind), carve(target, cameras, without)
    assert np.array_equal(np.isfinite(a.depth), np.isfinite(b.depth))
    known = np.isfinite(a.depth)
    assert np.allclose(a.depth[known], b.depth[known], rtol=0.01)
    assert a.num_cameras.max() == 4


def test_unknown_alone_is_no_silhouette() -> None:
    cameras = ring(4)
    masks = {name: np.full(SIZE[::-1], 128, np.uint8) for name in cameras}
    masks["cam00"] = sphere_masks(cameras)["cam00"]
    hull = carve(place(0), cameras, masks)
    assert hull.status == "the silhouettes have no point in common"
    assert np.isnan(hull.depth).all() and np.isnan(hull.sigma).all() and not hull.num_cameras.any()


@pytest.mark.parametrize("where", [(0.0, 0.0, -20.0), (30.0, 0.0, 0.0)])
def test_a_camera_that_does_not_see_the_point_does_not_vote(where: tuple[float, float, float]) -> None:
    cameras, target = ring(5), place(0)
    masks = sphere_masks(cameras)
    plain = carve(target, cameras, masks)
    # Turned away, and beside: an empty picture would carve everything.
    looking_away = {**cameras, "cam09": place(0, target=where, distance=4.0)}
    hull = carve(target, looking_away, {**masks, "cam09": np.zeros(SIZE[::-1], np.uint8)})
    assert np.array_equal(np.isfinite(hull.depth), np.isfinite(plain.depth))


def test_a_camera_that_sees_background_carves_unless_dissent_is_allowed() -> None:
    cameras, target = ring(6), place(0)
    masks = {**sphere_masks(cameras), "cam03": np.zeros(SIZE[::-1], np.uint8)}
    assert carve(target, cameras, masks).status == "the silhouettes have no point in common"
    hull = carve(target, cameras, masks, max_dissent=1)
    assert np.isfinite(hull.depth[inner(np.isfinite(trace_sphere(target)))]).all()


def scaled(camera: Camera, scale: float) -> Camera:
    return dataclasses.replace(camera, t=camera.t * scale)


@pytest.mark.parametrize("scale", [2.0**-20, 2.0**20, 1e-6, 1e6])
def test_the_scale_of_the_world_changes_nothing(scale: float) -> None:
    cameras, target = ring(5), place(0)
    masks, images = sphere_masks(cameras), paint(cameras)
    plain = carve(target, cameras, masks, images)
    large = carve_view(
        scaled(target, scale), {n: scaled(c, scale) for n, c in cameras.items()}, masks, images, None,
        (RANGE[0] * scale, RANGE[1] * scale), HullOptions(),
    )  # fmt: skip
    both = np.isfinite(plain.depth) & np.isfinite(large.depth)
    assert (np.isfinite(plain.depth) ^ np.isfinite(large.depth)).sum() <= 2
    off = np.abs(large.depth[both] / (plain.depth[both] * scale) - 1)
    # A rounding may tip a level or an interval of a few pixels.
    assert np.quantile(off, 0.99) < 1e-4


def test_the_order_of_cameras_changes_no_byte() -> None:
    cameras, target = ring(6), place(5)
    masks, images = sphere_masks(cameras), paint(cameras)
    order = ["cam03", "cam00", "cam05", "cam02", "cam04", "cam01"]
    a = carve(target, cameras, masks, images)
    b = carve(
        target,
        {n: cameras[n] for n in order},
        {n: masks[n] for n in order},
        {n: images[n] for n in order[::-1]},
    )
    for x, y in ((a.depth, b.depth), (a.sigma, b.sigma), (a.num_cameras, b.num_cameras)):
        np.testing.assert_array_equal(x, y)


def texture(points: np.ndarray) -> np.ndarray:
    """(..., 3) uint8: waves fixed to the world."""
    rng = np.random.default_rng(3)
    waves = points @ rng.normal(size=(3, 24)) * rng.uniform(4, 16, 24)
    mix = np.sin(waves + rng.uniform(0, 6, 24)) @ rng.normal(size=(24, 3))
    return np.clip(128 + 22 * mix, 0, 255).astype(np.uint8)


def paint(cameras: dict[str, Camera]) -> dict[str, np.ndarray]:
    images = {}
    for name, camera in cameras.items():
        depth = trace_sphere(camera)
        y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(float)
        points = camera.unproject(np.stack([x, y], -1), np.nan_to_num(depth, nan=1.0))
        images[name] = np.where(np.isfinite(depth)[..., None], texture(points), np.uint8(90))
    return images


def test_photo_consistency_finds_the_surface_inside_the_hull() -> None:
    # Cameras on one side only: the front of the hull stands far before the sphere.
    cameras = {f"cam{i}": place(a, 0.1) for i, a in enumerate((-24, -12, 12, 24))}
    target = place(0)
    masks = sphere_masks(cameras)
    truth = trace_sphere(target)
    middle = inner(np.isfinite(truth), 5)
    front = carve(target, cameras, masks).depth[middle]
    refined = carve(target, cameras, masks, paint(cameras))
    error = np.abs(refined.depth[middle] / truth[middle] - 1)
    assert np.median(np.abs(front / truth[middle] - 1)) > 5 * np.median(error)
    # A pixel of motion between the outer cameras is 0.007 of the depth.
    assert np.median(error) < 0.01
    # Its own sigma says how wrong it may be.
    off = np.abs(1 / refined.depth[middle] - 1 / truth[middle])
    assert (off < 2 * refined.sigma[middle]).mean() > 0.5


def test_grey_pictures_keep_the_front_of_the_hull_and_say_they_know_little() -> None:
    cameras, target = ring(5), place(0)
    masks = sphere_masks(cameras)
    grey = {name: np.full((*SIZE[::-1], 3), 120, np.uint8) for name in cameras}
    front, plain = carve(target, cameras, masks), carve(target, cameras, masks, grey)
    known = np.isfinite(front.depth)
    assert np.median(plain.depth[known] / front.depth[known] - 1) < 0.01
    assert (plain.sigma[known] > 0).all() and (front.sigma[known] >= 0).all()


def test_only_wanted_pixels_are_carved_and_come_out_the_same() -> None:
    cameras, target = ring(5), place(0)
    masks = sphere_masks(cameras)
    wanted = np.zeros(SIZE[::-1], bool)
    wanted[30:77, 51:99] = True
    part, whole = carve(target, cameras, masks, wanted=wanted), carve(target, cameras, masks)
    assert not np.isfinite(part.depth[~wanted]).any()
    np.testing.assert_array_equal(part.depth[wanted], whole.depth[wanted])


def test_one_camera_is_a_status_not_an_error() -> None:
    cameras = ring(1)
    hull = carve(place(0), cameras, sphere_masks(cameras))
    assert hull.status == "a hull takes 2 silhouettes, got 1"
    assert np.isnan(hull.depth).all()


def test_lens_distortion_is_followed() -> None:
    lens = np.array([-0.25, 0.08, 0.0, 0.0, 0.0])
    cameras = {n: dataclasses.replace(c, distortion=lens) for n, c in ring(12).items()}
    target = place(0)
    hull, truth = carve(target, cameras, sphere_masks(cameras)), trace_sphere(target)
    inside = inner(np.isfinite(truth))
    assert np.isfinite(hull.depth[inside]).all()
    assert np.median(np.abs(hull.depth[inside] / truth[inside] - 1)) < 0.01


def test_faults_are_named() -> None:
    cameras = ring(3)
    masks = sphere_masks(cameras)
    with pytest.raises(InputError, match=r"camera cam01: expected a silhouette of 160x120 .* \(80, 60\)"):
        carve(place(0), cameras, {**masks, "cam01": np.zeros((60, 80), np.uint8)})
    with pytest.raises(InputError, match=r"0 < near < far .* 3 to 3"):
        carve_view(place(0), cameras, masks, {}, None, (3.0, 3.0), HullOptions())
    with pytest.raises(InputError, match="calibrated camera cam07"):
        carve(place(0), cameras, {**masks, "cam07": masks["cam00"]})
