"""The receiver, the engine, or both die during live mapping: mapping continues in the same map, with a notice."""

import os
import signal
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from test_live_run import PATIENCE_S, SAMPLE, free_ports, receiving

from app.sensors.live.feed import Pace, feed
from app.sensors.live.process import LiveProcess
from app.sensors.live.urls import parse_address
from app.sensors.presets import resolve_params
from app.server.protocol import Snapshot
from app.server.worker import EngineProcess
from app.slam.params import Params


@pytest.fixture(scope="module")
def params() -> Params:
    return resolve_params(SAMPLE, None, None, []).with_values({"loops.enabled": False})


def restarts(snapshot: Snapshot) -> int:
    return snapshot.live.counters.restarts if snapshot.live is not None else 0


def test_whoever_dies_the_walk_goes_on_in_the_same_map(params: Params, tmp_path: Path) -> None:
    (port,) = free_ports(1)
    with receiving(params, tmp_path, f"foxglove://127.0.0.1:{port}") as live:
        processes: dict[str, LiveProcess | EngineProcess] = {"receiver": live.source, "engine": live.engine}
        stop = threading.Event()
        sender = partial(feed, SAMPLE, params, parse_address(live.url), pace=Pace(1.0, stop))
        thread = threading.Thread(target=sender, daemon=True)
        thread.start()
        before = live.until(lambda s: s.transport.frame >= 15)
        for dying, count in ({"receiver"}, 1), ({"receiver", "engine"}, 2):
            pids = {name: processes[name].pid for name in dying}
            for pid in pids.values():
                assert pid is not None
                os.kill(pid, signal.SIGKILL)
            deadline = time.monotonic() + PATIENCE_S
            while any(processes[name].pid == pid for name, pid in pids.items()):
                assert time.monotonic() < deadline
                time.sleep(0.01)
            back = live.until(lambda s, count=count: restarts(s) == count and s.progress is None)  # type: ignore[misc]
            live.until(lambda s, frame=back.transport.frame: s.transport.frame > frame + 3)  # type: ignore[misc]
        stop.set()
        thread.join(PATIENCE_S)
        end = live.until(lambda s: s.live is not None and (s.live.lidar_age_s or 0.0) > 1.0)
    assert end.session == before.session, "the page keeps its map"
    assert end.engine_alive and not end.transport.finished
    assert [chunk.index for chunk in end.chunks] == list(range(len(end.chunks)))
    assert len(end.trajectory) == end.transport.frame + 1
    assert (np.diff(end.series["stamp_s"]) > 0.05).all(), "no scan twice, and none before another"
    told = [notice.text for notice in end.notices]
    assert sum("was started again; nothing was received for" in text for text in told) == 2
    assert sum("returns to where it was" in text for text in told) == 1
