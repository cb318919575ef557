import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from fourd import config
from fourd.camera import Camera, CameraTrack, tracks_to_dict
from fourd.cli import run_stage
from fourd.errors import InputError
from fourd.io import Archive, read_image, write_json, write_png
from fourd.matchers import Match
from fourd.stereo.__main__ import main
from fourd.stereo.disparity import (
    StereoOptions,
    check_direction,
    left_right_difference,
    make_matcher,
    match_pair,
    rectify_image,
)
from fourd.stereo.files import (
    decode_confidence,
    decode_disparity,
    encode_confidence,
    encode_disparity,
    read_disparity_frame,
    read_rectification,
    write_rectification,
)
from fourd.stereo.rectify import (
    Rectification,
    RectifyOptions,
    disparity_from_depth,
    rectify_pair,
    rectify_tracks,
)
from tests.films import put_on_clock
from tests.unit.test_rectify import LENS, on_arc

NEAR, FAR = 3.0, 8.0
WALL_Y, BOARD_Y = 1.0, -1.2
BOARD = 0.55
SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "data"


def wall_texture():
    """(800, 800, 3) smooth noise at several scales; 100 px are one world unit."""
    rng = np.random.default_rng(3)
    image = np.zeros((800, 800, 3), np.float32)
    for cells in (20, 80, 300):
        image += cv2.resize(rng.uniform(0, 85, (cells, cells, 3)).astype(np.float32), (800, 800))
    return image.astype(np.uint8)


