"""Live mapping for several minutes: a walk sent as packets, with three open pages, one of them stalled.

Prints memory and dropped scans every half minute. The limits for an hour are `BUDGET_MB` in all processes together, and
no dropped scans. The pages are WebSocket clients that receive the same messages as a browser; the stalled one never
reads. Environment variables: `HEMISLAM_LIVE_MINUTES` (4) and `HEMISLAM_LIVE_SPEED` (1). A walk of up to eight minutes
goes round a building; a longer one covers new ground outdoors, or stays in the building with `HEMISLAM_LIVE_LAPS=1`.
"""

import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx

from app.sensors.live.feed import Pace, feed
from app.sensors.live.urls import parse_address
from app.sensors.presets import resolve_params
from benchmarks.client import PROTOCOL, listening
from benchmarks.record import Line
from benchmarks.scenes import half_hour_in_laps, outdoors, walk_in_laps

MINUTES = float(os.environ.get("HEMISLAM_LIVE_MINUTES", "4"))
SPEED = float(os.environ.get("HEMISLAM_LIVE_SPEED", "1"))
"""Multiple of real time; 2 is twenty scans per second."""
LAPS = os.environ.get("HEMISLAM_LIVE_LAPS", "0") != "0"
BUDGET_MB = 1500
REPORT_S = 30.0
NAMED = "hemislam-"
"""Prefix of the names of the processes that the server starts."""
SETTLE_S = 3.0
"""Time after the last packet within which all scans are mapped and shown."""


def run() -> list[Line]:
    minutes = MINUTES * SPEED
    walk = walk_in_laps() if minutes <= 8 else half_hour_in_laps() if LAPS else outdoors(30 if minutes <= 30 else 60)
    with TemporaryDirectory() as folder, served(walk, Path(folder) / "live.mcap") as (url, server, packets, imu):
        ended = threading.Event()
        wait_until(url, lambda state: state["recording"] is not None)
        feeder = threading.Thread(target=_feed, args=(walk, packets, imu, ended), daemon=True)
        feeder.start()
        wait_until(url, lambda state: state["transport"]["frame"] >= 20 and state["live"])
        memory: list[dict[str, float]] = []
        with listening(url, keep=False) as first, listening(url, keep=False) as second, _stalled_page(url):
            time.sleep(5.0)  # the process of the loop search has also begun
            begin = time.monotonic()
            while (passed := time.monotonic() - begin) < 60 * MINUTES:
                memory.append(_memory(server))
                _report(passed, _state(url), memory[-1])
                time.sleep(min(REPORT_S, 60 * MINUTES - passed))
            memory.append(_memory(server))
            _report(time.monotonic() - begin, _state(url), memory[-1])
        ended.set()
        feeder.join(30.0)
        time.sleep(SETTLE_S)
        state = _state(url)
        live = state["live"]
        done = state["transport"]["frame"] + 1
        missing = live["counters"]["frames"] - done - state["transport"]["dropped"]
        on = f"{walk.stem}, {MINUTES:g} min at {SPEED:g}x, 3 pages"
        print(f"pages were sent {first.received / 1e6:.0f} and {second.received / 1e6:.0f} MB; {live['counters']}")
        lines = [
            Line.of("frames", on, "", [done]),
            Line.of("keyframes", on, "", [state["keyframes"]]),
            Line.of("scans dropped", on, "", [live["counters"]["dropped"]]),
            Line.of("scans neither mapped nor dropped (the last one waits for IMU samples)", on, "", [missing]),
            Line.of("packets lost", on, "", [live["counters"]["lost"]]),
        ]
        most = max(sum(one.values()) for one in memory)
        print(f"at most {most:.0f} MB in all processes; the budget of an hour is {BUDGET_MB} MB")
        lines.append(Line.of("memory of all processes, at most", on, "MB", [most]))
        return [*lines, *(Line.of(f"{name}, end", on, "MB", [size]) for name, size in memory[-1].items())]


def _feed(walk: Path, packets: str, imu: str, ended: threading.Event) -> None:
    """Send packets until the time is over or the walk has ended."""
    feed(
        walk,
        resolve_params(walk, None, None, []),
        parse_address(packets),
        parse_address(imu),
        pace=Pace(SPEED, stop=ended),
    )


def _stalled_page(url: str) -> socket.socket:
    """Opens the page's WebSocket and then reads nothing from it."""
    host, port = url.removeprefix("http://").rstrip("/").split(":")
    page = socket.socket()
    page.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 18)
    page.connect((host, int(port)))
    page.sendall(
        f"GET / HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: {'A' * 22}==\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Protocol: {PROTOCOL}\r\n\r\n".encode()
    )
    return page


def _memory(server: "subprocess.Popen[str]") -> dict[str, float]:
    """Memory (MB) written by the server and by each process that it started. Linux only.

    Shared memory is divided among the processes that share it. Memory pages of libraries do not count.
    """
    found = {"server": _written_mb(server.pid)}
    for pid in children(server.pid):
        name = Path(f"/proc/{pid}/comm").read_text().strip()
        if name.startswith(NAMED):
            found[name.removeprefix(NAMED)] = _written_mb(pid)
    return found


def children(pid: int) -> list[int]:
    """All descendants of a process."""
    direct = [
        int(one) for task in Path(f"/proc/{pid}/task").iterdir() for one in (task / "children").read_text().split()
    ]
    return [one for child in sorted(direct) for one in (child, *children(child))]


def _written_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("Pss_Dirty")) / 1e3


def _report(seconds: float, state: Any, memory: dict[str, float]) -> None:
    live = state["live"]
    sizes = ", ".join(f"{name} {size:.0f}" for name, size in memory.items())
    print(
        f"{seconds:6.0f} s: frame {state['transport']['frame']:,}, {live['lidar_hz']:.1f} Hz, keyframes"
        f" {state['keyframes']}, dropped {live['counters']['dropped']}, waiting {live['backlog']}; MB: {sizes}",
        flush=True,
    )


def _state(url: str) -> Any:
    """As JSON."""
    return httpx.get(f"{url}api/state", timeout=30.0).raise_for_status().json()


def wait_until(url: str, wanted: Callable[[Any], object]) -> None:
    """Wait until the state meets a condition. The engine may have to be compiled first."""
    deadline = time.monotonic() + 300
    while not wanted(state := _state(url)):
        if time.monotonic() > deadline:
            raise RuntimeError(f"there are no frames: {state['notices']}")
        time.sleep(0.2)


@contextmanager
def served(walk: Path, record: Path) -> Iterator[tuple[str, "subprocess.Popen[str]", str, str]]:
    """Start the workbench on live packets: its address, its process, and the addresses for packets and IMU samples."""
    ports = [free_port() for _ in range(3)]
    packets, imu = f"rsbpearl://127.0.0.1:{ports[0]},{ports[1]}", f"imu-udp://127.0.0.1:{ports[2]}"
    params = walk.with_suffix(".params.yaml")
    command = [sys.executable, "-m", "app", "serve", "--live", packets, "--imu", imu, "--record", str(record)]
    command += ["--no-browser", "--port", "0", *(["--config", str(params)] if params.exists() else [])]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        found = re.search(r"http://\S+", server.stdout.readline())
        if found is None:
            raise RuntimeError("the server did not start")
        yield found.group(), server, packets, imu
    finally:
        server.terminate()
        server.wait(30.0)


def free_port() -> int:
    """A free UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
