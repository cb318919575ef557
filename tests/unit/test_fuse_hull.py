"""Where stereo is silent, silhouettes give depth: fusion of both."""

import numpy as np
import pytest

from fourd.camera import Camera
from fourd.errors import InputError
from fourd.fuse import FusedView, FuseOptions, PairFrame, fuse_view
from fourd.fuse.options import HULL, NO_DEPTH, STEREO
from fourd.geometry import look_at

RADIUS = 0.5
RANGE = (1.0, 10.0)


def _camera(azimuth: float, size: tuple[int, int] = (64, 48)) -> Camera:
    center = 4 * np.array([np.sin(azimuth), 0.0, -np.cos(azimuth)])
    R, t = look_at(center, np.zeros(3), np.array([0.0, 1.0, 0.0]))
    K = np.array([[80.0, 0, (size[0] - 1) / 2], [0, 80.0, (size[1] - 1) / 2], [0, 0, 1]])
    return Camera(K, R, t, size)


def _sphere(camera: Camera) -> np.ndarray:
    """(H, W) uint8: 255 where the ray meets the sphere at the origin."""
    y, x = np.mgrid[: camera.size[1], : camera.size[0]].astype(np.float64)
    rays = camera.rays(np.stack([x, y], axis=-1)) @ camera.R
    along = -(rays @ camera.center) / (rays**2).sum(axis=-1)
    miss = np.linalg.norm(camera.center + rays * along[..., None], axis=-1)
    return np.where(miss < RADIUS, 255, 0).astype(np.uint8)


def _upper_half(camera: Camera) -> np.ndarray:
    """(H, W) float32 80 / z of the sphere's upper half, NaN elsewhere."""
    y, x = np.mgrid[: camera.size[1], : camera.size[0]].astype(np.float64)
    rays = camera.rays(np.stack([x, y], axis=-1)) @ camera.R
    a, b, c = (rays**2).sum(axis=-1), rays @ camera.center, camera.center @ camera.center - RADIUS**2
    inside = b * b - a * c
    z = (-b - np.sqrt(np.maximum(inside, 0))) / a
    return np.where((inside > 0) & (y < camera.size[1] / 2), 80 / z, np.nan).astype(np.float32)


def _pairs(cameras: dict[str, Camera]) -> list[PairFrame]:
    """Maps in the cameras' own axes, one pair of every two of them."""
    maps = {name: _upper_half(camera) for name, camera in cameras.items()}
    return [
        PairFrame(
            a, b, cameras[a].K, cameras[b].K, cameras[a].R, cameras[b].R,
            cameras[a].center, cameras[b].center,
            (0.0, 0.0), (1 / 80, 1 / 80), maps[a], maps[b], np.ones_like(maps[a]), np.ones_like(maps[b]), 0.3,
        )
        for i, a in enumerate(cameras)
        for b in list(cameras)[i + 1 :]
    ]  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> tuple[Camera, dict[str, Camera], dict[str, np.ndarray], dict[str, np.ndarray]]:
    cameras = {f"cam{i:02d}": _camera(a) for i, a in enumerate(np.linspace(-2.4, 2.4, 7))}
    images = {name: np.full((48, 64, 3), 90 + 10 * i, np.uint8) for i, name in enumerate(cameras)}
    return _camera(0.3), cameras, images, {name: _sphere(camera) for name, camera in cameras.items()}


def _fuse(scene: tuple, pairs: list, device: str = "cpu") -> FusedView:
    target, cameras, images, silhouettes = scene
    return fuse_view(
        target,
        pairs,
        images,
        cameras,
        FuseOptions(),
        silhouettes=silhouettes,
        depth_range=RANGE,
        device=device,
    )


def test_hull_fills_what_no_pair_sees_and_says_so(scene):
    view = _fuse(scene, [])
    expected = _sphere(scene[0]) > 0
    assert view.status == "ok" and view.num_points == 0
    assert (view.valid["consensus"] & expected).sum() > 0.95 * expected.sum()
    assert (view.depth_source == np.where(view.valid["consensus"], HULL, NO_DEPTH)).all()
    assert not view.support.any() and not view.valid["closest"].any()
    depth = view.depths["consensus"][view.valid["consensus"]]
    assert (np.abs(depth - 4) < RADIUS + 0.3).all()
    assert (view.rgb["consensus"][view.valid["consensus"]] >= 90).all()


@pytest.mark.parametrize("device", ["reference", "torch:cpu"])
def test_backends_colour_the_hull_alike(scene, device):
    expected, view = _fuse(scene, []), _fuse(scene, [], device)
    np.testing.assert_array_equal(view.rgb["consensus"], expected.rgb["consensus"])
    np.testing.assert_array_equal(view.source, expected.source)


def test_stereo_stays_where_it_has_a_consensus(scene):
    target, cameras, images, _ = scene
    pairs = _pairs({name: cameras[name] for name in ("cam02", "cam03", "cam04")})
    stereo = fuse_view(target, pairs, images, cameras, FuseOptions())
    both = _fuse(scene, pairs)
    kept = stereo.valid["consensus"]
    assert kept.any() and (both.depth_source[kept] == STEREO).all()
    np.testing.assert_array_equal(both.depths["consensus"][kept], stereo.depths["consensus"][kept])
    np.testing.assert_array_equal(both.rgb["consensus"][kept], stereo.rgb["consensus"][kept])
    added = ~kept & both.valid["consensus"]
    assert added.sum() > 100 and (both.depth_source[added] == HULL).all()
    assert not both.support[added & (stereo.support == 0)].any()
    np.testing.assert_array_equal(both.valid["closest"], stereo.valid["closest"])


def test_without_silhouettes_nothing_comes_from_a_hull(scene):
    target, cameras, images, _ = scene
    pairs = _pairs({name: cameras[name] for name in ("cam02", "cam03")})
    view = fuse_view(target, pairs, images, cameras, FuseOptions())
    expected = np.where(view.source == 255, NO_DEPTH, STEREO)
    np.testing.assert_array_equal(view.depth_source, expected)


def test_a_hull_needs_a_depth_range(scene):
    target, cameras, images, silhouettes = scene
    with pytest.raises(InputError, match="depth_range"):
        fuse_view(target, [], images, cameras, FuseOptions(), silhouettes=silhouettes)
