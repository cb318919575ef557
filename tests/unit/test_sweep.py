"""Plane sweep on rendered scenes with known depth, and its compiled loops against plain forms."""

import dataclasses

import cv2
import numpy as np
import pytest

from fourd.camera import Camera, CameraTrack, tracks_to_dict
from fourd.cli import run_stage
from fourd.errors import InputError
from fourd.fuse.files import read_pair_frame
from fourd.io import Archive, write_json, write_png
from fourd.matchers.semi_global import aggregate, best_hypothesis
from fourd.stereo.__main__ import main
from fourd.stereo.check import StereoOptions
from fourd.stereo.disparity import make_matcher, match_pair
from fourd.stereo.files import read_disparity_frame
from fourd.stereo.rectification import Rectification
from fourd.stereo.rectify import (
    RectifyOptions,
    disparity_from_depth,
    inverse_depth_from_disparity,
    rectify_pair,
)
from fourd.stereo.sweep import SWEEP_SIGMA_PX, lens_of, sweep_pair
from fourd.stereo.sweep_frame import plane_motion
from fourd.stereo.sweep_kernels import fit_planes, warp_by_plane
from tests.films import put_on_clock
from tests.unit.test_rectify import LENS, camera_at, rectified

RANGE = (1.5, 12.0)
CENTER = [0.0, 0.0, 1.0]
FLOOR_Z, WALL_Y = 0.0, 2.0
BOARD_Y, BOARD = -0.5, 0.8


def noise_texture() -> np.ndarray:
    """(1200, 1200, 3) uint8 smooth noise at several scales."""
    rng = np.random.default_rng(3)
    image = np.zeros((1200, 1200, 3), np.float32)
    for cells in (30, 120, 450):
        image += cv2.resize(rng.uniform(0, 85, (cells, cells, 3)).astype(np.float32), (1200, 1200))
    return image.astype(np.uint8)


TEXTURE = noise_texture()


