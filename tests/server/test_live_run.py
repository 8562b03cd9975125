"""The workbench's engine on live data: the map is the same as from the file, and survives the death of the engine."""

import contextlib
import math
import os
import random
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from test_rewind import SAMPLE

from app.mapping.opening import open_session
from app.sensors.live.feed import Pace, feed
from app.sensors.live.process import LiveClient, LiveProcess
from app.sensors.live.urls import parse_address
from app.sensors.presets import resolve_params
from app.server.keeping import AddNote
from app.server.protocol import LIVE, OpenRecording, Pause, Play, Seek, Snapshot, StepFrame
from app.server.setup import Setup
from app.server.worker import EngineProcess
from app.slam.loops.service import InlineLoops
from app.slam.params import Params
from app.slam.types import StepResult

LENGTH_S = 7.0
PATIENCE_S = 90.0


@pytest.fixture(scope="module")
def params() -> Params:
    return resolve_params(SAMPLE, None, None, [])


@pytest.fixture(scope="module")
def from_file(params: Params) -> dict[int, np.ndarray]:
    """Positions by scan end, as the file gives them."""
    session = open_session(SAMPLE, params, 0.0, LENGTH_S, loops=InlineLoops)
    found = {}
    while (result := session.advance()) is not None:
        if isinstance(result, StepResult):
            found[result.stamp_ns] = result.T_map_imu[:3, 3]
    session.close()
    return found


@dataclass
class Live:
    """An engine's process on what is sent to it, as packets with an IMU beside them or as a Foxglove server."""

    engine: EngineProcess
    url: str
    imu: str | None
    params: Params
    source: LiveProcess
    errors: list[BaseException] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.onlooker = LiveClient(self.source.address)

    def play(self, speed: float, *, patiently: bool = True, length_s: float = LENGTH_S) -> threading.Thread:
        """patiently: no faster than the engine takes it, so that nothing is dropped however busy the machine is."""
        pace = Pace(speed, progress=self._wait_for_engine) if patiently else Pace(speed)

        def send() -> None:
            try:
                imu_to = parse_address(self.imu) if self.imu else None
                feed(SAMPLE, self.params, parse_address(self.url), imu_to, pace=pace, duration_s=length_s)
            except BaseException as error:
                self.errors.append(error)

        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        return thread

    def _wait_for_engine(self, played_s: float) -> None:
        """Until only a second of scans waits; those of the first second are held back until the clocks are compared."""
        deadline = time.monotonic() + PATIENCE_S
        while played_s > 1.4 and time.monotonic() < deadline:
            transport = self.engine.snapshot.transport
            if not transport.playing or transport.frame + transport.dropped > 10 * played_s - 10:
                return
            time.sleep(0.02)

    def until(self, wanted: Callable[[Snapshot], bool]) -> Snapshot:
        deadline = time.monotonic() + PATIENCE_S
        snapshot = self.engine.snapshot
        while not wanted(snapshot):
            assert time.monotonic() < deadline, (snapshot.transport, snapshot.notices, self.errors)
            snapshot = self.engine.wait(snapshot.revision, timeout=0.2)
        return snapshot

    def until_all_is_mapped(self) -> Snapshot:
        """Once every scan that came was mapped or is counted as dropped; none is missing."""

        def is_mapped(snapshot: Snapshot) -> bool:
            done, state = snapshot.transport, self.onlooker.state()
            return state.backlog == 0 and done.frame + 1 + done.dropped == state.counters.frames

        return self.until(is_mapped)


def free_ports(count: int) -> list[int]:
    """Different ports that are free for both UDP and TCP, outside the range used for outgoing connections."""
    ports: list[int] = []
    candidates = iter(random.sample(range(20_000, 32_000), 12_000))
    while len(ports) < count:
        port = next(candidates)
        with contextlib.ExitStack() as stack, contextlib.suppress(OSError):
            for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
                stack.enter_context(socket.socket(socket.AF_INET, kind)).bind(("127.0.0.1", port))
            ports.append(port)
    return ports


