"""The stage `fuse` on files: contract, refusals, determinism, error messages."""

import contextlib
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from fourd.errors import InputError
from fourd.fuse import ESTIMATES, FuseOptions
from fourd.fuse.__main__ import main
from fourd.fuse.files import Silhouettes
from fourd.io import Archive, ArchiveWriter, write_json
from tests.unit.fuse_scene import SIZE, change_archive, pair_from_plane, stage_words, write_pair, write_scene

SMALL = np.zeros((4, 24))


def test_options_equal_the_schema():
    path = Path(__file__).resolve().parents[2] / "config" / "schemas" / "fuse.schema.yaml"
    schema = yaml.safe_load(path.read_text(encoding="utf-8"))
    defaults = {key: entry["default"] for key, entry in schema["properties"].items()}
    assert defaults == dataclasses.asdict(FuseOptions())
    assert schema["additionalProperties"] is False


def test_stage_writes_the_contract(tmp_path):
    write_scene(tmp_path)
    output = tmp_path / "out.npz"
    main(["foreground", *stage_words(tmp_path), "--device", "cpu", "--output", str(output)])
    archive = Archive(output)
    assert archive.frames() == [0, 1]
    keys = {f"{e}_{kind}" for e in ESTIMATES for kind in ("rgb", "valid")}
    arrays = archive.frame(1)
    assert set(arrays) == keys | {"depth", "support", "num_cameras", "source", "depth_source"}
    height, width = SIZE[1], SIZE[0]
    assert arrays["consensus_rgb"].shape == (height, width, 3) and arrays["consensus_rgb"].dtype == np.uint8
    assert arrays["depth"].dtype == np.float32 and arrays["support"].dtype == np.uint8
    assert archive.meta["cameras"] == ["cam00", "cam01", "cam02"] and len(archive.meta["pairs"]) == 3
    assert archive.meta["frame_status"] == {"000000": "ok", "000001": "ok"}
    assert arrays["consensus_valid"].mean() > 0.5


def test_stage_leaves_out_pairs_with_the_target_and_refused_pairs(tmp_path):
    cameras = write_scene(tmp_path)
    pair = pair_from_plane(cameras, "cam00", "cam02", 4.0)
    write_pair(tmp_path / "disparity" / "cam00-cam02.npz", pair, (), status="too wide: 91 degrees")
    output = tmp_path / "out.npz"
    words = stage_words(tmp_path, "cam01")
    main(["foreground", *words, "--estimates", "consensus", "--device", "cpu", "--output", str(output)])
    archive = Archive(output)
    assert archive.meta["pairs"] == [] and archive.meta["cameras"] == ["cam00", "cam02"]
    assert archive.meta["refused"]["cam00-cam02"] == "too wide: 91 degrees"
    assert "cam01" in archive.meta["refused"]["cam00-cam01"]
    assert archive.meta["frame_status"]["000000"] == "no usable pair"
    arrays = archive.frame(0)
    assert not arrays["consensus_valid"].any() and "closest_rgb" not in arrays


def test_stage_is_deterministic_and_memory_does_not_matter(tmp_path):
    write_scene(tmp_path)
    for name, memory in (("a", "512"), ("b", "512"), ("c", "16")):
        words = ["foreground", *stage_words(tmp_path), "--device", "cpu", "--memory-mb", memory]
        main([*words, "--output", str(tmp_path / f"{name}.npz")])
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    a, c = Archive(tmp_path / "a.npz").frame(0), Archive(tmp_path / "c.npz").frame(0)
    assert all(np.array_equal(a[key], c[key], equal_nan=key == "depth") for key in a)


def test_stage_names_the_missing_frame(tmp_path):
    cameras = write_scene(tmp_path)
    pair = pair_from_plane(cameras, "cam00", "cam02", 4.0)
    write_pair(tmp_path / "disparity" / "cam00-cam02.npz", pair, (0,))
    output = tmp_path / "out.npz"
    with pytest.raises(InputError, match="cam00-cam02 at scene frame 1.*frames 0 to 0"):
        main(["foreground", *stage_words(tmp_path), "--device", "cpu", "--output", str(output)])
    assert not output.exists() and not list(tmp_path.glob(".out*"))


