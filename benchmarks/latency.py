"""Time from a scan's last packet to its pose and to the page, and time until a killed engine maps again.

A separate process sends a walk at the sensor's full resolution as packets in real time. A pose counts as arrived when
the server's process has it, and as shown when a WebSocket client has been sent the sensor's position.
"""

import math
import multiprocessing
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from mcap.reader import make_reader

from app.sensors.live.feed import LIDAR, packets_of
from app.sensors.live.process import LiveProcess
from app.sensors.live.urls import parse_address
from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.server.protocol import LIVE, Snapshot
from app.server.setup import Setup
from app.server.worker import EngineProcess
from app.slam.types import F64
from benchmarks.client import listening
from benchmarks.live import free_port, served, wait_until
from benchmarks.record import Line
from benchmarks.scenes import recording

SCENE = "corridor"
RUNS, KILLS = 4, 3
"""Number of runs with kills, and of kills in each run. The next kill follows as soon as the engine maps again."""
SAME_M = 1e-4
"""Tolerance: both runs give the same poses, except for the 32-bit rounding in viser's messages."""


def run() -> list[Line]:
    walk = recording(SCENE)
    on = f"{SCENE}, 57,632 firings a scan, as packets at real time"
    poses, positions = _to_poses(walk)
    pages = _to_page(walk, positions)
    kills = [_after_kills(walk) for _ in range(RUNS)]
    return [
        Line.of("last packet to pose", on, "ms", 1e3 * np.array(poses)),
        Line.of("last packet to page", on, "ms", 1e3 * np.array(pages)),
        Line.of(
            "kill -9 of the engine to the next frame", on, "s", [second for one in kills for second in one.seconds]
        ),
        Line.of("scans and samples received but not recorded", on, "", [one.not_recorded for one in kills]),
        Line.of("scans neither mapped nor counted as dropped", on, "", [one.unaccounted for one in kills]),
        Line.of("scans dropped", on, "", [one.dropped for one in kills]),
    ]


def _to_poses(walk: Path) -> tuple[list[float], dict[int, F64]]:
    """Seconds until the server's process has the pose of each scan, and positions by the scans' end times."""
    came: dict[int, float] = {}
    with received(walk) as (engine, sending):
        while not sending.ended or time.monotonic() - sending.last < 1.0:
            snapshot = engine.wait(engine.snapshot.revision, timeout=0.1)
            if snapshot.result is not None:
                came.setdefault(snapshot.result.stamp_ns, time.monotonic())
        assert snapshot.recording is not None
        stamps = snapshot.recording.start_ns + np.round(snapshot.series["stamp_s"] * 1e9).astype(np.int64)
        positions = dict(zip(stamps.tolist(), snapshot.trajectory, strict=True))
    return sending.delays(came), positions


def _to_page(walk: Path, positions: dict[int, F64]) -> list[float]:
    """Seconds until an open page was sent the position of each scan. positions: of all scans, by their end times."""
    stamps, places = np.array(list(positions)), np.array(list(positions.values()))
    came: dict[int, float] = {}
    with TemporaryDirectory() as folder, served(walk, Path(folder) / "live.mcap") as (url, _, packets, imu):
        wait_until(url, lambda state: state["recording"] is not None)
        with listening(url) as page, sent(walk, packets, imu) as sending:
            while not sending.ended or time.monotonic() - sending.last < 1.0:
                time.sleep(0.1)
    for at, message in page.entries():
        if message["type"] == "SetPositionMessage" and message["name"] == "/map/sensor":
            apart = np.linalg.norm(places - np.array(message["position"]), axis=1)
            if apart.min() < SAME_M:
                came.setdefault(int(stamps[apart.argmin()]), at)
    return sending.delays(came)


@dataclass(frozen=True, slots=True)
class _Killed:
    """Seconds from each kill to the next frame, and how much of the received data was not recorded, lost or dropped."""

    seconds: list[float]
    not_recorded: int
    unaccounted: int
    dropped: int


