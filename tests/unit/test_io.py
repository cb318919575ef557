"""Files are whole or absent, and say so."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra import numpy as arrays
from PIL import Image

from fourd import io
from fourd.errors import InputError


def test_atomic_path_leaves_nothing_behind_on_failure(tmp_path: Path) -> None:
    target = tmp_path / "result.json"
    target.write_text("old")
    with pytest.raises(RuntimeError), io.atomic_path(target) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["result.json"]


def test_json_round_trip_and_faults(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    io.write_json(path, {"x": [1.5, None]})
    assert io.read_json(path) == {"schema_version": io.SCHEMA_VERSION, "x": [1.5, None]}
    with pytest.raises(InputError, match=r"write to .*a\.json, got nan for x\[1\]\.y"):
        io.write_json(path, {"x": [1.5, {"y": np.float64("nan")}]})
    assert io.read_json(path)["x"] == [1.5, None]
    path.write_text("{")
    with pytest.raises(InputError, match=r"expected JSON in .*a\.json"):
        io.read_json(path)
    with pytest.raises(InputError, match="found nothing"):
        io.read_json(tmp_path / "b.json")


@settings(max_examples=25, deadline=None)
@given(arrays.arrays(np.float32, arrays.array_shapes(max_dims=3, max_side=5)))
def test_archive_round_trip(tmp_path_factory: pytest.TempPathFactory, array: np.ndarray) -> None:
    path = tmp_path_factory.mktemp("archive") / "a.npz"
    with io.ArchiveWriter(path, {"view": "cam00"}) as archive:
        archive.add_frame(12, depth=array)
        archive.add_frame(3, depth=array)
    opened = io.Archive(path)
    assert opened.meta["view"] == "cam00"
    assert opened.frames() == [3, 12]
    np.testing.assert_array_equal(opened.frame(12)["depth"], array)
    with np.load(path) as loaded:
        np.testing.assert_array_equal(loaded["000003/depth"], array)


def test_archive_bytes_depend_on_content_only(tmp_path: Path) -> None:
    for name in ("a", "b"):
        with io.ArchiveWriter(tmp_path / f"{name}.npz") as archive:
            archive.add("x", np.arange(5))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_cut_archive_is_refused_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "cut.npz"
    with io.ArchiveWriter(path) as archive:
        archive.add("x", np.arange(1000))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(InputError, match=r"whole archive .*cut\.npz.*delete the file"):
        io.Archive(path)


def test_a_meta_that_is_no_json_leaves_no_file(tmp_path: Path) -> None:
    with (
        pytest.raises(InputError, match=r"a\.npz, got inf for fps"),
        io.ArchiveWriter(tmp_path / "a.npz", {"fps": float("inf")}) as archive,
    ):
        archive.add("x", np.arange(5))
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("meta", ["[]", "1", "{}", '{"schema_version": 9}'])
def test_archives_of_another_kind_are_refused(tmp_path: Path, meta: str) -> None:
    np.savez(tmp_path / "other.npz", meta=np.frombuffer(meta.encode(), np.uint8))
    with pytest.raises(InputError, match=r"whole archive .*other\.npz.* schema_version 1"):
        io.Archive(tmp_path / "other.npz")


def test_arrays_of_another_form_are_refused(tmp_path: Path) -> None:
    with io.ArchiveWriter(tmp_path / "a.npz") as archive:
        archive.add("rgb", np.zeros((4, 6, 3), np.uint8))
        archive.add("none", np.zeros((0, 6, 3), np.uint8))
    opened = io.Archive(tmp_path / "a.npz")
    assert opened.read("rgb", np.uint8, (None, 6, 3)).shape == (4, 6, 3)
    for name, dtype, shape in (
        ("rgb", np.float32, (None, None, 3)),
        ("rgb", np.uint8, (None, None)),
        ("rgb", np.uint8, (5, None, 3)),
        ("none", np.uint8, (None, None, 3)),
    ):
        with pytest.raises(InputError, match=rf"expected {name} of type .*a\.npz, got uint8 \([04], 6, 3\)"):
            opened.read(name, dtype, shape)
    with pytest.raises(InputError, match=r"expected depth in .*a\.npz, found none"):
        opened.read("depth", np.float32, ())


def test_damaged_bytes_are_noticed_by_their_checksum(tmp_path: Path) -> None:
    path = tmp_path / "damaged.npz"
    with io.ArchiveWriter(path) as archive:
        archive.add("x", np.arange(1000))
    data = bytearray(path.read_bytes())
    data[1000] ^= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"damaged\.npz: the bytes of x are damaged"):
        io.Archive(path)["x"]


def test_convention_colours_are_rgb(tmp_path: Path) -> None:
    image = np.zeros((4, 6, 3), np.uint8)
    image[..., 0] = 200
    io.write_png(tmp_path / "red.png", image)
    np.testing.assert_array_equal(io.read_image(tmp_path / "red.png"), image)
    # Two exchanges would undo each other.
    assert Image.open(tmp_path / "red.png").getpixel((0, 0)) == (200, 0, 0)
    (tmp_path / "no.png").write_text("text")
    with pytest.raises(InputError, match="can be decoded"):
        io.read_image(tmp_path / "no.png")


WRITE_EIGHT_MEGABYTES = """
import sys
import numpy as np
from fourd import io
from fourd.cli import run_stage

def main(argv):
    with io.ArchiveWriter(argv[0]) as archive:
        archive.add("x", np.zeros(1_000_000))

sys.exit(run_stage(main, sys.argv[1:]))
"""


def write_too_much(target: Path, **how: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", WRITE_EIGHT_MEGABYTES, str(target)],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
        **how,  # type: ignore[call-overload]
    )


def check_refused(result: subprocess.CompletedProcess[str], target: Path) -> None:
    assert result.returncode == 3
    assert "Traceback" not in result.stderr
    assert "big.npz" in result.stderr
    assert target.read_text() == "finished work"
    assert os.listdir(target.parent) == ["big.npz"]


def test_file_size_limit_is_a_sentence_and_keeps_what_was_there(tmp_path: Path) -> None:
    target = tmp_path / "big.npz"
    target.write_text("finished work")

    def limit_file_size() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    check_refused(write_too_much(target, preexec_fn=limit_file_size), target)


def test_full_disk_is_a_sentence_and_keeps_what_was_there(tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=256k", "fourd-test", str(disk)]
    mounted = subprocess.run(mount, capture_output=True, text=True)
    if mounted.returncode != 0:
        pytest.skip(f"needs the right to mount a small disk: {mounted.stderr.strip()}")
    try:
        target = disk / "big.npz"
        target.write_text("finished work")
        result = write_too_much(target)
        check_refused(result, target)
        assert "the disk is full" in result.stderr
    finally:
        subprocess.run(["umount", str(disk)], check=True)
