"""The server on one's own machine: who may ask, what is read and written, one run, one view at a time."""

import http.client
import io
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from fourd.errors import InputError
from fourd.view.__main__ import main
from fourd.view.job import MAX_FILM_BYTES, MAX_FILMS, WorkflowJob, check_scene_name, store_film
from fourd.view.live import BackgroundSteps, Cancelled, LiveQueue
from fourd.view.server import ViewServer
from tests.conftest import REPOSITORY, Workspace
from tests.unit.film_files import constant_ticks, write_video

OWN = {"X-Fourd": "1"}


@pytest.fixture
def server(tmp_path: Path) -> Iterator[ViewServer]:
    page = tmp_path / "results" / "event" / "viewer"
    (page / "data").mkdir(parents=True)
    (page / "index.html").write_text("<head></head>page")
    (page / "data" / "view-lattice-00-0.js").write_text("fourd.receive()")
    (tmp_path / "results" / "event" / "secret.js").write_text("secret")
    (page / "data" / "link.js").symlink_to(tmp_path / "results" / "event" / "secret.js")
    with ViewServer(tmp_path / "results", WorkflowJob(tmp_path, 1)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


def ask(
    server: ViewServer, path: str, method: str = "GET", body: bytes | None = None, **headers: str
) -> tuple[int, bytes, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1], timeout=30)
    connection.request(method, path, body, {key.replace("_", "-"): value for key, value in headers.items()})
    answer = connection.getresponse()
    data = answer.read()
    connection.close()
    return answer.status, data, dict(answer.getheaders())


def test_only_this_machine_is_answered(server: ViewServer) -> None:
    assert server.server_address[0] == "127.0.0.1"
    address = socket.gethostbyname(socket.gethostname())
    if not address.startswith("127."):
        with pytest.raises(OSError):
            socket.create_connection((address, server.server_address[1]), timeout=2).close()


def test_page_and_its_files_are_sent_with_a_strict_policy(server: ViewServer) -> None:
    status, data, headers = ask(server, "/scenes/event/")
    assert (status, b'dataset.live = "yes"' in data, b"page" in data) == (200, True, True)
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert ask(server, "/scenes/event/data/view-lattice-00-0.js")[:2] == (200, b"fourd.receive()")
    assert b"Drop videos" in ask(server, "/")[1]


@pytest.mark.parametrize(
    "path",
    [
        "/scenes/event/../secret.js",
        "/scenes/event/data/../../secret.js",
        "/scenes/event/data/link.js",
        "/scenes/event/data/%2e%2e/%2e%2e/secret.js",
        "/scenes/../config/index.html",
        "/scenes/event/data/",
        "/scenes//etc/passwd",
        "/results/event/secret.js",
        "/scenes/nothing/",
    ],
)
def test_nothing_else_is_read(server: ViewServer, path: str) -> None:
    status, data, _ = ask(server, path)
    assert status in (400, 404)
    assert data != b"secret" and b"error" in data


def test_pages_of_other_hosts_are_turned_away(server: ViewServer) -> None:
    assert ask(server, "/", Host="evil.example")[0] == 403
    assert ask(server, "/api/run", "POST")[0] == 403
    assert ask(server, "/api/run", Sec_Fetch_Site="cross-site")[0] == 403
    assert ask(server, "/api/run", Sec_Fetch_Site="same-origin")[0] == 200
    assert ask(server, "/api/film?scene=a&index=0&suffix=mp4", "PUT", b"film")[0] == 403


