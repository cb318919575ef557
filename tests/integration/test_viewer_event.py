"""From the event to its page, a view rendered when asked for, and the film of a path that the page saved."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from fourd.io import read_image
from fourd.view.live import LiveScene
from tests.conftest import Workspace, tiny_scene


def save_path(browser, page_file: Path, output: Path) -> None:
    """A path of two key frames, taken in the browser."""
    page = browser.new_page()
    page.goto(page_file.as_uri() + "#t=0&v=0.25")
    page.wait_for_function("document.getElementById('picture').dataset.exact === 'true'")
    page.click("#add-key")
    page.evaluate("location.hash = '#t=5&v=0.75'")
    page.wait_for_function("document.getElementById('view').value === '0.75'")
    page.click("#add-key")
    page.fill("#keys input", "0.2")
    page.press("#keys input", "Enter")
    with page.expect_download() as download:
        page.click("#save-path")
    download.value.save_as(output)
    page.close()


def test_page_live_view_and_saved_film(
    workspace: Workspace, browser, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tiny_scene(num_cameras=4)
    scene["settings"] |= {"chunk_frames": 6, "viewer": {"num_views": 3}}
    workspace.write_scene("demo", scene)
    result = workspace.snakemake("--cores", "2", "viewer", "--show-failed-logs", timeout_s=1200)
    assert result.returncode == 0, result.stdout
    folder = workspace.folder / "results" / "demo"
    log = (workspace.folder / "logs" / "demo" / "viewer_page.log").read_text()
    assert "6 moments of 3 views" in log
    assert not list((folder / "lattice" / "foreground").glob("*/*.npz")), "estimates of the lattice stay"
    assert workspace.planned("viewer") == {}
    assert set(workspace.planned("viewer", "--config", "viewer={quality: 60}")) == {"viewer_page"}

    monkeypatch.chdir(workspace.folder)
    live = LiveScene("demo", Path("results"))
    steps: list[str] = []
    image = live.render(0.5, 3, 96, lambda step, done: steps.append(step))
    rendered = read_image(folder / "lattice" / "render" / "lattice-01" / "000000-000005" / "000003.png")
    assert list(dict.fromkeys(steps)) == ["background", "foreground", "composition"]
    assert len(steps) == 3 + len(live.samples.frames)
    assert np.abs(image.astype(int) - rendered).mean() < 2

    path = workspace.folder / "saved.json"
    save_path(browser, folder / "viewer" / "index.html", path)
    assert json.loads(path.read_text())["num_frames"] == 6
    film = os.path.join("results", "demo", "render", "mine.mp4")
    made = workspace.snakemake(
        "--cores", "2", film, "--config", "trajectories={mine: {file: saved.json}}", "--show-failed-logs"
    )
    assert made.returncode == 0, made.stdout
    assert (workspace.folder / film).stat().st_size > 1000
