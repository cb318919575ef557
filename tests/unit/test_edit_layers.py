"""What is taken out, what appears, and where it came from."""

import cv2
import numpy as np
import pytest
import torch

from fourd.camera import Camera
from fourd.edit import compose, insert, shadows
from fourd.edit.compose import Canvas, soften
from fourd.edit.layers import LayeredPairs, rectify_mask
from fourd.edit.network import load_network
from fourd.edit.origin import find_origin
from fourd.edit.voxels import OBJECT, OTHER, UNKNOWN
from fourd.errors import InputError
from fourd.fuse.options import FuseOptions
from fourd.fuse.view import fuse_view
from tests.unit import edit_scene as scene

GREEN, RED = 1, 2


def test_masks_follow_a_rectifying_rotation() -> None:
    camera = scene.camera("cam01")
    mask = np.zeros((64, 96), np.uint8)
    mask[20:40, 30:60] = 1
    assert (rectify_mask(mask, camera, (64, 96), camera.K, camera.R) == (mask > 0)).all()
    turn, _ = cv2.Rodrigues(np.array([0.02, -0.05, 0.03]))
    turned = rectify_mask(mask, camera, (64, 96), camera.K, turn @ camera.R)
    rays = camera.rays(np.array([[45.0, 30.0], [10.0, 30.0]])) @ turn.T
    pixels = np.rint(camera.pixels_from_normalized(rays[:, :2] / rays[:, 2:])).astype(int)
    assert turned[pixels[0, 1], pixels[0, 0]] and not turned[pixels[1, 1], pixels[1, 0]]


def fused(frame: int, masks: dict | None, is_kept: bool = False):
    """The view of cam01 from the true disparities of the other two."""
    pairs = [scene.pair_frame("cam00", "cam02", frame)]
    cameras = {name: scene.camera(name) for name in ("cam00", "cam02")}
    images = {name: scene.see(name, frame)[0] for name in cameras}
    layered = pairs if masks is None else LayeredPairs(pairs, masks, cameras, is_kept)
    return fuse_view(
        scene.camera("cam01"), layered, images, cameras, FuseOptions(min_pairs=1), ("consensus",)
    )


def test_without_marked_samples_the_next_surface_appears() -> None:
    frame = 3
    masks = {name: scene.see(name, frame)[2] == RED for name in ("cam00", "cam02")}
    truth = scene.see("cam01", frame, without=(RED,))[1]
    behind = (scene.see("cam01", frame)[2] == RED) & (truth < scene.WALL_Z)
    result = fused(frame, masks)
    shown = result.valid["consensus"] & behind
    assert shown.sum() > 20
    assert np.allclose(result.depths["consensus"][shown], scene.MIDDLE_Z, rtol=0.02)
    assert not (result.depths["consensus"] < 0.9 * scene.MIDDLE_Z).any()


def test_kept_samples_are_the_thing_alone() -> None:
    masks = {name: scene.see(name, 3)[2] == RED for name in ("cam00", "cam02")}
    result = fused(3, masks, is_kept=True)
    valid = result.valid["consensus"]
    assert valid.any() and np.allclose(result.depths["consensus"][valid], scene.NEAR_Z, rtol=0.02)


def test_without_marks_fusion_is_what_it_was() -> None:
    plain, layered = fused(2, None), fused(2, {})
    for name in ("rgb", "valid", "depths"):
        assert np.array_equal(
            getattr(plain, name)["consensus"], getattr(layered, name)["consensus"], equal_nan=name == "depths"
        )


def test_soft_edges_are_1_inside_and_0_far_away() -> None:
    mask = np.zeros((40, 40), bool)
    mask[15:25, 15:25] = True
    opacity = soften(mask, 1.5, 1.0)
    assert opacity[16:24, 16:24].min() > 0.97 and opacity[0:8].max() == 0
    assert 0 < opacity[13, 20] < opacity[14, 20] <= 1
    assert soften(np.zeros((4, 4), bool), 1.5, 1.0).max() == 0


def test_an_untouched_frame_stays_to_the_bit() -> None:
    image = scene.see("cam01", 1)[0]
    canvas = Canvas.of(image)
    canvas.lay(Canvas.of(255 - image), np.zeros(image.shape[:2], np.float32))
    assert (canvas.picture() == image).all() and (canvas.provenance()[..., 0] == compose.UNTOUCHED).all()


