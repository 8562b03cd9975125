"""The sample in a real browser: how fast it replays, and how long a slider takes to relabel the points drawn.

Everything is measured in the page: from the key that moves the slider to the end of drawing the first image
in which the points have their new colours. Chromium runs as it does on a machine without a graphics card,
which is the slowest case: the processor draws. Reading the drawn pixels back would take it longer than
drawing them, so the colours are recognised on their way to the drawing, whose end a fence tells.
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
from benchmarks.uploads import WATCH

SAMPLE = Path(__file__).resolve().parents[1] / "sample_data" / "museum.mcap"
CHROMIUM = (
    "--no-sandbox", "--enable-unsafe-swiftshader", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--no-first-run",
)  # fmt: skip
ALPHA = 2  # number of the slider of α, after those of time and M
TRIALS = 15  # within the fifty seconds of the sample
WATCHED_MS = 1500

LEAST_COLOURS = 3000
"""Bytes of colours, three a point: what is smaller is no scan."""

# Of all colours of points that go to the drawing: when, the share of points in the colour of ground, when drawn.
PROBE = f"""
(least) => {{{WATCH}
  window.drawn = [];
  window.pressed = 0;
  addEventListener('keydown', () => {{ window.pressed = performance.now(); }}, true);
  const teal = (colours) => {{
    let n = 0;
    for (let i = 0; i < colours.length; i += 3) n += colours[i + 1] > colours[i] + 40 && colours[i + 1] > 60;
    return 3 * n / colours.length;
  }};
  watchUploads(Uint8Array, least, (gl, colours) => {{
    const image = [performance.now(), teal(colours), null];
    window.drawn.push(image);
    if (window.drawn.length > 600) window.drawn.shift();
    setTimeout(() => onceDrawn(gl, () => {{ image[2] = performance.now(); }}), 0);  // the image is on its way by then
  }});
}}
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
    page.evaluate(PROBE, LEAST_COLOURS)
    slider = page.locator("[role=slider]").nth(ALPHA)
    delays = []
    for _ in range(TRIALS):
        httpx.patch(f"{url}api/params", json={"ground": {"alpha": 25.0}}).raise_for_status()
        page.wait_for_timeout(1000)
        slider.focus()
        page.keyboard.press("Home")
        page.wait_for_timeout(WATCHED_MS)
        delays.append(_delay_ms(page.evaluate("window.drawn"), page.evaluate("window.pressed")))
    return Line.of("slider to relabelled points in the page", "museum, playing", "ms", delays)


def _delay_ms(drawn: list[tuple[float, float, float | None]], pressed: float) -> float:
    """drawn: of each image the time it was begun (ms), its share of teal points, and the time it was finished."""
    before = np.median([teal for begun, teal, _ in drawn if pressed - 500 < begun < pressed])
    after = [finished for begun, teal, finished in drawn if begun > pressed and teal < 0.5 * before and finished]
    if before < 0.05 or not after:
        raise RuntimeError(f"the points did not change their colour: {before:.0%} were teal before")
    return after[0] - pressed


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
