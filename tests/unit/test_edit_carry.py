"""A mark through space and time, on a scene whose truth is known."""

import dataclasses
import functools

import cv2
import numpy as np
import pytest

from fourd.edit.carry import VOXEL_PX, Thing, carry_flow, carry_mark, find_frame, find_rest, splat_points
from fourd.edit.colours import learn_colours
from fourd.edit.moving import find_moving, project_ideal, sample_depth, world_points
from fourd.edit.outline import refine_outline
from fourd.edit.plate import is_no_plate, is_plate, plate_of
from fourd.edit.seeds import hints_of_hidden, hints_of_mark, merge_hints
from fourd.edit.single import follow_mask
from fourd.edit.spec import Mark
from fourd.edit.voxels import (
    MOVER,
    OBJECT,
    OTHER,
    UNKNOWN,
    MovingVoxels,
    distances_to,
    find_specks,
    find_strangers,
    find_strays,
    gather_voxels,
    is_one_thing,
    settle_labels,
    vote_labels,
)
from fourd.errors import InputError
from tests.unit import edit_scene as scene

GREEN, RED = 1, 2
load = functools.cache(scene.instant)
SIDE = VOXEL_PX * scene.MIDDLE_Z / 80


def iou(mask: np.ndarray, truth: np.ndarray) -> float:
    return float((mask & truth).sum() / max((mask | truth).sum(), 1))


def label(name: str, frame: int) -> np.ndarray:
    return scene.see(name, frame)[2]


@functools.cache
def carried(name: str, frame: int, number: int):
    mark = Mark(name, frame, "mask")
    hints = hints_of_mark(load(frame), mark, label(name, frame) == number, scene.camera(name), SIDE)
    return carry_mark(hints, frame, range(scene.NUM_FRAMES), load, SIDE)


def test_points_go_to_the_world_and_back() -> None:
    camera, depth = scene.camera("cam02"), scene.see("cam02", 3)[1]
    depth[5:9] = np.nan
    points, index = world_points(camera, depth)
    pixels, z = project_ideal(camera, points)
    assert len(points) == np.isfinite(depth).sum()
    assert np.allclose(pixels[:, 0] + pixels[:, 1].round() * scene.SIZE[0], index, atol=1e-6)
    assert np.allclose(sample_depth(camera, depth, points)[0], z)


def test_what_moves_is_told_from_what_stands_still() -> None:
    for name in scene.NAMES:
        instant, truth = load(3), label(name, 3)
        assert instant.moving[name][truth > 0].mean() > 0.95
        assert instant.moving[name][truth == 0].mean() < 0.01


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_moving_does_not_depend_on_the_scale_of_the_world(scale: float) -> None:
    def scaled(frame: int):
        camera, depth = scene.camera("cam01"), scene.see("cam01", frame)[1]
        return type(camera)(camera.K, camera.R, scale * camera.t, camera.size), (scale * depth).astype(
            np.float32
        )

    moving, _ = find_moving(*scaled(3), [scaled(t) for t in range(scene.NUM_FRAMES) if t != 3])
    expected, _ = find_moving(
        scene.camera("cam01"), scene.see("cam01", 3)[1],
        [(scene.camera("cam01"), scene.see("cam01", t)[1]) for t in range(scene.NUM_FRAMES) if t != 3],
    )  # fmt: skip
    assert (moving == expected).mean() > 0.999


@pytest.mark.parametrize(("name", "frame", "number"), [("cam01", 1, GREEN), ("cam00", 6, RED)])
def test_one_mark_reaches_all_cameras_and_frames(name: str, frame: int, number: int) -> None:
    found = carried(name, frame, number)
    scores = [
        iou(found[f].masks[cam], label(cam, f) == number)
        for f in range(scene.NUM_FRAMES)
        for cam in scene.NAMES
        if (label(cam, f) == number).sum() > 40
    ]
    assert np.mean(scores) > 0.85


