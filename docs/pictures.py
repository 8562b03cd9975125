"""Makes every picture in the documentation and the README from the present code: `make pictures`.

Serves the sample recording, lets it play to its end, and takes screenshots of the page in Chromium.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
from playwright.sync_api import Browser, Page, sync_playwright

ROOT = Path(__file__).resolve().parents[1]
SAMPLE, IMAGES = ROOT / "sample_data" / "cloister.mcap", ROOT / "docs" / "images"
ARGS = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
QUIET = ".mantine-Notification-root{display:none!important}"
"""viser warns of drawing in software."""
PATIENCE_MS = 180_000
MIDDLE = 300
"""A frame in the middle of the walk."""


@contextmanager
def served() -> Iterator[str]:
    """The address of a server that has played the sample to its end."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "app", "serve", str(SAMPLE), "--port", "0", "--no-browser"]
        server = subprocess.Popen(command, cwd=folder, env=_environment(), stdout=subprocess.PIPE, text=True)
        try:
            assert server.stdout is not None
            found = re.search(r"http://\S+", server.stdout.readline())
            assert found, "the server did not start"
            url = found[0]
            _wait(url, lambda state: state["recording"] is not None)
            httpx.post(f"{url}api/transport", json={"action": "speed", "factor": "max"})
            _wait(url, lambda state: state["transport"]["finished"])
            yield url
        finally:
            server.terminate()
            server.wait()


def _environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}


def _wait(url: str, holds: Callable[[Any], bool]) -> None:
    while not holds(httpx.get(f"{url}api/state").json()):
        time.sleep(0.5)


@contextmanager
def opened(browser: Browser, url: str, width: int, height: int) -> Iterator[Page]:
    phone = width < 600
    context = browser.new_context(viewport={"width": width, "height": height}, has_touch=phone, is_mobile=phone)
    context.add_init_script("localStorage.setItem('hemislam-tour', 'seen')")
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    page.goto(url)
    page.get_by_role("button", name="Play", exact=True).wait_for()
    page.add_style_tag(content=QUIET)
    page.wait_for_timeout(8000)  # until all points are drawn
    yield page
    context.close()


def shoot(page: Page, name: str) -> None:
    page.mouse.move(400, 300)  # away from what has a tooltip
    page.wait_for_timeout(3000)
    page.screenshot(path=IMAGES / f"{name}.png", timeout=PATIENCE_MS)
    print(name, flush=True)


def tab(page: Page, name: str) -> None:
    page.get_by_role("tab", name=name).first.click()


def main() -> None:
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    with served() as url, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=list(ARGS))
        with opened(browser, url, 1600, 1000) as page:
            shoot(page, "workbench")
        with opened(browser, url, 390, 844) as page:
            shoot(page, "phone")
        with opened(browser, url, 1600, 1000) as page:
            tab(page, "Loops")
            page.get_by_role("button", name="Diagnostics").click()
            page.locator("tr[data-hs]").first.click()
            page.get_by_text("Histogram of the points' distances").wait_for()
            page.get_by_role("button", name="fly there").click()
            shoot(page, "loops")
            page.get_by_role("button", name="close").click()
        httpx.post(f"{url}api/transport", json={"action": "seek", "frame": MIDDLE})
        with opened(browser, url, 1280, 720) as page:
            tab(page, "View")
            page.get_by_text("light theme").click()
            tab(page, "Readouts")
            shoot(page, "readouts")
        browser.close()


if __name__ == "__main__":
    main()
