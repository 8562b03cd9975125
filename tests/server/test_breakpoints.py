"""Breakpoints: the conditions on their own, and in a session."""

import math
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import server_fakes as fakes
from pydantic import ValidationError

from app.mapping.breakpoints import Breakpoints, CheckedFrame, reasons
from app.mapping.session import Session
from app.server.controller import Controller
from app.server.fold import Fold
from app.server.protocol import Pause, Play, Restart, Seek, SetBreakpoints, SetSpeed, Snapshot, StepFrame
from app.server.publisher import Publisher
from app.server.setup import Setup
from app.server.worker import EngineProcess
from app.slam.loops.types import Evidence, LoopEdge, Origin, Verdict
from app.slam.params import Params
from app.slam.types import ImuSamples, Scan, StepResult

BAD = range(20, 25)
"""Frames at which the engine below finds no ground, is slow, is degenerate and fits badly."""
FRAMES = 40


class MoodyEngine(fakes.FakeEngine):
    def step(self, scan: Scan, imu: ImuSamples) -> StepResult:
        result = super().step(scan, imu)
        return spoilt(result) if result.index in BAD else result


def spoilt(result: StepResult) -> StepResult:
    ground = replace(result.ground, found=False, reason="only 3 seed points; a plane needs 20", planarity=0.4)
    update = replace(result.registration, residual_rms=0.08, degenerate=True)
    return replace(result, ground=ground, registration=update, timings_ms={"total": 130.0})


def frame(**changes: object) -> StepResult:
    engine = fakes.FakeEngine(Params())
    entry = fakes.FakeFeed(Path("x"), 1).next()
    return replace(engine.step(entry.scan, entry.imu), **changes)  # type: ignore[union-attr, arg-type]


def edge(verdict: Verdict, newer: int = 9) -> LoopEdge:
    return LoopEdge(2, newer, newer, np.eye(4), np.eye(6), Evidence(), verdict, "overlap 0.2 is below 0.5")


GOOD = frame()


# --- conditions ----------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("chosen", "says"),
    [
        (Breakpoints(no_ground=True), "No ground plane: only 3 seed points; a plane needs 20."),
        (Breakpoints(planarity=0.3), "λ3/λ2 of the seeds is 0.400, over 0.3."),
        (Breakpoints(residual=0.05), "The residual is 80.0 mm, over 50 mm."),
        (Breakpoints(degenerate=True), "Degenerate: this scan leaves one direction unobserved."),
        (Breakpoints(frame_ms=100.0), "The frame took 130.0 ms, over 100 ms."),
    ],
)
def test_a_state_pauses_where_it_begins_and_says_so_with_its_number(chosen: Breakpoints, says: str) -> None:
    good, bad = CheckedFrame(GOOD), CheckedFrame(spoilt(GOOD))
    assert reasons(chosen, good, bad) == (says,)
    assert reasons(chosen, bad, bad) == ()
    assert reasons(chosen, bad, good) == ()
    assert reasons(chosen, None, bad) == (says,)
    assert reasons(Breakpoints(), good, bad) == ()


def test_an_error_that_is_not_known_is_no_error() -> None:
    chosen = Breakpoints(error=0.5)
    assert reasons(chosen, CheckedFrame(GOOD), CheckedFrame(GOOD, math.nan)) == ()
    assert reasons(chosen, CheckedFrame(GOOD, math.nan), CheckedFrame(GOOD, 0.512)) == (
        "The error to truth is 51.2 cm, over 50 cm.",
    )


def test_scans_left_out_pause_every_time() -> None:
    before, now = CheckedFrame(frame(dropped=1)), CheckedFrame(frame(dropped=2))
    assert reasons(Breakpoints(dropped=True), before, now) == ("2 scans were dropped just before this frame.",)
    assert reasons(Breakpoints(dropped=True), now, CheckedFrame(GOOD)) == ()


def test_a_loop_pauses_at_the_frame_at_which_it_takes_effect_and_says_why() -> None:
    result = frame(loops=(edge(Verdict.REJECTED, 11), edge(Verdict.ACCEPTED), edge(Verdict.CANDIDATE, 12)))
    found, turned_down = Breakpoints(loop_found=True), Breakpoints(loop_rejected=True)
    before = CheckedFrame(GOOD)
    assert reasons(found, before, CheckedFrame(result)) == (
        "Loop found between keyframes 2 and 9: overlap 0.2 is below 0.5.",
    )
    assert reasons(turned_down, before, CheckedFrame(result)) == (
        "Loop rejected between keyframes 2 and 11: overlap 0.2 is below 0.5.",
    )
    assert reasons(found, CheckedFrame(result), CheckedFrame(GOOD)) == ()


