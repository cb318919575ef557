"""The page of a scene in a real browser: nothing is asked of a network, all is shown, nothing is cut off."""

from pathlib import Path

import pytest

from fourd.report.__main__ import main
from tests.unit import report_scene


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    report_scene.write_results(folder / "results", folder / "footage")
    metrics = ("mse", "psnr_db", "a_metric_with_a_rather_long_name")
    methods = tuple(f"method_{i}" for i in range(9)) + ("ours",)
    report_scene.write_scores(folder / "results" / "evaluate" / "metrics.csv", 3, 40, methods, metrics)
    report_scene.hold_out(folder / "results", 3)
    report_scene.write_benchmarks(folder / "benchmarks")
    main(
        ["--results", str(folder / "results"), "--benchmarks", str(folder / "benchmarks")]
        + ["--output", str(folder / "page")]
    )
    return folder / "page" / "index.html"


def open_page(browser, page_file: Path, **settings):
    """The page, what the console said, and every address that was asked for."""
    page = browser.new_context(**settings).new_page()
    said: list[str] = []
    asked: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto(page_file.as_uri(), wait_until="load")
    return page, said, asked


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [380, 1200])
def test_page_is_quiet_whole_and_fits(browser, page_file: Path, width: int, scheme: str) -> None:
    page, said, asked = open_page(
        browser, page_file, viewport={"width": width, "height": 800}, color_scheme=scheme
    )
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert said == []
    assert [url for url in asked if not url.startswith("data:")] == [page_file.as_uri()]
    assert page.evaluate("document.images.length") > 8
    broken = "[...document.images].filter(i => !i.complete || !i.naturalWidth).length"
    assert page.evaluate(broken) == 0
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    # What is wider than the screen must lie in a box that scrolls.
    cut = """[...document.querySelectorAll('body *')].filter(e => !e.closest('.scroll, pre, .compare')
             && e.getBoundingClientRect().right > innerWidth + 1).map(e => e.outerHTML.slice(0, 80))"""
    assert page.evaluate(cut) == []
    paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
    levels = [int(level) for level in paper.removeprefix("rgb(").removesuffix(")").split(",")]
    assert (min(levels) > 200) if scheme == "light" else (max(levels) < 60)
    page.context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_is_told_from_its_ground(browser, page_file: Path, scheme: str) -> None:
    page, _, _ = open_page(browser, page_file, color_scheme=scheme)
    contrast = """(selector) => {
      const light = c => { const [r, g, b] = c.match(/\\d+/g).slice(0, 3).map(v => { v /= 255;
        return v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; });
        return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
      const ground = light(getComputedStyle(document.body).backgroundColor);
      const ink = light(getComputedStyle(document.querySelector(selector)).color);
      return (Math.max(ground, ink) + 0.05) / (Math.min(ground, ink) + 0.05); }"""
    for selector in ("h1", ".lead", "figcaption", "thead th", "a", ".none"):
        assert page.evaluate(contrast, selector) >= 4.5, selector
    page.context.close()


def test_slider_moves_by_keys_and_by_pointer(browser, page_file: Path) -> None:
    page, _, _ = open_page(browser, page_file, viewport={"width": 800, "height": 900})
    box = page.locator(".compare").first
    cut = "box => box.style.getPropertyValue('--cut')"
    assert box.evaluate(cut) == "50%"
    box.locator("input").focus()
    page.keyboard.press("ArrowLeft")
    assert box.evaluate(cut) == "49%"
    page.keyboard.press("End")
    assert box.evaluate(cut) == "100%"
    area = box.bounding_box()
    assert area is not None
    box.locator("input").click(position={"x": 0.25 * area["width"], "y": area["height"] / 2})
    assert 20 <= float(box.evaluate(cut).removesuffix("%")) <= 30
    page.context.close()


def test_without_scripts_both_pictures_are_shown(browser, page_file: Path) -> None:
    page, _, _ = open_page(
        browser, page_file, java_script_enabled=False, viewport={"width": 800, "height": 900}
    )
    before, after = (
        page.locator(f".compare .{side} img").first.bounding_box() for side in ("before", "after")
    )
    assert before is not None and after is not None
    assert after["x"] >= before["x"] + before["width"]
    page.context.close()