@contextlib.contextmanager
def receiving(params: Params, folder: Path, url: str, imu: str | None = None) -> Iterator[Live]:
    with LiveProcess(url, params, imu) as source:
        setup = Setup(LIVE, params=params, play=True, speed=math.inf, live=source.address, live_folder=folder)
        engine = EngineProcess(setup)
        live = Live(engine, url, imu, params, source)
        try:
            live.until(lambda s: s.recording is not None)
            yield live
        finally:
            engine.close()


@pytest.fixture
def live(params: Params, tmp_path: Path) -> Iterator[Live]:
    """Of whole scans by TCP: however busy the machine is, all of them arrive."""
    (port,) = free_ports(1)
    with receiving(params, tmp_path, f"foxglove://127.0.0.1:{port}") as live:
        yield live


def compared(snapshot: Snapshot, from_file: dict[int, np.ndarray]) -> tuple[float, float]:
    """How far frames are from where the file has them, m, and from when, s; more may have come than was read of it."""
    assert snapshot.recording is not None
    stamps = np.array(sorted(from_file))
    found = np.round(snapshot.series["stamp_s"] * 1e9) + snapshot.recording.start_ns
    known = np.flatnonzero(np.isfinite(found) & (found < stamps[-1] + 10_000_000))
    nearest = stamps[np.abs(stamps[None, :] - found[known, None]).argmin(axis=1)]
    there = np.array([from_file[int(stamp)] for stamp in nearest])
    away = np.linalg.norm(snapshot.trajectory[known] - there, axis=1)
    return float(away.max()), float(np.abs(nearest - found[known]).max() * 1e-9)


def apart(snapshot: Snapshot, from_file: dict[int, np.ndarray]) -> float:
    """m, the farthest that a frame is from where the file has it."""
    away, late = compared(snapshot, from_file)
    assert late < 0.001
    return away


def test_packets_give_the_same_walk_as_the_file(
    params: Params, from_file: dict[int, np.ndarray], tmp_path: Path
) -> None:
    """A machine that is too busy to send packets when it should, or to take them, is asked again, more slowly."""
    for speed in (2.0, 0.5, 0.25):
        msop, difop, imu_port = free_ports(3)
        url, imu = f"rsbpearl://127.0.0.1:{msop},{difop}", f"imu-udp://127.0.0.1:{imu_port}"
        with receiving(params, tmp_path, url, imu) as live:
            live.play(speed, patiently=False).join(PATIENCE_S)
            snapshot = live.until(lambda s: s.transport.frame + s.transport.dropped >= len(from_file) - 4)
            assert not live.errors
            assert snapshot.live is not None
            away, cut = compared(snapshot, from_file)
            if snapshot.live.counters.lost == snapshot.transport.dropped == 0 and cut < 0.001:  # no revolution was cut
                assert away < 0.005  # the packets' steps
                return
    pytest.skip("needs a machine that has time for packets as they come")


def test_what_a_robot_sends_gives_the_same_walk_as_the_file(live: Live, from_file: dict[int, np.ndarray]) -> None:
    live.play(4.0).join(PATIENCE_S)
    snapshot = live.until(lambda s: s.transport.frame >= len(from_file) - 4)
    assert not live.errors
    assert snapshot.transport.dropped == 0
    assert apart(snapshot, from_file) < 0.001


def test_a_source_that_sends_no_more_is_not_shown_at_its_last_rate(live: Live) -> None:
    live.play(4.0).join(PATIENCE_S)
    assert live.until_all_is_mapped().transport.frames_per_second > 1.0
    still = live.until(lambda s: s.transport.frames_per_second == 0.0)
    assert still.transport.playing


def test_an_engine_that_is_killed_is_followed_by_one_that_goes_on_in_the_same_map(
    live: Live, from_file: dict[int, np.ndarray]
) -> None:
    thread = live.play(4.0)
    live.until(lambda s: s.transport.frame >= 25)
    live.engine.send(AddNote("a door"))
    before = live.until(lambda s: bool(s.notes))
    assert live.engine.pid is not None
    os.kill(live.engine.pid, signal.SIGKILL)
    after = live.until(lambda s: s.transport.frame > before.transport.frame + 15 and s.engine_alive)
    assert after.session == before.session, "the page keeps its map"
    assert len(after.chunks) >= len(before.chunks)
    assert [chunk.index for chunk in after.chunks] == list(range(len(after.chunks)))
    live.engine.send(AddNote("another"))
    thread.join(PATIENCE_S)
    end = live.until_all_is_mapped()
    assert [note.text for note in end.notes] == ["a door", "another"]
    assert end.transport.dropped == 0
    assert apart(end, from_file) < 0.001
    assert any("returns to where it was" in notice.text for notice in end.notices)


