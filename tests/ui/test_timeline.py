"""The timeline: spikes survive thinning, later frames stay after going back, the panel sends little; breakpoints."""

import base64
import html
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st

from app.mapping.breakpoints import Breakpoints
from app.server.folders import Folders
from app.server.protocol import (
    SERIES,
    Chunk,
    Command,
    LoopsView,
    OpenedRecording,
    Seek,
    SetBreakpoints,
    SetParams,
    Snapshot,
    StepFrame,
    Transport,
)
from app.slam import iekf
from app.slam.errors import HemislamError
from app.slam.loops.types import Evidence, LoopEdge, Verdict
from app.ui.timeline import COLUMNS, DEGENERATE_CM, STRIPS, History, TimelinePanel, limits, message, packed
from app.ui.transport import BreakpointPanel
from app.ui.workbench import Workbench
from tests.ui.conftest import Clock, Wire, page_of, user_sets
from tests.ui.fake_engine import START_NS, FakeEngine
from tests.ui.fake_forks import alone

HOUR = 36_000


def snapshot(frames: int, total: int, session: int = 1, **columns: np.ndarray) -> Snapshot:
    """Of a recording at 10 Hz; series not named are 1."""
    series = {name: np.ones(frames) for name in SERIES} | {"stamp_s": 0.1 * np.arange(frames)} | columns
    recording = OpenedRecording(Path("walk.mcap"), START_NS, 0.1 * total, total, ())
    return Snapshot(session=session, recording=recording, transport=Transport(frame=frames - 1), series=series)


def seen(*snapshots: Snapshot) -> History:
    history = History()
    for one in snapshots:
        history.see(one)
    return history


def unpacked(text: str) -> np.ndarray:
    """As the page's script reads it."""
    return np.frombuffer(base64.b64decode(text), "<f4")


@given(st.integers(0, HOUR - 1))
def test_one_bad_frame_in_an_hour_stays_visible_at_its_place(frame: int) -> None:
    residual = np.full(HOUR, 0.01)
    residual[frame] = 0.5
    columns = seen(snapshot(HOUR, HOUR, residual_rms=residual)).columns()
    high, low = columns.high["residual"], columns.low["residual"]
    assert len(high) <= COLUMNS
    (at,) = np.flatnonzero(high > 499)
    following = columns.starts[at + 1] if at + 1 < len(high) else HOUR
    assert columns.starts[at] <= frame < following
    assert low.max() < 11


def test_a_short_recording_has_a_column_for_every_frame() -> None:
    took = np.arange(50.0)
    columns = seen(snapshot(50, 60, total_ms=took)).columns()
    assert np.array_equal(columns.starts, np.arange(60))
    assert np.array_equal(columns.high["took"][:50], took) and np.isnan(columns.high["took"][50:]).all()


def test_units_are_those_on_the_label() -> None:
    one = snapshot(
        1, 1, residual_rms=np.array([0.012]), inliers=np.array([80.0]), used=np.array([100.0]),
        degeneracy=np.array([1 / 0.04**2]), ground_share=np.array([0.3]), imu_gap_s=np.array([0.25]),
        error_m=np.array([0.07]),
    )  # fmt: skip
    values = {key: column[0] for key, column in seen(one).columns().high.items()}
    assert values == pytest.approx(
        {"residual": 12, "inliers": 80, "uncertain": 4, "ground": 30, "gap": 250, "dropped": 1, "took": 1, "error": 7}
    )
    assert [(strip.key, strip.unit) for strip in STRIPS if strip.unit in ("mm", "cm", "ms")] == [
        ("residual", "mm"), ("uncertain", "cm"), ("gap", "ms"), ("took", "ms"), ("error", "cm"),
    ]  # fmt: skip


def test_a_direction_that_is_open_is_called_so_instead_of_a_number_of_many_digits() -> None:
    one = snapshot(4, 4, degeneracy=np.array([1 / 0.04**2, 2.7e-13, 0.0, np.nan]))
    np.testing.assert_allclose(seen(one).columns().high["uncertain"], [4.0, 1000.0, 1000.0, np.nan])
    (strip,) = (strip for strip in message(seen(one), one)["strips"] if strip["name"] == "degeneracy")
    assert strip["most"] == (1000.0, "> 10 m") and strip["top"] <= 1200


def test_what_the_page_calls_degenerate_is_what_the_filter_does() -> None:
    assert DEGENERATE_CM == 100 * iekf.DEGENERATE_SIGMA


def test_frames_gone_back_over_stay_until_they_are_processed_again() -> None:
    first = snapshot(40, 60, total_ms=np.full(40, 5.0))
    history = seen(first, snapshot(10, 60, total_ms=np.full(10, 5.0)))
    assert history.present == 9
    assert np.nanmin(history.columns().high["took"][:40]) == 5.0
    history.see(snapshot(20, 60, total_ms=np.full(20, 7.0)))
    took = history.columns().high["took"]
    assert took[19] == 7.0 and took[20] == 5.0


def test_frames_gone_back_over_twice_stay_and_another_truth_makes_their_errors_unknown() -> None:
    history = seen(*(snapshot(n, 60, total_ms=np.full(n, float(n))) for n in (40, 30, 10, 20)))
    took = history.columns().high["took"]
    assert took[[0, 19, 20, 29, 30, 39]].tolist() == [20, 20, 30, 30, 40, 40] and np.isnan(took[40:]).all()
    other = snapshot(20, 60)
    assert other.recording is not None
    history.see(replace(other, recording=replace(other.recording, truth=Path("other.tum"))))
    error = history.columns().high["error"]
    assert np.isfinite(error[:20]).all() and np.isnan(error[20:]).all()
    assert np.isfinite(history.columns().high["took"][20:40]).all()


