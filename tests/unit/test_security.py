"""What comes from strangers, files and networks alike, is read and never run."""

import ast
import io
import json
import re
import struct
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fourd.errors import InputError
from fourd.io import Archive, ArchiveWriter, read_csv, read_image, read_json, write_csv, write_json, write_png
from tests.conftest import REPOSITORY

MODULES = sorted((REPOSITORY / "fourd").rglob("*.py"))
RULES = sorted((REPOSITORY / "rules").glob("*.smk"))
# The only module that asks a network for anything, and how.
FETCH = REPOSITORY / "fourd" / "fetch.py"
# A page for a browser on the same computer, which starts the workflow.
DOOR = REPOSITORY / "fourd" / "view"
NETWORK = {"urllib", "http", "socket", "ssl", "ftplib", "requests", "httpx", "aiohttp", "smtplib", "asyncio"}
# The unpickler that takes arrays only, and the name of the error of a refused checkpoint.
PICKLE = {"metrics_lpips.py", "checkpoint.py"}


def calls(module: Path) -> Iterator[tuple[str, ast.Call]]:
    """Every call of a module with the dotted name of what is called."""
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), node


def keyword(call: ast.Call, name: str) -> object:
    return next((ast.literal_eval(k.value) for k in call.keywords if k.arg == name), None)


def imports(module: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.split(".")[0])
    return found


def test_nothing_that_is_read_is_run() -> None:
    """Pickles only by the restricted readers; no evaluation of text; YAML of plain values."""
    bad = []
    for module in MODULES:
        if "pickle" in imports(module) and module.name not in PICKLE:
            bad.append(f"{module.name}: pickle")
        for name, call in calls(module):
            if name == "torch.load" and keyword(call, "weights_only") is not True:
                bad.append(f"{module.name}:{call.lineno}: torch.load without weights_only")
            if name in ("np.load", "numpy.load") and keyword(call, "allow_pickle") is not False:
                bad.append(f"{module.name}:{call.lineno}: np.load without allow_pickle=False")
            if name in (
                "eval",
                "exec",
                "os.system",
                "os.popen",
                "yaml.load",
                "yaml.unsafe_load",
                "pickle.loads",
            ):
                bad.append(f"{module.name}:{call.lineno}: {name}")
            if keyword(call, "shell") is True:
                bad.append(f"{module.name}:{call.lineno}: a shell")
    assert bad == []


def test_only_fetch_uses_a_network_and_only_doors_start_programs() -> None:
    for module in MODULES:
        if module != FETCH and DOOR not in module.parents:
            assert not imports(module) & NETWORK, module
            assert "subprocess" not in imports(module), module
    assert "check_sha256(" in FETCH.read_text()
    # The door answers this computer only; programs are given as words, never as a line for a shell.
    assert 'ADDRESS = "127.0.0.1"' in (DOOR / "server.py").read_text()


def test_rules_start_no_network_program() -> None:
    for path in RULES:
        assert not re.search(r"\b(curl|wget|scp|ssh|rsync|git|pip)\b\s", path.read_text()), path


def test_text_of_users_reaches_a_shell_quoted() -> None:
    """Paths of a scene file carry `:q`; values of the configuration are flags that were quoted as words."""
    quoted = {"source", "calibration"}
    for path in RULES:
        for name, how in re.findall(r"\{input\.(\w+)(:q)?\}", path.read_text()):
            assert name not in quoted or how, f"{path.name}: input.{name}"


def png_of(width: int, height: int) -> bytes:
    """A gray PNG that says to be so large, in a few bytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"\0" * width))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("size", [(16385, 10), (10, 16385), (16384, 16384), (2**31 - 1, 2**31 - 1)])
def test_picture_of_absurd_size_is_refused_before_it_is_unpacked(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(png_of(*size))
    with pytest.raises(InputError, match=r"expected an image .*bomb\.png"):
        read_image(path)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a": ' + "9" * 5000 + "}", "\ufeff{}", "", "[1]", "\0"])
def test_documents_that_are_none_are_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "document.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"expected (a )?JSON.* in .*document\.json"):
        read_json(path)


def test_pickled_objects_in_an_archive_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "objects.npz"
    member = io.BytesIO()
    np.lib.format.write_array(member, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with ArchiveWriter(path) as archive:
        archive.add("plain", np.zeros(3))
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("objects.npy", member.getvalue())
    with pytest.raises(InputError, match=r"objects.*damaged"):
        Archive(path)["objects"]


def test_archive_without_whole_facts_is_named(tmp_path: Path) -> None:
    path = tmp_path / "facts.npz"
    with zipfile.ZipFile(path, "w") as archive:
        member = io.BytesIO()
        np.lib.format.write_array(member, np.frombuffer(b'{"cut', dtype=np.uint8))
        archive.writestr("meta.npy", member.getvalue())
    with pytest.raises(InputError, match=r"facts\.npz.*delete the file"):
        Archive(path)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("written")
    rng = np.random.default_rng(0)
    write_json(folder / "a.json", {"cameras": {f"cam{i}": [i, 0.5] for i in range(20)}})
    write_csv(folder / "a.csv", ("x", "y"), [{"x": i, "y": i * i} for i in range(20)])
    write_png(folder / "a.png", rng.integers(0, 255, (40, 50, 3), np.uint8))
    with ArchiveWriter(folder / "a.npz", {"status": "ok"}) as archive:
        archive.add_frame(0, depth=rng.random((8, 9)))
    return folder


def read_all(path: Path) -> None:
    if path.suffix == ".npz":
        archive = Archive(path)
        archive["000000/depth"]
    else:
        {".json": read_json, ".png": read_image}[path.suffix](path)


@settings(max_examples=30, deadline=None)
@given(name=st.sampled_from(["a.json", "a.npz", "a.png"]), share=st.floats(0, 0.95))
def test_file_cut_anywhere_is_a_sentence(written: Path, name: str, share: float) -> None:
    data = (written / name).read_bytes()
    cut = written / f"cut{Path(name).suffix}"
    cut.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match=re.escape(str(cut))):
        read_all(cut)


def test_table_cut_within_a_row_is_a_sentence(written: Path) -> None:
    cut = written / "cut.csv"
    cut.write_text((written / "a.csv").read_text()[:-6])
    with pytest.raises(InputError, match=r"row 20 of .*cut\.csv"):
        read_csv(cut)
    cut.write_bytes(b"x,y\n\xff,1\n")
    with pytest.raises(InputError, match=r"expected a table in .*cut\.csv"):
        read_csv(cut)


def test_leftovers_of_killed_jobs_go_with_the_next_whole_file(tmp_path: Path) -> None:
    left = [tmp_path / ".a.tmp99999.json", tmp_path / ".b.tmp99999.json", tmp_path / ".a.tmpx"]
    for path in left:
        path.write_text("half")
    write_json(tmp_path / "a.json", {"x": 1})
    assert sorted(path.name for path in tmp_path.iterdir()) == [".a.tmpx", ".b.tmp99999.json", "a.json"]
    assert json.loads((tmp_path / "a.json").read_text())["x"] == 1