def render(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Image and z depth of a textured wall at y = 1 with a square board before it."""
    width, height = camera.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    directions = camera.rays(pixels) @ camera.R
    texture = wall_texture()
    image, depth = None, None
    for plane_y, spread in ((WALL_Y, 100.0), (BOARD_Y, 170.0)):
        z = (plane_y - camera.center[1]) / directions[..., 1]
        points = camera.center + z[..., None] * directions
        spots = (points[..., ::2] - [0, 1]) * spread + 400
        color = cv2.remap(texture, *np.moveaxis(spots, -1, 0).astype(np.float32), cv2.INTER_CUBIC)
        if image is None or depth is None:
            image, depth = color, z
        else:
            hit = np.abs(points[..., ::2] - [0, 1]).max(axis=-1) < BOARD
            image, depth = np.where(hit[..., None], color, image), np.where(hit, z, depth)
    assert image is not None and depth is not None
    return image, depth


def true_disparity(rectification: Rectification, side: str) -> np.ndarray:
    camera = rectification.camera(side)
    return disparity_from_depth(rectification, render(camera)[1])


def matched(left, right, options=None):
    rectification = rectify_pair(left, right, (NEAR, FAR), (NEAR, FAR), RectifyOptions())
    assert isinstance(rectification, Rectification), rectification
    options = options or StereoOptions()
    images = render(left)[0], render(right)[0]
    return match_pair(rectification, (left, right), images, make_matcher(options), options)


@pytest.mark.parametrize(
    "left, right",
    [
        (on_arc(0), on_arc(12)),
        (on_arc(12), on_arc(0)),
        (on_arc(0), on_arc(25, height=2.0)),
        (on_arc(0), on_arc(12, roll_deg=180)),
        (on_arc(0, roll_deg=90), on_arc(12)),
        (on_arc(0, size=(180, 320)), on_arc(12)),
        (on_arc(0, lens=LENS), on_arc(12)),
        (on_arc(0), on_arc(12, focal_px=420.0)),
    ],
    ids=["plain", "exchanged", "wide", "upside_down", "sideways", "portrait", "lens", "zoomed"],
)
def test_true_disparity_is_found_both_ways(left, right):
    result = matched(left, right)
    for side, disparity, confidence in (
        ("left", result.left_disparity, result.left_confidence),
        ("right", result.right_disparity, result.right_confidence),
    ):
        source = left if side == "left" else right
        _, inside = rectify_image(render(source)[0], result.rectification, source, side, "linear")
        found = np.isfinite(disparity)
        assert not np.any(found & ~inside)
        assert found[inside].mean() > 0.5
        error = np.abs(disparity - true_disparity(result.rectification, side))[found]
        assert np.median(error) < 0.3
        assert np.mean(error > 2) < 0.05
        assert np.all((confidence > 0) == found) and confidence.max() <= 1
        trusted = confidence[found] > np.median(confidence[found])
        assert np.mean(np.minimum(error[trusted], 2)) < np.mean(np.minimum(error[~trusted], 2))


def test_textureless_images_match_nothing():
    left, right = on_arc(0), on_arc(12)
    rectification = rectify_pair(left, right, (NEAR, FAR), (NEAR, FAR), RectifyOptions())
    assert isinstance(rectification, Rectification)
    for level in (0, 255):
        flat = np.full((180, 320, 3), level, np.uint8)
        options = StereoOptions()
        result = match_pair(rectification, (left, right), (flat, flat), make_matcher(options), options)
        assert np.isfinite(result.left_disparity).mean() < 0.05
        assert np.isfinite(result.left_confidence).all()


def test_left_right_difference_in_closed_form():
    left = np.full((2, 8), 3, np.float32)
    right = np.full((2, 8), 2.5, np.float32)
    right[0, 2] = np.nan
    everywhere = np.ones((2, 8), bool)
    behind = everywhere.copy()
    behind[1, 4] = False
    difference = left_right_difference(left, everywhere, right, behind, direction=-1)
    expected = np.full((2, 8), 0.5, np.float32)
    expected[:, :3] = np.inf
    expected[0, 5] = expected[1, 7] = np.inf
    np.testing.assert_array_equal(difference, expected)
    back = left_right_difference(right, everywhere, left, everywhere, direction=1)
    assert np.isinf(back[:, 6:]).all() and back[1, 0] == 0.5 and np.isinf(back[0, 2])


def test_lonely_matches_are_rejected_and_confidence_falls_with_the_difference():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (40, 40, 3)).astype(np.uint8)
    everywhere = np.ones((40, 40), bool)
    match = Match(np.full((40, 40), 5, np.float32), np.ones((40, 40), np.float32))
    difference = np.full((40, 40), np.inf, np.float32)
    difference[20, 20] = 0
    assert not np.isfinite(
        check_direction(match, everywhere, difference, image, StereoOptions()).disparity
    ).any()
    confidences = [
        check_direction(
            match, everywhere, np.full((40, 40), d, np.float32), image, StereoOptions()
        ).confidence
        for d in (0.0, 0.5, 1.0)
    ]
    assert np.all(confidences[0] > confidences[1]) and np.all(confidences[1] > confidences[2])
    assert confidences[2].min() >= 0.1 and confidences[0].mean() > 0.9
    gaps = np.zeros((40, 40), np.float32)
    gaps[:, ::3] = np.inf
    among_gaps = check_direction(match, everywhere, gaps, image, StereoOptions()).confidence
    kept = among_gaps > 0
    assert kept.any() and np.all(among_gaps[kept] < 0.6 * confidences[0][kept])


def test_image_of_another_size_is_refused():
    left, right = on_arc(0), on_arc(12)
    rectification = rectify_pair(left, right, (NEAR, FAR), (NEAR, FAR), RectifyOptions())
    assert isinstance(rectification, Rectification)
    with pytest.raises(InputError, match="320x180.*got 10x20"):
        rectify_image(np.zeros((20, 10, 3), np.uint8), rectification, left, "left", "cubic")


@pytest.mark.parametrize(
    "change, message",
    [({"matcher": "psychic"}, "stereo matcher"), ({"matcher": "sgbm", "sgbm_mode": "x"}, "sgbm_mode")],
)
def test_unknown_matcher_is_refused_by_name(change, message):
    with pytest.raises(InputError, match=message):
        make_matcher(dataclasses.replace(StereoOptions(), **change))


def test_fixed_point_round_trip():
    disparity = np.array([[np.nan, 0, -3.03, 1000.02, -1000]], np.float32)
    again = decode_disparity(encode_disparity(disparity))
    assert encode_disparity(disparity)[0, :3].tolist() == [-32768, 0, -97]
    assert again.dtype == np.float32 and np.isnan(again[0, 0])
    assert np.nanmax(np.abs(again - disparity)) <= 1 / 64
    confidence = np.array([[0, 0.1, 0.5, 1]], np.float32)
    np.testing.assert_allclose(decode_confidence(encode_confidence(confidence)), confidence, atol=1 / 510)
    with pytest.raises(ValueError, match="do not fit"):
        encode_disparity(np.array([[1100.0]], np.float32))


def test_confidence_beyond_its_range_is_cut_off_and_never_wraps():
    found = decode_confidence(encode_confidence(np.array([-0.1, 0.0, 1.0, 1.01], np.float32)))
    np.testing.assert_array_equal(found, [0, 0, 1, 1])


def test_rectification_file_round_trip(tmp_path):
    tracks = [
        CameraTrack("a", (on_arc(0),), NEAR, FAR),
        CameraTrack("b", tuple(on_arc(12 + i) for i in range(3)), NEAR, FAR),
    ]
    pair = rectify_tracks(*tracks, RectifyOptions())
    write_rectification(tmp_path / "a-b.npz", pair)
    again = read_rectification(tmp_path / "a-b.npz")
    assert (again.left, again.right, again.status, again.size) == ("a", "b", "ok", pair.size)
    assert again.num_frames == len(again.frames) == 3
    for frame in range(3):
        for key, array in pair.at(frame).to_arrays().items():
            np.testing.assert_array_equal(again.at(frame).to_arrays()[key], array)
    with pytest.raises(InputError, match="frame in 0..2, got 3"):
        again.at(3)


class TestCommandLine:
    """Two cameras as folders of images, through ingest and both commands."""

    @pytest.fixture()
    def scene(self, tmp_path):
        cameras = {"cam00": on_arc(0), "cam01": on_arc(12), "cam02": on_arc(100)}
        for name, camera in cameras.items():
            for frame in range(2):
                write_png(tmp_path / name / f"{frame:06d}.png", render(camera)[0])
            put_on_clock(tmp_path / name, name, tmp_path / f"{name}.json", 30, 2)
        tracks = {name: CameraTrack(name, (camera,), NEAR, FAR) for name, camera in cameras.items()}
        write_json(tmp_path / "cameras.json", {"fps": 30, "num_frames": 2, "cameras": tracks_to_dict(tracks)})
        return tmp_path

    def rectify(self, scene, right):
        return run_stage(
            main,
            ["rectify", "--cameras", str(scene / "cameras.json"), "--left", "cam00", "--right", right]
            + ["--output", str(scene / "pair.npz")],
        )

    def match(self, scene, right, *frames):
        return run_stage(
            main,
            [
                "disparity",
                "--rectification",
                str(scene / "pair.npz"),
                "--cameras",
                str(scene / "cameras.json"),
            ]
            + ["--left-film", str(scene / "cam00.json"), "--right-film", str(scene / f"{right}.json")]
            + [*frames, "--output", str(scene / "disparity.npz")],
        )

    def test_frames_are_written_as_the_format_says(self, scene):
        assert self.rectify(scene, "cam01") == 0
        assert self.match(scene, "cam01", "--first", "0", "--last", "1") == 0
        archive = Archive(scene / "disparity.npz")
        assert archive.meta["status"] == "ok" and archive.meta["sigma_px"] == StereoOptions().sigma_px
        assert (archive.meta["left"], archive.meta["right"]) == ("cam00", "cam01")
        assert archive.frames() == [0, 1]
        arrays = archive.frame(1)
        assert arrays["left_disparity"].dtype == np.int16 and arrays["left_confidence"].dtype == np.uint8
        assert {"K_left", "K_right", "R_left", "R_right", "baseline", "disparity_range"} <= set(arrays)
        disparity = read_disparity_frame(archive, 1)
        error = np.abs(disparity.left_disparity - true_disparity(disparity.rectification, "left"))
        assert np.nanmedian(error) < 0.3
        with pytest.raises(InputError, match=r"expected frame 2 .*got frames \[0, 1\]"):
            read_disparity_frame(archive, 2)

    def test_listed_frames_and_ranges_give_the_same_bytes(self, scene):
        self.rectify(scene, "cam01")
        self.match(scene, "cam01", "--first", "0", "--last", "1")
        first = (scene / "disparity.npz").read_bytes()
        self.match(scene, "cam01", "--frames", "0", "1")
        assert (scene / "disparity.npz").read_bytes() == first

    def test_refused_pair_is_a_file_with_the_reason(self, scene):
        assert self.rectify(scene, "cam02") == 0
        pair = read_rectification(scene / "pair.npz")
        assert pair.frames == () and "degrees apart" in pair.status
        assert self.match(scene, "cam02", "--frames", "0") == 0
        archive = Archive(scene / "disparity.npz")
        assert archive.meta["status"] == pair.status and archive.frames() == []
        with pytest.raises(InputError, match="refused pair.*degrees apart"):
            read_disparity_frame(archive, 0)

    def test_unknown_camera_is_one_sentence(self, scene, capsys):
        assert self.rectify(scene, "cam09") == 2
        error = capsys.readouterr().err
        assert (
            "expected camera cam09" in error
            and "cam00, cam01, cam02" in error
            and len(error.splitlines()) == 1
        )

    def test_frames_must_be_given_once(self, scene, capsys):
        self.rectify(scene, "cam01")
        assert self.match(scene, "cam01") == 2
        assert self.match(scene, "cam01", "--first", "1", "--last", "0") == 2
        assert self.match(scene, "cam01", "--frames", "0", "--first", "0", "--last", "1") == 2
        assert "--first N --last M" in capsys.readouterr().err
        assert not (scene / "disparity.npz").exists()

    def test_nan_intrinsics_are_refused(self, scene, capsys):
        document = json.loads((scene / "cameras.json").read_text())
        document["cameras"]["cam01"]["frames"][0]["t"] = [None, 0, 0]
        (scene / "cameras.json").write_text(json.dumps(document))
        assert self.rectify(scene, "cam01") == 2
        assert "cam01" in capsys.readouterr().err

    def test_another_archive_is_no_rectification(self, scene, capsys):
        self.rectify(scene, "cam01")
        self.match(scene, "cam01", "--frames", "0")
        (scene / "disparity.npz").replace(scene / "pair.npz")
        assert self.match(scene, "cam01", "--frames", "0") == 2
        assert "expected a rectification" in capsys.readouterr().err


def test_real_pairs_are_matched_within_bounds():
    folder = SHARED / "middlebury_prime" / "data" / "Teddy"
    if not folder.is_dir():
        pytest.skip("needs the Middlebury pair Teddy, which is not at hand")
    left, right = read_image(folder / "im2.png"), read_image(folder / "im6.png")
    truth = read_image(folder / "disp2.png")[:, :, 0] / np.float32(4)
    height, width = truth.shape
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    camera = Camera(K, np.eye(3), np.zeros(3), (width, height))
    rectification = Rectification(
        K, K, np.eye(3), np.zeros(3), np.array([1.0, 0, 0]), (width, height), (0, 64)
    )
    options = StereoOptions()
    result = match_pair(rectification, (camera, camera), (left, right), make_matcher(options), options)
    found = np.isfinite(result.left_disparity) & (truth > 0)
    assert found.sum() / (truth > 0).sum() > 0.75
    assert np.mean(np.abs(result.left_disparity - truth)[found] > 2) < 0.08


def test_schema_has_the_options_and_their_defaults():
    schema = config.load_yaml(config.SCHEMA_FOLDER / "stereo.schema.yaml")
    defaults = {key: entry["default"] for key, entry in schema["properties"].items()}
    assert defaults == dataclasses.asdict(StereoOptions())
    assert schema["additionalProperties"] is False
    assert all(len(entry["description"]) > 5 for entry in schema["properties"].values())
