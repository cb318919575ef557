"""The page that plays an event, in a real browser from the disk: what it shows, asks for and saves."""

import base64
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from fourd.camera import Camera
from fourd.config import SCHEMA_FOLDER, load_yaml, validate
from fourd.trajectory import scene_frames, trajectory_from_mapping
from fourd.trajectory.presets import place_cameras
from fourd.viewer.__main__ import main
from tests.unit import viewer_scene
from tests.unit.viewer_scene import FRAMES, NUM_FRAMES, NUM_VIEWS, SIZE, cross_fade, psnr_db

READY = "document.getElementById('picture').dataset.exact === 'true'"
LOADED = "document.getElementById('status').textContent.includes('moments from')"
# A browser that draws without a graphics card says so as a warning when its picture is taken.
DRIVER = "GPU stall due to ReadPixels"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("viewer") / "event"
    words = viewer_scene.write_event(folder)
    main([*words, "--quality", "90", "--output", str(folder / "viewer")])
    return folder / "viewer"


@pytest.fixture
def page(browser, folder: Path) -> Iterator:
    """The page, loaded; it may say nothing and ask for nothing but its own files."""
    context = browser.new_context(viewport={"width": 1000, "height": 800}, accept_downloads=True)
    page = context.new_page()
    said: list[str] = []
    asked: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto((folder / "index.html").as_uri())
    page.wait_for_function(f"{READY} && {LOADED}")
    yield page
    context.close()
    assert [text for text in said if DRIVER not in text] == []
    own = (folder.as_uri() + "/", "data:", "blob:")
    assert [url for url in asked if not url.startswith(own)] == []


def shown(page, name: str = "picture") -> np.ndarray:
    """(H, W, 3) uint8 RGB, what a canvas holds once the wanted picture is there."""
    # Two frames of the screen: the first takes the change over, the second has drawn it.
    page.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    page.wait_for_function(READY)
    text = page.evaluate(f"document.getElementById('{name}').toDataURL('image/png')")
    data = np.frombuffer(base64.b64decode(text.partition(",")[2]), np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR)[:, :, ::-1]


def set_slider(page, name: str, value: float) -> None:
    page.evaluate(
        "([name, value]) => { const slider = document.getElementById(name); slider.value = value;"
        " slider.dispatchEvent(new Event('input')); }",
        [name, str(value)],
    )


def views() -> list[Camera]:
    return [view.frames[0].camera for view in viewer_scene.lattice_views(viewer_scene.make_scene())]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [380, 1200])
def test_page_fits_every_screen(browser, folder: Path, width: int, scheme: str) -> None:
    context = browser.new_context(viewport={"width": width, "height": 800}, color_scheme=scheme)
    page = context.new_page()
    page.goto((folder / "index.html").as_uri())
    page.wait_for_function(READY)
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    page.check("#compare")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
    levels = [int(level) for level in paper.removeprefix("rgb(").removesuffix(")").split(",")]
    assert (min(levels) > 200) if scheme == "light" else (max(levels) < 60)
    # Every control can be named by a screen reader.
    nameless = """[...document.querySelectorAll('button, input, select, [tabindex]')].filter(e =>
      !e.getAttribute('aria-label') && !e.labels?.length && !e.textContent.trim()).map(e => e.id)"""
    assert page.evaluate(nameless) == []
    context.close()


def test_every_moment_is_shown_exactly(page) -> None:
    camera = views()[2]
    wanted = [viewer_scene.render(camera, frame) for frame in FRAMES]
    for moment in (3, 0, 5, 1):
        set_slider(page, "time", moment)
        scores = [psnr_db(shown(page), picture) for picture in wanted]
        assert int(np.argmax(scores)) == moment
        assert scores[moment] > 30
        assert f"{FRAMES[moment] + 1}/{NUM_FRAMES}" in page.inner_text("#time-text")