def test_a_thing_that_is_wholly_hidden_is_found_again() -> None:
    sizes = {(cam, f): (label(cam, f) == GREEN).sum() for cam in scene.NAMES for f in range(scene.NUM_FRAMES)}
    hidden = [place for place, size in sizes.items() if size < 20]
    found = carried("cam01", 1, GREEN)
    assert hidden
    for cam, frame in hidden:
        assert found[frame].masks[cam][label(cam, frame) == RED].mean() < 0.1
    last = scene.NUM_FRAMES - 1
    assert np.mean([iou(found[last].masks[c], label(c, last) == GREEN) for c in scene.NAMES]) > 0.85


def test_all_else_that_moves_is_the_rest() -> None:
    rest = find_rest(load(1), carried("cam01", 1, GREEN)[1], SIDE)
    assert np.mean([iou(rest.masks[c], label(c, 1) == RED) for c in scene.NAMES]) > 0.85


def test_what_moves_behind_the_thing_is_found() -> None:
    found = carried("cam00", 6, RED)
    frame = next(
        f for f in range(scene.NUM_FRAMES) if hints_of_hidden(load(f), found[f], scene.camera("cam01"), SIDE)
    )
    hints = hints_of_hidden(load(frame), found[frame], scene.camera("cam01"), SIDE)
    assert hints is not None
    for cam in scene.NAMES:
        ours = hints[cam] == OBJECT
        assert (label(cam, frame)[ours] == GREEN).mean() > 0.9


def test_a_box_means_what_lies_mostly_inside() -> None:
    truth = label("cam01", 1)
    y, x = np.nonzero(truth == GREEN)
    mask = np.zeros(truth.shape, bool)
    mask[y.min() - 4 : y.max() + 5, max(x.min() - 4, 0) : x.max() + 5] = True
    mark = Mark("cam01", 1, "box", ((float(x.min()), float(y.min())), (float(x.max()), float(y.max()))))
    hints = hints_of_mark(load(1), mark, mask, scene.camera("cam01"), SIDE)
    assert (label("cam00", 1)[hints["cam00"] == OBJECT] == GREEN).mean() > 0.95


def test_a_box_over_two_things_means_one_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    both = np.ones(scene.SIZE[::-1], bool)
    hints = hints_of_mark(load(1), Mark("cam01", 1, "box"), both, scene.camera("cam01"), SIDE)
    assert len(np.unique(label("cam01", 1)[hints["cam01"] == OBJECT])) == 1
    assert "holds 2 things: the largest is meant" in caplog.text


def test_a_box_that_holds_nothing_does_not_count_what_it_touches(caplog: pytest.LogCaptureFixture) -> None:
    y, x = np.nonzero(label("cam01", 1) == GREEN)
    corner = np.zeros(scene.SIZE[::-1], bool)
    corner[y.min() : y.min() + 4, x.min() : x.min() + 4] = True
    hints = hints_of_mark(load(1), Mark("cam01", 1, "box"), corner, scene.camera("cam01"), SIDE)
    assert not any((hint == OBJECT).any() for hint in hints.values()) and "holds" not in caplog.text


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_ball_before_the_marked_thing_is_another_one_and_a_leg_is_not(scale: float) -> None:
    body, leg, ball = np.zeros((9, 3)), np.zeros((6, 3)), np.zeros((3, 3))
    body[:, 1], leg[:, 1], ball[:, 1] = np.arange(9), 13 + np.arange(6), np.arange(3)
    ball[:, 2] = -6
    centers = scale * np.concatenate([body, leg, ball])
    parts = np.repeat([0, 1, 2], [9, 6, 3])
    assert find_strangers(centers, parts, np.array([90.0, 60.0, 30.0])).tolist() == [False, False, True]


def test_what_was_marked_as_one_thing_stays_one() -> None:
    line = np.stack([np.arange(30.0), np.zeros(30), np.zeros(30)], axis=-1)
    leg, ball = line[:12] + (32, 0, 0), line[:3] + (0, 8, 0)
    assert not find_strays(line, 1.0).any() and not find_strays(line[:0], 1.0).any()
    assert find_strays(np.concatenate([line, leg, ball]), 1.0).sum() == len(ball)
    # A hand's length away is a hand.
    assert not find_strays(np.concatenate([line, ball - (0, 2, 0)]), 1.0).any()
    assert is_one_thing(np.concatenate([line, leg, ball[:1]]), 1.0)
    assert not is_one_thing(np.concatenate([line, ball]), 1.0)