def test_provenance_prefers_the_same_time_and_names_what_nobody_saw() -> None:
    shape = (8, 8)
    composed, far = np.full((*shape, 3), 100, np.uint8), np.full(shape, 10.0, np.float32)
    valid, has_origin = np.zeros(shape, bool), np.zeros(shape, bool)
    valid[:, :3], has_origin[:, :6] = True, True
    layer = compose.without_thing(
        composed,
        (np.full(shape, 4.0, np.float32), valid, np.full(shape, 2, np.uint8)),
        (np.zeros((*shape, 3), np.uint8), np.zeros(shape, bool), far),
        (has_origin, np.full(shape, 1, np.uint8), np.full(shape, 5, np.uint8)),
        7,
    )
    assert layer.provenance()[0, 0].tolist() == [compose.SAME_TIME, 2, 7]
    assert layer.provenance()[0, 4].tolist() == [compose.OTHER_TIME, 1, 5]
    assert layer.provenance()[0, 7].tolist() == [compose.INFERRED, compose.NOBODY, compose.NOBODY]


def test_origin_is_the_camera_that_saw_the_wall_from_the_nearest_angle() -> None:
    wall = np.full(scene.SIZE[::-1], scene.WALL_Z, np.float32)
    sights = [(i, 0, scene.camera(n), scene.see(n, 3)[1]) for i, n in enumerate(scene.NAMES)]
    wanted = scene.see("cam01", 3)[2] == RED
    seen, who, when = find_origin(scene.camera("cam01"), wall, wanted, sights)
    assert not seen[~wanted].any() and set(np.unique(who[seen])) <= {0, 2} and (when[seen] == 0).all()


def test_light_is_found_from_shadows_and_shadows_from_the_light() -> None:
    rng = np.random.default_rng(3)
    light = np.array([0.4, -0.3, 0.85]) / np.linalg.norm([0.4, -0.3, 0.85])
    thing = rng.uniform([-0.2, -0.2, 0.3], [0.2, 0.2, 1.6], (900, 3))
    other = thing + [2.5, 0.5, 0]
    ground = np.stack([*np.meshgrid(np.linspace(-3, 4, 90), np.linspace(-2, 3, 60))], axis=-1).reshape(-1, 2)
    ground = np.concatenate([ground, np.zeros((len(ground), 1))], axis=1)
    up = np.array([0, 0, 1.0])
    ours, theirs = (shadows._covered(p, ground, light) < 0.06 for p in (thing, other))
    dark = ours | theirs
    moment = np.concatenate([thing, other]), ground[dark], ground[~dark]
    found = shadows.find_light([moment, (thing[:3], ground[dark], ground[~dark])], up, 0.06)
    assert found is not None and found @ light > np.cos(np.radians(4))
    mine = shadows.shadow_of(thing, other, ground[dark], found, 0.06)
    assert (mine == ours[dark]).mean() > 0.95
    assert shadows.find_light([(thing, ground[:10], ground)], up, 0.06) is None
    assert shadows.find_light([], up, 0.06) is None


def test_moments_of_one_light_agree_on_it() -> None:
    """A pole that stands in its own shadow's plane: one moment leaves the height of the sun open."""
    light, up = np.array([0.6, 0, 0.8]), np.array([0, 0, 1.0])
    ground = np.stack([*np.meshgrid(np.linspace(-2, 3, 90), np.linspace(-2, 3, 60))], axis=-1).reshape(-1, 2)
    ground = np.concatenate([ground, np.zeros((len(ground), 1))], axis=1)
    moments = []
    for y, height in ((0.0, 1.6), (1.0, 0.9)):
        pole = np.stack([np.zeros(200), np.full(200, y), np.linspace(0.1, height, 200)], axis=-1)
        dark = shadows._covered(pole, ground, light) < 0.08
        moments.append((pole, ground[dark], ground[~dark]))
    found = shadows.find_light(moments, up, 0.08)
    assert found is not None and found @ light > np.cos(np.radians(4))


