"""The sample in the workbench with an open page: replay speed, and time until a changed parameter relabels the points.

The page is a WebSocket client that receives the same messages as a browser. Drawing in a browser is not measured.
"""

import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from app.ui.colours import LABEL_COLOURS
from benchmarks.client import Client, listening
from benchmarks.record import Line

SAMPLE = Path(__file__).resolve().parents[1] / "sample_data" / "cloister.mcap"
SCAN = "/map/sensor/lidar/scan"
SETTLED = 60
"""By this frame, every process has started."""
TRIALS = 15  # within the 84 seconds of the sample
SOME_GROUND = 0.05
"""The least share of ground points while ground segmentation is on."""


def run() -> list[Line]:
    with _served() as (server, url), listening(url) as page:
        return [_relabelling(server, page), _replay(server)]


def _relabelling(server: httpx.Client, page: Client) -> Line:
    """Delay, during playback at real time, from switching the ground off until the page was sent colours without it."""
    _transport(server, {"action": "play"})
    while _state(server)["transport"]["frame"] < SETTLED:
        time.sleep(0.1)
    delays = []
    for _ in range(TRIALS):
        _look_for_ground(server, True)
        time.sleep(1.0)
        first, begin = len(page.heard), time.monotonic()
        _look_for_ground(server, False)
        time.sleep(1.0)
        shares = list(_ground_shares(page, max(first - 100, 0)))
        before = [share for at, share in shares if at < begin]
        after = [at for at, share in shares if at > begin and share == 0.0]
        if not after or not before or before[-1] < SOME_GROUND:
            raise RuntimeError("the points did not change their colour")
        delays.append(1e3 * (after[0] - begin))
    return Line.of("parameter to relabelled points at the WebSocket", "cloister, playing", "ms", delays)


def _ground_shares(page: Client, first: int) -> Iterator[tuple[float, float]]:
    """Time and share of ground points of every sent scan."""
    for at, entry in page.entries(first):
        if entry.get("name") == SCAN and "colors" in entry.get("updates", {}):
            colours = entry["updates"]["colors"].reshape(-1, 3)
            yield at, float(np.mean((colours == LABEL_COLOURS[1]).all(axis=1)))


def _look_for_ground(server: httpx.Client, enabled: bool) -> None:
    server.patch("api/params", json={"ground": {"enabled": enabled}}).raise_for_status()


def _replay(server: httpx.Client) -> Line:
    """Replay from the start, as fast as possible."""
    _transport(server, {"action": "pause"})
    _transport(server, {"action": "restart"})
    while _state(server)["transport"]["frame"] > 0:
        time.sleep(0.05)
    _transport(server, {"action": "speed", "factor": "max"})
    _transport(server, {"action": "play"})
    while (state := _state(server))["transport"]["frame"] < 50:
        time.sleep(0.01)
    begin, first, last = time.perf_counter(), state["transport"]["frame"], state["recording"]["frames"] - 20
    while (now := _state(server)["transport"]["frame"]) < last:
        time.sleep(0.1)
    rate = (now - first) / (time.perf_counter() - begin)
    seconds_a_frame = state["recording"]["duration_s"] / state["recording"]["frames"]
    return Line.of("replay with a page open", "cloister", "x real time", [rate * seconds_a_frame])


def _state(server: httpx.Client) -> Any:
    """As JSON."""
    return server.get("api/state").raise_for_status().json()


def _transport(server: httpx.Client, action: Mapping[str, object]) -> None:
    server.post("api/transport", json=action).raise_for_status()


@contextmanager
def _served() -> Iterator[tuple[httpx.Client, str]]:
    """A connection to a paused workbench on the sample, in a process of its own, and its address."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "app", "serve", str(SAMPLE), "--paused", "--no-browser", "--port", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    url = f"http://127.0.0.1:{port}/"
    try:
        with httpx.Client(base_url=url, timeout=30.0) as server:
            for _ in range(600):
                try:
                    if _state(server)["recording"]:
                        break
                except httpx.HTTPError:
                    pass
                time.sleep(0.2)
            yield server, url
    finally:
        process.terminate()
        process.wait()
