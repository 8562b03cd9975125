"""A viser server that records its messages to browsers."""

import asyncio
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import viser
from viser._messages import GuiUpdateMessage

from app.sensors.live.status import Counters, LiveState
from app.server.protocol import Command, Snapshot, StepFrame
from app.server.viser_adapter import _list_icons_once
from app.ui.widgets import Page
from tests.ui.fake_engine import FakeEngine

if TYPE_CHECKING:
    from tests.ui.drawn import Drawn

WELL = LiveState(
    counters=Counters(packets=1000, frames=10),
    lidar_hz=10.0,
    imu_hz=199.96,
    lidar_age_s=0.03,
    imu_age_s=0.004,
    clock="sensor",
    imu_lag_s=0.0021,
    sensor="RS-Bpearl 68656d690001: 600 rpm, strongest return",
    recorded=12_345_678,
)
"""A live source from which everything arrives as it should."""


class Wire:
    """What was sent to the browsers since `clear`."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.server = server
        self.messages: list[Any] = []
        send = server._websock_server.queue_message

        def record(message: Any) -> None:
            self.messages.append(message)
            send(message)

        server._websock_server.queue_message = record  # type: ignore[method-assign]

    def clear(self) -> None:
        self.messages.clear()

    def updates(self, node: str) -> dict[str, Any]:
        """Properties of a scene node that were sent, other than its pose."""
        found: dict[str, Any] = {}
        for message in self.messages:
            if type(message).__name__ == "SceneNodeUpdateMessage" and message.name == node:
                found |= message.updates
        return found

    def nodes(self, kind: str) -> list[str]:
        """Names in messages of a type, in the order sent."""
        return [message.name for message in self.messages if type(message).__name__ == kind]

    @property
    def kept(self) -> int:
        """Messages that a browser which connects now is sent."""
        return len(self.server._websock_server._broadcast_buffer.message_from_id)


@dataclass(slots=True)
class Cloud:
    """A node of points, as a browser shows it."""

    points: np.ndarray
    colors: np.ndarray
    point_size: float
    visible: bool = True
    wxyz: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
    position: tuple[float, ...] = (0.0, 0.0, 0.0)


def clouds(server: viser.ViserServer) -> dict[str, Cloud]:
    """All clouds by their names, as a browser has them that connects now."""
    found: dict[str, Cloud] = {}
    for message in server._websock_server._broadcast_buffer.message_from_id.values():
        kind, name = type(message).__name__, getattr(message, "name", "")
        if kind == "PointCloudMessage":
            props = message.props  # type: ignore[attr-defined]
            found[name] = Cloud(props.points, props.colors, props.point_size)
        elif name in found:
            told = message.updates if kind == "SceneNodeUpdateMessage" else vars(message)  # type: ignore[attr-defined]
            for prop in set(Cloud.__slots__) & told.keys():
                setattr(found[name], prop, told[prop])
    return found


@pytest.fixture(scope="session", autouse=True)
def icons_read_once() -> Iterator[None]:
    """As for the workbench's own viser: else each icon costs a list of all, and each worker a second."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("viser._icons.zipfile", None)
        _list_icons_once()
        yield


@pytest.fixture(scope="session")
def _viser() -> Iterator[viser.ViserServer]:
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


@pytest.fixture
def server(_viser: viser.ViserServer) -> Iterator[viser.ViserServer]:
    _viser.scene.reset()
    _viser.gui.reset()
    yield _viser


@pytest.fixture
def wire(server: viser.ViserServer) -> Iterator[Wire]:
    recorder = Wire(server)
    yield recorder
    del server._websock_server.queue_message  # type: ignore[attr-defined]


@pytest.fixture
def engine() -> Iterator[FakeEngine]:
    engine = FakeEngine(columns=40)
    yield engine
    engine.close()


SOMEONE = object()
"""Stands for a browser."""


def page_of(
    server: viser.ViserServer,
    send: Callable[[Command], None] = lambda _: None,
    snapshot: Callable[[], Snapshot] = Snapshot,
    **more: Any,
) -> Page:
    """What a panel under test is on."""
    return Page(server, send, snapshot, **more)


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def finish(work: Coroutine[Any, Any, Any]) -> None:
    """Run it to its end, in a thread: in this one the browser tests may have left an event loop running."""
    with ThreadPoolExecutor(1) as thread:
        thread.submit(asyncio.run, work).result()


def user_sets(handle: Any, value: Any) -> None:
    """As if somebody set a control in a browser."""
    handle._impl.value = value
    for callback in handle._impl.update_cb:
        called = callback(viser.GuiEvent(client=SOMEONE, client_id=0, target=handle))  # type: ignore[arg-type]
        if isinstance(called, Coroutine):
            finish(called)


def user_clicks(handle: Any) -> None:
    user_sets(handle, True)


class Browser:
    """A browser that shows a dialog. told: its notifications. added: the dialog's controls by their labels."""

    def __init__(self, server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch) -> None:
        self.gui, self.told, self.added = server.gui, list[str](), dict[str, Any]()
        for kind in ("add_text", "add_button"):
            monkeypatch.setattr(server.gui, kind, self._noting(getattr(server.gui, kind)))

    def _noting(self, add: Any) -> Any:
        return lambda label, *args, **options: self.added.setdefault(label, add(label, *args, **options))

    def add_notification(self, _title: str, text: str, **_: Any) -> None:
        self.told.append(text)

    def clicks(self, button: str) -> None:
        for callback in self.added[button]._impl.update_cb:
            finish(callback(viser.GuiEvent(client=self, client_id=0, target=self.added[button])))  # type: ignore[arg-type]


class BusyThreads:
    """Runs what it is given when told to, as threads do that are late."""

    def __init__(self) -> None:
        self._late: list[Callable[[], object]] = []

    def submit(self, call: Callable[..., object], *args: Any) -> Future[object]:
        self._late.append(lambda: call(*args))
        return Future()

    def catch_up(self) -> None:
        for call in self._late:
            call()


@pytest.fixture
def busy(server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch) -> BusyThreads:
    """viser's threads, all of them busy."""
    threads = BusyThreads()
    monkeypatch.setattr(server.gui, "_thread_executor", threads)
    monkeypatch.setattr(server.gui, "_resolve_client", lambda _: SOMEONE)
    return threads


def browser_sends(server: viser.ViserServer, handle: Any, value: Any) -> None:
    """As if a control's new value came in from a browser."""
    message = GuiUpdateMessage(handle._impl.uuid, {"value": value})
    finish(server.gui._handle_gui_updates(0, message))  # type: ignore[arg-type]


@pytest.fixture
def drawn(server: viser.ViserServer, wire: Wire, engine: FakeEngine) -> "Drawn":
    from tests.ui.drawn import Drawn

    drawn = Drawn(server, engine)
    engine.send(StepFrame(14))
    drawn.draw()
    wire.clear()
    return drawn
