import numpy as np
import pytest
import torch

from fourd.composition import CascadeOptions, infer
from fourd.composition.checkpoint import save_torch
from fourd.composition.model import CompositionNet
from fourd.errors import InputError

HEIGHT, WIDTH = 48, 64
ARGUMENTS = {"num_filters": 2, "unet_width": 1, "depth": 1, "head": "blend", "streams": "paper"}


def write_models(folder, num_levels, seed=0, streams="paper"):
    torch.manual_seed(seed)
    paths = []
    for level in range(num_levels):
        arguments = ARGUMENTS | {"level": level, "streams": streams}
        network = CompositionNet(**arguments)
        document = {"level": level, "num_levels": num_levels, "network": arguments}
        paths.append(folder / f"{level}.pt")
        save_torch(paths[-1], document | {"state_dict": network.state_dict()})
    return paths


def frame_arrays(hole=None, seed=0):
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 256, (2, HEIGHT, WIDTH, 3)).astype(np.uint8)
    valid = rng.random((2, HEIGHT, WIDTH)) < np.array([0.5, 2.0])[:, None, None]
    if hole is not None:
        valid[:, hole[0], hole[1]] = False
    rgb[~valid] = 0
    foreground = {"consensus_rgb": rgb[0], "consensus_valid": valid[0]}
    return foreground, {"farthest_rgb": rgb[1], "farthest_valid": valid[1]}


def test_paste_is_consensus_over_background():
    foreground, background = frame_arrays()
    expected = np.where(
        foreground["consensus_valid"][..., None], foreground["consensus_rgb"], background["farthest_rgb"]
    )
    assert np.array_equal(infer.paste(foreground, background), expected)


def test_untrained_blend_equals_the_paste_in_every_grey_level(tmp_path):
    models = infer.load_models(write_models(tmp_path, 1))
    foreground, background = frame_arrays(hole=(slice(3, 9), slice(5, 11)))
    image, rows = infer.compose_frame(models, 7, foreground, background)
    assert image.dtype == np.uint8
    holes = ~(foreground["consensus_valid"] | background["farthest_valid"])
    assert np.array_equal(image[~holes], infer.paste(foreground, background)[~holes])
    assert (infer.paste(foreground, background)[holes] == infer.paste(foreground, background)[3, 5]).all()
    assert [row["level"] for row in rows] == [0]
    assert rows[0]["frame"] == 7
    assert rows[0]["hole_share"] == pytest.approx(36 / (HEIGHT * WIDTH))


def test_all_streams_fill_what_consensus_and_background_leave_blank(tmp_path):
    """An untrained blend pastes, so each pixel tells which estimate it is from."""
    names = [("foreground", name) for name in ("consensus", "closest", "median", "farthest")]
    names += [("background", name) for name in ("farthest", "median")]
    arrays = {"foreground": {}, "background": {}}
    for i, (kind, name) in enumerate(names):
        valid = np.zeros((HEIGHT, WIDTH), bool)
        valid[:, i * 8 : (i + 1) * 8] = True
        arrays[kind][f"{name}_rgb"] = np.full((HEIGHT, WIDTH, 3), 40 * (i + 1), np.uint8) * valid[..., None]
        arrays[kind][f"{name}_valid"] = valid
    models = infer.load_models(write_models(tmp_path, 1, streams="all"))
    image, rows = infer.compose_frame(models, 0, arrays["foreground"], arrays["background"])
    assert [int(image[20, 8 * i + 4, 0]) for i in range(6)] == [40, 80, 120, 160, 200, 240]
    assert rows[0]["hole_share"] == pytest.approx(0.25)
    assert set(infer.estimates_read(models, "foreground")) == set(arrays["foreground"])
    assert set(infer.estimates_read(models, "background")) == set(arrays["background"])


def test_the_papers_streams_read_consensus_and_static_background_only(tmp_path):
    models = infer.load_models(write_models(tmp_path, 1))
    assert infer.estimates_read(models, "foreground") == ["consensus_rgb", "consensus_valid"]
    assert infer.estimates_read(models, "background") == ["farthest_rgb", "farthest_valid"]


def test_paste_of_nothing_is_black():
    foreground, background = frame_arrays(hole=(slice(None), slice(None)))
    assert (infer.paste(foreground, background) == 0).all()


def test_small_holes_need_one_level_only(tmp_path):
    models = infer.load_models(write_models(tmp_path, 3))
    _, rows = infer.compose_frame(models, 0, *frame_arrays(hole=(slice(0, 2), slice(0, 2))))
    assert [row["level"] for row in rows] == [2]
    assert rows[0]["filled_share"] == 0
    assert "small" in rows[0]["reason"]