def test_a_shadow_gets_its_light_back_and_keeps_the_details() -> None:
    rng = np.random.default_rng(5)
    plate = np.full((40, 60, 3), (160, 140, 110), np.uint8)
    grain = rng.normal(1, 0.04, (40, 60, 1))
    lit = plate * grain
    dark = lit.copy()
    dark[10:30, 15:45] *= 0.55
    opacity = np.zeros((40, 60), np.float32)
    opacity[8:32, 13:47] = 1
    relit = shadows.relight(dark.astype(np.float32), plate, opacity)
    inner = (slice(14, 26), slice(19, 41))
    assert np.abs(relit[inner] / lit[inner] - 1).mean() < 0.02
    assert np.corrcoef(relit[inner].ravel(), lit[inner].ravel())[0, 1] > 0.95
    assert (relit[opacity == 0] == np.clip(dark[opacity == 0].astype(np.float32), 0, 255)).all()
    # The ground is not darkened, whatever the plate says.
    assert (shadows.relight(dark.astype(np.float32), plate // 2, opacity) >= dark - 1e-3).all()


def test_darker_places_of_the_plate_are_dark() -> None:
    plate = np.full((20, 30, 3), (150, 140, 120), np.uint8)
    image = plate.copy()
    image[5:15, 5:15] = plate[0, 0] * 0.6
    image[5:15, 20:28] = (40, 180, 60)
    dark = shadows.find_dark(image, plate, np.ones((20, 30), bool))
    assert dark[7:13, 7:13].all() and not dark[7:13, 22:26].any() and not dark[:3].any()


def upright() -> tuple[Camera, np.ndarray]:
    return scene.camera("cam01"), np.array([0, -1.0, 0])


def test_an_inserted_picture_fills_its_box_and_is_hidden_by_what_is_nearer() -> None:
    camera, up = upright()
    box = ((30.0, 10.0), (50.0, 50.0))
    place = insert.place_in_box(box, camera, np.full((64, 96), 5.0, np.float32), "the box")
    picture = np.zeros((40, 20, 4), np.uint8)
    picture[...] = (10, 200, 30, 255)
    rgb, opacity, z = insert.draw_picture(picture, place, camera, up)
    y, x = np.nonzero(opacity > 0.5)
    assert (x.min(), x.max()) == pytest.approx((30, 50), abs=1.5) and (y.min(), y.max()) == pytest.approx(
        (10, 50), abs=1.5
    )
    assert z[30, 40] == pytest.approx(5.0, rel=0.01) and (rgb[30, 40] == (10, 200, 30)).all()


def test_an_inserted_picture_needs_ground_and_transparency(tmp_path) -> None:
    with pytest.raises(InputError, match="a surface to stand on"):
        insert.place_in_box(((1.0, 1.0), (5.0, 5.0)), upright()[0], np.full((64, 96), np.inf), "the box")
    cv2.imwrite(str(tmp_path / "opaque.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match="expected an 8-bit RGBA PNG"):
        insert.read_pictures(str(tmp_path / "opaque.png"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="found none"):
        insert.read_pictures(str(tmp_path / "empty"))


class Copy(torch.nn.Module):
    """The mask of the frame before, as it is."""

    def forward(self, image: torch.Tensor, before: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return mask + 0 * image[:, :1] + 0 * before[:, :1]


class Half(torch.nn.Module):
    def forward(self, image: torch.Tensor, before: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        return mask[:, :, ::2]


def test_a_network_of_the_user_carries_masks(tmp_path) -> None:
    torch.jit.script(Copy()).save(str(tmp_path / "copy.pt"))
    carry = load_network(tmp_path / "copy.pt")
    mask = np.full((6, 8), OTHER, np.uint8)
    mask[2:4, 2:5], mask[0, 0] = OBJECT, UNKNOWN
    image = np.zeros((6, 8, 3), np.uint8)
    assert (carry(image, image, mask) == np.where(mask == OBJECT, OBJECT, OTHER)).all()


def test_a_file_that_is_no_such_network_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="found nothing"):
        load_network(tmp_path / "none.pt")
    (tmp_path / "text.pt").write_text("no network")
    with pytest.raises(InputError, match="torch cannot load"):
        load_network(tmp_path / "text.pt")
    torch.jit.script(Half()).save(str(tmp_path / "half.pt"))
    image = np.zeros((6, 8, 3), np.uint8)
    with pytest.raises(InputError, match="to give \\(1, 1, 6, 8\\), got \\(1, 1, 3, 8\\)"):
        load_network(tmp_path / "half.pt")(image, image, np.zeros((6, 8), np.uint8))
