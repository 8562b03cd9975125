"""A fork in a real Chromium: created, shown, swapped and kept."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from app.server.fork import Workspace
from app.server.protocol import Seek, SetParams
from tests.browser.conftest import Bench, opened
from tests.ui.fake_engine import FakeEngine
from tests.ui.fake_forks import workspace


@pytest.fixture(scope="module")
def forks(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workspace]:
    engine = FakeEngine(columns=120)
    engine.send(Seek(20))
    forks = workspace(engine, tmp_path_factory.mktemp("sessions"), 120)
    yield forks
    forks.close()


@pytest.fixture(scope="module")
def bench(chromium: Browser, forks: Workspace, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with opened(chromium, forks, tmp_path_factory.mktemp("recordings"), 1280, 900) as bench:
        yield bench


def blue(bench: Bench) -> int:
    """Pixels of the scene in B's colour, which the page draws paler."""
    r, _, b = np.moveaxis(bench.pixels(), 2, 0)
    return int(((b > 180) & (b - r > 60)).sum())


def test_a_fork_is_tuned_seen_swapped_and_kept(bench: Bench, forks: Workspace, tmp_path: Path) -> None:
    page = bench.page
    page.get_by_role("tab", name="A/B").click()
    page.locator(".mantine-Flex-root:has(> * label:text-is('name')) input").last.fill("wide band")
    page.get_by_role("button", name="Fork here").click()
    bench.eventually(lambda: forks.names[1] == "wide band")
    expect(page.get_by_text("B · wide band")).to_be_visible()
    page.get_by_role("tab", name="Parameters").click()
    expect(page.get_by_text("act on")).to_be_visible()
    page.get_by_role("tab", name="A/B").click()
    before = blue(bench)
    forks.send_other(SetParams({"ground.sigma": 0.1}))
    forks.send(Seek(80))
    bench.eventually(lambda: (b := forks.other) is not None and b.transport.frame == 80)
    expect(page.get_by_text("only in A", exact=True).last).to_be_visible()
    if "HEMISLAM_SHOTS" in os.environ:
        page.wait_for_timeout(2500)
        page.screenshot(path=Path(os.environ["HEMISLAM_SHOTS"]) / "fork.png")
    bench.eventually(lambda: blue(bench) > before + 50, every_ms=500)  # taking a picture is work
    bench.press("x", lambda: forks.names == ("wide band", "main"))
    expect(page.get_by_text("A · wide band")).to_be_visible()
    page.get_by_role("button", name="keep", exact=True).click()
    bench.eventually(lambda: forks.other is None)
    expect(page.get_by_text("hemislam serve opens it")).to_be_visible()
    expect(page.get_by_role("button", name="Fork here")).to_be_visible()
    page.get_by_role("button", name="Open as B").click()
    page.get_by_role("button", name="hall_bpearl-main").click()
    bench.eventually(lambda: forks.names[1] == "hall_bpearl-main")
    expect(page.get_by_text("B · hall_bpearl-main")).to_be_visible()