def test_large_holes_are_filled_from_below_and_reported(tmp_path):
    models = infer.load_models(write_models(tmp_path, 3))
    arrays = frame_arrays(hole=(slice(16, 32), slice(24, 40)))
    image, rows = infer.compose_frame(models, 4, *arrays)
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert [row["level"] for row in rows] == [0, 1, 2]
    assert "coarsest" in rows[0]["reason"]
    assert rows[0]["filled_share"] == 0
    assert all("filled from" in row["reason"] for row in rows[1:])
    assert rows[2]["filled_share"] == rows[2]["hole_share"] == pytest.approx(256 / (HEIGHT * WIDTH))


def test_a_hole_that_vanishes_when_reduced_stops_the_descent(tmp_path):
    models = infer.load_models(write_models(tmp_path, 3))
    foreground, background = frame_arrays()
    for valid in (foreground["consensus_valid"], background["farthest_valid"]):
        valid[::4, :] = False
    _, rows = infer.compose_frame(models, 0, foreground, background)
    assert [row["level"] for row in rows] == [1, 2]
    assert rows[0]["hole_share"] == 0


def test_either_share_asks_for_the_coarser_level():
    scattered = np.zeros((100, 100), bool)
    scattered[::10, ::10] = True
    assert infer.hole_shares(scattered) == (0.01, 0.0001)
    assert infer.holes_are_large(scattered, CascadeOptions(0.005, 0.5))
    assert not infer.holes_are_large(scattered, CascadeOptions(0.02, 0.005))
    block = np.zeros((100, 100), bool)
    block[40:50, 40:50] = True
    assert infer.holes_are_large(block, CascadeOptions(0.02, 0.005))
    assert infer.hole_shares(np.zeros((4, 4), bool)) == (0.0, 0.0)
    assert infer.hole_shares(np.ones((4, 4), bool)) == (1.0, 1.0)


def test_filling_touches_holes_of_the_background_only():
    images = np.full((4, 5, 7, 4), 9, np.uint8)
    images[:, 1:3, 2:4] = 0
    holes = infer.find_holes(images)
    assert holes.sum() == 4
    coarser = np.full((3, 4, 3), 77, np.uint8)
    before = images.copy()
    infer.fill_holes(images, holes, coarser)
    assert (images[3, holes] == [77, 77, 77, 255]).all()
    assert np.array_equal(images[3, ~holes], before[3, ~holes])
    assert np.array_equal(images[:3], before[:3])


def test_same_input_same_bytes(tmp_path):
    models = infer.load_models(write_models(tmp_path, 2))
    arrays = frame_arrays(hole=(slice(10, 30), slice(10, 30)))
    first, second = (infer.compose_frame(models, 0, *arrays)[0] for _ in range(2))
    assert np.array_equal(first, second)


def test_missing_level_is_refused(tmp_path):
    paths = write_models(tmp_path, 3)
    with pytest.raises(InputError, match=r"levels \[0, 2\]"):
        infer.load_models([paths[0], paths[2]])
    assert [m.level for m in infer.load_models(paths[::-1])] == [0, 1, 2]


@pytest.mark.parametrize("content", [b"", b"no model", b"PK\x03\x04broken"])
def test_file_that_is_no_model_is_refused(tmp_path, content):
    path = tmp_path / "model.pt"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"whole file of this training in .*model\.pt"):
        infer.load_models([path])


def test_file_with_code_in_it_is_refused(tmp_path):
    path = tmp_path / "model.pt"
    torch.save({"level": 0, "num_levels": 1, "network": np.zeros, "state_dict": {}}, path)
    with pytest.raises(InputError, match=r"model\.pt"):
        infer.load_models([path])


def test_missing_file_and_unequal_sizes_are_refused(tmp_path):
    with pytest.raises(InputError, match="run the training first"):
        infer.load_models([tmp_path / "absent.pt"])
    foreground, background = frame_arrays()
    background = {key: array[:-2] for key, array in background.items()}
    with pytest.raises(InputError, match="one size"):
        infer.paste(foreground, background)


def test_model_of_another_network_is_refused(tmp_path):
    (path,) = write_models(tmp_path, 1)
    document = torch.load(path, weights_only=True)
    document["network"] |= {"head": "direct"}
    save_torch(path, document)
    with pytest.raises(InputError, match="level 0, .* another network .*train it again"):
        infer.load_models([path])
