"""The sample in a real browser: how fast it replays, and how long a slider takes to relabel the points drawn.

Everything is measured in the page: from the key that moves the slider to the first drawn image in
which the points have their new colours. Chromium renders in software here, which is the slowest case.
"""

import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from playwright.sync_api import Page, expect, sync_playwright

from benchmarks.record import Line

SAMPLE = Path(__file__).resolve().parents[1] / "sample_data" / "museum.mcap"
CHROMIUM = (
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run",
)  # fmt: skip
ALPHA = 2  # number of the slider of α, after those of time and M
TRIALS = 15
WATCHED_MS = 2500

# At every drawn image, how many pixels of the scene are as bright as points of the ground are.
PROBE = """
() => {
  const area = (canvas) => canvas.width * canvas.height;
  const source = [...document.querySelectorAll('canvas')].sort((a, b) => area(b) - area(a))[0];
  const small = document.createElement('canvas');
  small.width = 240; small.height = 150;
  const pen = small.getContext('2d', {willReadFrequently: true});
  window.drawn = [];
  window.pressed = 0;
  addEventListener('keydown', () => { window.pressed = performance.now(); }, true);
  const look = () => {
    pen.clearRect(0, 0, 240, 150);
    pen.drawImage(source, 0, 0, 240, 150);
    const p = pen.getImageData(0, 0, 240, 150).data;
    let teal = 0;
    for (let i = 0; i < p.length; i += 4) teal += p[i + 1] > p[i] + 40 && p[i + 1] > 60;
    window.drawn.push([performance.now(), teal]);
    if (window.drawn.length > 600) window.drawn.shift();
    requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
}
"""


def run() -> list[Line]:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        print("The page is not measured: there is no chromium.")
        return []
    with _served() as url, sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=browser, args=list(CHROMIUM))
        page = chromium.new_page(viewport={"width": 1280, "height": 800})
        page.goto(url)
        expect(page.get_by_role("button", name="Play", exact=True)).to_be_visible(timeout=60_000)
        lines = [_relabelling(url, page), _replay(url)]
        chromium.close()
    return lines


def _relabelling(url: str, page: Page) -> Line:
    """While playing at real time, α goes to its least (no seeds, no ground) and back."""
    page.get_by_role("tab", name="View").click()
    for layer in ("map", "seed wedge", "ground plane", "path, truth", "grid"):
        page.get_by_role("checkbox", name=layer, exact=True).uncheck()
    page.get_by_role("tab", name="Tune").click()
    _transport(url, {"action": "play"})
    page.wait_for_timeout(4000)
    page.evaluate(PROBE)
    slider = page.locator("[role=slider]").nth(ALPHA)
    delays = []
    for _ in range(TRIALS):
        httpx.patch(f"{url}api/params", json={"ground": {"alpha": 25.0}}).raise_for_status()
        page.wait_for_timeout(1000)
        slider.focus()
        page.keyboard.press("Home")
        page.wait_for_timeout(WATCHED_MS)
        delays.append(_delay_ms(np.array(page.evaluate("window.drawn")), page.evaluate("window.pressed")))
    return Line.of("slider to relabelled points in the page", "museum, playing", "ms", delays)


def _delay_ms(drawn: np.ndarray, pressed: float) -> float:
    """drawn (n, 2): time ms and teal pixels of each image. When they first fall below half of what they were."""
    before = np.median(drawn[(drawn[:, 0] < pressed) & (drawn[:, 0] > pressed - 500), 1])
    after = drawn[drawn[:, 0] > pressed]
    if before < 50 or after[-1, 1] > 0.5 * before:
        raise RuntimeError(f"the points did not change their colour: {before:.0f} teal pixels, then {after[-1, 1]:.0f}")
    return float(after[np.argmax(after[:, 1] < 0.5 * before), 0] - pressed)


def _replay(url: str) -> Line:
    """From the start, as fast as it can, with the page open and drawing everything."""
    _transport(url, {"action": "pause"})
    _transport(url, {"action": "restart"})
    while _state(url)["transport"]["frame"] > 0:
        time.sleep(0.05)
    _transport(url, {"action": "speed", "factor": "max"})
    _transport(url, {"action": "play"})
    while (state := _state(url))["transport"]["frame"] < 50:
        time.sleep(0.01)
    begin, first, last = time.perf_counter(), state["transport"]["frame"], state["recording"]["frames"] - 20
    while (now := _state(url)["transport"]["frame"]) < last:
        time.sleep(0.1)
    rate = (now - first) / (time.perf_counter() - begin)
    seconds_a_frame = state["recording"]["duration_s"] / state["recording"]["frames"]
    return Line.of("replay with a page open", "museum", "x real time", [rate * seconds_a_frame])


def _state(url: str) -> Any:
    """As JSON."""
    return httpx.get(f"{url}api/state").raise_for_status().json()


def _transport(url: str, action: Mapping[str, object]) -> None:
    httpx.post(f"{url}api/transport", json=action).raise_for_status()


@contextmanager
def _served() -> Iterator[str]:
    """The workbench on the sample, paused, in a process of its own; gives its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "app", "serve", str(SAMPLE), "--paused", "--no-browser", "--port", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    url = f"http://127.0.0.1:{port}/"
    try:
        for _ in range(600):
            try:
                if _state(url)["recording"]:
                    break
            except httpx.HTTPError:
                pass
            time.sleep(0.2)
        yield url
    finally:
        server.terminate()
        server.wait()
