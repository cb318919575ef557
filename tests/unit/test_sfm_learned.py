import cv2
import numpy as np
import pytest
import torch

from fourd import fetch
from fourd.errors import InputError
from fourd.sfm.recover import learned
from fourd.sfm.recover.aliked import Aliked, deform_conv2d, pick_keypoints, sample_bilinear
from fourd.sfm.recover.features import Features, find_features, match_features
from fourd.sfm.recover.lightglue import NUM_LAYERS, LightGlue, normalise_places
from fourd.sfm.recover.options import RecoverOptions
from tests.conftest import REPOSITORY

# Where the weights lie if somebody fetched them beside the other data.
WEIGHTS = REPOSITORY / "data" / "aliked"
CHANNELS = {"block1": (3, 16), "block2": (16, 32), "block3": (32, 64), "block4": (64, 128)}


def random_tensors(shapes: dict[str, tuple[int, ...]], seed: int) -> dict[str, torch.Tensor]:
    """Weights of the given shapes that keep the size of a signal roughly as it is."""
    generator = torch.Generator().manual_seed(seed)
    return {
        name: torch.randn(shape, generator=generator) / max(1, np.prod(shape[1:])) ** 0.5
        for name, shape in shapes.items()
    }


def aliked_weights(seed: int = 0) -> dict[str, torch.Tensor]:
    shapes: dict[str, tuple[int, ...]] = {}
    ones: dict[str, torch.Tensor] = {}
    for level, (block, (inputs, outputs)) in enumerate(CHANNELS.items(), start=1):
        shapes[f"conv{level}.weight"] = (32, outputs, 1, 1)
        if level > 1:
            shapes |= {f"{block}.downsample.weight": (outputs, inputs, 1, 1)}
            shapes |= {f"{block}.downsample.bias": (outputs,)}
        for layer, source in ((1, inputs), (2, outputs)):
            name = f"{block}.conv{layer}"
            if level > 2:
                shapes |= {f"{name}.offset_conv.weight": (18, source, 3, 3)}
                shapes |= {f"{name}.offset_conv.bias": (18,)}
                name += ".regular_conv"
            shapes[f"{name}.weight"] = (outputs, source, 3, 3)
            norm = f"{block}.bn{layer}"
            shapes |= {f"{norm}.bias": (outputs,), f"{norm}.running_mean": (outputs,)}
            ones |= {f"{norm}.weight": torch.ones(outputs), f"{norm}.running_var": torch.ones(outputs)}
    for layer, (outputs, inputs, side) in {0: (8, 128, 1), 2: (4, 8, 3), 4: (4, 4, 3), 6: (1, 4, 3)}.items():
        shapes[f"score_head.{layer}.weight"] = (outputs, inputs, side, side)
    shapes |= {"desc_head.agg_weights": (16, 128, 128), "desc_head.sf_conv.weight": (128, 128, 1, 1)}
    shapes |= {"desc_head.offset_conv.0.weight": (32, 128, 3, 3), "desc_head.offset_conv.0.bias": (32,)}
    shapes |= {"desc_head.offset_conv.2.weight": (32, 32, 1, 1), "desc_head.offset_conv.2.bias": (32,)}
    return random_tensors(shapes, seed) | ones


def lightglue_weights(seed: int = 0) -> dict[str, torch.Tensor]:
    sizes = {"input_proj": (256, 128)}
    norms: dict[str, torch.Tensor] = {}
    for i in range(NUM_LAYERS):
        layer, head = f"transformers.{i}.", f"log_assignment.{i}."
        sizes |= {f"{head}matchability": (1, 256), f"{head}final_proj": (256, 256)}
        sizes |= {f"token_confidence.{i}.token.0": (1, 256)}
        sizes |= {f"{layer}self_attn.Wqkv": (768, 256), f"{layer}self_attn.out_proj": (256, 256)}
        sizes |= {f"{layer}cross_attn.{name}": (256, 256) for name in ("to_qk", "to_v", "to_out")}
        for part in ("self_attn", "cross_attn"):
            sizes |= {f"{layer}{part}.ffn.0": (512, 512), f"{layer}{part}.ffn.3": (256, 512)}
            norms |= {f"{layer}{part}.ffn.1.weight": torch.ones(512)}
            norms |= {f"{layer}{part}.ffn.1.bias": torch.zeros(512)}
    shapes: dict[str, tuple[int, ...]] = {f"{name}.weight": shape for name, shape in sizes.items()}
    shapes |= {f"{name}.bias": shape[:1] for name, shape in sizes.items()} | {"posenc.Wr.weight": (32, 2)}
    state = random_tensors(shapes, seed) | norms
    # A bias common to all keypoints would drown what tells them apart.
    state["input_proj.bias"] *= 0
    for i in range(NUM_LAYERS):
        state[f"log_assignment.{i}.final_proj.bias"] *= 0
        # Small messages: what a keypoint looks like still counts in the end, so that equal ones match.
        for part in ("self_attn", "cross_attn"):
            state[f"transformers.{i}.{part}.ffn.3.weight"] *= 0.05
            state[f"transformers.{i}.{part}.ffn.3.bias"] *= 0
        state[f"log_assignment.{i}.final_proj.weight"] *= 8
        state[f"log_assignment.{i}.matchability.weight"] *= 0.05
        state[f"log_assignment.{i}.matchability.bias"] += 5
    return state


