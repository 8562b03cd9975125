"""The timeline, the breakpoints, the study of a frame and the panel of a live source in a real Chromium."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Locator, expect

from app.mapping.breakpoints import Breakpoints
from app.sensors.live.status import Counters
from app.server.protocol import Seek, SetBreakpoints, StepFrame
from tests.browser.conftest import Bench
from tests.ui.conftest import WELL

LEFT, RIGHT = 78, 72
"""Pixels of the timeline beside its strips: names and values."""
PANEL = 640, 1000
"""Where the panel begins and ends across the page, in pixels."""


@pytest.fixture(autouse=True)
def _fresh(bench: Bench) -> None:
    bench.engine.sent.clear()


def timeline(bench: Bench) -> Locator:
    return bench.page.locator("canvas[aria-label=diagnostics]")


def place_of(bench: Bench, frame: int) -> tuple[float, float]:
    """Where on the page a frame's first strip is."""
    box = timeline(bench).bounding_box()
    assert box is not None
    share = (frame + 0.5) / bench.engine.frames
    return box["x"] + LEFT + share * (box["width"] - LEFT - RIGHT), box["y"] + 28


def seeks(bench: Bench) -> list[int]:
    return [command.frame for command in bench.engine.sent if isinstance(command, Seek)]


def click_goes_to(bench: Bench, frame: int) -> None:
    """Click where a frame is, again if need be: a page that is still busy may move the strips meanwhile."""

    def clicked() -> bool:
        bench.engine.sent.clear()
        bench.page.mouse.move(*place_of(bench, frame))
        bench.page.mouse.down()
        bench.page.mouse.up()
        return bench.within(0.7, lambda: bool(seeks(bench)) and abs(seeks(bench)[-1] - frame) <= 2)  # less than a pixel

    bench.eventually(clicked)


def drawn(bench: Bench) -> int:
    """Pixels of the timeline's canvas that are painted; while viser makes the panel twice, of the newest."""
    script = (
        "(c) => {const p = c.getContext('2d').getImageData(0, 0, c.width, c.height).data; let n = 0;"
        "for (let i = 3; i < p.length; i += 4) n += p[i] > 150; return n}"
    )
    return int(timeline(bench).first.evaluate(script))


def test_a_click_on_the_timeline_goes_there_and_what_is_passed_is_drawn(bench: Bench) -> None:
    bench.eventually(lambda: timeline(bench).count() == 1)
    expect(timeline(bench)).to_be_hidden()
    bench.page.get_by_role("button", name="Diagnostics").click()
    before = drawn(bench)
    bench.engine.send(StepFrame(120))
    bench.engine.sent.clear()
    bench.eventually(lambda: drawn(bench) > before + 300)
    click_goes_to(bench, 60)
    bench.eventually(lambda: bench.engine.snapshot.transport.frame == seeks(bench)[-1])
    assert bench.page.evaluate("document.querySelectorAll('canvas[aria-label=diagnostics]').length") == 1


def test_the_transport_lies_along_the_scene_and_what_was_unfolded_stays_so_after_a_reload(bench: Bench) -> None:
    page = bench.page
    scene, bar = page.locator("canvas[data-engine]"), page.get_by_role("toolbar", name="transport")
    inside, outside = bar.bounding_box(), scene.bounding_box()
    assert inside is not None and outside is not None
    assert inside["width"] > 0.9 * outside["width"]
    assert 0 <= outside["y"] + outside["height"] - inside["y"] - inside["height"] < 20
    bench.eventually(lambda: timeline(bench).count() == 1)
    if timeline(bench).is_hidden():  # alone
        page.get_by_role("button", name="Diagnostics").click()
        bench.engine.send(StepFrame(120))
        bench.eventually(lambda: drawn(bench) > 300)
    page.reload()
    bench.eventually(lambda: timeline(bench).count() == 1 and drawn(bench) > 300)
    click_goes_to(bench, 20)
    page.get_by_role("button", name="Diagnostics").click()
    expect(timeline(bench)).to_be_hidden()
    page.get_by_role("button", name="Diagnostics").click()
    expect(timeline(bench)).to_be_visible()


def test_no_sign_below_the_track_stands_without_its_name(bench: Bench) -> None:
    cut = """() => { const row = document.querySelector('body > * .hs-marks'), box = row.getBoundingClientRect();
      if (getComputedStyle(row).visibility === 'hidden') return 0;
      return [...row.children].map((one) => one.getBoundingClientRect())
        .filter((one) => one.top < box.bottom && one.left < box.right && one.right > box.right + 0.5).length; }"""
    shown: set[int] = set()
    try:
        for width in range(1000, 1400, 50):
            bench.page.set_viewport_size({"width": width, "height": 620})
            bench.page.wait_for_timeout(700)
            shown.add(bench.page.evaluate(cut))
        narrow = bench.page.add_style_tag(content=".hs-track{max-width:80px}")  # as beside a long message
        shown.add(bench.page.evaluate(cut))
        narrow.evaluate("(style) => style.remove()")
    finally:
        bench.page.set_viewport_size({"width": 1000, "height": 620})
    assert shown == {0}


