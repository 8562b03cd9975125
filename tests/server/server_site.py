"""The server's public port on a real socket, for tests of its traffic."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import msgspec
import viser
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from app.server.access import Access
from app.server.address import listen
from app.server.folders import Folders
from app.server.viser_adapter import Viser
from app.server.web import Tls, make_app, make_server
from app.server.worker import EngineProcess

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")
TIMEOUT_S = 60.0

VIEWER = {"Authorization": "Bearer for-viewers"}
OWNER = {"Authorization": "Bearer for-owners"}
"""For `public_site`."""


@dataclass
class Site:
    port: int
    engine: EngineProcess
    viser: Viser
    folder: Path
    access: Access

    def url(self, path: str = "/") -> str:
        return f"http://127.0.0.1:{self.port}{path}"

    def socket(self, **kwargs: object) -> ClientConnection:
        url = f"ws://127.0.0.1:{self.port}/"
        return connect(url, subprotocols=[PROTOCOL], max_size=None, proxy=None, **kwargs)  # type: ignore[arg-type]


@contextmanager
def serving(
    engine: EngineProcess,
    target: Viser,
    folder: Path,
    token: str | None,
    viewer_token: str | None = None,
    tls: Tls | None = None,
    parts: str = "",
) -> Iterator[Site]:
    listener = listen("127.0.0.1", 0)
    access = Access(listener.getsockname()[1], token, viewer_token, secure=tls is not None)
    server = make_server(make_app(engine, Folders([folder]), target, access, parts), tls)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        yield Site(access.port, engine, target, folder, access)
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


def engine_recording(engine: EngineProcess) -> Path:
    deadline = time.monotonic() + TIMEOUT_S
    while (recording := engine.snapshot.recording) is None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return recording.path


def eventually(site: Site, **wanted: object) -> dict[str, object]:
    """The transport, once it is as wanted."""
    deadline = time.monotonic() + TIMEOUT_S
    while True:
        transport: dict[str, object] = httpx.get(site.url("/api/state")).json()["transport"]
        if wanted.items() <= transport.items():
            return transport
        assert time.monotonic() < deadline, transport
        time.sleep(0.02)


def until(true: Any) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not true():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def packed(**message: Any) -> bytes:
    return msgspec.msgpack.encode(message)


CAMERA: dict[str, Any] = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, 0.0),
    "fov": 1.0,
    "near": 0.1,
    "far": 100.0,
    "image_height": 100,
    "image_width": 100,
    "look_at": (1.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}
