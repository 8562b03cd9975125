"""The session with one page open: replay against real time, and from a moved slider to relabelled points.

The page is a client that speaks viser's protocol through the public port and decodes all that it is
sent. It stands for the browser up to the drawing itself, which depends on the graphics card.
"""

import math
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import uvicorn
import viser
import viser._messages as messages
import zstandard
from websockets.sync.client import ClientConnection, connect

from app.sensors.presets import resolve_params
from app.server.access import Access
from app.server.folders import Folders
from app.server.protocol import Play, Restart, SetSpeed
from app.server.viser_page import start_viser
from app.server.web import listen, make_app
from app.server.worker import EngineProcess, Setup
from app.slam.types import SEED
from app.ui.colours import LABEL_COLOURS
from app.ui.workbench import Workbench
from benchmarks.record import Line

SAMPLE = Path(__file__).parents[1] / "sample_data"
SCAN = "/map/sensor/lidar/scan"
MOVES = 60
ALPHAS = (10.0, 45.0)
SEED_COLOUR = np.array(LABEL_COLOURS[SEED], dtype=np.uint8)


def run() -> list[Line]:
    (path,) = SAMPLE.glob("*.mcap")
    engine = EngineProcess(Setup(recording=path, params=resolve_params(path, None, None, [])))
    try:
        with _serve(engine) as port, Page(port) as page:
            snapshot = engine.snapshot
            while snapshot.recording is None or snapshot.progress is not None:
                snapshot = engine.wait(snapshot.revision)
            latency = Line.of("slider to relabelled points, playing", path.stem, "ms", _relabel(engine, page))
            return [latency, Line.of("replay with one page", path.stem, "x real time", [_replay(engine)])]
    finally:
        engine.close()


def _relabel(engine: EngineProcess, page: "Page") -> list[float]:
    """Milliseconds from a browser's message that α moved to points coloured by labels found with it.

    α goes to and fro between two values so far apart that the number of seeds tells which it was.
    """
    engine.send(SetSpeed(1.0))
    engine.send(Play())
    engine.wait(engine.snapshot.revision)
    time.sleep(2.0)
    seeds = []
    for alpha in ALPHAS:
        page.move("α (°)", alpha)
        time.sleep(1.0)
        seeds.append(page.seeds)
    between = math.sqrt((seeds[0] + 1) * (seeds[1] + 1))
    samples = []
    for move in range(MOVES):
        if engine.snapshot.transport.finished:
            engine.send(Restart())
            engine.send(Play())
            time.sleep(1.0)
        many = move % 2 == 1
        begin = time.perf_counter()
        page.move("α (°)", ALPHAS[many])
        samples.append(1000 * (page.wait_for_seeds(between, many) - begin))
        time.sleep(0.13)
    return samples


def _replay(engine: EngineProcess) -> float:
    engine.send(Restart())
    engine.send(SetSpeed(math.inf))
    snapshot = engine.snapshot
    while snapshot.transport.frame > 0:
        snapshot = engine.wait(snapshot.revision)
    begin = time.perf_counter()
    engine.send(Play())
    while not snapshot.transport.finished:
        snapshot = engine.wait(snapshot.revision)
    seconds = time.perf_counter() - begin
    assert snapshot.recording is not None
    return snapshot.recording.duration_s / seconds


@contextmanager
def _serve(engine: EngineProcess) -> Iterator[int]:
    """The workbench on a free port, as `hemislam serve` makes it."""
    listener: socket.socket = listen("127.0.0.1", 0)
    port = int(listener.getsockname()[1])
    target = start_viser()
    folders = Folders([SAMPLE])
    workbench = Workbench(target.server, engine, folders)
    workbench.start()
    app = make_app(engine, folders, target, Access.on("127.0.0.1", port))
    server = uvicorn.Server(
        uvicorn.Config(app, log_level="warning", lifespan="off", ws="websockets-sansio", ws_per_message_deflate=False)
    )
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    try:
        yield port
    finally:
        server.should_exit = True
        thread.join(timeout=5.0)
        workbench.close()
        target.stop()


class Page:
    """A browser without a screen."""

    def __init__(self, port: int) -> None:
        address = f"127.0.0.1:{port}"
        self._socket: ClientConnection = connect(
            f"ws://{address}/",
            origin=f"http://{address}",  # type: ignore[arg-type]
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            compression=None,
            max_size=None,
            proxy=None,
        )
        self._sliders: dict[str, str] = {}
        self._coloured = threading.Condition()
        self.seeds = -1
        """Points of the scan that have the seeds' colour, as last sent."""
        self._send(
            messages.ViewerCameraMessage(
                wxyz=(1.0, 0.0, 0.0, 0.0),
                position=(0.0, 0.0, 5.0),
                fov=1.0,
                near=0.01,
                far=1000.0,
                image_height=800,
                image_width=1200,
                look_at=(0.0, 0.0, 0.0),
                up_direction=(0.0, 0.0, 1.0),
            )
        )
        threading.Thread(target=self._receive, daemon=True).start()

    def __enter__(self) -> "Page":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def move(self, label: str, value: float) -> None:
        """Move a slider, named by its label."""
        self._send(messages.GuiUpdateMessage(self._sliders[label], {"value": value}))

    def wait_for_seeds(self, count: float, more: bool) -> float:
        """When there are more (or fewer) seeds than `count`; seconds of `perf_counter`."""
        with self._coloured:
            if not self._coloured.wait_for(lambda: (self.seeds > count) == more, timeout=10.0):
                raise TimeoutError("The scan was not coloured anew within 10 s.")
            return time.perf_counter()

    def _send(self, message: Any) -> None:
        self._socket.send(msgspec.msgpack.encode({"type": type(message).__name__, **vars(message)}))

    def _receive(self) -> None:
        decompressor = zstandard.ZstdDecompressor()
        for raw in self._socket:
            assert isinstance(raw, bytes)
            size, packed = (int.from_bytes(raw[i : i + 8], "little") for i in (0, 8))
            content = msgspec.msgpack.decode(decompressor.decompress(raw[16 : 16 + packed], max_output_size=size))
            for message in content["messages"]:
                if message["type"] == "GuiSliderMessage":
                    self._sliders[message["props"]["label"]] = message["uuid"]
                elif message["type"] == "SceneNodeUpdateMessage" and message["name"] == SCAN:
                    lengths, colours = content["binaryBufferLengths"], message["updates"].get("colors")
                    if colours is not None:
                        self._count(_buffer(raw, 16 + packed, lengths, colours["__binary_index"]))

    def _count(self, colours: bytes) -> None:
        rgb = np.frombuffer(colours, dtype=np.uint8).reshape(-1, 3)
        with self._coloured:
            self.seeds = int((rgb == SEED_COLOUR).all(axis=1).sum())
            self._coloured.notify_all()


def _buffer(raw: bytes, offset: int, lengths: list[int], index: int) -> bytes:
    """One of the arrays behind a message's text; each begins at a multiple of 8 bytes."""
    for length in lengths[:index]:
        offset += -offset % 8 + length
    offset += -offset % 8
    return raw[offset : offset + lengths[index]]


if __name__ == "__main__":
    for line in run():
        print(f"{line.what}: {line.median:.1f} {line.unit} (p95 {line.p95:.1f}, max {line.max:.1f})")
