from pathlib import Path

import cv2
import numpy as np
import pytest

from fourd.ingest.flags import (
    SAMPLE_STEP,
    find_gaps,
    find_repeats,
    is_constant_picture,
    measure_changes,
    words_by_frame,
)
from fourd.video import VideoReader, probe_video
from tests.unit.film_files import constant_ticks, write_video

SIZE = (320, 192)
NUM_FRAMES = 60


def texture() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (400, 520), dtype=np.uint8)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.0), None, 20, 235, cv2.NORM_MINMAX)


def take_picture(index: int, is_handheld: bool, noise: float, person_x: float | None) -> np.ndarray:
    """What a camera sees: a wall that the hand shakes, a disc that walks by, noise of the sensor."""
    x, y = (5 * np.sin(0.35 * index) + 0.3 * index, 3 * np.cos(0.23 * index)) if is_handheld else (0.0, 0.0)
    shift = np.array([[1, 0, -60 - x], [0, 1, -60 - y]], dtype=np.float32)
    picture = cv2.warpAffine(texture(), shift, SIZE)
    if person_x is not None:
        cv2.circle(picture, (round(person_x), 90), 12, 230, -1)
    noisy = picture + np.random.default_rng(index).normal(0, noise, picture.shape)
    return np.repeat(np.clip(noisy, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def take_film(repeated: set[int], is_handheld: bool = True, noise: float = 2.0, person: str = "walks"):
    pictures = []
    for index in range(NUM_FRAMES):
        if index in repeated:
            pictures.append(pictures[-1])
            continue
        walked = {"walks": index, "stops": min(index, 20) + max(index - 35, 0), "absent": 0}[person]
        pictures.append(
            take_picture(index, is_handheld, noise, None if person == "absent" else 30 + 4 * walked)
        )
    return pictures


def changes_of(path: Path, pictures: list[np.ndarray], crf: int) -> tuple[np.ndarray, np.ndarray, float]:
    ticks = constant_ticks(len(pictures))
    write_video(path, ticks, size=SIZE, gop=30, options={"crf": str(crf)}, pictures=pictures)
    info = probe_video(path)
    with VideoReader(path, info) as reader:
        return measure_changes(reader.read_luma(i, SAMPLE_STEP) for i in range(len(info.pts_s)))


@pytest.mark.parametrize("crf", [16, 23, 30])
@pytest.mark.parametrize(
    "repeated",
    [{13, 40, 41}, set(range(5, 60, 5)), set(range(1, 60, 2))],
    ids=["lost", "24 in 30", "15 in 30"],
)
def test_repeated_pictures_of_a_hand_held_film_are_found(tmp_path, repeated, crf):
    mean, worst, lasting = changes_of(tmp_path / "a.mp4", take_film(repeated), crf)
    duplicate, still = find_repeats(mean, worst)
    assert still == [] and set(duplicate) <= repeated
    assert len(duplicate) >= 0.9 * len(repeated)
    assert not is_constant_picture(lasting)


@pytest.mark.parametrize("crf", [16, 23, 30])
@pytest.mark.parametrize("person", ["walks", "stops", "absent"])
def test_a_tripod_in_a_quiet_room_repeats_nothing(tmp_path, person, crf):
    mean, worst, lasting = changes_of(tmp_path / "a.mp4", take_film(set(), False, person=person), crf)
    duplicate, still = find_repeats(mean, worst)
    assert duplicate == []
    assert set(still) <= (set(range(20, 37)) if person == "stops" else set())
    assert is_constant_picture(lasting) == (person == "absent")


def test_a_frozen_camera_is_still_not_a_duplicate(tmp_path):
    frozen = set(range(25, 45))
    mean, worst, _ = changes_of(tmp_path / "a.mp4", take_film(frozen), 20)
    duplicate, still = find_repeats(mean, worst)
    assert duplicate == [] and set(still) == frozen


def test_a_covered_lens_is_constant_whatever_its_noise(tmp_path):
    dark = [
        np.clip(np.random.default_rng(i).normal(6, 3, (192, 320, 3)), 0, 255).astype(np.uint8)
        for i in range(20)
    ]
    mean, worst, lasting = changes_of(tmp_path / "a.mp4", dark, 18)
    assert is_constant_picture(lasting) and find_repeats(mean, worst) == ([], [])


def test_measures_are_those_of_plain_sums():
    samples = [np.zeros((16, 16), np.float32), np.zeros((16, 16), np.float32)]
    samples[1][:8, 8:] = 4
    mean, worst, lasting = measure_changes(iter(samples))
    assert (mean.tolist(), worst.tolist(), lasting) == ([1.0], [4.0], 4.0)
    # A remainder belongs to the last block, and a picture may be smaller than one.
    odd = [np.zeros((5, 17), np.float32), np.ones((5, 17), np.float32)]
    assert measure_changes(odd) == (np.array([1.0]), np.array([1.0]), 1.0)
    nothing = measure_changes([samples[0]])
    assert (len(nothing[0]), len(nothing[1]), nothing[2]) == (0, 0, 0.0)
    assert find_repeats(*nothing[:2]) == ([], [])


@pytest.mark.parametrize("fps", [24, 30000 / 1001, 60, 240])
def test_missing_frames_and_pauses_are_found(fps):
    pts_s = np.delete(np.arange(200) / fps, [20, 77, 78])
    pts_s[120:] += 0.8
    dropped, paused = find_gaps(pts_s, fps)
    assert (dropped, paused) == ([20, 76], [120])
    assert find_gaps(np.arange(100) / fps, fps) == ([], [])
    assert find_gaps(np.zeros(1), 1.0) == ([], [])


def test_a_rate_that_falls_slowly_loses_nothing():
    pts_s = np.cumsum(1 / np.linspace(30, 12, 120))
    assert find_gaps(pts_s, 30.0) == ([], [])


def test_rounded_and_shaken_times_lose_nothing():
    pts_s = np.round(np.arange(100) / 60, 3) + np.random.default_rng(0).uniform(-0.002, 0.002, 100)
    assert find_gaps(pts_s, 60.0) == ([], [])


def test_words_stand_beside_their_frames():
    assert words_by_frame({"duplicate": [1], "dropped_before": [1, 2]}, 4) == [
        "",
        "duplicate dropped_before",
        "dropped_before",
        "",
    ]