def colours_of(number: int):
    """Colours of a figure against those of the other one."""
    masks = {cam: (label(cam, 1) == number, label(cam, 1) == GREEN + RED - number) for cam in scene.NAMES}
    return learn_colours(load(1).images, masks)


@pytest.mark.parametrize("is_one", [True, False])
def test_what_is_apart_again_is_given_back(is_one: bool) -> None:
    hints = {cam: np.where(label(cam, 1) > 0, OBJECT, OTHER).astype(np.uint8) for cam in scene.NAMES}
    thing = Thing(colours_of(GREEN), 1, is_one)
    nowhere = np.zeros((0, 3)), np.zeros((0, 3))
    found = find_frame(load(1), SIDE, hints, nowhere, thing)
    assert iou(found.masks["cam01"], label("cam01", 1) == GREEN if is_one else label("cam01", 1) > 0) > 0.9


def hidden(frame: int, numbers: tuple[int, ...]):
    """An instant in which some figures are not there."""
    instant = load(frame)
    moving = {cam: m & ~np.isin(label(cam, frame), numbers) for cam, m in instant.moving.items()}
    return dataclasses.replace(instant, moving=moving)


@pytest.mark.parametrize(("number", "other"), [(GREEN, RED), (RED, GREEN)])
def test_who_leaves_all_views_and_comes_back_is_found_again(number: int, other: int) -> None:
    """At frames 3 and 4 nobody is there, then both come at once."""
    hints = hints_of_mark(
        load(1), Mark("cam01", 1, "mask"), label("cam01", 1) == number, scene.camera("cam01"), SIDE
    )
    found = carry_mark(hints, 1, range(8), lambda f: hidden(f, (GREEN, RED) if f in (3, 4) else ()), SIDE)
    assert not any(mask.any() for f in (3, 4) for mask in found[f].masks.values())
    for cam in ("cam00", "cam01", "cam02"):
        assert iou(found[6].masks[cam], label(cam, 6) == number) > 0.8
    # And not if only the other one comes.
    alone = carry_mark(
        hints,
        1,
        range(8),
        lambda f: hidden(f, (GREEN, RED) if f in (3, 4) else (number,) if f > 4 else ()),
        SIDE,
    )
    assert not any(mask.any() for f in (5, 6, 7) for mask in alone[f].masks.values())


def test_noise_that_hangs_on_the_thing_is_no_other_thing() -> None:
    """A thing of 100 voxels, 3 others on it, 3 alone and 30 on its other end."""
    x = np.concatenate([np.arange(100.0), [49, 50, 51], [20, 21, 22], np.full(30, 98.5)])
    y = np.concatenate([np.zeros(100), [1, 1, 1], [9, 9, 9], 1 + np.arange(30)])
    points = np.stack([x, y, np.zeros(len(x))], axis=-1)
    labels = np.where(np.arange(len(x)) < 100, OBJECT, OTHER).astype(np.uint8)
    voxels = MovingVoxels(1.0, points, np.full(len(x), 5), {})
    assert np.flatnonzero(find_specks(voxels, labels, None)).tolist() == [100, 101, 102]
    assert find_specks(voxels, labels, (points[:100], points[103:])).sum() == 3
    # What was another thing before it touched this one stays so.
    assert not find_specks(voxels, labels, (points[:40], points[100:])).any()


