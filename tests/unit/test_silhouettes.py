"""Silhouettes: plate, segmentation under noise, gain and shadow, need, files and command line."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from fourd.camera import Camera, CameraTrack
from fourd.errors import InputError
from fourd.geometry import look_at
from fourd.ingest.__main__ import main as ingest
from fourd.io import Archive, ArchiveWriter, read_json, write_json, write_png
from fourd.sfm.cameras import SceneCameras, write_cameras
from fourd.silhouettes import SilhouetteOptions
from fourd.silhouettes.__main__ import main
from fourd.silhouettes.need import reason_against
from fourd.silhouettes.plate import estimate_plate, turned_plate
from fourd.silhouettes.segment import find_unrest, fit_gain, resolve_unknown, segment

SIZE = (96, 72)
OPTIONS = SilhouetteOptions()
BALL = (slice(20, 44), slice(30, 52))


def scene(seed: int = 0) -> np.ndarray:
    """(H, W, 3) float: a wall of smooth colours, edges and fine grain."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(60, 200, (10, 13, 3)).repeat(8, axis=0).repeat(8, axis=1)
    return coarse[: SIZE[1], : SIZE[0]] + rng.normal(0, 6, (SIZE[1], SIZE[0], 1))


def shoot(picture: np.ndarray, seed: int, noise: float = 2.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.clip(picture + rng.normal(0, noise, picture.shape), 0, 255).astype(np.uint8)


def with_ball(picture: np.ndarray, colour=(230.0, 30.0, 40.0), where=BALL) -> np.ndarray:
    changed = picture.copy()
    changed[where] = colour
    return changed


def empty_plate(count: int = 9):
    return estimate_plate([shoot(scene(), i) for i in range(count)], OPTIONS.jitter_px)


def overlap(mask: np.ndarray, where=BALL) -> float:
    """Intersection over union of what moves with a rectangle."""
    truth = np.zeros(mask.shape, bool)
    truth[where] = True
    return float((truth & (mask == 255)).sum() / (truth | (mask == 255)).sum())


def test_noise_does_not_move_and_a_ball_does() -> None:
    plate = empty_plate()
    assert plate.known.all()
    assert not segment(shoot(scene(), 50), plate, OPTIONS).any()
    mask = segment(shoot(with_ball(scene()), 51), plate, OPTIONS)
    assert overlap(mask) > 0.93
    assert set(np.unique(mask)) == {0, 255}


@pytest.mark.parametrize("gain", [(0.6, 0.6, 0.6), (1.2, 1.2, 1.2), (0.9, 1.0, 1.15)])
def test_exposure_and_white_balance_may_jump(gain: tuple[float, float, float]) -> None:
    picture = shoot(with_ball(scene()) * gain, 52)
    assert fit_gain(picture, empty_plate()) == pytest.approx(gain, rel=0.02)
    assert overlap(segment(picture, empty_plate(), OPTIONS)) > 0.9


def test_gain_of_a_picture_that_is_mostly_somebody_is_that_of_the_rest() -> None:
    large = (slice(0, 72), slice(0, 40))
    picture = shoot(with_ball(scene(), where=large) * 0.8, 53)
    assert fit_gain(picture, empty_plate()) == pytest.approx((0.8, 0.8, 0.8), rel=0.03)


def test_a_shadow_is_background_and_what_is_darker_is_not() -> None:
    shadow = (slice(50, 70), slice(10, 60))
    picture = with_ball(scene())
    picture[shadow] *= 0.75
    assert overlap(segment(shoot(picture, 54), empty_plate(), OPTIONS)) > 0.9
    picture[shadow] *= 0.3
    assert (segment(shoot(picture, 55), empty_plate(), OPTIONS)[shadow] == 255).mean() > 0.9


def test_camouflage_is_missed_in_the_measure_of_its_likeness() -> None:
    found = []
    for difference in (0.0, 10.0, 60.0):
        picture = scene()
        picture[BALL] += (difference, -difference, 0)
        found.append((segment(shoot(picture, 56), empty_plate(), OPTIONS)[BALL] == 255).mean())
    assert found[0] == 0 and found[2] > 0.9
    assert found[0] <= found[1] <= found[2]


def test_a_pixel_of_noise_and_a_hole_in_somebody_are_cleaned() -> None:
    picture = with_ball(scene())
    picture[60, 80] = (255, 0, 255)
    picture[30:32, 40:42] = scene()[30:32, 40:42]
    mask = segment(shoot(picture, 57), empty_plate(), SilhouetteOptions(min_area_share=0.002))
    assert mask[60, 80] == 0 and (mask[BALL] == 255).mean() > 0.97


@pytest.mark.parametrize("level", [0, 128, 255])
def test_constant_pictures_do_not_move(level: int) -> None:
    flat = np.full((SIZE[1], SIZE[0], 3), level, np.uint8)
    plate = estimate_plate([flat] * 3, OPTIONS.jitter_px)
    assert not segment(flat, plate, OPTIONS).any()


def test_somebody_who_seldom_leaves_makes_the_plate_unknown() -> None:
    colours = np.random.default_rng(1).uniform(0, 255, (9, 3))
    images = [shoot(with_ball(scene(), tuple(c)), i) for i, c in enumerate(colours)]
    plate = estimate_plate(images, OPTIONS.jitter_px)
    inside = (slice(21, 43), slice(31, 51))
    assert not plate.known[inside].any()
    assert plate.known[50:].all()
    assert (segment(images[0], plate, OPTIONS)[inside] == 128).all()
    unrest = find_unrest(images, plate, OPTIONS)
    assert (unrest[inside] == 1).all() and (unrest[50:] == 0).all()


def test_colours_of_what_surely_moves_resolve_the_unknown() -> None:
    # A red body stands in a place that is unknown, its red arm passes where the plate is known.
    body, arm, place = (
        (slice(24, 60), slice(30, 44)),
        (slice(28, 34), slice(50, 70)),
        (slice(20, 62), slice(26, 50)),
    )
    picture = np.full((SIZE[1], SIZE[0], 3), (60.0, 120.0, 90.0))
    picture[body] = picture[arm] = picture[28:34, 44:50] = (220.0, 40.0, 40.0)
    mask = np.zeros(SIZE[::-1], np.uint8)
    mask[place], mask[arm] = 128, 255
    unrest = np.where(mask == 128, 1, np.where(mask == 255, 0.2, 0)).astype(np.float32)
    image = shoot(picture, 58)
    resolved = resolve_unknown(image, mask, unrest, OPTIONS)
    assert (resolved[body] == 255).mean() > 0.97
    assert (resolved[48:60, 46:50] == 0).all()
    assert not (resolved == 128).any()
    assert resolved.tobytes() == resolve_unknown(image, mask, unrest, OPTIONS).tobytes()
    # With nothing that surely moves there is no colour to go by.
    silent = np.where(mask == 255, 0, mask).astype(np.uint8)
    assert np.array_equal(resolve_unknown(image, silent, unrest, OPTIONS), silent)


def panorama(camera: Camera) -> np.ndarray:
    """(H, W, 3) what is very far in every direction."""
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(float)
    ray = camera.rays(np.stack([x, y], -1)) @ camera.R
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    waves = np.sin(ray @ np.random.default_rng(2).normal(0, 9, (3, 8)))
    return 128 + 25 * waves @ np.random.default_rng(3).normal(size=(8, 3))


def test_a_camera_in_the_hand_gets_its_plate_from_other_frames() -> None:
    K = np.array([[100.0, 0, 47.5], [0, 100, 35.5], [0, 0, 1]])
    cameras = []
    for i in range(9):
        R, t = look_at(
            np.zeros(3), np.array([0.05 * np.sin(i), 0.04 * np.cos(2 * i), 1.0]), np.array([0, -1.0, 0])
        )
        cameras.append(Camera(K, R, t, SIZE))
    images = [shoot(panorama(c), i, 1.0) for i, c in enumerate(cameras)]
    for i in (0, 1):
        images[i][5:15, 60:75] = (250, 20, 20)
    plate = turned_plate(images, cameras, cameras[4], OPTIONS.jitter_px)
    assert plate.known[10:-10, 10:-10].mean() > 0.99
    assert np.median(np.abs(plate.rgb - panorama(cameras[4]))[10:-10, 10:-10]) < 2
    mask = segment(shoot(with_ball(panorama(cameras[4])), 60, 1.0), plate, OPTIONS)
    assert overlap(np.where(mask == 255, 255, 0)) > 0.9


def test_stereo_suffices_where_every_camera_has_matched_pairs() -> None:
    names = ["a", "b", "c"]
    matched = {("a", "b"): "ok", ("b", "c"): "ok", ("a", "c"): "ok"}
    assert reason_against(matched, names, OPTIONS) == "stereo suffices: 3 of 3 pairs are matched"
    refused = {**matched, ("a", "c"): "angle of 60 degrees"}
    assert reason_against(refused, names, OPTIONS) is None
    assert reason_against(refused, names, SilhouetteOptions(min_pairs=1)) == (
        "stereo suffices: 2 of 3 pairs are matched"
    )
    assert reason_against(matched, names, SilhouetteOptions(use="always")) is None
    assert reason_against(refused, names, SilhouetteOptions(use="never")) == (
        "not used: silhouettes use is never"
    )
    assert reason_against({}, ["a"], OPTIONS) == "one camera: a hull takes silhouettes of two, got 1"
    with pytest.raises(InputError, match="auto, always, never, got often"):
        reason_against({}, names, SilhouetteOptions(use="often"))


def write_film(folder: Path, name: str, pictures: list[np.ndarray]) -> Path:
    """A camera's film on the common clock: align/cameras/{cam}.json of a folder of images."""
    for i, picture in enumerate(pictures):
        write_png(folder / name / f"{i:06d}.png", picture)
    facts = folder / f"{name}.ingest.json"
    ingest(
        ["--camera", name, "--source", str(folder / name), "--fps", "30", "--output-json", str(facts),
         "--output-table", str(folder / f"{name}.csv")]
    )  # fmt: skip
    count = len(pictures)
    document = {
        "camera": name, "ingest": read_json(facts), "status": "ok", "fps": 30, "num_frames": count,
        "source_frame": list(range(count)), "dt_s": [0.0] * count,
    }  # fmt: skip
    write_json(folder / f"{name}.json", document)
    return folder / f"{name}.json"


def write_event(folder: Path, num_frames: int = 5) -> dict[str, Path]:
    """Two cameras whose pair is refused; cam01 sees a ball in two of its frames."""
    K = np.array([[100.0, 0, 47.5], [0, 100, 35.5], [0, 0, 1]])
    track = {
        n: CameraTrack(n, (Camera(K, np.eye(3), np.zeros(3), SIZE),), 1.0, 9.0) for n in ("cam01", "cam02")
    }
    scene_cameras = SceneCameras(
        30, num_frames, ("cam01", "cam02"), (), track, np.zeros(3), 1.0, np.array([0, -1.0, 0]),
        dict.fromkeys(track, "given"),
    )  # fmt: skip
    write_cameras(folder / "cameras.json", scene_cameras)
    with ArchiveWriter(folder / "pair.npz", {"left": "cam01", "right": "cam02", "status": "too wide"}):
        pass
    pictures = [shoot(with_ball(scene()) if i in (1, 3) else scene(), i) for i in range(num_frames)]
    film = write_film(folder, "cam01", pictures)
    return {"film": film, "cameras": folder / "cameras.json", "pair": folder / "pair.npz"}


def run_plate(files: dict[str, Path], output: Path, *more: str) -> Archive:
    need = output.with_name("need.json")
    main(
        ["need", "--cameras", str(files["cameras"]), "--rectification", str(files["pair"]),
         "--output", str(need)]
    )  # fmt: skip
    main(
        ["plate", "--film", str(files["film"]), "--cameras", str(files["cameras"]), "--need", str(need),
         "--output", str(output), *more]
    )  # fmt: skip
    return Archive(output)


def run_segment(files: dict[str, Path], plate: Path, output: Path) -> Archive:
    main(
        ["segment", "--plate", str(plate), "--film", str(files["film"]), "--cameras", str(files["cameras"]),
         "--frames", "1", "2", "--output", str(output)]
    )  # fmt: skip
    return Archive(output)


def test_command_line_from_film_to_masks(tmp_path: Path) -> None:
    files = write_event(tmp_path)
    assert run_plate(files, tmp_path / "plate.npz").meta["made_from"] == "own frames"
    masks = run_segment(files, tmp_path / "plate.npz", tmp_path / "masks.npz")
    assert (masks.meta["cameras"], masks.frames()) == ({"cam01": "ok"}, [1, 2])
    assert overlap(masks["000001/cam01"]) > 0.9
    assert not masks["000002/cam01"].any()
    run_segment(files, tmp_path / "plate.npz", tmp_path / "again.npz")
    assert (tmp_path / "masks.npz").read_bytes() == (tmp_path / "again.npz").read_bytes()


def test_film_of_the_empty_scene_is_the_plate(tmp_path: Path) -> None:
    files = write_event(tmp_path, num_frames=3)
    write_film(tmp_path, "empty", [shoot(scene(), 70 + i) for i in range(4)])
    flags = ("--background-film", str(tmp_path / "empty.ingest.json"))
    plate = run_plate(files, tmp_path / "plate.npz", *flags)
    assert plate.meta["made_from"] == "film of the empty scene" and "unrest" not in plate
    assert overlap(run_segment(files, tmp_path / "plate.npz", tmp_path / "m.npz")["000001/cam01"]) > 0.9
    write_film(tmp_path, "small", [shoot(scene(), 1)[:40] for _ in range(3)])
    flags = ("--background-film", str(tmp_path / "small.ingest.json"))
    with pytest.raises(InputError, match="at 96 x 72 like the camera's own, got 96 x 40"):
        run_plate(files, tmp_path / "plate.npz", *flags)


def test_reasons_are_carried_through_the_files(tmp_path: Path) -> None:
    files = write_event(tmp_path, num_frames=2)
    reason = "no background: a plate takes 3 pictures, got 2"
    assert run_plate(files, tmp_path / "plate.npz").meta["status"] == reason
    masks = run_segment(files, tmp_path / "plate.npz", tmp_path / "masks.npz")
    assert masks.meta["cameras"] == {"cam01": reason} and masks.frames() == []
    with ArchiveWriter(files["pair"], {"left": "cam01", "right": "cam02", "status": "ok"}):
        pass
    plate = run_plate(files, tmp_path / "plate.npz")
    assert plate.meta["status"] == "stereo suffices: 1 of 1 pairs are matched"


def test_a_camera_that_moves_has_no_plate_unless_asked_for(tmp_path: Path) -> None:
    """What never leaves its place in turned pictures would be taken for background and carve the hull."""
    files = write_event(tmp_path, num_frames=4)
    document = read_json(files["cameras"])
    frames = document["cameras"]["cam01"]["frames"]
    turned = [cv2.Rodrigues(np.array([0.0, 0.01 * i, 0.0]))[0].tolist() for i in range(4)]
    document["cameras"]["cam01"]["frames"] = [{**frames[0], "R": R} for R in turned]
    write_json(files["cameras"], document)
    assert run_plate(files, tmp_path / "plate.npz").meta["status"] == "no background: the camera moves"
    asked = run_plate(files, tmp_path / "plate.npz", "--use", "always")
    assert (asked.meta["status"], asked.frames()) == ("ok", [0, 1, 2, 3])