@pytest.mark.parametrize(
    ("arrays", "meta"),
    [
        ({"K_left": None}, {}),
        ({"K_left": np.full((3, 3), 1e300)}, {}),
        ({"K_right": np.zeros((3, 3))}, {}),
        ({"R_left": np.zeros((3, 3))}, {}),
        ({"center_left": np.zeros(6)}, {}),
        ({"center_left": np.array(["x", "y", "z"])}, {}),
        ({"disparity_range": np.array([np.nan, 1])}, {}),
        ({"right_disparity": SMALL.astype(np.int16)}, {}),
        ({"right_disparity": SMALL.astype(np.int16), "right_confidence": SMALL.astype(np.uint8)}, {}),
        ({"left_disparity": np.zeros(SIZE[::-1])}, {}),
        ({"left_confidence": np.zeros((1, *SIZE[::-1]), np.uint8)}, {}),
        ({}, {"sigma_px": [None]}),
    ],
)
def test_stage_names_a_damaged_disparity(tmp_path, arrays, meta):
    write_scene(tmp_path)
    path = tmp_path / "disparity" / "cam00-cam01.npz"
    change_archive(path, {f"000001/{name}": array for name, array in arrays.items()}, meta)
    with pytest.raises(InputError, match=r"cam00-cam01\.npz"):
        main(["foreground", *stage_words(tmp_path), "--device", "cpu", "--output", str(tmp_path / "o.npz")])


def test_stage_reports_cameras_that_are_not_calibrated(tmp_path):
    write_scene(tmp_path)
    document = json.loads((tmp_path / "cameras.json").read_text())
    del document["cameras"]["cam02"]
    write_json(tmp_path / "cameras.json", document)
    with pytest.raises(InputError, match="cam02"):
        main(["foreground", *stage_words(tmp_path), "--device", "cpu", "--output", str(tmp_path / "o.npz")])


def write_silhouettes(path, cameras, frames):
    with ArchiveWriter(
        path, {"cameras": dict.fromkeys(cameras, "ok") | {"cam09": "no background"}}
    ) as writer:
        for frame in frames:
            writer.add_frame(frame, **{name: np.full(SIZE[::-1], 255, np.uint8) for name in cameras})


def test_stage_takes_depth_from_silhouettes_where_no_pair_is_usable(tmp_path):
    cameras = write_scene(tmp_path)
    for path in (tmp_path / "disparity").glob("*.npz"):
        left, right = path.stem.split("-")
        write_pair(path, pair_from_plane(cameras, left, right, 4.0), (), status="too wide")
    write_silhouettes(tmp_path / "masks.npz", cameras, [0, 1])
    words = ["foreground", *stage_words(tmp_path), "--silhouettes", str(tmp_path / "masks.npz")]
    main([*words, "--device", "cpu", "--output", str(tmp_path / "o.npz")])
    with contextlib.closing(Archive(tmp_path / "o.npz")) as archive:
        arrays = archive.frame(0)
    is_hull = arrays["depth_source"] == 2
    assert is_hull.any() and not (arrays["depth_source"] == 1).any()
    np.testing.assert_array_equal(is_hull, np.isfinite(arrays["depth"]))
    np.testing.assert_array_equal(is_hull, arrays["consensus_valid"])
    assert not arrays["support"].any()


def test_own_silhouette_is_not_used(tmp_path):
    write_silhouettes(tmp_path / "masks.npz", ["cam00", "cam01"], [3])
    silhouettes = Silhouettes([tmp_path / "masks.npz"], exclude="cam01")
    assert list(silhouettes.at(3)) == ["cam00"] and silhouettes.at(4) == {}
    assert silhouettes.status == {"cam09": "no background"}
    silhouettes.close()
    with ArchiveWriter(tmp_path / "other.npz", {"view": "cam00"}):
        pass
    with pytest.raises(InputError, match="its meta lacks `cameras`: delete it"):
        Silhouettes([tmp_path / "other.npz"], exclude="cam01")
