"""Play, pause, step, speed and time: words of the page's script become commands, and the bar's state follows.

Tests app/ui/transport.py.
"""

import html
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import viser

from app.server.protocol import Command, Pause, Play, Progress, Seek, SetSpeed, StepFrame
from app.ui.transport import SPEEDS, TransportPanel, speed_name, where
from tests.ui.conftest import Clock, Wire, page_of, user_sets
from tests.ui.fake_engine import FakeEngine


class Transporting:
    def __init__(self, server: viser.ViserServer, engine: FakeEngine) -> None:
        self.engine, self.clock = engine, Clock()
        self.panel = TransportPanel(page_of(server, engine.send, lambda: engine.snapshot, now=self.clock))

    def says(self, word: str) -> None:
        """What the page's script writes into the field that nobody sees."""
        user_sets(self.panel._bridge._field, word + " #1")

    @property
    def shown(self) -> dict[str, Any]:
        self.clock.now += 1.0
        self.panel.draw(self.engine.snapshot)
        return dict(json.loads(html.unescape(self.panel._state.content.split('"')[3])))


@pytest.fixture
def transport(server: viser.ViserServer, engine: FakeEngine) -> Transporting:
    return Transporting(server, engine)


def test_the_play_button_plays_then_pauses(transport: Transporting) -> None:
    transport.says("play")
    assert transport.shown["playing"]
    transport.says("play")
    assert not transport.shown["playing"]
    assert transport.engine.sent == [Play(), Pause()]


def test_pause_and_resume_of_the_tour_do_not_depend_on_what_the_page_believes(transport: Transporting) -> None:
    for word in ("pause", "resume", "resume"):
        transport.says(word)
    assert transport.engine.sent == [Pause(), Play(), Play()] and transport.shown["playing"]


def test_the_track_follows_the_frame_and_ends_at_the_last(transport: Transporting) -> None:
    assert transport.shown["frame"] == 0
    transport.engine.send(StepFrame(7))
    assert (transport.shown["frame"], transport.shown["last"]) == (6, transport.engine.frames - 1)


def test_before_a_recording_is_open_the_bar_says_that_it_is_being_opened_and_how_far(transport: Transporting) -> None:
    transport.engine.publish(recording=None, progress=Progress.opening(Path("hall.mcap")))
    assert "Opening hall.mcap …" in transport.shown["words"]
    transport.engine.publish(progress=Progress("Compiling deskew", 0.25))
    assert "Compiling deskew · 25 %" in transport.shown["words"]
    transport.engine.publish(progress=None)
    assert "No recording is open." in transport.shown["words"]


@pytest.mark.parametrize(
    ("word", "command"), [("step -1", StepFrame(-1)), ("step 1", StepFrame()), ("seek 0", Seek(0)), ("seek 4", Seek(4))]
)
def test_buttons_step_and_seek(transport: Transporting, word: str, command: Command) -> None:
    transport.says(word)
    assert transport.engine.sent == [command]


@pytest.mark.parametrize(
    "word", ["", "seek", "seek x", "seek -3", "step 9", "step", "speed 3×", "speed", "play 1", "reboot 1"]
)
def test_anything_else_that_comes_from_a_page_is_left_alone(transport: Transporting, word: str) -> None:
    transport.says(word)
    assert transport.engine.sent == []


@pytest.mark.parametrize("name", SPEEDS)
def test_speeds_are_sent_and_shown(transport: Transporting, name: str) -> None:
    transport.says(f"speed {name}")
    assert transport.engine.sent == [SetSpeed(SPEEDS[name])]
    assert transport.shown["speed"] == name == speed_name(SPEEDS[name])


def test_the_stamp_is_exact_to_the_millisecond(engine: FakeEngine) -> None:
    engine.send(StepFrame(12))
    text = where(engine.snapshot)
    assert "frame <b>11</b> of 0–399" in text and "<b>1.10</b> of 40.0 s" in text
    assert "2023-11-14 22:13:21.100 UTC" in text
    assert "frames/s" not in text, "nothing plays"


def test_a_part_of_a_recording_has_its_own_end_and_length(engine: FakeEngine) -> None:
    recording = engine.snapshot.recording
    assert recording is not None
    engine.publish(recording=replace(recording, start_s=10.0, frames=300))
    assert "300 frames, 30.0 s" in where(engine.snapshot)
    engine.publish(transport=replace(engine.snapshot.transport, frame=0, stamp_ns=recording.start_ns + 10_100_000_000))
    text = where(engine.snapshot)
    assert "frame <b>0</b> of 0–299" in text and "<b>10.10</b> of 40.0 s" in text


def test_the_bar_is_sent_four_times_a_second_while_playing_and_ends_at_the_frame_it_stops_at(
    transport: Transporting, wire: Wire
) -> None:
    transport.panel.draw(transport.engine.snapshot)
    wire.clear()
    for _ in range(100):
        transport.engine.send(StepFrame(1))
        transport.engine.publish(transport=replace(transport.engine.snapshot.transport, playing=True))
        transport.clock.now += 0.01
        transport.panel.draw(transport.engine.snapshot)
    assert 3 <= len(wire.messages) <= 5
    transport.engine.publish(transport=replace(transport.engine.snapshot.transport, playing=False))
    assert transport.shown["frame"] == 99
