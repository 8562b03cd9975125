"""Going back and continuing gives the same result as never going back, to the last bit, in engine and page."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import server_fakes as fakes
from hypothesis import example, given, settings
from hypothesis import strategies as st
from test_fold import content

from app.mapping.checkpoints import DEFAULT_BYTES, START
from app.mapping.feed import FileFeed
from app.mapping.opening import open_session
from app.mapping.session import Session
from app.sensors.presets import resolve_params
from app.server.controller import Controller
from app.server.fold import Fold
from app.server.protocol import SERIES, Command, EditLabels, Pause, Play, Seek, SetParams, SetSpeed, Snapshot, StepFrame
from app.server.publisher import Publisher
from app.slam.loops.service import InlineLoops
from app.slam.params import Params
from app.slam.types import DroppedScan

SAMPLE = next((Path(__file__).resolve().parents[2] / "sample_data").glob("*.mcap"))
FRAMES = 60
FREE = tuple(name for name in SERIES if name.endswith("_ms"))
"""Readouts that no two runs share."""


class Bench:
    """A session that works whenever it is told something, and the page's view of it."""

    def __init__(self, params: Params, opener: Callable[..., Session], path: Path, *, settle: bool = True) -> None:
        self.params, self.page, self.fold = params, Publisher(params), Fold()
        self.sessions: list[Session] = []

        def opening(path: Path, truth: Path | None, params: Params, part: object = None) -> Session:
            self.sessions.append(opener(path, truth, params))
            return self.sessions[-1]

        self.controller = self._controller(opening)
        self.controller.open(path, None)
        if settle:
            self.settle()

    def _controller(self, opener: Callable[..., Session]) -> Controller:
        return Controller(self.page, self.params, opener, clock=lambda: 0.0)

    @property
    def session(self) -> Session:
        return self.sessions[-1]

    def do(self, *commands: Command) -> Snapshot:
        for command in commands:
            self.controller.handle(command)
            self.settle()
        return self.see()

    def settle(self) -> None:
        while self.controller.work() == 0:
            pass

    def see(self) -> Snapshot:
        if self.page.filled:
            self.fold.apply(self.page.take())
        return self.fold.snapshot


def page(snapshot: Snapshot) -> dict[str, object]:
    """What the page shows, without what depends on how one came here: what was told, and how long it took."""
    seen = content(replace(snapshot, notices=(), transport=replace(snapshot.transport, finished=False)))
    return seen | {"series": {name: column for name, column in seen["series"].items() if name not in FREE}}


# --- with an engine that knows the answer --------------------------------------------------------
SIGMAS = (0.02, 0.1, 0.2)
SCRIPTS = st.lists(
    st.one_of(
        st.builds(Seek, st.integers(0, FRAMES + 5)),
        st.builds(StepFrame, st.integers(-12, 12).filter(bool)),
        st.sampled_from(SIGMAS).map(lambda sigma: SetParams({"ground.sigma": sigma})),
    ),
    min_size=1,
    max_size=12,
)


class Expected:
    """Where one is, and with which parameter each frame that is known was processed: nothing else matters."""

    def __init__(self) -> None:
        self.at, self.present = 0, Params().ground.sigma
        self.used = [self.present]

    def do(self, command: Command) -> None:
        match command:
            case SetParams(values):
                if values["ground.sigma"] != self.present:
                    del self.used[self.at + 1 :]
                self.present = values["ground.sigma"]
            case StepFrame(frames) if frames < 0:
                self.at = max(self.at + frames, 0)
            case StepFrame(frames):
                self._on(self.at + frames)
            case Seek(frame):
                self.at = min(frame, len(self.used) - 1)
                self._on(frame)

    def _on(self, frame: int) -> None:
        while self.at < min(frame, FRAMES - 1):
            self.at += 1
            if self.at < len(self.used) and self.used[self.at] != self.present:
                del self.used[self.at :]
            if self.at == len(self.used):
                self.used.append(self.present)


def straight_to(expected: Expected) -> Snapshot:
    """The page of a run that went there without a detour."""
    bench = Bench(Params(), fakes.open_fake, Path(f"walk-{FRAMES}.mcap"))
    for sigma in expected.used[1 : expected.at + 1]:
        bench.do(SetParams({"ground.sigma": sigma}), StepFrame())
    return bench.do(SetParams({"ground.sigma": expected.present}))


