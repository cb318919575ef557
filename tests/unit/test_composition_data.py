import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd.composition import data
from fourd.composition.model import TEST_STREAMS
from fourd.errors import InputError
from fourd.io import ArchiveWriter

HEIGHT, WIDTH = 24, 32


def solid(value, height=HEIGHT, width=WIDTH):
    return np.full((height, width, 3), value, np.uint8), np.ones((height, width), bool)


def write_archives(folder, cam, frames, same_as=None, keys=("consensus", "closest", "median", "farthest")):
    foreground, background = folder / f"foreground/{cam}/a.npz", folder / f"background/{cam}/a.npz"
    with ArchiveWriter(foreground, {"view": cam}) as writer:
        for frame in frames:
            for i, key in enumerate(keys):
                rgb, valid = solid(10 * frame + i)
                writer.add_frame(frame, **{f"{key}_rgb": rgb, f"{key}_valid": valid})
    with ArchiveWriter(background, {"view": cam, "same_as": same_as or {}}) as writer:
        for frame in frames:
            if str(frame) not in (same_as or {}):
                for i, key in enumerate(("farthest", "median")):
                    rgb, valid = solid(100 + 10 * frame + i)
                    writer.add_frame(frame, **{f"{key}_rgb": rgb, f"{key}_valid": valid})
    return foreground, background


def read_target(cam, frame):
    return solid(200 + frame)


def test_reduction_averages_valid_colours_only():
    rgb = np.zeros((2, 4, 3), np.uint8)
    valid = np.array([[True, True, True, False], [True, True, False, False]])
    rgb[:, :2] = [[[10] * 3, [20] * 3], [[30] * 3, [41] * 3]]
    rgb[:, 2:] = 255
    rgb[0, 2] = 8
    image = data.reduce_image(rgb, valid, 2)
    assert image.shape == (1, 2, 4)
    # (10 + 20 + 30 + 41) / 4 = 25.25; one valid pixel of four is too few.
    assert image[0, 0].tolist() == [25, 25, 25, 255]
    assert image[0, 1].tolist() == [0, 0, 0, 0]
    valid[1, 2], rgb[1, 2] = True, 9
    # 8.5 rounds up.
    assert data.reduce_image(rgb, valid, 2)[0, 1].tolist() == [9, 9, 9, 255]


def test_reduction_of_odd_sizes_counts_only_what_is_inside():
    rgb, valid = solid(70, 5, 7)
    image = data.reduce_image(rgb, valid, 4)
    assert image.shape == (2, 2, 4)
    assert (image == [70, 70, 70, 255]).all()


@given(seed=st.integers(0, 1000), factor=st.sampled_from([1, 2, 4]))
@settings(max_examples=25, deadline=None)
def test_reduction_stays_between_the_valid_colours(seed, factor):
    rng = np.random.default_rng(seed)
    rgb = rng.integers(50, 100, (9, 13, 3)).astype(np.uint8)
    valid = rng.random((9, 13)) < 0.6
    image = data.reduce_image(np.where(valid[..., None], rgb, 255), valid, factor)
    keep = image[..., 3] > 0
    assert ((image[keep, :3] >= 50) & (image[keep, :3] < 100)).all()
    assert (image[~keep] == 0).all()
    assert (factor > 1) or np.array_equal(keep, valid)


def test_levels_halve_the_size():
    assert [data.reduction_factor(level, 3) for level in range(3)] == [4, 2, 1]
    with pytest.raises(InputError, match="level"):
        data.reduction_factor(3, 3)


def test_order_is_a_permutation_that_depends_on_seed_and_epoch_only():
    order = data.sample_order(50, 2, 7)
    assert sorted(order) == list(range(50))
    assert order == data.sample_order(50, 2, 7)
    assert order != data.sample_order(50, 3, 7)
    assert order != data.sample_order(50, 2, 8)


