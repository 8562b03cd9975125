"""The tour on the first visit, and the messages of the page's own script to the server."""

import json

import pytest
from playwright.sync_api import Browser, expect

from app.server.protocol import Pause, Play, SetSpeed, StepFrame
from app.server.viser_adapter import BADGE
from tests.browser.conftest import ALPHA, SLIDERS, Bench, new_page


@pytest.fixture(autouse=True)
def _fresh(bench: Bench) -> None:
    """Each test starts paused and with nothing sent."""
    bench.engine.sent.clear()


def test_the_first_visit_is_shown_around_once(bench: Bench, chromium: Browser) -> None:
    page = new_page(chromium, 1000, 620, tour=True)
    bench.engine.send(SetSpeed(0.1))  # not at its end before the tour is
    bench.engine.send(Play())
    try:
        page.goto(bench.url)
        tour = page.get_by_role("dialog", name="Tour")
        bench.eventually(lambda: not bench.engine.snapshot.transport.playing)  # while it is read
        for title in ("Play, or step", "Go anywhere", "Tune the ground", "Judge a loop", "That is all"):
            expect(tour.get_by_text(title)).to_be_visible()
            expect(page.locator(".hs-outlined")).to_have_count(1)
            tour.locator(".hs-next").click()
        expect(tour).to_have_count(0)
        bench.eventually(lambda: bench.engine.snapshot.transport.playing)
        bench.engine.send(Pause())
        page.reload()
        expect(page.get_by_role("button", name="Play", exact=True)).to_be_visible()
        page.wait_for_function("Boolean(window.hemislamTour)")
        page.wait_for_timeout(1700)  # it would begin after 1.5 s
        expect(tour).to_have_count(0)
        page.get_by_role("tab", name="Help").click()
        page.get_by_role("button", name="One-minute tour").click()
        page.keyboard.press("Escape")
        expect(tour).to_have_count(0)
    finally:
        page.close()


def test_who_may_only_view_is_not_told_what_to_try(bench: Bench, chromium: Browser) -> None:
    page = new_page(chromium, 1000, 620, tour=True)
    page.add_init_script(
        "document.addEventListener('DOMContentLoaded', () => "
        f"document.body.insertAdjacentHTML('beforeend', {json.dumps(BADGE)}))"
    )
    try:
        page.goto(bench.url)
        expect(page.get_by_text("View only")).to_be_visible()
        expect(page.get_by_role("button", name="Play", exact=True)).to_be_visible()
        page.wait_for_function("Boolean(window.hemislamTour)")
        page.wait_for_timeout(3500)  # it would begin after 1.5 s, or 1 s later
        assert not page.get_by_role("dialog", name="Tour").count()
    finally:
        page.close()


def test_what_is_asked_for_in_the_same_moment_all_arrives(bench: Bench) -> None:
    bench.engine.sent.clear()
    bench.page.evaluate(
        """[['camera', 'cover 66'], ['transport', 'speed 2×'], ['transport', 'step 1'], ['camera', 'cover 70']].forEach(
          ([name, word]) => hemislamTell(name, word))"""
    )
    bench.eventually(lambda: StepFrame(1) in bench.engine.sent)
    assert SetSpeed(2.0) in bench.engine.sent


def test_a_word_of_the_page_does_not_take_the_place_of_what_a_slider_was_set_to(bench: Bench) -> None:
    """viser sends only the last of what changes within 50 ms, of all controls of a tab together."""
    said, alpha = bench.workbench._parameters._bridge._field, bench.engine.snapshot.params.ground.alpha
    before = said.value
    bench.page.get_by_role("tab", name="Parameters").click()
    slider = bench.page.locator(SLIDERS).nth(ALPHA)
    slider.evaluate(
        """async (thumb) => {
          const busy = (ms) => { for (const end = performance.now() + ms; performance.now() < end;); };
          for (let n = 0; n < 3; n++) {
            thumb.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowRight', bubbles: true}));
            await null; // the slider is drawn, but no timer fires
          }
          busy(100); // viser's timer and ours are both late
          hemislamTell('sliders', 'released');
          busy(200);
        }"""
    )
    bench.eventually(lambda: said.value != before)

    def agree() -> bool:
        """The slider may be set back for a moment, by what the engine says of the first step."""
        shown = float(slider.get_attribute("aria-valuenow") or "nan")
        return bench.engine.snapshot.params.ground.alpha == shown

    bench.eventually(agree, seconds=20.0)
    assert bench.engine.snapshot.params.ground.alpha > alpha
