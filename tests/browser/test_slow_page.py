"""What the page saves where the processor draws, as it does here."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from app.server.slow_page import MOST_POINTS
from app.server.viser_page import Viser, start_viser
from tests.browser.conftest import SLOW_MS
from tests.server.server_site import serving
from tests.ui.fake_engine import FakeEngine

POINTS = 4 * MOST_POINTS

COUNTED = """
() => {
  window.images = [];
  let image = null;
  const draw = WebGL2RenderingContext.prototype.drawArrays;
  WebGL2RenderingContext.prototype.drawArrays = function (mode, first, count) {
    if (mode === this.POINTS) {
      if (image === null) {
        image = 0;
        queueMicrotask(() => { window.images.push(image); image = null; });
      }
      image += count;
    }
    return draw.call(this, mode, first, count);
  };
}
"""
"""Points of each image, as they reach the drawing."""


@pytest.fixture
def map_of_points(tmp_path: Path) -> Iterator[Viser]:
    target = start_viser()
    target.server.scene.add_point_cloud("/map", np.zeros((POINTS, 3), np.float32), np.zeros((POINTS, 3), np.uint8))
    yield target
    target.stop()


def opened(chromium: Browser, url: str) -> Page:
    page = chromium.new_page(viewport={"width": 400, "height": 300})
    page.set_default_timeout(SLOW_MS)
    page.add_init_script(f"({COUNTED})()")
    page.goto(url)
    page.wait_for_function(f"window.images.at(-1) === {POINTS}")
    return page


def test_a_scene_that_changes_is_drawn_with_fewer_points_and_one_that_rests_with_all(
    chromium: Browser, map_of_points: Viser, tmp_path: Path
) -> None:
    with serving(FakeEngine(), map_of_points, tmp_path, None) as site:  # type: ignore[arg-type]
        marker = map_of_points.server.scene.add_frame("/marker")  # comes with the map: nothing comes after it
        page = opened(chromium, site.url())
        for step in range(30):
            marker.position = (0.1 * step, 0.0, 0.0)
            page.wait_for_timeout(100)
        while_it_changed = page.evaluate("window.images.slice(-5)")
        assert max(while_it_changed) <= MOST_POINTS
        assert min(while_it_changed) > MOST_POINTS / 3
        page.wait_for_function(f"window.images.at(-1) === {POINTS}")
        page.close()


def test_nothing_is_drawn_again_and_again_when_only_a_panel_has_changed(
    chromium: Browser, map_of_points: Viser, tmp_path: Path
) -> None:
    words = map_of_points.server.gui.add_html("0")
    with serving(FakeEngine(), map_of_points, tmp_path, None) as site:  # type: ignore[arg-type]
        page = opened(chromium, site.url())
        page.wait_for_timeout(1500)
        before = page.evaluate("window.images.length")
        for number in range(20):
            words.content = f"<p>number {number}</p>"
            page.wait_for_timeout(100)
        assert page.evaluate("window.images.length") - before <= 4, "one a second, whatever came"
        expect(page.get_by_text("number 19")).to_be_visible()
        page.close()