@settings(deadline=None, max_examples=40)
@example(script=[Seek(10), Seek(0), StepFrame(5), Seek(10)])
@given(script=SCRIPTS)
def test_the_page_is_that_of_a_run_that_went_straight_there(script: list[Command]) -> None:
    bench, expected = Bench(Params(), fakes.open_fake, Path(f"walk-{FRAMES}.mcap")), Expected()
    for command in script:
        bench.do(command)
        expected.do(command)
    assert page(bench.see()) == page(straight_to(expected))
    bench.controller.close()


def test_going_back_sends_nothing_that_the_page_has() -> None:
    bench = Bench(Params(), fakes.open_fake, Path("walk-60.mcap"))
    bench.do(Seek(50))
    bench.controller.handle(Seek(33))
    bench.settle()
    delta = bench.page.take()
    assert (delta.keep, delta.frames, delta.chunks) == (51, (), ())
    assert len(bench.fold.apply(delta).chunks) == 7


def test_going_forth_again_sends_no_keyframe_that_the_page_had() -> None:
    bench = Bench(Params(), fakes.open_fake, Path("walk-60.mcap"))
    had = bench.do(Seek(50)).chunks
    assert len(bench.do(Seek(20)).chunks) == 5
    bench.controller.handle(Seek(43))
    bench.settle()
    delta = bench.page.take()
    assert (delta.keep, delta.frames, delta.chunks) == (51, (), ())
    again = bench.fold.apply(delta).chunks
    assert len(again) == 9 and all(one is other for one, other in zip(again, had, strict=False))


def test_frames_on_the_way_back_are_not_shown() -> None:
    bench = Bench(Params(), fakes.open_fake, Path("walk-60.mcap"))
    bench.do(Seek(50))
    bench.controller.handle(Seek(38))
    seen = set()
    for _ in range(30):
        bench.controller.work()
        seen.add(bench.see().transport.frame)
    assert seen == {50, 38}


def test_a_pause_on_the_way_back_shows_the_frame_that_was_reached() -> None:
    bench = Bench(Params(), fakes.open_fake, Path("walk-60.mcap"))
    there = bench.do(Seek(50))
    bench.controller.handle(Seek(38))
    for _ in range(3):
        bench.controller.work()
    snapshot = bench.do(Pause())
    at = snapshot.transport.frame
    assert 20 < at < 38
    assert snapshot.result is not None
    assert np.array_equal(snapshot.trajectory, there.trajectory[: at + 1]) and snapshot.result.index == at
    assert bench.do(StepFrame()).transport.frame == at + 1


def test_steps_back_that_come_faster_than_they_are_done_add_up() -> None:
    bench = Bench(Params(), fakes.open_fake, Path("walk-60.mcap"))
    bench.do(Seek(50))
    for _ in range(7):
        bench.controller.handle(StepFrame(-1))
    bench.controller.work()
    bench.controller.handle(StepFrame())
    bench.settle()
    assert bench.see().transport.frame == 44


def test_playing_on_after_going_back_overwrites_the_future() -> None:
    bench = Bench(Params(), fakes.open_fake, Path("walk-60.mcap"))
    before = bench.do(Seek(50))
    bench.do(Seek(20), SetParams({"ground.sigma": 0.2}), SetSpeed(math.inf), Play())
    after = bench.do(Seek(50))
    assert np.array_equal(after.series["speed"][:21], before.series["speed"][:21])
    assert np.all(after.series["speed"][21:51] > before.series["speed"][21:51])
    used = [params.ground.sigma for params in bench.session.engine.steps_with]  # type: ignore[attr-defined]
    assert used[-1] == 0.2


def test_label_edits_of_keyframes_that_become_different_ones_are_dropped() -> None:
    bench = Bench(Params(), fakes.open_fake, Path("walk-60.mcap"))
    bench.do(Seek(50))
    bench.do(*(EditLabels(index, 0) for index in range(11)))
    bench.do(Seek(20))
    assert len(bench.session.keyframes.edits) == 11, "the later keyframes are still known"
    bench.do(SetParams({"ground.sigma": 0.2}))
    assert [edit.keyframe for edit in bench.session.keyframes.edits] == [0, 1, 2, 3, 4]


def test_a_longer_way_shows_progress() -> None:
    bench = Bench(Params(), fakes.open_fake, Path("walk-60.mcap"))
    bench.do(Seek(50))
    checkpoints = bench.session.checkpoints
    checkpoints.drop([frame for frame in checkpoints.frames if frame > START])
    bench.controller.handle(Seek(40))
    fractions = []
    while bench.controller.work() == 0:
        progress = bench.see().progress
        fractions += [progress.fraction] if progress else []
    assert len(fractions) > 30 and fractions == sorted(fractions) and fractions[-1] > 0.9
    assert bench.see().progress is None and bench.see().transport.frame == 40