def render(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Image and z depth of a floor, a wall that faces the cameras and a square board before it."""
    width, height = camera.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    rays = camera.rays(pixels) @ camera.R
    center = camera.center
    color, depth = np.zeros((height, width, 3), np.uint8), np.full((height, width), np.inf)
    for axis, at, spread in ((1, WALL_Y, 100.0), (2, FLOOR_Z, 30.0), (1, BOARD_Y, 130.0)):
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (at - center[axis]) / rays[..., axis]
            points = center + z[..., None] * rays
        across = points[..., [0, 3 - axis]]
        hit = (z > 0) & (z < depth)
        if at == BOARD_Y:
            hit &= np.abs(across - [0, 1]).max(axis=-1) < BOARD
        spots = np.where(hit[..., None], across * spread + [600, 500], 0).astype(np.float32)
        picture = cv2.remap(
            TEXTURE, spots[..., 0], spots[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
        )
        color, depth = np.where(hit[..., None], picture, color), np.where(hit, z, depth)
    return color, depth


def swept(left: Camera, right: Camera, change=lambda image: image, options: RectifyOptions | None = None):
    rectification = rectify_pair(left, right, RANGE, RANGE, options or RectifyOptions())
    assert isinstance(rectification, Rectification), rectification
    assert rectification.kind == "sweep"
    images = render(left)[0], change(render(right)[0])
    return sweep_pair(rectification, (left, right), images, StereoOptions())


def behind(**kwargs):
    return camera_at([0, -6, 1], CENTER, **kwargs)


def before(**kwargs):
    return camera_at([0.2, -4.6, 1.1], CENTER, **kwargs)


def errors_of(result, side):
    """Found (H, W), relative depth error and error in units of the map's own sigma, at found pixels."""
    rectification = result.rectification
    disparity, confidence = getattr(result, f"{side}_disparity"), getattr(result, f"{side}_confidence")
    truth = render(rectification.camera(side))[1]
    found = np.isfinite(disparity)
    inverse = inverse_depth_from_disparity(rectification, disparity, side)
    relative = np.abs(inverse * truth - 1)[found]
    sigmas = (
        np.abs(disparity - disparity_from_depth(rectification, truth, side)) * confidence / result.sigma_px
    )
    return found, relative, sigmas[found]


def seen_by_other(result, side):
    """(H, W) bool: the true point lies inside the other image, covered or not."""
    camera, other = (
        result.rectification.camera(s) for s in sorted(("left", "right"), key=lambda s: s != side)
    )
    depth = render(camera)[1]
    pixels = np.stack(np.meshgrid(np.arange(camera.size[0]), np.arange(camera.size[1])), axis=-1)
    there, _ = other.project(camera.unproject(pixels.astype(np.float64), depth))
    with np.errstate(invalid="ignore"):
        return np.all((there >= 0) & (there <= np.array(other.size) - 1), axis=-1)


@pytest.mark.parametrize(
    "left, right",
    [
        (behind(), before()),
        (before(), behind()),
        (behind(roll_deg=180), before()),
        (behind(roll_deg=90), before(roll_deg=-60)),
        (behind(size=(180, 320)), before()),
        (behind(lens=LENS), before(lens=-LENS)),
        (behind(focal_px=450.0), before(focal_px=250.0)),
        (behind(size=(400, 220), focal_px=380.0), before()),
    ],
    ids=["plain", "exchanged", "upside_down", "sideways", "portrait", "lens", "zoomed", "sizes"],
)
def test_depth_behind_one_another(left, right):
    """The epipole lies inside both images; away from it depth is right, and near it nothing is claimed."""
    result = swept(left, right)
    for side in ("left", "right"):
        found, relative, sigmas = errors_of(result, side)
        assert found[seen_by_other(result, side)].mean() > 0.5
        assert np.mean(relative < 0.01) > 0.75 and np.mean(relative < 0.05) > 0.98
        assert np.mean(sigmas < 2) > 0.98
        confidence = getattr(result, f"{side}_confidence")
        assert np.all((confidence >= 0.1) == found) and confidence.max() <= 1
        camera = result.rectification.camera(side)
        other = result.rectification.camera("right" if side == "left" else "left")
        direction = camera.R @ (other.center - camera.center)
        epipole = camera.K @ (direction / direction[2])
        y, x = np.mgrid[: camera.size[1], : camera.size[0]]
        distance = np.hypot(x - epipole[0], y - epipole[1])
        assert not found[distance < 0.03 * camera.focal_px].any()
        assert confidence[distance < 0.1 * camera.focal_px].max(initial=0) < 0.3


def test_gain_and_offset_change_little():
    """Correlation knows neither; clipping and rounding remain."""
    plain = swept(behind(), before())
    other = swept(behind(), before(), lambda image: cv2.convertScaleAbs(image, alpha=0.6, beta=30))
    both = np.isfinite(plain.left_disparity) & np.isfinite(other.left_disparity)
    assert both.mean() > 0.9 * np.isfinite(plain.left_disparity).mean()
    assert np.median(np.abs(plain.left_disparity - other.left_disparity)[both]) < 0.1


def test_pair_that_a_plane_would_stretch():
    """Side by side, swept all the same: the baseline's direction does not matter to a sweep."""
    left, right = camera_at([-0.6, -5, 1], CENTER), camera_at([0.6, -5, 1.2], CENTER, roll_deg=180)
    result = swept(left, right, options=RectifyOptions(max_stretch=1.01))
    for side in ("left", "right"):
        found, relative, _ = errors_of(result, side)
        assert found.mean() > 0.6 and np.mean(relative < 0.01) > 0.9


def test_textureless_images_match_nothing():
    left, right = behind(), before()
    rectification = rectified(left, right)
    flat = np.full((180, 320, 3), 128, np.uint8)
    result = sweep_pair(rectification, (left, right), (flat, flat), StereoOptions())
    assert np.isfinite(result.left_disparity).mean() < 0.02
    assert np.isfinite(result.left_confidence).all()


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_scale_of_the_world_changes_nothing(scale):
    left, right = behind(), before()
    images = render(left)[0], render(right)[0]
    results = []
    for factor in (1.0, scale):
        one, two = (dataclasses.replace(c, t=c.t * factor) for c in (left, right))
        depths = RANGE[0] * factor, RANGE[1] * factor
        rectification = rectify_pair(one, two, depths, depths, RectifyOptions())
        assert isinstance(rectification, Rectification)
        results.append(sweep_pair(rectification, (one, two), images, StereoOptions()).left_disparity)
    agree = np.isfinite(results[0]) == np.isfinite(results[1])
    assert agree.mean() > 0.999
    assert np.nanquantile(np.abs(results[0] - results[1]), 0.999) < 0.01


def test_image_of_another_size_is_refused():
    left, right = behind(), before()
    with pytest.raises(InputError, match="320x180.*got 10x20"):
        sweep_pair(
            rectified(left, right), (left, right), (np.zeros((20, 10, 3), np.uint8),) * 2, StereoOptions()
        )


def test_rows_of_a_swept_pair_are_not_matched():
    left, right = behind(), before()
    result = swept(left, right)
    images = render(left)[0], render(right)[0]
    options = StereoOptions()
    with pytest.raises(ValueError, match="sweep_pair"):
        match_pair(result.rectification, (left, right), images, make_matcher(options), options)


def test_warp_is_the_projection_of_the_plane():
    """Against Camera.project of the plane's points, sampled by OpenCV."""
    left, right = behind(), before(lens=LENS)
    image = cv2.cvtColor(render(right)[0], cv2.COLOR_RGB2GRAY).astype(np.float32)
    A, b = plane_motion(left, right)
    warped = np.empty((180, 320), np.float32)
    warp_by_plane(image, A, b, 1 / 6.0, *lens_of(right), warped)
    valid = np.isfinite(warped)
    pixels = np.stack(np.meshgrid(np.arange(320), np.arange(180)), axis=-1).astype(np.float64)
    there, _ = right.project(left.unproject(pixels, np.full((180, 320), 6.0)))
    there = there.astype(np.float32)
    expected = cv2.remap(image, there[..., 0], there[..., 1], cv2.INTER_LINEAR)
    inside = (there >= 0).all(axis=-1) & (there[..., 0] <= 319) & (there[..., 1] <= 179)
    assert valid.mean() > 0.3 and np.mean(valid == inside) > 0.99
    # OpenCV rounds positions to 1/32 px.
    assert np.abs(warped - expected)[valid & inside].max() < 4
    assert np.abs(warped - expected)[valid & inside].mean() < 0.3


def test_aggregation_against_the_definition():
    """All eight paths by plain recursion, L(p, d) = C + min(...) - min L."""
    rng = np.random.default_rng(1)
    cost = rng.integers(0, 60, (5, 7, 6)).astype(np.uint8)
    small, large = 5, 20
    expected = np.zeros(cost.shape, int)
    for dy, dx in [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]:
        path = np.zeros(cost.shape, int)
        rows = range(5) if dy <= 0 else range(4, -1, -1)
        columns = range(7) if dx <= 0 else range(6, -1, -1)
        for y in rows:
            for x in columns:
                before_y, before_x = y + dy, x + dx
                inside = 0 <= before_y < 5 and 0 <= before_x < 7
                last = path[before_y, before_x] if inside else np.zeros(6, int)
                for d in range(6):
                    steps = [last[d], last.min() + large]
                    steps += [last[e] + small for e in (d - 1, d + 1) if 0 <= e < 6]
                    path[y, x, d] = cost[y, x, d] + min(steps) - last.min()
        expected += path
    np.testing.assert_array_equal(aggregate(cost, small, large), expected)


def test_planes_of_a_slanted_surface_before_another():
    """A plane is fitted to its own surface: the step beside it does not bend it."""
    y, x = np.mgrid[:40, :40].astype(np.float32)
    disparity = 10 + 0.8 * y - 0.3 * x
    disparity[:, 25:] += 30
    disparity[5, 5] = np.nan
    planes = fit_planes(disparity.astype(np.float32))
    found = np.isfinite(planes).all(axis=-1)
    assert found[5:-5, 5:-5].mean() > 0.99 and not found[5, 5]
    np.testing.assert_allclose(planes[found][:, 1:], [[-0.3, 0.8]] * found.sum(), atol=1e-3)
    np.testing.assert_allclose(planes[found][:, 0], disparity[found], atol=1e-3)


def test_ground_is_not_pulled_into_steps():
    """Errors on the floor, far from facing the cameras, are a fraction of what it falls per row."""
    left, right = camera_at([-0.6, -5, 1], CENTER), camera_at([0.6, -5, 1.2], CENTER)
    result = swept(left, right, options=RectifyOptions(max_stretch=1.01))
    rectification = result.rectification
    truth = disparity_from_depth(rectification, render(rectification.camera("left"))[1])
    error = (result.left_disparity - truth)[140:]
    assert np.median(np.diff(truth[140:], axis=0)) > 0.9
    assert np.isfinite(error).mean() > 0.3
    assert np.nanmedian(np.abs(error)) < 0.3


def test_best_hypothesis_of_a_parabola():
    at = np.arange(9)
    total = np.stack([[np.rint(100 * (at - 3.3) ** 2), np.rint(100 * (at + 2.0) ** 2)]]).astype(np.int16)
    best = best_hypothesis(total)
    assert best[0, 0] == pytest.approx(3.3, abs=0.01) and np.isnan(best[0, 1])


def test_command_sweeps_and_fusion_reads_it(tmp_path):
    cameras = {"cam00": behind(), "cam01": before(size=(280, 200))}
    for name, camera in cameras.items():
        write_png(tmp_path / name / "000000.png", render(camera)[0])
        put_on_clock(tmp_path / name, name, tmp_path / f"{name}.json", 30, 1)
    tracks = {name: CameraTrack(name, (camera,), *RANGE) for name, camera in cameras.items()}
    write_json(tmp_path / "cameras.json", {"fps": 30, "num_frames": 1, "cameras": tracks_to_dict(tracks)})
    pair, output = tmp_path / "pair.npz", tmp_path / "disparity.npz"
    shared = ["--cameras", tmp_path / "cameras.json"]
    words = ["rectify", *shared, "--left", "cam00", "--right", "cam01", "--output", pair]
    assert run_stage(main, [str(w) for w in words]) == 0
    words = ["disparity", *shared, "--rectification", pair, "--frames", 0, "--output", output]
    words += ["--left-film", tmp_path / "cam00.json", "--right-film", tmp_path / "cam01.json"]
    assert run_stage(main, [str(w) for w in words]) == 0
    archive = Archive(output)
    assert archive.meta["kind"] == "sweep" and archive.meta["sigma_px"] == SWEEP_SIGMA_PX
    read = read_disparity_frame(archive, 0)
    direct = sweep_pair(
        rectify_pair(*cameras.values(), RANGE, RANGE, RectifyOptions()),
        tuple(cameras.values()),
        tuple(render(camera)[0] for camera in cameras.values()),
        StereoOptions(),
    )
    assert read.rectification.size_right == read.right_disparity.shape[::-1] != read.rectification.size
    assert np.nanmax(np.abs(read.left_disparity - direct.left_disparity)) <= 1 / 64 + 1e-6
    frame = read_pair_frame(archive, 0)
    assert frame.disparity_at_infinity == (0, 0)
    for side, i in (("left", 0), ("right", 1)):
        truth = render(read.rectification.camera(side))[1]
        disparity = getattr(frame, f"{side}_disparity")
        depth = 1 / (disparity * frame.inverse_depth_per_px[i])
        assert np.nanmedian(np.abs(depth / truth - 1)) < 0.01