def test_streams_are_the_papers_in_training_and_consensus_and_background_at_test():
    assert [data.ESTIMATES[i] for i in data.TRAINING_STREAMS] == [
        *(("foreground", name) for name in ("consensus", "closest", "median")),
        *(("background", name) for name in ("farthest", "median")),
        ("foreground", "farthest"),
    ]
    names = [data.ESTIMATES[i] for i in TEST_STREAMS["paper"]]
    assert names == 3 * [("foreground", "consensus")] + 3 * [("background", "farthest")]
    assert TEST_STREAMS["all"] == data.TRAINING_STREAMS


def test_augmentation_is_a_function_of_seed_and_step():
    images = np.random.default_rng(0).integers(0, 256, (7, 40, 60, 4)).astype(np.uint8)
    images[..., 3] = 255
    first = data.augment(images, 16, (1.0, 1.5), 3, 11)
    assert first.shape == (7, 16, 16, 4)
    assert np.array_equal(first, data.augment(images, 16, (1.0, 1.5), 3, 11))
    assert not np.array_equal(first, data.augment(images, 16, (1.0, 1.5), 3, 12))
    assert not np.array_equal(first, data.augment(images, 16, (1.0, 1.5), 4, 11))


def test_augmentation_without_enlargement_is_an_exact_crop_of_all_images():
    images = np.random.default_rng(0).integers(0, 256, (7, 20, 30, 4)).astype(np.uint8)
    cropped = data.augment(images, 8, (1.0, 1.0), 0, 5).astype(np.uint8)
    windows = np.lib.stride_tricks.sliding_window_view(images, (8, 8), axis=(1, 2))
    found = (windows == np.moveaxis(cropped, 3, 1)[:, None, None]).all(axis=(0, 3, 4, 5))
    assert found.sum() == 1
    assert np.array_equal(data.augment(images, None, (1.0, 1.0), 0, 5).astype(np.uint8), images)


def test_augmentation_enlarges_a_ramp_by_at_most_the_factor():
    ramp = np.zeros((1, 64, 96, 4), np.uint8)
    ramp[..., 0], ramp[..., 3] = 2 * np.arange(96), 255
    slopes = []
    for step in range(20):
        row = data.augment(ramp, 32, (1.0, 1.5), 0, step)[0, 16, :, 0]
        assert np.allclose(np.diff(row), np.diff(row)[0], atol=0.1)
        slopes.append(2 / np.diff(row).mean())
    assert 1.0 <= min(slopes) < 1.1
    assert 1.4 < max(slopes) <= 1.51