def test_scans_dropped_and_frames_failed_before_are_so_again_and_not_reported_again() -> None:
    for name in ("dropped-60-20.mcap", "failing-60-20.mcap"):
        bench = Bench(Params(), fakes.open_fake, Path(name))
        bench.do(SetSpeed(math.inf), Play())
        there = bench.do(Play() if name.startswith("failing") else Pause(), Seek(45))
        notices = len(there.notices)
        back = bench.do(Seek(15))
        assert back.transport.dropped == 0 and len(back.notices) == notices
        again = bench.do(Seek(45))
        assert page(again) == page(there) and len(again.notices) == notices


# --- with the real engine ------------------------------------------------------------------------
LENGTH_S = 6.0
CHANGES = {12: {"ground.sigma": 0.02}, 25: {"filter.max_iterations": 2}, 40: {"scan.voxel_size": 0.6}}


def open_sample(path: Path, truth: Path | None, params: Params, /, *, kilobytes: int = 1 << 20) -> Session:
    return open_session(path, params, 0.0, LENGTH_S, truth=truth, loops=InlineLoops, checkpoint_bytes=kilobytes << 10)


def open_whole(path: Path, truth: Path | None, params: Params, part: object = None, /) -> Session:
    return open_session(path, params, truth=truth, loops=InlineLoops, checkpoint_bytes=DEFAULT_BYTES)


@pytest.fixture(scope="module")
def sample_params() -> Params:
    return resolve_params(SAMPLE, None, None, [])


@pytest.fixture(scope="module")
def never_stopped(sample_params: Params) -> Snapshot:
    bench = Bench(sample_params, open_sample, SAMPLE)
    walk_on(bench, FRAMES)
    bench.controller.close()
    return bench.see()


def walk_on(bench: Bench, end: int) -> None:
    """Frame by frame to the end, changing parameters on the way."""
    while (at := bench.see().transport.frame) < end - 1:
        bench.controller.handle(SetParams(CHANGES.get(at, {})))
        bench.do(StepFrame())
        if bench.see().transport.finished:
            break


@pytest.mark.parametrize("kilobytes", [1 << 20, 100])
def test_restored_and_continued_equals_never_stopped(
    sample_params: Params, never_stopped: Snapshot, kilobytes: int
) -> None:
    def opener(path: Path, truth: Path | None, params: Params, part: object = None, /) -> Session:
        return open_sample(path, truth, params, kilobytes=kilobytes)

    bench = Bench(sample_params, opener, SAMPLE)
    walk_on(bench, FRAMES)
    rng = np.random.default_rng(kilobytes)
    last = never_stopped.transport.frame
    for frame in rng.integers(0, last, 8).tolist():
        snapshot = bench.do(Seek(frame))
        assert snapshot.trajectory.tobytes() == never_stopped.trajectory[: frame + 1].tobytes()
    assert (bench.session.checkpoints.nbytes > kilobytes << 10) is (kilobytes == 100)
    # From an early frame on, all of it anew, with the parameters chosen anew:
    first = {name: sample_params.value(name) for change in CHANGES.values() for name in change}
    bench.do(Seek(5), SetParams(first))
    walk_on(bench, FRAMES)
    assert bench.session.engine.params == never_stopped.params
    assert page(bench.see()) == page(never_stopped)
    bench.controller.close()


def test_after_going_back_there_is_nothing_of_what_came_later(sample_params: Params) -> None:
    bench = Bench(sample_params, open_sample, SAMPLE)
    fresh = bench.do(Seek(17))
    assert page(bench.do(Seek(45), Seek(17))) == page(fresh)
    bench.controller.close()


def test_reading_is_taken_up_between_any_two_measurements_as_if_it_had_gone_on(sample_params: Params) -> None:
    feed, read, places = FileFeed(SAMPLE, sample_params, 1.0, 3.0), [], []
    while (entry := feed.next()) is not None:
        read.append(entry)
        places.append(feed.place())
    for at in range(0, len(places), 3):
        feed.go_to(places[at])
        rest = list(iter(feed.next, None))
        assert len(rest) == len(read) - at - 1
        for one, other in zip(rest, read[at + 1 :], strict=True):
            assert not isinstance(one, DroppedScan) and not isinstance(other, DroppedScan)
            assert one.scan.points.tobytes() == other.scan.points.tobytes()
            assert one.imu.stamps_ns.tobytes() == other.imu.stamps_ns.tobytes()
            assert one.imu.accel.tobytes() == other.imu.accel.tobytes() and one.notices == other.notices
    feed.close()
