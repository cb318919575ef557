"""FID with a network of the same form as the public file: its features, refusals, another implementation."""

from pathlib import Path

import numpy as np
import pytest

from fourd.errors import InputError
from fourd.metrics_distribution import frechet_distance
from fourd.metrics_fid import InceptionNetwork


@pytest.fixture(scope="module")
def network_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scripted network that scales pictures itself and gives 2048 features."""
    return write_network(tmp_path_factory.mktemp("fid") / "net.pt", 2048)


def write_network(path: Path, num_features: int) -> Path:
    import torch

    class Features(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            torch.manual_seed(0)
            self.layer = torch.nn.Linear(3 * 8 * 8, num_features)

        def forward(self, x: torch.Tensor, return_features: bool = False) -> torch.Tensor:
            small = torch.nn.functional.interpolate(x.float() / 255, size=[8, 8], mode="bilinear")
            return torch.relu(self.layer(small.flatten(1)))

    torch.jit.script(Features()).save(str(path))
    return path


def pictures(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, 40, 60, 3)).astype(np.uint8)


def test_fid_is_that_of_another_implementation(network_file: Path) -> None:
    fid = pytest.importorskip("torchmetrics.image.fid", reason="needs the package torchmetrics")
    import torch

    network = InceptionNetwork(network_file)
    first, second = (
        [network.describe(p) for p in pictures(seed, count)] for seed, count in ((0, 9), (1, 12))
    )
    other = fid.FrechetInceptionDistance(feature=torch.jit.load(str(network_file)))
    for seed, count, real in ((0, 9, False), (1, 12, True)):
        other.update(torch.from_numpy(pictures(seed, count).transpose(0, 3, 1, 2)), real=real)
    found = frechet_distance(np.stack(first), np.stack(second))
    assert found == pytest.approx(float(other.compute()), rel=1e-3)


def test_features_are_of_one_picture_and_of_any_size(network_file: Path) -> None:
    network = InceptionNetwork(network_file)
    feature = network.describe(pictures(2, 1)[0])
    assert feature.shape == (2048,) and feature.dtype == np.float32 and np.isfinite(feature).all()


def test_a_file_that_is_no_such_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found nothing"):
        InceptionNetwork(tmp_path / "none.pt")
    (tmp_path / "text.pt").write_text("no network")
    with pytest.raises(InputError, match=r"expected a TorchScript network .* in .*text.pt"):
        InceptionNetwork(tmp_path / "text.pt")
    with pytest.raises(InputError, match=r"expected 2048 features .* got \(7,\)"):
        InceptionNetwork(write_network(tmp_path / "small.pt", 7))
