"""LPIPS against its formula on the public layout, refusal of other files, and pinned values."""

import hashlib
import pickle
from pathlib import Path

import cv2
import numpy as np
import pytest

from fourd import metrics_lpips
from fourd.errors import InputError
from fourd.metrics_lpips import NETWORKS, FeatureNetwork, load_network, lpips, missing_weights
from tests.conftest import REPOSITORY, SHARED_DATA

WEIGHTS = REPOSITORY / "data" / "lpips"
ALEX = [(3, 64, 11), (64, 192, 5), (192, 384, 3), (384, 256, 3), (256, 256, 3)]
VGG = [(3, 64), (64, 64), (64, 128), (128, 128), (128, 256), (256, 256), (256, 256), (256, 512)]
VGG += [(512, 512)] * 5


@pytest.fixture
def weights() -> str:
    if not all((WEIGHTS / network.file).is_file() for network in NETWORKS.values()):
        pytest.skip(f"needs the weights: python -m fourd.fetch lpips --output {WEIGHTS}")
    return str(WEIGHTS)


def picture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (96, 128, 3)).astype(np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 2.5)


def noisy(image: np.ndarray, amplitude: int) -> np.ndarray:
    noise = np.random.default_rng(9).integers(-amplitude, amplitude + 1, image.shape)
    return np.clip(image.astype(int) + noise, 0, 255).astype(np.uint8)


def random_arrays(net: str) -> dict:
    """Arrays in the layout of the files: kernels (height, width, in, out)."""
    rng = np.random.default_rng(0)
    sizes = ALEX if net == "alex" else [(*pair, 3) for pair in VGG]
    convolutions = {
        f"Conv_{i}": {
            "kernel": rng.normal(0, (2 / (fan_in * side**2)) ** 0.5, (side, side, fan_in, out)).astype(
                np.float32
            ),
            "bias": rng.normal(0, 0.1, out).astype(np.float32),
        }
        for i, (fan_in, out, side) in enumerate(sizes)
    }
    heads = [64, 192, 384, 256, 256] if net == "alex" else [64, 128, 256, 512, 512]
    return {NETWORKS[net].group: convolutions} | {
        f"NetLinLayer_{i}": {"Conv_0": {"kernel": rng.random((1, 1, count, 1)).astype(np.float32)}}
        for i, count in enumerate(heads)
    }


