"""The tour on the first visit, in a real Chromium."""

import json
from pathlib import Path

from playwright.sync_api import Browser, expect

from app.server.protocol import Pause, Play, SetSpeed
from app.server.viser_adapter import BADGE
from tests.browser.conftest import opened
from tests.ui.fake_engine import FakeEngine


def test_the_first_visit_is_shown_around_once(chromium: Browser, tmp_path: Path) -> None:
    engine = FakeEngine(columns=30)
    engine.send(SetSpeed(0.1))  # not at its end before the tour is
    engine.send(Play())
    with opened(chromium, engine, tmp_path, 1000, 620, tour="") as bench:
        page = bench.page
        tour = page.get_by_role("dialog", name="Tour")
        bench.eventually(lambda: not engine.snapshot.transport.playing)  # while it is read
        for title in ("Play, or step", "Go anywhere", "Tune the ground", "Judge a loop", "That is all"):
            expect(tour.get_by_text(title)).to_be_visible()
            expect(page.locator(".hs-outlined")).to_have_count(1)
            tour.locator(".hs-next").click()
        expect(tour).to_have_count(0)
        bench.eventually(lambda: engine.snapshot.transport.playing)
        engine.send(Pause())
        page.reload()
        expect(page.get_by_role("button", name="Play", exact=True)).to_be_visible()
        page.wait_for_function("Boolean(window.hemislamTour)")
        page.wait_for_timeout(1700)  # it would begin after 1.5 s
        expect(tour).to_have_count(0)
        page.get_by_role("tab", name="Help").click()
        page.get_by_role("button", name="One-minute tour").click()
        page.keyboard.press("Escape")
        expect(tour).to_have_count(0)
    engine.close()


def test_who_may_only_view_is_not_told_what_to_try(chromium: Browser, tmp_path: Path) -> None:
    badge = (
        "document.addEventListener('DOMContentLoaded', () => "
        f"document.body.insertAdjacentHTML('beforeend', {json.dumps(BADGE)}))"
    )
    engine = FakeEngine(columns=30)
    with opened(chromium, engine, tmp_path, 1000, 620, tour=badge) as bench:
        page = bench.page
        expect(page.get_by_text("View only")).to_be_visible()
        expect(page.get_by_role("button", name="Play", exact=True)).to_be_visible()
        page.wait_for_function("Boolean(window.hemislamTour)")
        page.wait_for_timeout(3500)  # it would begin after 1.5 s, or 1 s later
        assert not page.get_by_role("dialog", name="Tour").count()
    engine.close()
