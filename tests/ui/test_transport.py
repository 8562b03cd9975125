"""Play, pause, step, speed and the time slider."""

from dataclasses import replace

import pytest
import viser

from app.server.protocol import (
    Command,
    Pause,
    Play,
    Seek,
    SetSpeed,
    StepFrame,
)
from app.ui.transport import SPEEDS, TransportPanel, speed_name, where
from tests.ui.conftest import BusyThreads, Clock, browser_sends, page_of, user_clicks, user_sets
from tests.ui.fake_engine import FakeEngine


class Transporting:
    def __init__(self, server: viser.ViserServer, engine: FakeEngine) -> None:
        self.engine, self.clock = engine, Clock()
        self.panel = TransportPanel(page_of(server, engine.send, lambda: engine.snapshot, now=self.clock))

    def tick(self, seconds: float = 0.0) -> None:
        self.clock.now += seconds
        self.panel.draw(self.engine.snapshot)


@pytest.fixture
def transport(server: viser.ViserServer, engine: FakeEngine) -> Transporting:
    return Transporting(server, engine)


def test_the_play_button_plays_then_pauses(transport: Transporting) -> None:
    user_clicks(transport.panel._play)
    transport.tick()
    assert transport.panel._play.label == "Pause"
    user_clicks(transport.panel._play)
    transport.tick()
    assert transport.engine.sent == [Play(), Pause()]
    assert transport.panel._play.label == "Play"


def test_the_slider_follows_the_frame_without_seeking(transport: Transporting) -> None:
    transport.engine.send(StepFrame(7))
    transport.tick()
    assert transport.panel._slider.value == 6
    assert transport.panel._slider.max == transport.engine.frames - 1
    transport.tick(5.0)
    assert transport.engine.sent == [StepFrame(7)]


@pytest.mark.parametrize(
    ("button", "command"), [("◂ back", StepFrame(-1)), ("step ▸", StepFrame()), ("to start", Seek(0))]
)
def test_buttons_step_and_go_to_the_start(transport: Transporting, button: str, command: Command) -> None:
    user_sets(transport.panel._frames, button)
    assert transport.engine.sent == [command]


def test_dragging_back_seeks_to_the_earlier_frame(transport: Transporting) -> None:
    transport.engine.send(StepFrame(30))
    transport.tick()
    user_sets(transport.panel._slider, 4)
    transport.tick(0.3)
    assert transport.engine.sent[1:] == [Seek(4)]
    transport.tick()
    assert transport.panel._slider.value == 4 == transport.engine.snapshot.transport.frame


def test_dragging_seeks_once_to_where_the_hand_came_to_rest(transport: Transporting) -> None:
    transport.engine.send(StepFrame(3))
    transport.tick()
    for frame in (5, 9, 12):
        user_sets(transport.panel._slider, frame)
        transport.tick(0.05)
        assert transport.panel._slider.value == frame
    transport.tick(0.3)
    assert transport.engine.sent[1:] == [Seek(12)]
    transport.tick()
    assert transport.panel._slider.value == 12


@pytest.mark.parametrize("name", SPEEDS)
def test_speeds_are_sent_and_shown(transport: Transporting, name: str) -> None:
    user_sets(transport.panel._speed, name)
    assert transport.engine.sent == [SetSpeed(SPEEDS[name])]
    assert speed_name(SPEEDS[name]) == name
    transport.tick()
    assert transport.panel._speed.value == name


def test_the_stamp_is_exact_to_the_millisecond(engine: FakeEngine) -> None:
    engine.send(StepFrame(12))
    text = where(engine.snapshot)
    assert "frame <b>11</b> of 400" in text and "<b>1.10</b> of 40.0 s" in text
    assert "2023-11-14 22:13:21.100 UTC" in text


def test_a_dragged_slider_seeks_though_the_present_frame_is_shown_just_then(
    transport: Transporting, server: viser.ViserServer, busy: BusyThreads
) -> None:
    transport.engine.send(StepFrame(4))
    transport.tick()
    browser_sends(server, transport.panel._slider, 2)
    transport.tick()
    busy.catch_up()
    transport.tick(1.0)
    assert transport.engine.sent[-1] == Seek(2)


def test_numbers_follow_what_plays_four_times_a_second_and_end_at_the_frame_it_stops_at(
    transport: Transporting,
) -> None:
    shown = set()
    for _ in range(100):
        transport.engine.send(StepFrame(1))
        transport.engine.publish(transport=replace(transport.engine.snapshot.transport, playing=True))
        transport.tick(0.01)
        shown.add(transport.panel._slider.value)
    assert 4 <= len(shown) <= 5
    transport.engine.publish(transport=replace(transport.engine.snapshot.transport, playing=False))
    transport.tick(0.01)
    assert transport.panel._slider.value == transport.engine.snapshot.transport.frame == 99