def _after_kills(walk: Path) -> _Killed:
    with TemporaryDirectory() as folder:
        record = Path(folder) / "live.mcap"
        with received(walk, record) as (engine, sending):
            _until(engine, lambda s: s.transport.frame >= 40)
            seconds = []
            for _ in range(KILLS):
                frame, pid = engine.snapshot.transport.frame, engine.pid
                assert pid is not None
                os.kill(pid, signal.SIGKILL)
                begin = time.monotonic()
                _until(engine, lambda s, frame=frame: s.transport.frame > frame)
                seconds.append(time.monotonic() - begin)
            while not sending.ended or time.monotonic() - sending.last < 2.0:
                time.sleep(0.1)
            end = engine.wait(engine.snapshot.revision, timeout=2.0)
        assert end.live is not None
        came, done = end.live.counters, end.transport
        with record.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None and summary.statistics is not None
        recorded = sum(summary.statistics.channel_message_counts.values())
        return _Killed(
            seconds,
            not_recorded=came.frames + came.imu - recorded,
            unaccounted=came.frames - (done.frame + 1) - done.dropped,
            dropped=done.dropped,
        )


def _until(engine: EngineProcess, wanted: Any) -> Snapshot:
    deadline = time.monotonic() + 60.0
    snapshot = engine.snapshot
    while not wanted(snapshot):
        if time.monotonic() > deadline:
            raise RuntimeError(f"the engine does not continue: {snapshot.notices}")
        snapshot = engine.wait(snapshot.revision, timeout=0.1)
    return snapshot


# --- the sensor ----------------------------------------------------------------------------------
class Sending:
    """Sends a walk from a separate process, which reports when each LiDAR packet was sent."""

    def __init__(self, walk: Path, packets: str, imu: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._told, theirs = context.Pipe(duplex=False)
        self._go = context.Event()
        self._process = context.Process(target=_send, args=(walk, packets, imu, theirs, self._go), daemon=True)
        self._process.start()
        theirs.close()
        self._told.recv()  # all packets are ready
        self._sent: list[tuple[int, float]] = []
        self.last = time.monotonic()
        self.ended = False
        self._go.set()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        self._sent = self._told.recv()
        self.last = self._sent[-1][1]
        self.ended = True

    def delays(self, came: dict[int, float]) -> list[float]:
        """Seconds from the last packet of each scan to its arrival. came: monotonic s, by the scans' end times."""
        stamps = np.array([stamp for stamp, _ in self._sent])
        last = np.searchsorted(stamps, np.array(list(came)), side="right") - 1
        return [at - self._sent[index][1] for index, at in zip(last, came.values(), strict=True)]

    def close(self) -> None:
        self._process.kill()
        self._process.join()


def _send(walk: Path, packets: str, imu: str, told: Any, go: Event) -> None:
    """The process: makes all packets in advance, so that nothing delays them."""
    with open_recording(walk, resolve_params(walk, None, None, [])) as opened:
        made = list(packets_of(opened))
    ports = (*parse_address(packets).ports, *parse_address(imu).ports)
    sent: list[tuple[int, float]] = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        told.send(None)
        go.wait()
        begin = time.monotonic() - made[0].time_ns * 1e-9
        for one in made:
            if (ahead := begin + one.time_ns * 1e-9 - time.monotonic()) > 0.0002:
                time.sleep(ahead)
            sender.sendto(one.data, ("127.0.0.1", ports[one.stream]))
            if one.stream == LIDAR:
                sent.append((one.time_ns, time.monotonic()))
    told.send(sent)


@contextmanager
def sent(walk: Path, packets: str, imu: str) -> Iterator[Sending]:
    sending = Sending(walk, packets, imu)
    try:
        yield sending
    finally:
        sending.close()


@contextmanager
def received(walk: Path, record: Path | None = None) -> Iterator[tuple[EngineProcess, Sending]]:
    """An engine's process, without a page, that maps the packets."""
    ports = [free_port() for _ in range(3)]
    packets, imu = f"rsbpearl://127.0.0.1:{ports[0]},{ports[1]}", f"imu-udp://127.0.0.1:{ports[2]}"
    params = resolve_params(walk, None, None, [])
    with TemporaryDirectory() as folder, LiveProcess(packets, params, imu, record) as source:
        setup = Setup(LIVE, params=params, play=True, speed=math.inf, live=source.address, live_folder=Path(folder))
        engine = EngineProcess(setup)
        try:
            _until(engine, lambda s: s.recording is not None)
            with sent(walk, packets, imu) as sending:
                yield engine, sending
        finally:
            engine.close()