def draw_corners(width: int, height: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (height // 8, width // 8, 3), dtype=np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST)


def bilinear(image: np.ndarray, y: float, x: float) -> float:
    """One value of (H, W), zero outside."""
    top, left = int(np.floor(y)), int(np.floor(x))
    total = 0.0
    for row in (top, top + 1):
        for column in (left, left + 1):
            if 0 <= row < image.shape[0] and 0 <= column < image.shape[1]:
                total += image[row, column] * (1 - abs(y - row)) * (1 - abs(x - column))
    return total


@pytest.mark.parametrize("size", [(5, 7), (1, 4), (6, 1)])
def test_deformable_convolution_is_what_its_equation_says(size):
    rng = np.random.default_rng(3)
    x, weight = rng.normal(size=(2, *size)), rng.normal(size=(3, 2, 3, 3))
    offset, bias = rng.normal(scale=2, size=(18, *size)), rng.normal(size=3)
    expected = np.zeros((3, *size))
    for row, column in np.ndindex(size):
        for tap in range(9):
            y = row + tap // 3 - 1 + offset[2 * tap, row, column]
            z = column + tap % 3 - 1 + offset[2 * tap + 1, row, column]
            values = [bilinear(channel, y, z) for channel in x]
            expected[:, row, column] += weight[:, :, tap // 3, tap % 3] @ values
    expected += bias[:, None, None]
    tensors = [torch.from_numpy(a) for a in (x[None], offset[None], weight, bias)]
    found = deform_conv2d(*tensors)
    np.testing.assert_allclose(found[0].numpy(), expected, rtol=0, atol=1e-9)


def test_without_displacements_it_is_a_plain_convolution():
    generator = torch.Generator().manual_seed(1)
    x, weight = (torch.randn(s, generator=generator) for s in ((1, 4, 9, 12), (5, 4, 3, 3)))
    found = deform_conv2d(x, torch.zeros(1, 18, 9, 12), weight, None)
    torch.testing.assert_close(found, torch.nn.functional.conv2d(x, weight, padding=1))
    places = torch.tensor([[[[0.0, 0], [11, 8], [3, 5]]]])
    torch.testing.assert_close(sample_bilinear(x, places)[0, :, 0], x[0][:, [0, 8, 5], [0, 11, 3]])


def test_aliked_gives_pixels_inside_and_descriptors_of_unit_length():
    image = torch.from_numpy(draw_corners(96, 64).transpose(2, 0, 1).astype(np.float32) / 255)
    network = Aliked(aliked_weights())
    pixels, descriptors = network.detect(image, 1000)
    assert len(pixels) > 20 and pixels.dtype == descriptors.dtype == np.float32
    assert (pixels >= 0).all() and (pixels <= [95, 63]).all()
    assert descriptors.shape == (len(pixels), 128)
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, atol=1e-5)
    few = network.detect(image, 7)
    np.testing.assert_array_equal(few[0], pixels[:7])
    np.testing.assert_allclose(few[1], descriptors[:7], atol=1e-5)


def test_aliked_finds_nothing_where_nothing_stands_out():
    assert pick_keypoints(torch.full((20, 30), 0.19), 10).shape == (0, 2)
    pixels, descriptors = Aliked(aliked_weights()).detect(torch.zeros(3, 32, 64), 0)
    assert pixels.shape == (0, 2) and descriptors.shape == (0, 128)


def test_keypoints_are_local_maxima_the_strongest_first_to_parts_of_a_pixel():
    scores = torch.zeros(20, 30)
    scores[5, 7], scores[5, 8], scores[12, 20], scores[1, 15] = 0.5, 0.4, 0.9, 0.95
    pixels = pick_keypoints(scores, 10).numpy()
    # The border is left out, a neighbour is no maximum but draws the corner towards itself.
    np.testing.assert_array_equal(pixels[0], [20, 12])
    assert len(pixels) == 2 and 7 < pixels[1, 0] < 7.5 and pixels[1, 1] == pytest.approx(5, abs=1e-6)
    np.testing.assert_array_equal(pick_keypoints(scores, 1), pixels[:1])


def keypoints(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(count, 128)).astype(np.float32)
    return rng.uniform(-1, 1, (count, 2)), descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)


def test_lightglue_matches_each_keypoint_once_whatever_their_order():
    network = LightGlue(lightglue_weights())
    places, descriptors = keypoints(40, 0)
    other_places, other_descriptors = places[:30] + 0.01, descriptors[:30]
    found = network.match((places, other_places), (descriptors, other_descriptors))
    assert found.shape[1] == 2 and found.dtype == np.int64 and len(found) >= 15
    assert all(len(np.unique(column)) == len(found) for column in found.T)
    assert (found[:, 0] == found[:, 1]).mean() > 0.9
    rng = np.random.default_rng(1)
    order, other_order = rng.permutation(40), rng.permutation(30)
    shuffled = network.match(
        (places[order], other_places[other_order]), (descriptors[order], other_descriptors[other_order])
    )
    back = np.stack([order[shuffled[:, 0]], other_order[shuffled[:, 1]]], axis=1)
    assert {tuple(pair) for pair in back} == {tuple(pair) for pair in found}
    swapped = network.match((other_places, places), (other_descriptors, descriptors))
    assert {tuple(pair[::-1]) for pair in swapped} == {tuple(pair) for pair in found}


def test_lightglue_without_keypoints_matches_nothing():
    network = LightGlue(lightglue_weights())
    none, some = keypoints(0, 0), keypoints(3, 1)
    for first, second in ((none, some), (some, none), (none, none)):
        assert network.match((first[0], second[0]), (first[1], second[1])).shape == (0, 2)


def test_convention_places_count_from_the_middle_in_halves_of_the_longer_side():
    places = normalise_places(np.array([[32.0, 16], [64, 16], [0, 0]]), (64, 32))
    np.testing.assert_array_equal(places, [[0, 0], [1, 0], [-1, -0.5]])
    assert learned.network_size((1920, 1080)) == (1024, 576)
    assert learned.network_size((540, 960)) == (544, 960)
    assert learned.network_size((10, 5)) == (32, 32)


@pytest.mark.parametrize("folder", ["", "nowhere"])
def test_missing_weights_say_which_command_fetches_them(folder):
    options = RecoverOptions(features="aliked", learned_weights=folder)
    with pytest.raises(InputError, match=r"aliked-n16rot\.pth.*`python -m fourd\.fetch aliked --output DIR`"):
        find_features(draw_corners(64, 64), options)
    with pytest.raises(InputError, match="sift, aliked, got 'orb'"):
        find_features(draw_corners(64, 64), RecoverOptions(features="orb"))


def test_other_weights_are_refused(tmp_path):
    (tmp_path / "aliked-n16rot.pth").write_bytes(b"something else")
    with pytest.raises(InputError, match="with SHA-256 ddf3"):
        find_features(draw_corners(64, 64), RecoverOptions(features="aliked", learned_weights=str(tmp_path)))


def test_what_is_fetched_is_what_is_read():
    (package,) = fetch.PACKAGES["aliked"]
    assert package.calibration is None
    assert set(learned.SHA256) | {"LICENSE"} == set(package.members.values())


def test_sift_is_matched_as_before():
    image = cv2.GaussianBlur(draw_corners(160, 120), (0, 0), 1)
    options = RecoverOptions()
    features = find_features(image, options)
    assert features.descriptors.dtype == np.float32 and len(features.pixels) > 50
    same = match_features(features, features, ((160, 120), (160, 120)), options)
    assert len(same) > 20 and (same[:, 0] == same[:, 1]).all()
    none = Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    assert match_features(features, none, ((160, 120), (160, 120)), options).shape == (0, 2)


@pytest.mark.skipif(
    not WEIGHTS.is_dir(), reason=f"no weights: `python -m fourd.fetch aliked --output {WEIGHTS}`"
)
def test_real_weights_match_a_picture_with_itself_seen_askew():
    image = cv2.GaussianBlur(draw_corners(320, 256), (0, 0), 1)
    # A homography that a camera would see from some 30 degrees beside.
    H = np.array([[0.8, 0.1, 20], [-0.1, 0.9, 30], [-4e-4, 1e-4, 1]])
    askew = cv2.warpPerspective(image, H, (320, 256))
    options = RecoverOptions(features="aliked", learned_weights=str(WEIGHTS))
    a, b = find_features(image, options), find_features(askew, options)
    again = find_features(image, options)
    np.testing.assert_array_equal(a.pixels, again.pixels)
    found = match_features(a, b, ((320, 256), (320, 256)), options)
    moved = cv2.perspectiveTransform(a.pixels[found[:, 0], None], H)[:, 0]
    error = np.linalg.norm(moved - b.pixels[found[:, 1]], axis=1)
    assert len(found) > 100 and np.median(error) < 1 and (error < 3).mean() > 0.9
