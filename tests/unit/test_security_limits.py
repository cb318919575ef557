"""Scene files and films from strangers: what is absurd, or would be read as a command, is refused by name."""

import os
import shutil
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import av
import pytest

from fourd.config import load_config, load_scene, load_yaml
from fourd.errors import InputError
from fourd.sources import source_stamp
from fourd.video import probe_video
from tests.conftest import Workspace
from tests.small_event import small_scene

HOSTILE = ["a{cam}.mp4", "<results>.mp4", "new\nline.mp4", "nul\0.mp4", ""]


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("where", ["source", "background", "calibration", "labels"])
def test_paths_that_the_engine_would_read_as_patterns_are_refused(
    workspace: Workspace, where: str, name: str
) -> None:
    scene = small_scene()
    if where in ("source", "background"):
        scene["cameras"]["cam00"][where] = name
    else:
        scene[where] = [name] if where == "calibration" else name
    workspace.write_scene("demo", scene)
    with pytest.raises(InputError, match=f"{where}.*expected text that matches"):
        load_scene("demo", workspace.folder / "config" / "scenes")


@pytest.mark.parametrize("path", ["a b", "a;touch pwned", "$(touch pwned)", "`a`", "a'b", "-rf", "", "a{b}"])
def test_folders_that_stand_in_commands_are_plain(path: str) -> None:
    with pytest.raises(InputError, match="pathvars.*expected text that matches"):
        load_config({"pathvars": {"results": path}}, {}, "demo")


def test_folder_that_there_is_none_of_is_refused() -> None:
    with pytest.raises(InputError, match="pathvars"):
        load_config({"pathvars": {"home": "/tmp"}}, {}, "demo")


@pytest.mark.parametrize(
    "source", ["data/demo/frames/../../../pwned", "data/demo/frames/cam00&&touch pwned", "data/demo/frames/x"]
)
def test_demo_makes_nothing_but_its_cameras(workspace: Workspace, source: str) -> None:
    scene = small_scene()
    scene["cameras"]["cam00"]["source"] = source
    workspace.write_scene("demo", scene)
    result = workspace.snakemake("results/demo/ingest/cam00.json", "--cores", "1", "--show-failed-logs")
    assert result.returncode != 0
    assert "Traceback" not in result.stdout
    assert list(workspace.folder.rglob("pwned*")) == []


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [1]\nb: *a",
        "a: " + "[" * 5000,
        "a: " + "9" * 5000,
        "a: 2020-99-99",
        "? [a]\n: b",
        "a: !!python/name:os",
    ],
)
def test_yaml_that_unpacks_or_makes_no_sense_is_a_sentence(tmp_path: Path, text: str) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"expected YAML in .*scene\.yaml"):
        load_yaml(path)


@pytest.fixture
def listener() -> Iterator[tuple[int, list]]:
    """A port of this computer, and who asked it."""
    asked: list = []
    server = socket.create_server(("127.0.0.1", 0))
    server.settimeout(0.1)
    done = threading.Event()

    def listen() -> None:
        while not done.is_set():
            try:
                connection, address = server.accept()
            except TimeoutError:
                continue
            asked.append(address)
            connection.close()

    thread = threading.Thread(target=listen)
    thread.start()
    yield server.getsockname()[1], asked
    done.set()
    thread.join()
    server.close()


HLS = "#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\n{}\n#EXT-X-ENDLIST\n"


@pytest.mark.parametrize(
    "text",
    [HLS.format("http://127.0.0.1:PORT/a.ts"), HLS.format("FILM"), "ffconcat version 1.0\nfile 'FILM'\n"],
    ids=["network", "playlist", "list"],
)
@pytest.mark.parametrize("name", ["list.mp4", "list.m3u8"])
def test_lists_of_films_are_none(tmp_path: Path, listener: tuple[int, list], text: str, name: str) -> None:
    port, asked = listener
    write_film(tmp_path / "real.mp4", 64, 48)
    (tmp_path / name).write_text(text.replace("PORT", str(port)).replace("FILM", "real.mp4"))
    with pytest.raises(InputError, match=name):
        probe_video(tmp_path / name)
    assert asked == []


def write_film(path: Path, width: int, height: int) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg", rate=30)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuvj420p"
        stream.thread_count = 1
        for packet in stream.encode(av.VideoFrame(width, height, "yuvj420p")):
            container.mux(packet)
        for packet in stream.encode(None):
            container.mux(packet)


def test_names_with_a_colon_are_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_film(tmp_path / "http:10.30.mp4", 64, 48)
    monkeypatch.chdir(tmp_path)
    assert probe_video("http:10.30.mp4").size == (64, 48)


def test_frames_of_absurd_size_are_refused_before_they_are_decoded(tmp_path: Path) -> None:
    write_film(tmp_path / "huge.mp4", 16000, 12000)
    with pytest.raises(InputError, match=r"at most \d+ px a frame at .*huge\.mp4, got 16000 x 12000"):
        probe_video(tmp_path / "huge.mp4")


def test_stamp_tells_a_source_that_was_replaced_by_an_older_one(tmp_path: Path) -> None:
    film = tmp_path / "film.mp4"
    film.write_bytes(b"one")
    before = source_stamp(str(film), ("data/demo/",))
    assert source_stamp(str(film), ("data/demo/",)) == before
    film.write_bytes(b"two")
    os.utime(film, (0, 0))
    assert source_stamp(str(film), ("data/demo/",)) != before
    folder = source_stamp(str(tmp_path), ())
    shutil.copy(film, tmp_path / "another.png")
    assert source_stamp(str(tmp_path), ()) != folder
    assert source_stamp("data/demo/frames/cam00", ("data/demo/",)) == ""