def test_the_bar_is_there_once_and_follows_the_frames_when_viser_makes_the_panel_anew(bench: Bench) -> None:
    for width, height in ((390, 844), (1000, 620)):
        bench.page.set_viewport_size({"width": width, "height": height})
        bench.page.wait_for_timeout(500)
        bench.next_frame()
        expect(timeline(bench)).to_have_count(1)


def test_a_breakpoint_is_switched_on(bench: Bench) -> None:
    bench.page.get_by_role("tab", name="Readouts").click()
    bench.page.get_by_text("Pause when").click()
    switch = bench.page.get_by_role("checkbox", name="no ground")

    def switched(on: bool) -> bool:
        """Click it, again if need be: a busy page may make the panel anew meanwhile."""
        if switch.is_checked() is not on:
            switch.click()
        wanted = SetBreakpoints(Breakpoints(no_ground=on))
        return bench.within(1.5, lambda: bench.engine.sent[-1:] == [wanted])

    bench.eventually(lambda: switched(True))
    bench.eventually(lambda: switched(False))
    assert not switch.is_checked()
    bench.page.get_by_text("Pause when").click()


def pixel_of(bench: Bench, index: int) -> tuple[float, float]:
    """Where on the page a point of the newest scan is drawn."""
    (client,) = bench.server.get_clients().values()
    result, camera = bench.engine.snapshot.result, client.camera
    assert result is not None
    T = result.T_map_imu @ result.state.T_imu_lidar
    root = bench.server.scene._handle_from_node_name["/map"].position
    towards = T[:3, :3] @ result.cloud.points[index] + T[:3, 3] + root - camera.position
    forward = (camera.look_at - camera.position) / np.linalg.norm(camera.look_at - camera.position)
    right = np.cross(forward, camera.up_direction)
    right /= np.linalg.norm(right)
    scene = bench.page.locator("canvas[data-engine]").bounding_box()
    assert scene is not None
    scale = scene["height"] / 2 / np.tan(camera.fov / 2) / (towards @ forward)
    x = scene["x"] + scene["width"] / 2 + scale * (towards @ right)
    y = scene["y"] + scene["height"] / 2 - scale * (towards @ np.cross(right, forward))
    return float(x), float(y)


def test_a_clicked_point_shows_its_numbers_until_another_frame_comes(bench: Bench) -> None:
    bench.engine.send(StepFrame())
    bench.look((-4.0, -4.0, 9.0), (0.3, 0.2, -0.6))
    bench.page.get_by_role("tab", name="Study").click()
    asks = bench.page.get_by_text("Pause and click a point")
    expect(asks).to_be_visible()
    bench.page.wait_for_timeout(1000)  # the view still glides to the sensor
    result = bench.engine.snapshot.result
    assert result is not None
    seeds = np.flatnonzero(result.cloud.labels == 2)
    bench.page.mouse.click(*pixel_of(bench, int(seeds[len(seeds) // 2])))
    told = bench.page.get_by_text("plane of its neighbours")
    expect(told).to_be_visible()
    expect(bench.page.locator(".hs-value").get_by_text("seed", exact=True)).to_be_visible()
    bench.engine.send(StepFrame(1))
    expect(asks).to_be_visible()


def test_a_frame_is_downloaded(bench: Bench, tmp_path: Path) -> None:
    bench.engine.send(StepFrame())
    bench.page.get_by_role("tab", name="Study").click()
    with bench.page.expect_download() as download:
        bench.page.get_by_role("button", name="PLY").click()
    download.value.save_as(tmp_path / "frame.ply")
    frame = bench.engine.snapshot.transport.frame
    assert download.value.suggested_filename == f"hall_bpearl-frame-{frame:06d}.ply"
    assert (tmp_path / "frame.ply").read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")


def test_the_panel_is_there_while_a_source_is_live_and_shows_when_it_is_not_well(bench: Bench) -> None:
    page = bench.page
    page.get_by_role("tab", name="Recording").click()
    heading = page.get_by_text("Live source", exact=True)
    expect(heading).to_have_count(0)
    bench.engine.send(StepFrame(10))
    bench.engine.publish(live=WELL)
    expect(heading).to_be_visible()
    for words in ("RS-Bpearl 68656d690001: 600 rpm, strongest return", "receiving", "last 30 ms ago", "12 MB"):
        expect(page.get_by_text(words)).to_be_visible()
    for words in ("IMU behind LiDAR", "oldest scans first; never IMU data"):
        box = page.get_by_text(words).bounding_box()
        assert box is not None and PANEL[0] <= box["x"] and box["x"] + box["width"] <= PANEL[1], "nothing is cut off"
    worse = replace(WELL, lidar_age_s=4.2, counters=Counters(packets=151_000, lost=3_000, frames=1000, dropped=21))
    bench.engine.publish(live=worse)
    expect(page.get_by_text("LiDAR silent")).to_be_visible()
    expect(page.get_by_text("1.95 % of 154,000")).to_be_visible()
    bench.engine.publish(live=None)
    expect(heading).to_have_count(0)