def test_scans_that_an_engine_is_too_slow_for_are_dropped_counted_and_reported(live: Live) -> None:
    """At four times real time, and held for a while."""
    thread = live.play(4.0, patiently=False, length_s=14.0)
    live.until(lambda s: s.transport.frame >= 5)
    assert live.engine.pid is not None
    os.kill(live.engine.pid, signal.SIGSTOP)
    deadline = time.monotonic() + PATIENCE_S
    while live.onlooker.state().counters.dropped < 5 and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(live.engine.pid, signal.SIGCONT)
    thread.join(PATIENCE_S)
    assert not live.errors

    end = live.until_all_is_mapped()
    assert end.transport.dropped == live.onlooker.state().counters.dropped >= 5
    assert live.onlooker.state().counters.imu_lost == 0
    assert end.series["dropped"].sum() == end.transport.dropped, "the timeline draws them"
    assert any("too many scans waited" in notice.text for notice in end.notices)


def test_there_is_no_going_back_live_and_it_is_said(live: Live) -> None:
    thread = live.play(4.0)
    live.until(lambda s: s.transport.frame >= 10)
    for command in (Seek(2), StepFrame(-1)):
        told = sum("cannot go back" in notice.text for notice in live.engine.snapshot.notices)
        live.engine.send(command)
        live.until(lambda s, told=told: sum("cannot go back" in notice.text for notice in s.notices) > told)  # type: ignore[misc]
    live.engine.send(Pause())
    paused = live.until(lambda s: not s.transport.playing)
    assert paused.transport.frame >= 10, "it stayed where it was, or went on"
    thread.join(PATIENCE_S)


def test_a_recording_that_is_opened_after_a_live_session_is_not_live(live: Live) -> None:
    live.until(lambda now: now.live is not None)
    live.engine.send(OpenRecording(SAMPLE, None))
    opened = live.until(lambda now: now.recording is not None and now.recording.path == SAMPLE)
    assert opened.live is None, "the page would offer no timeline, no truth and no search for parameters"
    live.engine.send(OpenRecording(LIVE))
    live.until(lambda now: now.live is not None and now.transport.playing and now.progress is None)
    live.play(4.0)
    mapped = live.until(lambda now: now.transport.frame >= 10)
    assert mapped.session > opened.session and mapped.recording is not None and mapped.recording.path == LIVE


def test_paused_the_source_is_still_watched_and_its_end_is_said_and_survived(live: Live) -> None:
    thread = live.play(4.0)
    live.until(lambda s: s.transport.frame >= 10)
    live.engine.send(Pause())
    thread.join(PATIENCE_S)
    paused = live.until(lambda s: not s.transport.playing and s.live is not None)
    assert paused.live is not None
    live.until(lambda s: s.live is not None and s.live.imu_age_s is not None and s.live.imu_age_s > 1.0)
    pid = live.engine.pid
    live.source.close()
    ended = live.until(lambda s: s.transport.finished)
    assert "The live source has ended" in ended.notices[-1].text
    assert live.engine.pid == pid and ended.engine_alive
    assert ended.transport.frame == paused.transport.frame, "what was mapped stays"
    live.engine.send(Play())
    again = live.until(lambda s: s.last_notice > ended.last_notice)
    assert again.notices[-1].text == ended.notices[-1].text, "it is no recording"


def test_a_way_back_to_a_source_that_has_ended_plays_no_recording_instead(live: Live) -> None:
    live.until(lambda now: now.live is not None)
    live.engine.send(OpenRecording(SAMPLE, None))
    opened = live.until(lambda now: now.recording is not None and now.recording.path == SAMPLE)
    live.source.close()
    live.engine.send(OpenRecording(LIVE))
    refused = live.until(lambda now: now.last_notice > opened.last_notice and now.progress is None)
    assert refused.notices[-1].level == "error" and not refused.transport.playing