def test_the_users_own_word_on_a_loop_pauses_nothing() -> None:
    overridden = replace(edge(Verdict.ACCEPTED), edited=True)
    added = replace(edge(Verdict.ACCEPTED), origin=Origin.USER)
    result = frame(loops=(overridden, added))
    assert reasons(Breakpoints(loop_found=True), CheckedFrame(GOOD), CheckedFrame(result)) == ()


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_a_limit_that_is_no_limit_is_refused_by_name(value: float) -> None:
    with pytest.raises(ValidationError, match="residual"):
        Breakpoints(residual=value)


# --- in a session --------------------------------------------------------------------------------
class Bench:
    def __init__(self, name: str = f"walk-{FRAMES}.mcap") -> None:
        self.now = 0.0
        self.page, self.fold = Publisher(Params()), Fold()
        self.controller = Controller(self.page, Params(), self._open, clock=lambda: self.now)
        self.controller.open(Path(name), None)
        self.settle()

    def _open(self, path: Path, truth: Path | None, params: Params, part: object = None, /) -> Session:
        session = fakes.open_fake(path, truth, params)
        session.engine = MoodyEngine(params)  # type: ignore[assignment]
        return session

    def settle(self) -> Snapshot:
        while self.controller.work() == 0:
            pass
        return self.fold.apply(self.page.take()) if self.page.filled else self.fold.snapshot

    def do(self, *commands: object) -> Snapshot:
        for command in commands:
            self.controller.handle(command)  # type: ignore[arg-type]
        return self.settle()


FAST = SetSpeed(math.inf)
NO_GROUND = SetBreakpoints(Breakpoints(no_ground=True))


def test_playing_pauses_there_also_at_full_speed_shows_why_and_play_goes_on() -> None:
    bench = Bench()
    snapshot = bench.do(NO_GROUND, FAST, Play())
    assert snapshot.breakpoints == NO_GROUND.breakpoints
    assert snapshot.transport.frame == BAD[0] and not snapshot.transport.playing
    assert snapshot.notices[-1].text == (
        f"Paused at frame {BAD[0]}. No ground plane: only 3 seed points; a plane needs 20."
    )
    assert bench.do(Play()).transport.frame == FRAMES - 1


def test_a_seek_passes_but_playing_over_known_frames_pauses_again() -> None:
    bench = Bench()
    snapshot = bench.do(NO_GROUND, FAST, Seek(BAD[-1] + 5))
    assert snapshot.transport.frame == BAD[-1] + 5
    assert bench.do(Seek(BAD[0] - 3)).transport.frame == BAD[0] - 3
    assert bench.do(Play()).transport.frame == BAD[0]


def test_playing_on_from_within_does_not_pause_for_what_already_was_so() -> None:
    bench = Bench()
    bench.do(NO_GROUND, FAST, Seek(FRAMES - 2))
    assert bench.do(Seek(BAD[1]), Play()).transport.frame == FRAMES - 1
    bench = Bench()
    bench.do(NO_GROUND, FAST, StepFrame(BAD[1]))
    assert bench.do(Play()).transport.frame == FRAMES - 1


def test_a_scan_left_out_pauses_at_the_frame_after_it() -> None:
    bench = Bench("dropped-30-12.mcap")
    snapshot = bench.do(SetBreakpoints(Breakpoints(dropped=True)), FAST, Play())
    assert snapshot.transport.frame == 12 and not snapshot.transport.playing
    assert "1 scan was dropped" in snapshot.notices[-1].text
    assert snapshot.series["dropped"][-2:].tolist() == [0.0, 1.0]


def test_breakpoints_taken_off_pause_nothing() -> None:
    bench = Bench()
    bench.do(NO_GROUND, SetBreakpoints(Breakpoints()), FAST)
    assert bench.do(Play(), Pause()).transport.frame >= 0
    assert bench.do(Play()).transport.frame == FRAMES - 1


def test_an_engine_that_was_killed_still_pauses_there() -> None:
    engine = EngineProcess(Setup(recording=Path("dropped-30-12.mcap")), main=fakes.fake_main)
    try:
        engine.send(SetBreakpoints(Breakpoints(dropped=True)))
        first = until(engine, lambda s: s.breakpoints.dropped and s.transport.frame == 0)
        assert engine.pid is not None
        os.kill(engine.pid, signal.SIGKILL)
        until(engine, lambda s: not s.engine_alive)
        engine.send(Restart())
        until(engine, lambda s: s.engine_alive and s.session > first.session and s.transport.frame == 0)
        engine.send(FAST)
        engine.send(Play())
        assert until(engine, lambda s: s.transport.frame > 0 and not s.transport.playing).transport.frame == 12
    finally:
        engine.close()


def until(engine: EngineProcess, wanted: Callable[[Snapshot], bool]) -> Snapshot:
    deadline = time.monotonic() + 60.0
    snapshot = engine.snapshot
    while not wanted(snapshot):
        assert time.monotonic() < deadline, snapshot.transport
        snapshot = engine.wait(snapshot.revision, timeout=1.0)
    return snapshot