def reference_layers(net: str):
    """The public networks up to their last convolution, and the ReLUs that LPIPS reads."""
    from torch import nn

    if net == "alex":
        strides, paddings, layers = (4, 1, 1, 1, 1), (2, 2, 1, 1, 1), []
        for i, (fan_in, out, side) in enumerate(ALEX):
            layers += [nn.Conv2d(fan_in, out, side, strides[i], paddings[i]), nn.ReLU()]
            layers += [nn.MaxPool2d(3, 2)] if i < 2 else []
        return nn.Sequential(*layers), (1, 4, 7, 9, 11)
    layers = []
    for i, (fan_in, out) in enumerate(VGG):
        layers += [nn.MaxPool2d(2, 2)] if i in (2, 4, 7, 10) else []
        layers += [nn.Conv2d(fan_in, out, 3, padding=1), nn.ReLU()]
    return nn.Sequential(*layers), (3, 8, 15, 22, 29)


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_distance_is_the_formula_on_the_public_layout(net):
    import torch

    arrays = random_arrays(net)
    network = FeatureNetwork(NETWORKS[net], arrays)
    image, truth = noisy(picture(0), 40), picture(0)
    found = network.distance(network.features(image), network.features(truth))
    layers, read_after = reference_layers(net)
    convolutions = [layer for layer in layers if isinstance(layer, torch.nn.Conv2d)]
    for i, layer in enumerate(convolutions):
        entry = arrays[NETWORKS[net].group][f"Conv_{i}"]
        layer.weight.data = torch.from_numpy(np.ascontiguousarray(entry["kernel"].transpose(3, 2, 0, 1)))
        layer.bias.data = torch.from_numpy(entry["bias"])

    def activations(picture: np.ndarray) -> list[np.ndarray]:
        scaled = (picture / 127.5 - 1 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
        x = torch.from_numpy(scaled.transpose(2, 0, 1)[None].astype(np.float32))
        kept = []
        for i, layer in enumerate(layers):
            x = layer(x)
            if i in read_after:
                kept.append(x[0].detach().numpy().astype(np.float64))
        return kept

    expected = 0.0
    for i, (a, b) in enumerate(zip(activations(image), activations(truth), strict=True)):
        a, b = (v / (np.linalg.norm(v, axis=0) + 1e-10) for v in (a, b))
        head = arrays[f"NetLinLayer_{i}"]["Conv_0"]["kernel"].reshape(-1, 1, 1)
        expected += float((head * (a - b) ** 2).sum(axis=0).mean())
    assert found == pytest.approx(expected, rel=1e-4)
    assert network.distance(network.features(truth), network.features(truth)) == 0


def test_feature_of_the_neighbours_has_unit_length():
    network = FeatureNetwork(NETWORKS["alex"], random_arrays("alex"))
    feature = network.describe(picture(1))
    assert feature.shape == (9216,)
    assert np.linalg.norm(feature) == pytest.approx(1, rel=1e-5)


def test_without_weights_there_is_a_reason(tmp_path):
    assert "python -m fourd.fetch lpips" in str(missing_weights("", "alex"))
    assert str(tmp_path / "vgg16.ckpt") in str(missing_weights(str(tmp_path), "vgg"))
    with pytest.raises(InputError, match="expected the weights of alex for LPIPS, got none"):
        load_network(str(tmp_path), "alex")
    (tmp_path / "alexnet.ckpt").write_bytes(b"other")
    with pytest.raises(InputError, match=f"got {hashlib.sha256(b'other').hexdigest()}"):
        load_network(str(tmp_path), "alex")
    with pytest.raises(ValueError, match="one shape"):
        lpips(picture(0)[:50], picture(0), "")


class Payload:
    def __reduce__(self):
        return Path.touch, (Path("was_run"),)


def test_a_pickle_that_is_more_than_arrays_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.ckpt").write_bytes(pickle.dumps({"a": Payload()}))
    with pytest.raises(InputError, match=r"expected pickled arrays .* is no array"):
        metrics_lpips.read_arrays_only(tmp_path / "bad.ckpt")
    assert not (tmp_path / "was_run").exists()
    (tmp_path / "cut.ckpt").write_bytes(b"")
    with pytest.raises(InputError, match="expected pickled arrays"):
        metrics_lpips.read_arrays_only(tmp_path / "cut.ckpt")
    arrays = {"a": np.arange(6, dtype=np.float32).reshape(2, 3)}
    (tmp_path / "good.ckpt").write_bytes(pickle.dumps(arrays))
    np.testing.assert_array_equal(metrics_lpips.read_arrays_only(tmp_path / "good.ckpt")["a"], arrays["a"])


# Computed with the package lpips 0.1.4 (version 0.1 heads) on the same weights.
@pytest.mark.parametrize(
    ("net", "of_noise", "of_another"),
    [("alex", 0.8274060, 0.1751435), ("vgg", 0.5805116, 0.5210947)],
)
def test_values_of_the_reference_package(weights, net, of_noise, of_another):
    truth = picture(0)
    assert lpips(truth, truth, weights, net) == 0
    assert lpips(noisy(truth, 40), truth, weights, net) == pytest.approx(of_noise, abs=1e-4)
    assert lpips(picture(1), truth, weights, net) == pytest.approx(of_another, abs=1e-4)


def test_distance_rises_with_noise(weights):
    truth = picture(0)
    values = [lpips(noisy(truth, amplitude), truth, weights) for amplitude in (0, 4, 10, 25, 60)]
    assert values == sorted(values) and values[0] == 0 < values[1]


@pytest.mark.parametrize(
    ("name", "alex", "vgg"), [("ex_p0.png", 0.7219, 0.5686), ("ex_p1.png", 0.1376, 0.4217)]
)
def test_values_of_the_published_example(weights, name, alex, vgg):
    folder = SHARED_DATA / "lpips"
    if not (folder / "ex_ref.png").is_file():
        pytest.skip(f"needs the example pictures of the LPIPS repository (ex_ref.png, {name}) in {folder}")
    from fourd.io import read_image

    image, truth = read_image(folder / name), read_image(folder / "ex_ref.png")
    assert lpips(image, truth, weights, "alex") == pytest.approx(alex, abs=1e-3)
    assert lpips(image, truth, weights, "vgg") == pytest.approx(vgg, abs=1e-3)
