"""The workbench's engine on live data: the same map as from the file, and one that survives the engine."""

import math
import os
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

from app.sensors.live.feed import Pace, feed
from app.sensors.live.process import LiveProcess
from app.sensors.live.urls import parse_address
from app.sensors.presets import resolve_params
from app.server.protocol import LIVE, Pause, Seek, Snapshot, StepFrame
from app.server.run import open_run
from app.server.setup import Setup
from app.server.worker import EngineProcess
from app.slam.params import Params
from app.slam.types import Measurement

LENGTH_S = 9.0
PATIENCE_S = 90.0


@pytest.fixture(scope="module")
def params() -> Params:
    return resolve_params(SAMPLE, None, None, [])


@pytest.fixture(scope="module")
def from_file(params: Params) -> dict[int, np.ndarray]:
    """Positions by scan end, as the file gives them."""
    run = open_run(SAMPLE, None, params, 0.0, LENGTH_S)
    found = {}
    while (entry := run.peek()) is not None:
        if isinstance(entry, Measurement):
            result = run.step()
            found[result.stamp_ns] = result.T_map_imu[:3, 3]
    run.close()
    return found


@dataclass
class Live:
    """An engine's process on packets that are sent to it."""

    engine: EngineProcess
    packets: str
    imu: str
    params: Params
    source: LiveProcess
    errors: list[BaseException] = field(default_factory=list)

    def play(self, speed: float) -> threading.Thread:
        def send() -> None:
            try:
                to, imu_to = parse_address(self.packets), parse_address(self.imu)
                feed(SAMPLE, self.params, to, imu_to, pace=Pace(speed), duration_s=LENGTH_S)
            except BaseException as error:
                self.errors.append(error)

        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        return thread

    def until(self, wanted: Callable[[Snapshot], bool]) -> Snapshot:
        deadline = time.monotonic() + PATIENCE_S
        snapshot = self.engine.snapshot
        while not wanted(snapshot):
            assert time.monotonic() < deadline, (snapshot.transport, snapshot.notices, self.errors)
            snapshot = self.engine.wait(snapshot.revision, timeout=0.2)
        return snapshot


def free_ports(count: int) -> list[int]:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


@pytest.fixture
def live(params: Params, tmp_path: Path) -> Iterator[Live]:
    msop, difop, imu_port = free_ports(3)
    packets, imu = f"rsbpearl://127.0.0.1:{msop},{difop}", f"imu-udp://127.0.0.1:{imu_port}"
    with LiveProcess(packets, params, imu) as source:
        setup = Setup(LIVE, params=params, play=True, speed=math.inf, live=source.address, live_folder=tmp_path)
        engine = EngineProcess(setup)
        live = Live(engine, packets, imu, params, source)
        live.until(lambda s: s.recording is not None)
        yield live
        engine.close()


def apart(snapshot: Snapshot, from_file: dict[int, np.ndarray]) -> float:
    """m, the farthest that a frame is from where the file has it."""
    assert snapshot.trajectory is not None and snapshot.recording is not None
    stamps = np.array(sorted(from_file))
    found = np.round(snapshot.series["stamp_s"] * 1e9).astype(np.int64) + snapshot.recording.start_ns
    known = np.flatnonzero(np.isfinite(snapshot.series["stamp_s"]))
    nearest = stamps[np.abs(stamps[None, :] - found[known, None]).argmin(axis=1)]
    there = np.array([from_file[int(stamp)] for stamp in nearest])
    return float(np.linalg.norm(snapshot.trajectory[known] - there, axis=1).max())


def test_packets_give_the_same_walk_as_the_file(live: Live, from_file: dict[int, np.ndarray]) -> None:
    live.play(2.0).join(PATIENCE_S)
    snapshot = live.until(lambda s: s.transport.frame >= len(from_file) - 4)
    assert not live.errors
    assert snapshot.transport.dropped == 0
    assert apart(snapshot, from_file) < 0.005  # the packets' steps
    assert snapshot.live is not None


def test_an_engine_that_is_killed_is_followed_by_one_that_goes_on_in_the_same_map(
    live: Live, from_file: dict[int, np.ndarray]
) -> None:
    thread = live.play(1.0)
    before = live.until(lambda s: s.transport.frame >= 35)
    assert live.engine.pid is not None
    os.kill(live.engine.pid, signal.SIGKILL)
    after = live.until(lambda s: s.transport.frame > before.transport.frame + 15 and s.engine_alive)
    assert after.session == before.session, "the page keeps its map"
    assert len(after.chunks) >= len(before.chunks)
    assert [chunk.index for chunk in after.chunks] == list(range(len(after.chunks)))
    thread.join(PATIENCE_S)
    end = live.until(lambda s: s.transport.frame + s.transport.dropped >= len(from_file) - 4)
    assert end.transport.dropped < 10, "a machine that is busy may drop some, and says so"
    assert apart(end, from_file) < (0.005 if end.transport.dropped == 0 else 0.03)
    assert any("goes where it was" in notice.text for notice in end.notices)


def test_there_is_no_going_back_live_and_it_is_said(live: Live) -> None:
    thread = live.play(4.0)
    live.until(lambda s: s.transport.frame >= 10)
    for command in (Seek(2), StepFrame(-1)):
        told = len(live.engine.snapshot.notices)
        live.engine.send(command)
        snapshot = live.until(lambda s, told=told: len(s.notices) > told)  # type: ignore[misc]
        assert "only go on" in snapshot.notices[-1].text
    live.engine.send(Pause())
    live.until(lambda s: not s.transport.playing)
    thread.join(PATIENCE_S)


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
    assert "Nothing more comes live" in ended.notices[-1].text
    assert live.engine.pid == pid and ended.engine_alive
    assert ended.transport.frame == paused.transport.frame, "what was mapped stays"
