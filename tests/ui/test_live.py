"""The panel of a live source, and the transport during live mapping.

Tests app/ui/html.py.
"""

import html
import re
from dataclasses import replace

import pytest
import viser

from app.sensors.live.status import Counters, LiveState
from app.server.protocol import LIVE, Command, OpenRecording, StepFrame
from app.ui.html import BAD, GOOD, WARN
from app.ui.live import LivePanel, live_html, verdict
from app.ui.transport import TransportPanel, state, where
from tests.ui.conftest import WELL, Clock, Wire, page_of, user_clicks
from tests.ui.fake_engine import FakeEngine


def shown(state: LiveState) -> str:
    return html.unescape(re.sub(r"\s+", " ", re.sub("<[^>]+>", " ", live_html(state))))


def test_each_reading_has_its_unit() -> None:
    text = shown(replace(WELL, counters=Counters(packets=990, lost=10, duplicates=3, dropped=2, foreign=4), backlog=1))
    for words in ("LiDAR 10.0 Hz last 30 ms ago", "IMU 200.0 Hz last 4 ms ago", "packets lost 10 1.00 % of 1,000",
                  "not usable 4 packets", "duplicates 3", "scans dropped 2", "waiting 1 scans",
                  "IMU behind LiDAR +2.1 ms", "recorded 12 MB", "clock in use the sensors' own",
                  "RS-Bpearl 68656d690001: 600 rpm, strongest return"):  # fmt: skip
        assert words in text, words


def test_what_is_not_known_is_a_dash_and_not_zero() -> None:
    text = shown(LiveState())
    assert (
        "IMU behind LiDAR – ms" in text
        and "nothing received yet" in text
        and "recorded – off; start with --record" in text
    )


@pytest.mark.parametrize(
    ("state", "words", "colour"),
    [
        (WELL, "receiving", GOOD),
        (LiveState(), "waiting for the LiDAR", WARN),
        (replace(WELL, lidar_age_s=5.0), "LiDAR silent", BAD),
        (replace(WELL, imu_age_s=5.0), "IMU silent", BAD),
        (replace(WELL, backlog=12), "engine behind", WARN),
        (replace(WELL, clock=""), "settling", WARN),
    ],
)
def test_the_worst_is_said_in_a_word(state: LiveState, words: str, colour: str) -> None:
    assert verdict(state) == (words, colour)


def test_while_the_user_has_paused_the_engine_is_not_called_behind() -> None:
    assert verdict(replace(WELL, backlog=99), paused=True) == ("scans wait", WARN)


def test_the_bar_says_what_a_pause_costs_instead_of_that_no_scan_was_dropped(engine: FakeEngine) -> None:
    engine.send(StepFrame(5))
    playing = replace(engine.snapshot.transport, playing=True)
    engine.publish(live=replace(WELL, backlog=99, counters=Counters(dropped=40)), transport=playing)
    assert "no scan dropped" in where(engine.snapshot) and "wait" not in where(engine.snapshot)
    engine.publish(transport=replace(playing, playing=False))
    assert "99 scans wait" in where(engine.snapshot) and "no scan dropped" not in where(engine.snapshot)
    assert "the oldest are dropped" in where(engine.snapshot)


def test_an_ended_source_is_not_shown_as_receiving() -> None:
    ended = live_html(WELL, ended=True)
    assert "receiving" not in ended and "ended" in ended and BAD in ended


def test_only_trouble_is_coloured_as_trouble() -> None:
    assert BAD not in live_html(WELL) and WARN not in live_html(WELL)
    for worse in (
        replace(WELL, counters=Counters(packets=10, dropped=1)),
        replace(WELL, counters=Counters(packets=10, lost=5)),
        replace(WELL, lidar_age_s=3.0),
    ):
        assert BAD in live_html(worse)
    for warned in (replace(WELL, imu_lag_s=0.3), replace(WELL, counters=Counters(packets=10, truncated=1))):
        assert WARN in live_html(warned)
    assert WARN not in live_html(replace(WELL, imu_lag_s=0.3, clock="host")), "then it does no harm"


def test_a_sensor_s_words_are_no_html() -> None:
    assert "<script>" not in live_html(replace(WELL, sensor="<script>alert(1)</script>"))


def test_the_panel_takes_no_place_while_a_recording_is_open(server: viser.ViserServer, engine: FakeEngine) -> None:
    panel = LivePanel(page_of(server))
    panel.draw(engine.snapshot)
    assert not panel._html.content
    panel.draw(replace(engine.snapshot, live=WELL))
    assert "receiving" in panel._html.content
    panel.draw(engine.snapshot)
    assert not panel._html.content


def test_from_a_recording_there_is_a_way_back_to_the_live_source(server: viser.ViserServer, engine: FakeEngine) -> None:
    sent: list[Command] = []
    panel, recorded = LivePanel(page_of(server, sent.append)), engine.snapshot
    panel.draw(recorded)
    assert not panel._back.visible, "there is no source"
    panel.draw(replace(recorded, live=WELL))
    assert not panel._back.visible
    panel.draw(recorded)
    assert panel._back.visible
    user_clicks(panel._back)
    assert sent == [OpenRecording(LIVE)]


def test_nothing_is_sent_while_nothing_changes(server: viser.ViserServer, engine: FakeEngine, wire: Wire) -> None:
    panel = LivePanel(page_of(server))
    live = replace(engine.snapshot, live=WELL)
    panel.draw(live)
    wire.clear()
    panel.draw(replace(live, revision=live.revision + 1))
    assert not wire.messages


def test_a_live_session_cannot_go_back_and_the_page_says_why(server: viser.ViserServer, engine: FakeEngine) -> None:
    panel = TransportPanel(page_of(server, engine.send, lambda: engine.snapshot, now=Clock()))
    live = replace(engine.snapshot, live=WELL)
    panel.draw(live)
    assert state(live)["live"] and state(live)["open"]
    assert "--record" not in panel._state.content, "it is recorded already"
    panel.draw(replace(live, live=replace(WELL, recorded=None)))
    assert "--record" in panel._state.content
    panel.draw(engine.snapshot)
    assert not state(engine.snapshot)["live"]
    assert "--record" not in panel._state.content


def test_the_panel_shows_the_end_although_no_new_reading_came(server: viser.ViserServer, engine: FakeEngine) -> None:
    panel = LivePanel(page_of(server))
    engine.publish(live=WELL)
    panel.draw(engine.snapshot)
    assert "receiving" in panel._html.content
    engine.publish(transport=replace(engine.snapshot.transport, finished=True))
    panel.draw(engine.snapshot)
    assert "receiving" not in panel._html.content and "ended" in panel._html.content
