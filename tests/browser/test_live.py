"""The panel of a live source in a real Chromium."""

from dataclasses import replace

from playwright.sync_api import expect

from app.sensors.live.status import Counters, LiveState
from app.server.protocol import StepFrame
from tests.browser.conftest import Bench

PANEL = 640, 1000
"""Where the panel begins and ends across the page, in pixels."""
WELL = LiveState(
    counters=Counters(packets=151_000, frames=1000, imu=20_000),
    lidar_hz=10.0,
    imu_hz=200.0,
    lidar_age_s=0.03,
    imu_age_s=0.004,
    clock="sensor",
    imu_lag_s=0.0021,
    sensor="RS-Bpearl 68656d690001: 600 rpm, strongest return",
    recorded=12_345_678,
)


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
