"""How fast the viewer's page opens, scrubs, orbits and plays, in a browser without a graphics card.

`python -m benches.viewer --page results/demo/viewer/index.html` opens the page from the disk in headless
Chromium, changes the time, the view or both on every frame of the screen as a hand at a slider would, and
writes one row per movement: frames per second, median and 95th percentile of the time between two frames,
share of frames that show exactly what was asked for. The first rows are how long the first picture takes.
The last rows leave out every second view and compare what the page shows in its place, bent by depth and
only cross-faded, with the render that was left out.
"""

import argparse
import base64
import json
import re
import shutil
import statistics
import time
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Browser, Page, sync_playwright

from fourd.io import write_csv

COLUMNS = ("movement", "milliseconds", "p95_milliseconds", "frames_per_second", "exact_share", "cpu_seconds")
COLUMNS += ("psnr_db", "lowest_psnr_db")
NO_WEBGL = """const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
  return kind === "webgl2" ? null : get.call(this, kind, ...more); };"""
# What a hand does in one frame of the screen: a part of the slider's way.
MOVEMENTS = {
    "scrub time": "time.value = String(Math.floor(last * triangle(i / 90)))",
    "orbit": "view.value = String(triangle(i / 120))",
    "both": "time.value = String(Math.floor(last * triangle(i / 90)));"
    " view.value = String(triangle(i / 170))",
    "play": "",
}
SCRIPT = """async ([movement, frames]) => {
  const [time, view, picture] = ["time", "view", "picture"].map((id) => document.getElementById(id));
  const last = Number(time.max);
  const triangle = (x) => 1 - Math.abs(1 - (x % 2));
  const move = new Function("i", "time", "view", "last", "triangle", movement);
  if (!movement) document.getElementById("play").click();
  const gaps = [];
  let exact = 0, before = performance.now();
  for (let i = 0; i < frames; i++) {
    move(i, time, view, last, triangle);
    if (movement.includes("time")) time.dispatchEvent(new Event("input"));
    if (movement.includes("view")) view.dispatchEvent(new Event("input"));
    const now = await new Promise(requestAnimationFrame);
    gaps.push(now - before);
    before = now;
    exact += picture.dataset.exact === "true";
  }
  if (!movement) document.getElementById("play").click();
  return [gaps.slice(1), exact / frames];
}"""


def measure(page: Page, num_frames: int) -> list[dict[str, object]]:
    """Rows of all movements, after the whole page is loaded."""
    rows: list[dict[str, object]] = []
    for name, movement in MOVEMENTS.items():
        # Once to decode, then measured: a hand that comes back finds pictures decoded.
        page.evaluate(SCRIPT, [movement, num_frames // 2])
        start = time.process_time()
        gaps, exact = page.evaluate(SCRIPT, [movement, num_frames])
        gaps.sort()
        rows.append(
            {
                "movement": name,
                "milliseconds": round(statistics.median(gaps), 2),
                "p95_milliseconds": round(gaps[int(0.95 * len(gaps))], 2),
                "frames_per_second": round(1000 * len(gaps) / sum(gaps), 1),
                "exact_share": round(exact, 3),
                "cpu_seconds": round(time.process_time() - start, 2),
            }
        )
    return rows


def show(page: Page, moment: int, share: float) -> np.ndarray:
    """(H, W, 3) uint8 BGR, what the page shows once it has come to rest."""
    page.evaluate(
        "([time, view]) => { for (const [id, value] of [['time', time], ['view', view]]) {"
        " const slider = document.getElementById(id); slider.value = value;"
        " slider.dispatchEvent(new Event('input')); } }",
        [moment, share],
    )
    page.wait_for_timeout(700)
    page.wait_for_function("document.getElementById('picture').dataset.exact === 'true'")
    text = page.evaluate("document.getElementById('picture').toDataURL('image/png')")
    return cv2.imdecode(np.frombuffer(base64.b64decode(text.partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)


def compare_between(browser: Browser, path: Path, moments: int = 3) -> list[dict[str, object]]:
    """Rows of what stands for a view that was left out, against its render."""
    text = path.read_text(encoding="utf-8")
    found = re.search(r'(?<=type="application/json">).*?(?=</script>)', text)
    assert found is not None
    manifest = json.loads(found[0])
    views = manifest["views"]
    if len(views) % 2 == 0:
        return []
    thin = path.with_name("thin.html")
    parts = json.dumps({**manifest, "views": views[::2]})
    thin.write_text(text[: found.start()] + parts + text[found.end() :], encoding="utf-8")
    times = [round(i * (len(manifest["frames"]) - 1) / max(moments - 1, 1)) for i in range(moments)]
    wanted = [(t, view["share"]) for t in times for view in views[1::2]]
    shown = {}
    for name, file, script in (("truth", path, ""), ("bent", thin, ""), ("faded", thin, NO_WEBGL)):
        page = browser.new_page(viewport={"width": 1200, "height": 860})
        page.add_init_script(script)
        page.goto(file.resolve().as_uri())
        shown[name] = [show(page, *place).astype(np.float64) for place in wanted]
        page.close()
    thin.unlink()
    rows = []
    for name in ("bent", "faded"):
        errors = [np.mean((a - b) ** 2) for a, b in zip(shown[name], shown["truth"], strict=True)]
        scores = 10 * np.log10(255**2 / np.array(errors))
        rows.append(
            {
                "movement": f"every second view {name}",
                "psnr_db": round(float(scores.mean()), 2),
                "lowest_psnr_db": round(float(scores.min()), 2),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--page", type=Path, required=True, help="viewer/index.html of a scene")
    parser.add_argument("--frames", type=int, default=360)
    parser.add_argument("--browser", default=shutil.which("chromium"))
    parser.add_argument("--output", type=Path, default=Path("results/bench/viewer/viewer.csv"))
    args = parser.parse_args()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=args.browser, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1200, "height": 860})
        page.goto(args.page.resolve().as_uri(), wait_until="commit")
        page.wait_for_function("performance.getEntriesByName('first picture').length > 0")
        first = page.evaluate(
            "[performance.getEntriesByType('paint').at(-1)?.startTime,"
            " performance.getEntriesByName('first picture')[0].startTime]"
        )
        page.wait_for_function("document.getElementById('status').textContent.includes('moments from')")
        opened = [
            {"movement": "poster is seen", "milliseconds": round(first[0] or 0)},
            {"movement": "first picture", "milliseconds": round(first[1])},
            {"movement": "all is loaded", "milliseconds": round(page.evaluate("performance.now()"))},
        ]
        rows = [*opened, *measure(page, args.frames), *compare_between(browser, args.page)]
        browser.close()
    write_csv(args.output, COLUMNS, rows)
    for row in rows:
        print("  ".join(f"{key} {value}" for key, value in row.items()))


if __name__ == "__main__":
    main()
