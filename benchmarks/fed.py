"""A recording fed in real time, as packets and through Foxglove: how far its trajectory is from that of the file.

A separate process feeds the whole recording. The position of each frame in the final map is compared with the result of
the same engine on the file. Frames are matched by the scans' end times, and nothing is aligned. `HEMISLAM_PRESET` names
the device; files beside the recording apply as usual.
"""

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from app.sensors.live.process import LiveProcess
from app.sensors.presets import resolve_params
from app.server.protocol import LIVE, Snapshot
from app.server.setup import Setup
from app.server.worker import EngineProcess
from app.slam.params import Params
from app.slam.types import F64, I64
from benchmarks.live import free_port
from benchmarks.record import Line

SAMPLE = next((Path(__file__).resolve().parents[1] / "sample_data").glob("*.mcap"))
PRESET = os.environ.get("HEMISLAM_PRESET")
SAME_NS = 10_000
"""Scans whose end times differ by at most this are the same scan; packets hold whole microseconds."""
TIMEOUT_S, SILENT_S = 60.0, 3.0
"""The benchmark gives up after this time without news, and waits this long after the last message was sent."""


def run(recording: Path | None = None) -> list[Line]:
    recording = recording or SAMPLE
    params = resolve_params(recording, PRESET, None, [])
    with closing(EngineProcess(Setup(recording, params=params, play=True, speed=math.inf))) as engine:
        stamps, positions = _positions(_until(engine, lambda s: s.transport.finished))
    lines = []
    ports = [free_port() for _ in range(4)]
    for way, url, imu in (
        ("as packets", f"rsbpearl://127.0.0.1:{ports[0]},{ports[1]}", f"imu-udp://127.0.0.1:{ports[2]}"),
        ("through Foxglove", f"foxglove://127.0.0.1:{ports[3]}", None),
    ):
        end = _fed(recording, params, url, imu)
        if isinstance(end, str):
            print(f"{way}: {end}")
            continue
        ends, there = _positions(end)
        nearest = np.abs(stamps[None, :] - ends[:, None]).argmin(axis=1)
        same = np.abs(stamps[nearest] - ends) < SAME_NS
        apart = np.linalg.norm(there[same] - positions[nearest[same]], axis=1)
        assert end.live is not None
        on = f"{recording.stem} in real time, {way}, against the file"
        lines += [
            Line.of("distance of a frame", on, "mm", 1e3 * apart),
            Line.of("frames not compared", on, "", [len(stamps) - len(apart)]),
            Line.of("scans dropped", on, "", [end.transport.dropped]),
            Line.of("packets or samples lost", on, "", [end.live.counters.lost + end.live.counters.imu_lost]),
        ]
    return lines


def _fed(recording: Path, params: Params, url: str, imu: str | None) -> Snapshot | str:
    """The final snapshot of a live session fed with the recording, or why it cannot be fed this way."""
    with TemporaryDirectory() as folder, LiveProcess(url, params, imu) as source:
        setup = Setup(LIVE, params=params, play=True, speed=math.inf, live=source.address, live_folder=Path(folder))
        with closing(EngineProcess(setup)) as engine:
            _until(engine, lambda s: s.recording is not None)
            to = ["--to", url, *(["--imu-to", imu] if imu else [])]
            command = [sys.executable, "-m", "app", "feed", str(recording), *to]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                return done.stderr.strip()
            time.sleep(SILENT_S)
            return engine.wait(engine.snapshot.revision, timeout=1.0)


def _positions(snapshot: Snapshot) -> tuple[I64, F64]:
    """End times of the scans (n,), ns, and positions of the IMU in the map at these times (n, 3), m."""
    assert snapshot.recording is not None
    stamps = snapshot.recording.start_ns + np.round(snapshot.series["stamp_s"] * 1e9)
    known = np.isfinite(stamps)
    return stamps[known].astype(np.int64), np.array(snapshot.trajectory)[known]


def _until(engine: EngineProcess, wanted: Callable[[Snapshot], bool]) -> Snapshot:
    snapshot = engine.snapshot
    while not wanted(snapshot):
        before, snapshot = snapshot, engine.wait(snapshot.revision, timeout=TIMEOUT_S)
        if snapshot.revision == before.revision:
            raise SystemExit(f"Nothing came for {TIMEOUT_S:.0f} s: {[notice.text for notice in snapshot.notices]}")
    return snapshot
