"""A browser for the pages that the workflow makes."""

import shutil
from collections.abc import Iterator

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="module")
def browser() -> Iterator:
    """Headless Chromium, where one is installed."""
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f"needs a browser: none of {', '.join(BROWSERS)} is installed")
    driver = pytest.importorskip("playwright.sync_api", reason="needs the package playwright")
    with driver.sync_playwright() as playwright:
        # Without the sandbox a browser starts as root too, as in containers; it opens own files only.
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])
        yield browser
        browser.close()