def test_films_are_stored_under_names_of_their_own(server: ViewServer, tmp_path: Path) -> None:
    status, data, _ = ask(server, "/api/film?scene=party&index=3&suffix=mp4", "PUT", b"film", X_Fourd="1")
    assert (status, json.loads(data)) == (200, {"name": "cam03.mp4"})
    assert (tmp_path / "data" / "uploads" / "party" / "cam03.mp4").read_bytes() == b"film"
    for query in (
        "scene=../up&index=0&suffix=mp4",
        "scene=party&index=0&suffix=../../x",
        "scene=party&index=0&suffix=html",
        f"scene=party&index={MAX_FILMS}&suffix=mp4",
        "scene=party&index=-1&suffix=mp4",
        "scene=party&index=x&suffix=mp4",
        "scene=<script>&index=0&suffix=mp4",
    ):
        status, data, headers = ask(server, f"/api/film?{query}", "PUT", b"film", X_Fourd="1")
        assert (status, headers["Content-Type"]) == (400, "application/json"), query
    assert [path.name for path in (tmp_path / "data" / "uploads").rglob("*.*")] == ["cam03.mp4"]
    assert not list(tmp_path.glob("up*"))


def test_films_of_wrong_size_leave_nothing(tmp_path: Path) -> None:
    for num_bytes in (0, MAX_FILM_BYTES + 1):
        with pytest.raises(InputError, match="expected a film of 1 byte to 4 GB"):
            store_film(tmp_path, 0, "mp4", io.BufferedReader(io.BytesIO(b"film")), num_bytes)
    with pytest.raises(InputError, match="6 are missing: send it again"):
        store_film(tmp_path, 0, "mp4", io.BufferedReader(io.BytesIO(b"film")), 10)
    assert list(tmp_path.iterdir()) == []


def test_a_film_sent_again_makes_nothing_anew(tmp_path: Path) -> None:
    def send(film: bytes) -> os.stat_result:
        path = store_film(tmp_path, 0, "mp4", io.BufferedReader(io.BytesIO(film)), len(film))
        assert path.read_bytes() == film
        return path.stat()

    send(b"film")
    os.utime(tmp_path / "cam00.mp4", ns=(10**18, 10**18))
    assert send(b"film").st_mtime_ns == 10**18
    assert send(b"Film").st_mtime_ns > 10**18


def test_scene_names_are_words() -> None:
    assert check_scene_name("my_event2") == "my_event2"
    for name in ("", "..", "a/b", "Event", "a" * 33, "event\n", "é"):
        with pytest.raises(InputError, match="expected a scene name"):
            check_scene_name(name)


def wait_for(job: WorkflowJob) -> dict:
    end = time.monotonic() + 120
    while job.state["status"] == "running" and time.monotonic() < end:
        time.sleep(0.1)
    return job.state


def test_run_needs_films_and_says_what_went_wrong(workspace: Workspace) -> None:
    job = WorkflowJob(workspace.folder, 1)
    with pytest.raises(InputError, match="expected at least 2 films, got 0"):
        job.start("party", 0)
    for index in range(2):
        store_film(job.films_folder("party"), index, "mp4", io.BufferedReader(io.BytesIO(b"no film")), 7)
    job.start("party", 2)
    with pytest.raises(InputError, match="expected one run at a time"):
        job.start("party", 2)
    state = wait_for(job)
    assert state["status"] == "failed"
    assert any("cam00.mp4" in line for line in state["words"])


def test_run_goes_through_scene_file_and_workflow(workspace: Workspace) -> None:
    dry = ("--snakefile", str(REPOSITORY / "Snakefile"), "-n", "--quiet", "rules", "host")
    job = WorkflowJob(workspace.folder, 1, dry)
    folder = job.films_folder("party")
    folder.mkdir(parents=True)
    for index in range(2):
        write_video(folder / f"cam{index:02d}.mp4", constant_ticks(12))
    job.start("party", 2, is_synchronized=True)
    state = wait_for(job)
    assert state["status"] == "done", state
    assert state["address"] == "/scenes/party/"
    assert (workspace.folder / "config" / "scenes" / "party.yaml").is_file()
    scene_file = workspace.folder / "config" / "scenes" / "party.yaml"
    written = scene_file.stat().st_mtime_ns
    job.start("party", 2)
    assert wait_for(job)["status"] == "done", "the same films go on"
    assert scene_file.stat().st_mtime_ns == written
    with pytest.raises(InputError, match="there is one of other films already"):
        job.start("party", 3)
    write_video(folder / "cam02.mp4", constant_ticks(12))
    with pytest.raises(InputError, match="there is one of other films already"):
        job.start("party", 3)


