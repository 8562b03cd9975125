"""The workbench in a real Chromium with software rendering. All tests share one browser, since starting it is slow."""

import io
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser
from PIL import Image
from playwright.sync_api import Browser, Page, expect, sync_playwright

from app.server.folders import Folders
from app.server.fork import Workspace
from app.server.protocol import StepFrame
from app.server.viser_adapter import Viser
from app.ui.workbench import Workbench
from tests.server.server_site import serving
from tests.ui.conftest import icons_read_once  # noqa: F401 - a fixture
from tests.ui.fake_engine import FakeEngine
from tests.ui.fake_forks import alone

ARGS = (
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-gpu-compositing",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run",
)  # fmt: skip
SLOW_MS = 120_000
"""Software rendering on a busy machine; what is expected comes as soon as it comes."""
expect.set_options(timeout=SLOW_MS)
OF_OTHERS = ("THREE.Clock: ", "GL Driver Message", "Canvas2D: Multiple readback")
"""Parts of warnings that viser, the software renderer and the tests themselves cause."""
AT_TEN_FRAMES_A_SECOND = """(() => {
  const requestFrame = requestAnimationFrame.bind(window), pending = new Map();
  let lastId = 0, scheduled = false;
  const runPending = (time) => {
    const callbacks = [...pending.values()];
    pending.clear();
    scheduled = false;
    for (const callback of callbacks) {
      try { callback(time); } catch (error) { reportError(error); }
    }
  };
  window.requestAnimationFrame = (callback) => {
    pending.set(++lastId, callback);
    if (!scheduled) { scheduled = true; setTimeout(() => requestFrame(runPending), 100); }
    return lastId;
  };
  window.cancelAnimationFrame = (id) => pending.delete(id);
})()"""
"""Limits the page's drawing. Software rendering without a limit would take a whole core from the tests."""
COARSE = """(() => {
  const getContext = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, asked) {
    return getContext.call(this, kind, kind.startsWith("webgl") ? {...asked, antialias: false} : asked);
  };
  Object.defineProperty(window, "devicePixelRatio", {get: () => 0.5});
})()"""
"""Draws the scene in pixels of twice the size and without antialiasing: fewer pixels for software rendering."""
SLIDERS = "[role=slider][aria-valuenow]"
"""The sliders of parameters; those of the legend's colour bar are inputs of the browser's own."""
ALPHA = 1
"""Number of the slider of α: after that of M."""
complaints: list[str] = []
"""Errors and warnings on the browser's consoles, and uncaught exceptions, since the last test."""


@dataclass
class Bench:
    """A served workbench and a page that shows it."""

    server: viser.ViserServer
    workbench: Workbench
    engine: Any
    page: Page
    url: str

    def eventually(self, holds: Callable[[], bool], seconds: float = 60.0, every_ms: float = 50.0) -> None:
        deadline = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < deadline, "it did not come about in time"
            self.page.wait_for_timeout(every_ms)

    def within(self, seconds: float, holds: Callable[[], bool]) -> bool:
        """Whether it comes about in this time, as soon as it does."""
        deadline = time.monotonic() + seconds
        while not (held := holds()) and time.monotonic() < deadline:
            self.page.wait_for_timeout(50)
        return held

    def press(self, key: str, holds: Callable[[], bool], page: Page | None = None) -> None:
        """Press a key, again if need be: a page that is still busy may drop it."""

        def pressed() -> bool:
            (page or self.page).keyboard.press(key)
            return self.within(1.5, holds)

        self.eventually(pressed)

    def next_frame(self) -> None:
        """Step, and wait until the page shows it, hence all that was sent before, and has answered.

        viser gathers for 50 ms what a page says, and a page draws every 100 ms.
        """
        self.engine.send(StepFrame())
        self.page.locator(".hs-when", has_text=f"frame {self.engine.snapshot.transport.frame} of").wait_for()
        self.page.wait_for_timeout(300)

    def look(self, position: Any, look_at: Any) -> None:
        """Put the page's camera somewhere, and wait until it is there.

        Again if need be: a page that is still busy says late where it was before, and is put there again.
        """
        self.eventually(lambda: bool(self.server.get_clients()))
        (client,) = self.server.get_clients().values()
        self.resting_camera(client)

        def there() -> bool:
            client.camera.position, client.camera.look_at = position, look_at
            put = client.camera.update_timestamp
            self.within(1.0, lambda: client.camera.update_timestamp > put)  # the page says that it moved it
            return bool(np.allclose(self.resting_camera(client), position, atol=1e-3))

        self.eventually(there)

    def resting_camera(self, client: viser.ClientHandle) -> np.ndarray:
        """(3,) where the page's camera is, once it has said so and stays there."""
        seen = [client.camera.position]

        def rests() -> bool:
            self.page.wait_for_timeout(400)
            seen.append(client.camera.position)
            return bool(np.allclose(seen[-1], seen[-2], atol=1e-6))

        self.eventually(rests)
        return np.asarray(seen[-1])

    def pixels(self) -> np.ndarray:
        """(h, w, 3) of the scene's middle."""
        shot = self.page.screenshot(clip={"x": 150, "y": 150, "width": 340, "height": 390})
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


@pytest.fixture(scope="session")
def chromium() -> Iterator[Browser]:
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None and "CI" in os.environ:
        pytest.fail("CI must have chromium")
    if path is None:
        pytest.skip("needs chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(ARGS))
        yield browser
        browser.close()


def new_page(chromium: Browser, width: int, height: int, tour: str | None = None) -> Page:
    """A page on which an error or a warning of our own fails the test. tour: as on a first visit, running this."""
    page = chromium.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(SLOW_MS)
    page.add_init_script(AT_TEN_FRAMES_A_SECOND)
    page.add_init_script(COARSE)
    page.add_init_script("localStorage.setItem('hemislam-tour', 'seen')" if tour is None else tour)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda said: complaints.append(said.text) if said.type in ("error", "warning") else None)
    return page


@pytest.fixture(autouse=True)
def _no_complaints() -> Iterator[None]:
    yield
    told = [text for text in complaints if not any(part in text for part in OF_OTHERS)]
    complaints.clear()
    assert not told


@contextmanager
def opened(
    chromium: Browser,
    engine: Any,
    folder: Path,
    width: int,
    height: int,
    camera: tuple[Any, Any] | None = None,
    tour: str | None = None,
) -> Iterator[Bench]:
    """A workbench on an engine, which stays the caller's, and its page, ready to be clicked.

    Args:
        camera: where it is at first, and what it looks at.
        tour: a script; as on a first visit.
    """
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    forks = engine if isinstance(engine, Workspace) else alone(engine)
    workbench = Workbench(server, forks, Folders([folder]))
    workbench.start()
    page = new_page(chromium, width, height, tour)
    with serving(forks, Viser(server, ""), folder, None, parts=workbench.parts) as site:
        page.goto(site.url())
        page.locator(".hs-play").wait_for()
        bench = Bench(server, workbench, engine, page, site.url())
        if camera is not None:
            bench.look(*camera)
        yield bench
        workbench.close()
        page.close()
    server.stop()


@pytest.fixture(scope="module")
def bench(chromium: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """On a recording of thirty columns of building, in a small window."""
    folder = tmp_path_factory.mktemp("recordings")
    (folder / "garage.mcap").write_bytes(b"x" * 2_000)
    (folder / "other_slam.tum").write_text("0 0 0 0 0 0 0 1\n")
    (folder / "older").mkdir()
    engine = FakeEngine(columns=30)
    with opened(chromium, engine, folder, 1000, 620) as bench:
        yield bench
    engine.close()