def test_another_session_forgets() -> None:
    history = seen(snapshot(40, 60), snapshot(5, 60, session=2))
    assert np.isnan(history.columns().high["took"][5:]).all()


def edge(newer: int, decided_at: int, verdict: Verdict) -> LoopEdge:
    return LoopEdge(0, newer, decided_at, np.eye(4), np.eye(6), Evidence(), verdict, "fits")


def test_loops_are_where_they_were_decided_and_stay_there_when_going_back() -> None:
    nothing = np.empty(0)
    chunks = tuple(Chunk(i, 10 * i, 0, nothing, nothing, nothing, nothing, np.eye(4)) for i in range(4))  # type: ignore[arg-type]
    loops = LoopsView(edges=(edge(1, 2, Verdict.ACCEPTED), edge(2, 3, Verdict.REJECTED), edge(3, 9, Verdict.ACCEPTED)))
    history = seen(replace(snapshot(40, 60), chunks=chunks, loops=loops))
    found = history.columns().loops
    assert np.flatnonzero(found["accepted"]).tolist() == [20] and np.flatnonzero(found["rejected"]).tolist() == [30]
    history.see(replace(snapshot(5, 60), chunks=chunks[:1], loops=LoopsView()))
    assert np.flatnonzero(history.columns().loops["accepted"]).tolist() == [20]
    history.see(replace(snapshot(35, 60), chunks=chunks, loops=LoopsView()))
    assert not any(history.columns().loops["accepted"])


def test_troubles_are_where_a_red_stretch_begins_without_slow_frames_and_loops() -> None:
    share = np.full(60, 0.3)
    share[20:25] = 0.0
    dropped, took = np.zeros(60), np.ones(60)
    dropped[[23, 31, 32]] = 1
    took[50] = 500.0
    one = snapshot(
        60, 60, ground_share=share, dropped=dropped, degeneracy=np.full(60, 1e4), imu_gap_s=np.zeros(60), total_ms=took
    )
    nothing = np.empty(0)
    chunk = Chunk(0, 40, 0, nothing, nothing, nothing, nothing, np.eye(4))  # type: ignore[arg-type]
    one = replace(one, chunks=(chunk,), loops=LoopsView(edges=(edge(1, 0, Verdict.ACCEPTED),)))
    assert seen(one).troubles(limits(one)) == [20, 31]


def test_frames_slower_than_the_sensor_are_red() -> None:
    assert limits(snapshot(1, 100))["took"] == pytest.approx(100.0)
    whole = snapshot(1, 100)
    assert whole.recording is not None
    part = replace(whole, recording=replace(whole.recording, start_s=4.0, frames=60))
    assert limits(part)["took"] == pytest.approx(100.0)


@given(st.lists(st.one_of(st.floats(0, 1e4), st.just(float("nan"))), min_size=1, max_size=40))
def test_packed_numbers_come_out_as_they_went_in(numbers: list[float]) -> None:
    np.testing.assert_allclose(unpacked(packed(np.array(numbers))), numbers, rtol=1e-6, atol=1e-30)


def test_a_message_is_small_however_long_the_recording_and_without_truth_has_no_error() -> None:
    long = snapshot(HOUR, HOUR, error_m=np.full(HOUR, np.nan))
    sent = message(seen(long), long)
    assert len(json.dumps(sent)) < 60_000
    assert [strip["name"] for strip in sent["strips"]] == [s.name for s in STRIPS if s.key != "error"]
    assert sent["present"] == HOUR - 1


# --- the panel -----------------------------------------------------------------------------------
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
    bench.engine.publish(transport=replace(bench.engine.snapshot.transport, frame=0))
    with pytest.raises(HemislamError, match="no problem before this frame"):
        bench.panel._jump(-1)


def test_a_moved_slider_reaches_the_scene_before_the_curve(
    server: viser.ViserServer, wire: Wire, engine: FakeEngine, tmp_path: Path
) -> None:
    clock = Clock()
    workbench = Workbench(server, alone(engine), Folders([tmp_path]), now=clock)
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
    switch, number = panel._switches["residual"], panel._numbers["residual"]
    user_sets(switch, True)
    user_sets(number, 30.0)
    assert sent[-1] == SetBreakpoints(Breakpoints(no_ground=True, residual=0.03))
    user_sets(switch, False)
    assert sent[-1] == SetBreakpoints(Breakpoints(no_ground=True))


def test_what_another_page_chose_is_shown_and_not_sent_back(server: viser.ViserServer) -> None:
    sent: list[Command] = []
    panel = BreakpointPanel(page_of(server, sent.append))
    panel.draw(Snapshot(breakpoints=Breakpoints(dropped=True, error=0.25)))
    switch, number = panel._switches["error"], panel._numbers["error"]
    assert panel._switches["dropped"].value and switch.value and number.visible and number.value == 25.0
    assert sent == []


def test_a_switch_stays_while_the_engine_has_not_heard_of_it(server: viser.ViserServer) -> None:
    panel = BreakpointPanel(page_of(server))
    user_sets(panel._switches["no_ground"], True)
    panel.draw(Snapshot())
    assert panel._switches["no_ground"].value