def test_a_foot_of_the_grounds_own_colours_belongs_to_the_leg() -> None:
    """Its depth is the ground's, and it shows the ground's two colours where the other one should be."""
    checks = (np.indices((60, 60)) // 10).sum(axis=0) % 2 > 0
    plate = np.where(checks[..., None], (150, 80, 60), (90, 70, 110)).astype(np.uint8)
    image, truth, kind = plate.copy(), np.zeros((60, 60), bool), np.full((60, 60), OTHER, np.uint8)
    image[5:40, 20:30], kind[5:40, 20:30], truth[5:40, 20:30] = (30, 60, 160), OBJECT, True
    foot = np.zeros((60, 60), bool)
    foot[40:46, 20:40] = True
    image[foot] = np.where(checks[..., None], (90, 70, 110), (150, 80, 60)).astype(np.uint8)[foot]
    known = np.ones((60, 60), bool)
    mask = refine_outline(image, kind, kind == OBJECT, lambda window: (plate[window], known[window]))
    assert mask[foot].mean() > 0.6 and iou(mask, truth | foot) > 0.85


def test_the_rim_of_who_stands_before_the_thing_goes_by_colour() -> None:
    """The red one's depth is three pixels too wide: there the green one still shows."""
    image = np.random.default_rng(0).integers(60, 80, (60, 60, 3)).astype(np.uint8)
    plate = image.copy()
    image[10:50, 15:30] = image[10:50, 15:30] // 4 + np.array([0, 150, 0], np.uint8)
    image[10:50, 30:50] = image[10:50, 30:50] // 4 + np.array([150, 0, 0], np.uint8)
    kind = np.full((60, 60), OTHER, np.uint8)
    kind[10:50, 15:27], kind[10:50, 27:50] = OBJECT, MOVER
    known = np.ones((60, 60), bool)
    mask = refine_outline(image, kind, kind == OBJECT, lambda window: (plate[window], known[window]))
    truth = np.zeros((60, 60), bool)
    truth[10:50, 15:30] = True
    assert iou(kind == OBJECT, truth) < 0.85 < 0.97 < iou(mask, truth)


def test_a_mark_on_a_view_without_a_film_means_the_same() -> None:
    truth = label("cam01", 1) == GREEN
    direct = hints_of_mark(load(1), Mark("cam01", 1, "mask"), truth, scene.camera("cam01"), SIDE)
    virtual = hints_of_mark(load(1), Mark("hold_view", 1, "mask"), truth, scene.camera("cam01"), SIDE)
    told = (direct["cam02"] != UNKNOWN) & (virtual["cam02"] != UNKNOWN)
    assert told.sum() > 100 and (direct["cam02"] == virtual["cam02"])[told].mean() > 0.97


def test_marks_on_the_background_or_on_a_hole_are_refused() -> None:
    wall = np.zeros(scene.SIZE[::-1], bool)
    wall[:8, :8] = True
    with pytest.raises(InputError, match="lies on the background: 0 % of it move"):
        hints_of_mark(load(1), Mark("cam01", 1, "mask"), wall, scene.camera("cam01"), SIDE)
    instant = scene.instant(1)
    instant.depths["cam01"][:8, :8] = np.nan
    with pytest.raises(InputError, match="lies on a hole: 100 % of it have no depth"):
        hints_of_mark(instant, Mark("cam01", 1, "mask"), wall, scene.camera("cam01"), SIDE)


def test_a_mark_that_is_larger_than_the_thing_is_said(caplog: pytest.LogCaptureFixture) -> None:
    hints_of_mark(
        load(1), Mark("cam01", 1, "box"), np.ones(scene.SIZE[::-1], bool), scene.camera("cam01"), SIDE
    )
    assert "larger than the thing" in caplog.text


def test_a_mark_of_what_is_not_part_takes_pixels_away() -> None:
    truth = label("cam01", 1)
    ours = (
        Mark("cam01", 1, "mask"),
        hints_of_mark(load(1), Mark("cam01", 1, "mask"), truth > 0, scene.camera("cam01"), SIDE),
    )
    no = Mark("cam01", 1, "mask", is_part=False)
    merged = merge_hints([ours, (no, hints_of_mark(load(1), no, truth == RED, scene.camera("cam01"), SIDE))])
    assert (label("cam01", 1)[merged["cam01"] == OBJECT] == GREEN).all()


def test_voxels_go_with_the_majority_of_cameras_and_with_what_they_touch() -> None:
    line = np.stack([np.linspace(0, 3, 400), np.zeros(400), np.zeros(400)], axis=-1)
    points = {name: (line, np.arange(400)) for name in scene.NAMES}
    voxels = gather_voxels(points, dict.fromkeys(scene.NAMES, (20, 20)), 0.1)
    yes, no = np.full((20, 20), OBJECT, np.uint8), np.full((20, 20), OTHER, np.uint8)
    assert (vote_labels(voxels, dict(zip(scene.NAMES, (yes, yes, no), strict=True))) == OBJECT).all()
    half = np.full((20, 20), UNKNOWN, np.uint8)
    half.ravel()[:100], half.ravel()[300:] = OBJECT, OTHER
    labels = settle_labels(voxels, vote_labels(voxels, {"cam00": half}))
    assert (labels[voxels.centers[:, 0] < 1.3] == OBJECT).all() and (
        labels[voxels.centers[:, 0] > 1.7] == OTHER
    ).all()


def test_distances_are_infinite_without_targets() -> None:
    assert np.isinf(distances_to(np.zeros((3, 3)), np.zeros((0, 3)), 1.0)).all()


def test_splats_keep_the_nearest() -> None:
    camera = scene.camera("cam01")
    z = splat_points(camera, np.array([[0, 0, 5.0], [0, 0, 3.0], [0, 0, -2.0]]), 0.05)
    assert np.isfinite(z).sum() > 0 and z[np.isfinite(z)].max() == np.float32(3.0)


def test_plate_is_the_wall_behind_what_moves() -> None:
    window = slice(0, 64), slice(0, 96)
    rgb, known, depth = plate_of(scene.camera("cam01"), window, (2.0, 100.0), load(3).still["cam01"])
    empty = scene.see("cam01", 3, without=(GREEN, RED))[0]
    assert known.mean() > 0.95
    assert np.abs(rgb[known].astype(int) - empty[known]).mean() < 1
    assert np.allclose(depth[known], scene.WALL_Z)
    same = is_plate(scene.see("cam01", 3)[0], rgb)
    assert same[label("cam01", 3) == 0].mean() > 0.9 and same[label("cam01", 3) > 0].mean() < 0.1
    assert is_plate((0.6 * empty).astype(np.uint8), empty).mean() > 0.99
    other = is_no_plate(scene.see("cam01", 3)[0], rgb)
    assert other[label("cam01", 3) > 0].mean() > 0.9 and other[label("cam01", 3) == 0].mean() < 0.05
    assert not is_no_plate((0.6 * np.roll(empty, 1, axis=1)).astype(np.uint8), empty)[:, 2:].any()
    assert not is_plate(np.roll(empty, 1, axis=1), empty).all()


def shifted(num_frames: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pictures of a red square that moves by 2 px a frame over a textured ground, and where it is."""
    rng = np.random.default_rng(0)
    ground, square = (
        cv2.GaussianBlur(rng.uniform(0, 255, (80, 120)).astype(np.float32), (0, 0), 1.5) * 1.5
        for _ in range(2)
    )
    frames = []
    for frame in range(num_frames):
        mask = np.zeros((80, 120), bool)
        mask[25:55, 20 + 2 * frame : 50 + 2 * frame] = True
        image = np.repeat(np.clip(ground - 60, 0, 255)[..., None], 3, axis=2)
        moved = np.roll(square, 2 * frame, axis=1)
        image[mask] = np.stack([np.clip(moved + 60, 0, 255), moved / 4, moved / 4], axis=-1)[mask]
        frames.append((image.astype(np.uint8), mask))
    return frames


def test_flow_carries_a_mask_and_knows_where_it_does_not() -> None:
    (before, mask), (now, truth) = shifted(2)
    result = carry_flow(now, before, mask.astype(np.uint8))
    told = result != UNKNOWN
    assert told.mean() > 0.8
    assert iou(result[told] == OBJECT, truth[told]) > 0.85


def test_one_film_alone_is_followed() -> None:
    frames = shifted(12)
    masks = follow_mask([image for image, _ in frames], frames[0][1])
    assert (masks[0] == frames[0][1]).all() and len(masks) == 12
    assert min(iou(mask, truth) for mask, (_, truth) in zip(masks, frames, strict=True)) > 0.85
