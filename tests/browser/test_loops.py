"""Loops in a real Chromium: clicks on HTML that reach the server, clicks in the scene, and the keys."""

import os
from collections.abc import Iterator

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from app.server.protocol import EditLoop, InspectLoop, RedoLoop, UndoLoop
from app.slam.loops.edits import Reject
from tests.browser.conftest import Bench, opened
from tests.ui.fake_loops import LoopEngine

GOOD = (12, 89)
UP = np.array([12.0, 6.9, 38.0])
"""Where the camera is: high above the middle of the building."""


@pytest.fixture(scope="module")
def bench(chromium: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    engine = LoopEngine()
    above = (tuple(UP), (12.0, 7.0, 0.0))
    with opened(chromium, engine, tmp_path_factory.mktemp("recordings"), 1280, 900, above) as bench:
        bench.page.get_by_role("tab", name="Loops").click()
        expect(bench.page.get_by_text("accepted 6")).to_be_visible()
        yield bench
    engine.close()


def choose(bench: Bench) -> None:
    """Choose the good loop, unless the test before has left it chosen."""
    bench.page.get_by_role("tab", name="Loops").click()
    if bench.workbench._loops.chosen != GOOD:
        bench.page.locator("tr[aria-selected]", has_text="12–89").click()
    expect(bench.page.get_by_text("keyframes 12–89")).to_be_visible()


def test_chips_rows_and_heads_of_the_table_can_be_clicked(bench: Bench) -> None:
    page = bench.page
    expect(page.locator("tr[aria-selected]")).to_have_count(9)
    page.get_by_role("button", name="rejected 20").click()
    expect(page.locator("tr[aria-selected]")).to_have_count(29)
    page.get_by_role("columnheader", name="overlap").click()
    expect(page.get_by_text("overlap▴")).to_be_visible()
    page.get_by_role("button", name="rejected 20").click()
    expect(page.locator("tr[aria-selected]")).to_have_count(9)
    page.locator("tr[aria-selected]", has_text="12–89").click()
    expect(page.get_by_text("keyframes 12–89")).to_be_visible()
    expect(page.get_by_text("Histogram of the points' distances")).to_be_visible()
    assert InspectLoop(GOOD) in bench.engine.sent
    page.locator("tr[aria-selected]", has_text="12–89").press("Enter")
    expect(page.get_by_text("keyframes 12–89")).to_have_count(0)


def test_a_click_on_an_arch_shows_the_loop_whatever_tab_is_open(bench: Bench) -> None:
    page, poses = bench.page, bench.engine.snapshot.keyframe_poses
    assert poses is not None
    page.get_by_role("tab", name="Parameters").click()
    expect(page.get_by_text("accepted 6")).to_be_hidden()
    # the knob above the middle, through a camera that looks straight down at the middle of the canvas
    middle = poses[list(GOOD), :3, 3].mean(axis=0)
    knob = middle + np.array([0.0, 0.0, 0.7 + 0.12 * np.linalg.norm(np.diff(poses[list(GOOD), :3, 3], axis=0))])
    box = page.evaluate(
        "() => { const size = (c) => c.width * c.height; const all = [...document.querySelectorAll('canvas')];"
        " const b = all.sort((a, c) => size(c) - size(a))[0].getBoundingClientRect();"
        " return [b.x, b.y, b.width, b.height]; }"
    )
    focal = box[3] / 2 / np.tan(np.radians(30.0))
    depth = UP[2] - knob[2]
    x = box[0] + box[2] / 2 + focal * (knob[0] - 12.0) / depth
    y = box[1] + box[3] / 2 - focal * (knob[1] - 7.0) / depth

    shown = page.get_by_text("keyframes 12–89")

    def clicked() -> bool:
        if bench.workbench._loops.chosen != GOOD:
            page.mouse.click(x, y)
        return bench.within(2.0, lambda: bench.workbench._loops.chosen == GOOD and shown.is_visible())

    bench.eventually(clicked)  # a page that is still busy may drop a click, or say late that a tab was opened before it
    expect(shown).to_be_visible()


def test_a_loop_is_rejected_undone_and_rejected_again(bench: Bench) -> None:
    page = bench.page
    choose(bench)
    bench.engine.sent.clear()
    reject = page.get_by_role("button", name="Reject it")
    reject.evaluate("(button) => button.scrollIntoView({block: 'start'})")
    expect(page.get_by_text("Keyframes would move by up to")).to_be_visible()
    before = reject.bounding_box()
    reject.click()
    expect(page.get_by_text("Rejected 12–89; keyframes moved by up to")).to_be_visible()
    expect(page.get_by_role("button", name="Undo: reject 12–89")).to_be_visible()
    expect(page.get_by_role("button", name="Undo", exact=True)).to_be_in_viewport(ratio=1)
    assert page.get_by_role("button", name="Undo", exact=True).bounding_box() == before, "the way back is in its place"
    bench.eventually(lambda: EditLoop(Reject(*GOOD)) in bench.engine.sent)
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("Control+z")
    expect(page.get_by_role("button", name="Redo: reject 12–89")).to_be_visible()
    page.keyboard.press("Control+Shift+Z")
    expect(page.get_by_role("button", name="Undo: reject 12–89")).to_be_visible()
    assert bench.engine.sent.count(UndoLoop()) == bench.engine.sent.count(RedoLoop()) == 1


def test_the_tabs_stay_in_view_while_the_panel_is_scrolled(bench: Bench) -> None:
    page = bench.page
    choose(bench)
    page.get_by_text("Graph residuals").scroll_into_view_if_needed()
    expect(page.get_by_text("hall_bpearl.mcap")).not_to_be_in_viewport()
    for name in ("Parameters", "Help"):
        expect(page.get_by_role("tab", name=name)).to_be_in_viewport(ratio=1)
    layer = "(element) => Number(getComputedStyle(element).zIndex)"
    tabs, knob = page.locator("[role=tablist]:has([data-dock-tab])").last, page.locator(".mantine-Slider-thumb").first
    assert tabs.evaluate(layer) > knob.evaluate(layer), "a knob does not shine through them"


def test_edits_are_downloaded_as_the_command_line_takes_them(bench: Bench) -> None:
    if not bench.engine.snapshot.loops.undo:
        bench.engine.send(EditLoop(Reject(*GOOD)))
    with bench.page.expect_download() as download:
        bench.page.get_by_role("button", name="Save edits (1)").click()
    assert download.value.suggested_filename == "edits.yaml"
    assert "- reject: [12, 89]" in download.value.path().read_text()


def test_flying_to_a_loop_brings_its_submaps_before_the_camera(bench: Bench) -> None:
    page = bench.page
    choose(bench)
    (client,) = bench.workbench._server.get_clients().values()
    page.keyboard.press("f")  # follow the sensor
    bench.eventually(lambda: bench.workbench._appearance.view.follow)
    page.get_by_role("button", name="fly there").click()
    expect(page.get_by_text("Follow is off")).to_be_visible()
    poses = bench.engine.snapshot.keyframe_poses
    assert poses is not None
    middle = poses[list(GOOD), :3, 3].mean(axis=0)
    bench.eventually(lambda: bool(np.linalg.norm(client.camera.look_at - middle) < 0.3))
    bench.eventually(lambda: bool(np.linalg.norm(client.camera.position - middle) < 12.0))
    if folder := os.environ.get("HEMISLAM_SCREENSHOTS"):
        page.wait_for_timeout(1500)
        page.screenshot(path=f"{folder}/loops.png")


def test_another_tab_or_escape_closes_the_chosen_loop_and_the_look_of_things_does_not(bench: Bench) -> None:
    page, loops = bench.page, bench.workbench._loops
    choose(bench)
    page.get_by_role("tab", name="View").click()
    page.wait_for_timeout(500)
    assert loops.chosen == GOOD
    page.get_by_role("tab", name="Readouts").click()
    bench.eventually(lambda: loops.chosen is None)
    page.get_by_role("tab", name="Loops").click()
    page.locator("tr[aria-selected]", has_text="12–89").click()
    bench.eventually(lambda: loops.chosen == GOOD)
    page.keyboard.press("Escape")
    bench.eventually(lambda: loops.chosen is None)