def test_orbit_shows_views_as_rendered_and_bends_between_them(page) -> None:
    cameras = views()
    for i, camera in enumerate(cameras):
        set_slider(page, "view", i / (NUM_VIEWS - 1))
        assert psnr_db(shown(page), viewer_scene.render(camera, FRAMES[0])) > 30
    if not page.evaluate("!!document.createElement('canvas').getContext('webgl2')"):
        pytest.skip("this browser has no WebGL 2, so views are cross-faded")
    for share in (0.375, 0.625, 0.3, 0.1):
        place = share * (NUM_VIEWS - 1)
        first, weight = int(place), place % 1
        spec = trajectory_from_mapping({"kind": "hold", "position": share, "num_frames": 1}, "between")
        truth = viewer_scene.render(place_cameras(spec, viewer_scene.make_scene(), SIZE)[0], FRAMES[0])
        set_slider(page, "view", share)
        page.wait_for_timeout(400)
        pair = [viewer_scene.render(camera, FRAMES[0]) for camera in cameras[first : first + 2]]
        scores = psnr_db(shown(page), truth), psnr_db(cross_fade(*pair, weight), truth)
        print(f"share {share}: bent {scores[0]:.1f} dB, faded {scores[1]:.1f} dB")
        assert scores[0] > scores[1] + 6


def test_keyboard_alone_moves_everything(page) -> None:
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.id") == "stage"
    page.keyboard.press("ArrowUp")
    page.keyboard.press("Shift+ArrowRight")
    page.wait_for_function("document.getElementById('time').value === '1'")
    assert float(page.input_value("#view")) == pytest.approx(0.6)
    page.keyboard.press("Space")
    page.wait_for_function("document.getElementById('play').textContent === 'Pause'")
    before = page.input_value("#time")
    page.wait_for_function(f"document.getElementById('time').value !== '{before}'")
    page.keyboard.press("Space")
    for _ in range(6):
        page.keyboard.press("[")
    page.wait_for_function("document.getElementById('speed').value === '0.1'")


def test_keys_work_before_anything_has_the_focus(page) -> None:
    assert page.evaluate("document.activeElement === document.body")
    page.keyboard.press("Shift+ArrowRight")
    page.wait_for_function("document.getElementById('view').value === '0.6'")
    # This one scrolls the page, unless the picture has the focus.
    page.keyboard.press("ArrowUp")
    page.focus("#view")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Shift+ArrowLeft")
    page.wait_for_function("document.getElementById('view').value === '0.48'")
    assert page.input_value("#time") == "0"
    page.focus("#speed")
    page.keyboard.press("l")
    assert page.is_checked("#loop")


def test_drag_and_wheel_move_view_and_time(page) -> None:
    box = page.locator("#stage").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x - 0.2 * box["width"], y, steps=8)
    page.mouse.up()
    page.wait_for_function("Number(document.getElementById('view').value) > 0.6")
    assert page.input_value("#time") == "0"
    page.mouse.wheel(0, 100)
    page.wait_for_function("Number(document.getElementById('time').value) >= 2")


def test_links_lead_to_a_moment_and_back(page) -> None:
    page.evaluate("location.hash = '#t=7&v=0.25&o=depth'")
    page.wait_for_function("document.getElementById('time').value === '3'")
    assert page.input_value("#view") == "0.25"
    page.wait_for_function("!document.getElementById('overlay').hidden")
    set_slider(page, "time", 5)
    page.wait_for_function("location.hash === '#t=11&v=0.2500&o=depth'")


def test_overlays_colour_what_they_are_about(page) -> None:
    page.select_option("#shown", "hull")
    page.wait_for_function("!document.getElementById('overlay').hidden")
    purple = shown(page, "overlay")[..., 2] > 200
    # Written as rows 0 to 19 of the pictures, of which every third has a row in the map.
    assert purple[:7].all() and not purple[7:].any()
    assert "silhouettes" in page.inner_text("#legend")
    page.select_option("#shown", "none")
    page.wait_for_function("document.getElementById('overlay').hidden")


def test_real_picture_stands_beside_the_render(page) -> None:
    page.check("#compare")
    page.wait_for_function("document.getElementById('real').dataset.camera === 'cam01'")
    camera = viewer_scene.make_scene().tracks["cam01"].at(0)
    truth = cv2.resize(viewer_scene.render(camera, 0), (128, 72), interpolation=cv2.INTER_AREA)
    assert psnr_db(shown(page, "real"), truth) > 30
    set_slider(page, "cut", 20)
    page.wait_for_function("document.getElementById('stage').style.getPropertyValue('--cut') === '20%'")
    box = page.locator("#stage").bounding_box()
    line = page.locator("#cutline").bounding_box()
    assert line["x"] + line["width"] / 2 == pytest.approx(box["x"] + 0.2 * box["width"], abs=1)
    page.mouse.move(line["x"] + line["width"] / 2, box["y"] + 20)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 60, steps=4)
    page.mouse.up()
    assert (page.input_value("#cut"), page.input_value("#view")) == ("70", "0.5")
    assert page.locator("#cameras button[aria-current='true']").inner_text() == "cam01"
    page.click("#cameras button:has-text('cam02')")
    page.wait_for_function("document.getElementById('real').dataset.camera === 'cam02'")
    page.wait_for_function(
        "document.querySelector(\"#cameras button[aria-current='true']\").textContent === 'cam02'"
    )