def test_progress_is_read_from_the_workflow_and_a_run_can_be_cancelled(workspace: Workspace) -> None:
    snakefile = workspace.folder / "Snakefile"
    snakefile.write_text(
        "rule viewer:\n    input: 'b'\n"
        "checkpoint b:\n    input: 'a'\n    output: 'b'\n    shell: 'sleep 60; touch b'\n"
        "rule a:\n    output: 'a'\n    shell: 'touch a'\n"
    )
    job = WorkflowJob(workspace.folder, 1, ("--nolock",))
    folder = job.films_folder("party")
    folder.mkdir(parents=True)
    for index in range(2):
        write_video(folder / f"cam{index:02d}.mp4", constant_ticks(12))
    job.start("party", 2, is_synchronized=True)
    end = time.monotonic() + 100
    while job.state.get("step") != "b" and job.state["status"] == "running" and time.monotonic() < end:
        time.sleep(0.1)
    assert (job.state["step"], job.state["done"], job.state["total"]) == ("b", 1, 3), job.state
    with pytest.raises(InputError, match="expected one run at a time"):
        job.start("party", 2)
    start = time.monotonic()
    job.cancel()
    assert wait_for(job)["status"] == "cancelled"
    assert time.monotonic() - start < 30
    assert not (workspace.folder / "b").exists()


def test_newest_wish_wins() -> None:
    begun, go = threading.Event(), threading.Event()
    rendered: list[float] = []

    def render(share: float, frame: int, width: int, tell) -> np.ndarray:
        begun.set()
        go.wait(10)
        tell("foreground", 0.5)
        rendered.append(share)
        return np.zeros((2, 3, 3), np.uint8)

    queue = LiveQueue(render)
    results: dict[float, object] = {}

    def wish(share: float) -> None:
        try:
            results[share] = queue.ask(share, 0, 64)
        except Cancelled as error:
            results[share] = error

    threads = []
    for share in (0.1, 0.2, 0.3):
        threads.append(threading.Thread(target=wish, args=(share,)))
        threads[-1].start()
        assert begun.wait(10)
        time.sleep(0.1)
    go.set()
    for thread in threads:
        thread.join(10)
    assert rendered == [0.3]
    assert isinstance(results[0.1], Cancelled) and isinstance(results[0.2], Cancelled)
    picture = results[0.3]
    assert isinstance(picture, bytes) and picture.startswith(b"\x89PNG")
    assert queue.state["step"] == "idle"


def test_faults_of_live_views_are_sentences(server: ViewServer) -> None:
    for query in ("scene=event", "scene=event&share=x&frame=1", "scene=../x&share=0.5&frame=1"):
        status, data, _ = ask(server, f"/api/render?{query}")
        assert (status, "expected" in json.loads(data)["error"]) == (400, True)
    status, data, _ = ask(server, "/api/render?scene=event&share=0.5&frame=1")
    assert status == 400 and "known scenes are" in json.loads(data)["error"]
    assert json.loads(ask(server, "/api/live?scene=event")[1])["step"] == "idle"


def test_scene_without_a_page_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"viewer --config scene=event` makes it"):
        main(["event", "--results", str(tmp_path), "--no-browser"])


def test_a_port_that_is_taken_is_named(server: ViewServer, tmp_path: Path) -> None:
    taken = str(server.server_address[1])
    with pytest.raises(InputError, match=f"expected port {taken} to be free"):
        main(["--results", str(tmp_path), "--port", taken, "--no-browser"])


def test_a_background_is_stopped_by_a_newer_wish() -> None:
    def tell(step: str, share: float) -> None:
        told.append(share)
        if len(told) == 2:
            raise Cancelled

    told: list[float] = []
    steps = BackgroundSteps(4, tell)
    steps.step("sample 0")
    with pytest.raises(Cancelled):
        steps.step("sample 5")
    assert told == pytest.approx([0.2, 0.4])
