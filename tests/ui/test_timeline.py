"""The timeline and the breakpoints as panels: what they send, and how often."""

import html
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import viser

from app.mapping.breakpoints import Breakpoints
from app.server.folders import Folders
from app.server.protocol import Command, Seek, SetBreakpoints, SetParams, Snapshot, StepFrame
from app.ui.timeline import TimelinePanel
from app.ui.transport import BreakpointPanel
from app.ui.workbench import Workbench
from tests.ui.conftest import Clock, Wire, page_of, user_sets
from tests.ui.fake_engine import FakeEngine


class Bench:
    def __init__(self, server: viser.ViserServer, engine: FakeEngine) -> None:
        self.clock, self.engine = Clock(), engine
        self.sent: list[Command] = []
        self.panel = TimelinePanel(page_of(server, self.sent.append, lambda: engine.snapshot, now=self.clock))

    def draw(self, seconds: float = 1.0) -> None:
        self.clock.now += seconds
        self.panel.draw(self.engine.snapshot)

    @property
    def shown(self) -> dict[str, Any]:
        text = html.unescape(self.panel._data.content.partition(">")[2].rpartition("<")[0])
        return dict(json.loads(text))

    def says(self, word: str) -> None:
        """What the page's script writes into the field that nobody sees."""
        user_sets(self.panel._bridge._field, word + " #1")


@pytest.fixture
def bench(server: viser.ViserServer, engine: FakeEngine) -> Bench:
    return Bench(server, engine)


def test_it_shows_the_frames_so_far_and_marks_the_present_one(bench: Bench) -> None:
    bench.engine.send(StepFrame(12))
    bench.draw()
    assert (bench.shown["present"], bench.shown["frames"]) == (11, 400)
    bench.engine.send(Seek(4))
    bench.draw()
    assert bench.shown["present"] == 4


def test_it_is_sent_twice_a_second_at_most_and_not_at_all_at_rest(bench: Bench, wire: Wire) -> None:
    for _ in range(100):
        bench.engine.send(StepFrame(1))
        bench.draw(0.02)
    uuid = bench.panel._data._impl.uuid
    assert 3 <= len([m for m in wire.messages if getattr(m, "uuid", "") == uuid]) <= 6
    bench.draw()
    wire.clear()
    bench.draw()
    assert wire.messages == []


def test_frames_played_just_before_going_back_stay(bench: Bench) -> None:
    bench.engine.send(StepFrame(12))
    bench.draw()
    bench.engine.send(StepFrame(5))
    bench.draw(0.01)  # too soon to be sent
    bench.engine.send(Seek(3))
    bench.draw(1.0)
    (residual,) = (strip for strip in bench.shown["strips"] if strip["name"] == "residual")
    assert bench.shown["present"] == 3
    assert bench.panel._history.columns().high["residual"][16] == pytest.approx(12.3)
    assert residual["unit"] == "mm"


def test_a_click_goes_to_its_frame(bench: Bench) -> None:
    bench.says("seek 123")
    assert bench.sent == [Seek(123)]


@pytest.mark.parametrize("word", ["", "seek", "seek x", "seek -3", "reboot 1"])
def test_anything_else_that_comes_from_a_page_is_left_alone(bench: Bench, word: str) -> None:
    bench.says(word)
    assert bench.sent == []


def test_keys_go_to_the_next_trouble_and_to_the_one_before(bench: Bench) -> None:
    bench.engine.send(StepFrame(40))
    series = dict(bench.engine.snapshot.series)
    share = series["ground_share"].copy()
    share[[10, 11, 30]] = 0.0
    bench.engine.publish(series=series | {"ground_share": share})
    bench.draw()
    bench.engine.publish(transport=replace(bench.engine.snapshot.transport, frame=20))
    bench.panel._jump(1)
    bench.panel._jump(-1)
    assert bench.sent == [Seek(30), Seek(10)]


def test_a_moved_slider_reaches_the_scene_before_the_curve(
    server: viser.ViserServer, wire: Wire, engine: FakeEngine, tmp_path: Path
) -> None:
    clock = Clock()
    workbench = Workbench(server, engine, Folders([tmp_path]), now=clock)
    engine.send(StepFrame(3))
    workbench.draw(engine.snapshot)
    wire.clear()
    clock.now += 5.0
    engine.send(SetParams({"ground.sigma": 0.2}))
    workbench.draw(engine.snapshot)
    order = [getattr(message, "name", "") or getattr(message, "uuid", "") for message in wire.messages]
    assert order.index("/map/sensor/lidar/scan") < order.index(workbench._study._plot._impl.uuid)
    assert workbench._timeline._data._impl.uuid not in order  # nothing of the frames so far has changed


# --- breakpoints ---------------------------------------------------------------------------------
def test_switches_and_limits_are_sent_in_si_units(server: viser.ViserServer) -> None:
    sent: list[Command] = []
    panel = BreakpointPanel(page_of(server, sent.append))
    user_sets(panel._switches["no_ground"], True)
    assert sent[-1] == SetBreakpoints(Breakpoints(no_ground=True))
    switch, number = panel._limits["residual"]
    user_sets(switch, True)
    user_sets(number, 30.0)
    assert sent[-1] == SetBreakpoints(Breakpoints(no_ground=True, residual=0.03))
    user_sets(switch, False)
    assert sent[-1] == SetBreakpoints(Breakpoints(no_ground=True))


def test_what_another_page_chose_is_shown_and_not_sent_back(server: viser.ViserServer) -> None:
    sent: list[Command] = []
    panel = BreakpointPanel(page_of(server, sent.append))
    panel.draw(Snapshot(breakpoints=Breakpoints(dropped=True, error=0.25)))
    switch, number = panel._limits["error"]
    assert panel._switches["dropped"].value and switch.value and number.visible and number.value == 25.0
    assert sent == []


def test_a_switch_stays_while_the_engine_has_not_heard_of_it(server: viser.ViserServer) -> None:
    panel = BreakpointPanel(page_of(server))
    user_sets(panel._switches["no_ground"], True)
    panel.draw(Snapshot())
    assert panel._switches["no_ground"].value
