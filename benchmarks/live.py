"""Live for minutes on end: a walk fed as packets, with three pages open, one of them stalled.

Prints memory and drops each half minute, and at the end how much each process has grown since a third of the time.
The pages are WebSocket clients that take everything that a browser would be sent; the stalled one reads nothing at
all. `HEMISLAM_LIVE_MINUTES` (4) and `HEMISLAM_LIVE_SPEED` (1): up to eight minutes round a building, from then on
over new ground outdoors, or with `HEMISLAM_LIVE_LAPS=1` round the building all the time.
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
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from app.sensors.live.feed import Pace, feed
from app.sensors.live.urls import parse_address
from app.sensors.presets import resolve_params
from benchmarks.record import Line
from benchmarks.scenes import half_hour, half_hour_in_laps, walk_in_laps

MINUTES = float(os.environ.get("HEMISLAM_LIVE_MINUTES", "4"))
SPEED = float(os.environ.get("HEMISLAM_LIVE_SPEED", "1"))
"""Times real time: at 2, twenty scans a second."""
LAPS = os.environ.get("HEMISLAM_LIVE_LAPS", "0") != "0"
REPORT_S = 30.0
NAMED = "hemislam-"
"""What the names of processes begin with that the server starts."""
SETTLE_S = 3.0
"""After the last packet: what waits is mapped by then, and has been told."""


def run() -> list[Line]:
    walk = walk_in_laps() if MINUTES * SPEED <= 8 else half_hour_in_laps() if LAPS else half_hour()
    with TemporaryDirectory() as folder, served(walk, Path(folder) / "live.mcap") as (url, server, packets, imu):
        ended = threading.Event()
        wait_until(url, lambda state: state["recording"] is not None)
        feeder = threading.Thread(target=_feed, args=(walk, packets, imu, ended), daemon=True)
        feeder.start()
        wait_until(url, lambda state: state["transport"]["frame"] >= 20 and state["live"])
        received = [0, 0]
        for number in range(2):
            threading.Thread(target=_page, args=(url, ended, received, number), daemon=True).start()
        stalled = _stalled_page(url)
        time.sleep(5.0)  # the loops' process has begun too
        memory: list[dict[str, float]] = []
        begin = time.monotonic()
        while (passed := time.monotonic() - begin) < 60 * MINUTES:
            memory.append(_memory(server))
            _tell(passed, _state(url), memory[-1])
            time.sleep(min(REPORT_S, 60 * MINUTES - passed))
        memory.append(_memory(server))
        _tell(time.monotonic() - begin, _state(url), memory[-1])
        ended.set()
        stalled.close()
        feeder.join(30.0)
        time.sleep(SETTLE_S)
        state = _state(url)
        live = state["live"]
        done = state["transport"]["frame"] + 1
        missing = live["counters"]["frames"] - done - state["transport"]["dropped"]
        on = f"{walk.stem}, {MINUTES:g} min at {SPEED:g}x, 3 pages"
        print(f"pages took {received[0] / 1e6:.0f} and {received[1] / 1e6:.0f} MB; {live['counters']}")
        lines = [
            Line.of("frames", on, "", [done]),
            Line.of("keyframes", on, "", [state["keyframes"]]),
            Line.of("scans dropped", on, "", [live["counters"]["dropped"]]),
            Line.of("scans neither mapped nor dropped; the last waits for samples", on, "", [missing]),
            Line.of("packets lost", on, "", [live["counters"]["lost"]]),
        ]
        for name in memory[0]:
            third, end = (_usual(memory, name, share) for share in (1 / 3, 1.0))
            print(f"{name}: {third:.0f} MB after a third, {end:.0f} MB at the end, {100 * (end / third - 1):+.0f} %")
            lines.append(Line.of(f"{name}, after a third", on, "MB", [third]))
            lines.append(Line.of(f"{name}, end", on, "MB", [end]))
        return lines


def _usual(memory: list[dict[str, float]], name: str, share: float) -> float:
    """What a process took about that share of the time: the median of a tenth of all samples."""
    half = len(memory) // 20
    at = min(round(share * (len(memory) - 1)), len(memory) - 1 - half)
    return median(one[name] for one in memory[max(at - half, 0) : at + half + 1] if name in one)


def _feed(walk: Path, packets: str, imu: str, ended: threading.Event) -> None:
    """Until the time is over or the walk."""
    feed(
        walk,
        resolve_params(walk, None, None, []),
        parse_address(packets),
        parse_address(imu),
        pace=Pace(SPEED, stop=ended),
    )


def _page(url: str, ended: threading.Event, received: list[int], number: int) -> None:
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    with connect(url.replace("http", "ws", 1), subprotocols=[protocol], max_size=None, proxy=None) as page:
        while not ended.is_set():
            try:
                received[number] += len(page.recv(timeout=1.0))
            except TimeoutError:
                continue
            except ConnectionClosed:
                return


def _stalled_page(url: str) -> socket.socket:
    """Asks for the page's WebSocket and then reads nothing."""
    host, port = url.removeprefix("http://").rstrip("/").split(":")
    page = socket.socket()
    page.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 18)
    page.connect((host, int(port)))
    page.sendall(
        f"GET / HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: {'A' * 22}==\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Protocol: viser-v{viser.__version__}\r\n\r\n".encode()
    )
    return page


def _memory(server: "subprocess.Popen[str]") -> dict[str, float]:
    """MB that each process has written: the server, and those that it started. Linux only.

    What several of them share is shared out among them. Pages of libraries do not count: whether they are shared
    depends on what else the machine happens to run.
    """
    found = {"server": _written_mb(server.pid)}
    for pid in children(server.pid):
        name = Path(f"/proc/{pid}/comm").read_text().strip()
        if name.startswith(NAMED):
            found[name.removeprefix(NAMED)] = _written_mb(pid)
    return found


def children(pid: int) -> list[int]:
    """Processes that it started, and that these started."""
    direct = [
        int(one) for task in Path(f"/proc/{pid}/task").iterdir() for one in (task / "children").read_text().split()
    ]
    return [one for child in sorted(direct) for one in (child, *children(child))]


def _written_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("Pss_Dirty")) / 1e3


def _tell(seconds: float, state: Any, memory: dict[str, float]) -> None:
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
    """Until the state is as wanted: the engine may have to be compiled first, and pages come when there is a map."""
    deadline = time.monotonic() + 300
    while not wanted(state := _state(url)):
        if time.monotonic() > deadline:
            raise RuntimeError(f"no frames come: {state['notices']}")
        time.sleep(0.2)


@contextmanager
def served(walk: Path, record: Path) -> Iterator[tuple[str, "subprocess.Popen[str]", str, str]]:
    """The workbench on live packets; gives its address, its process, and where packets and IMU samples go."""
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
    """For UDP."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port
