"""From the last packet of a scan to its points in the drawn scene of a real Chromium.

A walk at the sensor's full resolution is sent as packets at real time by a process of its own, to the real program,
whose page is open as everybody sees it first. A scan has come when the first image that holds its points is drawn:
they are recognised on their way to the drawing, whose end a fence tells (as in `page.py`). Chromium runs as on a
machine without a graphics card, the slowest case: the processor draws, beside the sender, receiver and engine.
"""

import shutil
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from playwright.sync_api import Page, expect, sync_playwright

from app.slam.types import F32
from app.ui.sensor import MOST_SCAN_POINTS
from app.ui.thinning import strided
from benchmarks.latency import SCENE, Sending, received, sent
from benchmarks.live import served, wait_until
from benchmarks.page import CHROMIUM
from benchmarks.record import Line
from benchmarks.scenes import recording
from benchmarks.uploads import WATCH

LEAST_POINTS = 1000
"""Fewer are no scan."""
COMPARED = 20
"""The first points of a scan, which tell it from all others."""
SAME_M = 0.02
"""The same scan in another run, rounded to 16 bits; others differ by what the sensor moved and by its noise."""

# Of all points that go to the drawing: the first of them, when (ms since 1970), when they were there, when drawn.
PROBE = f"""
([least, compared]) => {{{WATCH}
  window.seen = [];
  const now = () => performance.timeOrigin + performance.now();
  watchUploads(Uint16Array, 3 * least, (gl, points) => {{
    const image = [Array.from(points.subarray(0, 3 * compared)), now(), null];
    window.seen.push(image);
    // once all of the image is on its way: it is drawn in one go
    queueMicrotask(() => onceDrawn(gl, () => {{ image[2] = now(); }}));
  }});
}}
"""


def run() -> list[Line]:
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        print("The page is not measured: there is no chromium.")
        return []
    walk = recording(SCENE)
    scans = _scans(walk)
    with TemporaryDirectory() as folder, served(walk, Path(folder) / "live.mcap") as (url, _, packets, imu):
        wait_until(url, lambda state: state["recording"] is not None)
        with sync_playwright() as playwright:
            chromium = playwright.chromium.launch(executable_path=browser, args=list(CHROMIUM))
            page = chromium.new_page(viewport={"width": 1280, "height": 800})
            page.add_init_script(f"({PROBE})([{LEAST_POINTS}, {COMPARED}])")
            page.goto(url)
            expect(page.get_by_role("button", name="Pause", exact=True)).to_be_visible(timeout=60_000)
            renderer = _renderer(page)
            page.wait_for_timeout(3000)
            with sent(walk, packets, imu) as sending:
                while not sending.ended or time.monotonic() - sending.last < 2.0:
                    page.wait_for_timeout(100)
                seen = page.evaluate("window.seen")
                begun, drawn = _recognised(seen, scans)
                lines = _lines(sending, scans, begun, drawn, renderer)
            chromium.close()
    return lines


def _lines(
    sending: Sending, scans: dict[int, F32], begun: dict[int, float], drawn: dict[int, float], renderer: str
) -> list[Line]:
    on = f"{SCENE}, 57,632 firings a scan, as packets at real time; Chromium draws by {renderer}"
    return [
        Line.of("last packet to the page's upload", on, "ms", 1e3 * np.array(sending.delays(begun))),
        Line.of("last packet to the drawn scan", on, "ms", 1e3 * np.array(sending.delays(drawn))),
        Line.of("scans drawn, of all", on, "%", [100 * len(drawn) / len(scans)]),
    ]


def _scans(walk: Path) -> dict[int, F32]:
    """The first points of each scan that the page will draw, by the scan's end: from a run without a page."""
    found: dict[int, F32] = {}
    with received(walk) as (engine, sending):
        while not sending.ended or time.monotonic() - sending.last < 1.0:
            result = engine.wait(engine.snapshot.revision, timeout=0.1).result
            if result is not None and result.stamp_ns not in found and len(result.cloud) > LEAST_POINTS:
                shown = result.cloud.points[strided(len(result.cloud), MOST_SCAN_POINTS)][:COMPARED]
                found[result.stamp_ns] = shown.astype(np.float16).astype(np.float32)
    return found


def _recognised(seen: list[Any], scans: dict[int, F32]) -> tuple[dict[int, float], dict[int, float]]:
    """When (monotonic s) each scan's points went to the drawing for the first time, and were drawn."""
    stamps, known = np.array(list(scans)), np.array(list(scans.values()))
    to_monotonic = time.monotonic() - time.time()
    begun: dict[int, float] = {}
    drawn: dict[int, float] = {}
    for halves, began, ended in seen:
        points = np.array(halves, np.uint16).view(np.float16).astype(np.float32).reshape(-1, 3)
        apart = np.abs(known - points).mean(axis=(1, 2))
        if apart.min() < SAME_M and ended is not None:
            stamp = int(stamps[apart.argmin()])
            begun.setdefault(stamp, began * 1e-3 + to_monotonic)
            drawn.setdefault(stamp, ended * 1e-3 + to_monotonic)
    return begun, drawn


def _renderer(page: Page) -> str:
    """What draws the scene, as the browser calls it."""
    named: str = page.evaluate(
        """() => {
          const gl = document.createElement('canvas').getContext('webgl2');
          const about = gl.getExtension('WEBGL_debug_renderer_info');
          return gl.getParameter(about ? about.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
        }"""
    )
    return "SwiftShader, without a graphics card" if "swiftshader" in named.lower() else named