@pytest.mark.parametrize("crop", [None, 32])
def test_augmentation_reduces_a_ramp_to_no_less_than_the_factor(crop):
    ramp = np.zeros((1, 64, 96, 4), np.uint8)
    ramp[..., 0], ramp[..., 3] = 2 * np.arange(96), 255
    slopes = []
    for step in range(20):
        out = data.augment(ramp, crop, (0.5, 1.0), 0, step)[0]
        slopes.append(np.diff(out[out.shape[0] // 2, 1:-1, 0]).mean() / 2)
        # As much of the picture as there is after it was reduced.
        expected = [int(side / slopes[-1] + 0.1) for side in (64, 96)]
        assert out.shape[:2] == (32, 32) if crop else np.allclose(out.shape[:2], expected, atol=1)
    assert 1.0 <= min(slopes) < 1.1
    assert 1.8 < max(slopes) <= 2.01


@pytest.mark.parametrize("scales", [(1.0, 1.5), (0.5, 1.0)])
def test_augmentation_never_mixes_blank_into_colour(scales):
    image = np.zeros((1, 32, 32, 4), np.uint8)
    image[:, :, :16] = [200, 100, 50, 255]
    for step in range(10):
        out = data.augment(image, 24, scales, 0, step)[0]
        valid = out[..., 3] == 255
        assert np.allclose(out[valid], [200, 100, 50, 255], atol=1e-3)
        assert (out[~valid] == 0).all()


def test_sample_stack_has_the_documented_order(tmp_path):
    foreground, background = write_archives(tmp_path, "cam00", [0, 1])
    samples = data.SampleSet([foreground], [background], read_target, 1, 64)
    assert [(s.cam, s.frame) for s in samples.ids] == [("cam00", 0), ("cam00", 1)]
    images = samples.images(samples.ids[1])
    assert images.shape == (7, HEIGHT, WIDTH, 4)
    assert images[:, 0, 0, 0].tolist() == [10, 11, 12, 110, 111, 13, 201]
    assert samples.images(samples.ids[1]) is images


def test_background_stored_once_serves_other_frames(tmp_path):
    foreground, background = write_archives(tmp_path, "cam00", [0, 1, 2], same_as={"1": 0, "2": 0})
    samples = data.SampleSet([foreground], [background], read_target, 1, 64)
    assert samples.images(samples.ids[2])[3, 0, 0, 0] == 100


def test_cache_is_bounded_and_does_not_change_samples(tmp_path):
    foreground, background = write_archives(tmp_path, "cam00", range(8))
    size = 7 * 4 * HEIGHT * WIDTH
    bounded = data.SampleSet([foreground], [background], read_target, 1, 0)
    assert bounded.fill_cache() == 0
    full = data.SampleSet([foreground], [background], read_target, 1, 1)
    assert full.fill_cache() == min(8, 2**20 // size)
    for sample in full.ids:
        assert np.array_equal(full.images(sample), bounded.images(sample))


def test_validation_is_kept_apart_and_spread():
    ids = [data.SampleId(f"cam{c:02d}", f, None, None) for c in range(4) for f in range(10)]
    training, apart = data.split_validation(ids, 4)
    assert len(apart) == 4
    assert len({sample.cam for sample in apart}) == 4
    assert sorted(training + apart, key=lambda s: (s.cam, s.frame)) == ids
    assert data.split_validation(ids[:9], 4) == (ids[:9], [])
    assert data.split_validation(ids, 0) == (ids, [])


def test_missing_background_names_camera_and_frame(tmp_path):
    foreground, _ = write_archives(tmp_path / "a", "cam00", [0, 1])
    _, background = write_archives(tmp_path / "b", "cam00", [0])
    with pytest.raises(InputError, match="background of camera cam00, frame 1"):
        data.SampleSet([foreground], [background], read_target, 1, 1)


def test_missing_estimate_names_key_and_file(tmp_path):
    foreground, background = write_archives(tmp_path, "cam00", [0], keys=("consensus",))
    samples = data.SampleSet([foreground], [background], read_target, 1, 1)
    with pytest.raises(InputError, match="000000/closest_rgb in .*foreground"):
        samples.images(samples.ids[0])


def test_target_of_another_size_is_refused(tmp_path):
    foreground, background = write_archives(tmp_path, "cam00", [0])
    samples = data.SampleSet([foreground], [background], lambda cam, frame: solid(1, 10, 10), 1, 1)
    with pytest.raises(InputError, match="one size"):
        samples.images(samples.ids[0])


def test_empty_archives_are_refused(tmp_path):
    foreground, background = write_archives(tmp_path, "cam00", [])
    with pytest.raises(InputError, match="at least one frame to train on"):
        data.SampleSet([foreground], [background], read_target, 1, 1)


def test_fingerprint_follows_content_and_settings(tmp_path):
    foreground, background = write_archives(tmp_path, "cam00", [0])
    first = data.fingerprint({"seed": 0}, [foreground, background])
    assert first == data.fingerprint({"seed": 0}, [foreground, background])
    assert first != data.fingerprint({"seed": 1}, [foreground, background])
    write_archives(tmp_path, "cam00", [1])
    assert first != data.fingerprint({"seed": 0}, [foreground, background])
    with pytest.raises(InputError, match="found nothing"):
        data.fingerprint({}, [tmp_path / "absent.json"])