def test_saved_path_is_a_film_of_the_workflow(page, tmp_path: Path) -> None:
    for share, moment in ((0, 0), (1, 3), (0.5, 5)):
        set_slider(page, "view", share)
        set_slider(page, "time", moment)
        page.wait_for_function(f"document.getElementById('view').value === '{share}'")
        page.click("#add-key")
    page.click("#keys button[aria-label='Remove key frame 3']")
    page.click("#preview")
    page.wait_for_function("document.getElementById('preview').textContent === 'Preview'")
    assert (page.input_value("#time"), page.input_value("#view")) == ("3", "1")
    with page.expect_download() as download:
        page.click("#save-path")
    path = tmp_path / download.value.suggested_filename
    download.value.save_as(path)
    spec = trajectory_from_mapping({"file": str(path)}, "saved")
    frames = scene_frames(spec, NUM_FRAMES)
    assert (frames[0], frames[-1], len(frames)) == (0, FRAMES[3], 60)
    cameras = place_cameras(spec, viewer_scene.make_scene(), SIZE)
    lattice = views()
    for camera, view in ((cameras[0], lattice[0]), (cameras[-1], lattice[-1])):
        np.testing.assert_allclose(camera.center, view.center, atol=1e-4)
        np.testing.assert_allclose(camera.R, view.R, atol=1e-4)
        assert camera.focal_px == pytest.approx(view.focal_px, rel=1e-4)
    # Around the event like the places between, not straight through.
    distances = [np.linalg.norm(camera.center[:2]) for camera in cameras]
    assert min(distances) > 3.85


def test_saved_mark_is_in_pixels_of_the_camera(page, tmp_path: Path) -> None:
    page.evaluate("document.getElementById('mark-tools').open = true")
    page.click("#draw-box")
    page.wait_for_function("document.getElementById('real').dataset.camera === 'cam01'")
    page.locator("#stage").scroll_into_view_if_needed()
    box = page.locator("#stage").bounding_box()
    at = [(box["x"] + u * box["width"], box["y"] + v * box["height"]) for u, v in ((0.25, 0.2), (0.5, 0.7))]
    page.mouse.move(*at[0])
    page.mouse.down()
    page.mouse.move(*at[1], steps=4)
    page.mouse.up()
    with page.expect_download() as download:
        page.click("#save-mark")
    path = tmp_path / download.value.suggested_filename
    assert path.name == "event_remove.yaml"
    download.value.save_as(path)
    edit = load_yaml(path)
    validate(edit, load_yaml(SCHEMA_FOLDER / "edit_file.schema.yaml"), "mark")
    mark = edit["marks"][0]
    assert (edit["scene"], mark["view"], mark["frame"]) == ("event", "cam01", 0)
    wanted = [0.25 * SIZE[0], 0.2 * SIZE[1], 0.5 * SIZE[0], 0.7 * SIZE[1]]
    np.testing.assert_allclose(mark["box"], np.array(wanted) - 0.5, atol=1)


def test_missing_file_is_named(browser, folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (copy / "data" / "view-lattice-04-0.js").unlink()
    page = browser.new_page()
    page.goto((copy / "index.html").as_uri())
    page.wait_for_function("document.getElementById('status').textContent.includes('view-lattice-04-0.js')")
    assert page.evaluate(READY)
    page.close()


def test_without_scripts_the_first_moment_is_seen(browser, folder: Path) -> None:
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    page.goto((folder / "index.html").as_uri())
    assert page.locator("#poster").evaluate("image => image.naturalWidth") == SIZE[0]
    assert "needs scripts" in page.inner_text("noscript")
    context.close()
