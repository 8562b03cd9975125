"""A live source in a process of its own.

A busy engine then loses no packet, and one that dies loses neither what is recorded nor its place:
`LiveProcess` is owned by whoever supervises, `LiveClient` is what an engine polls, and a new engine
goes on where its checkpoint was (`rewind`).
"""

import contextlib
import logging
import multiprocessing
import os
import secrets
import signal
import sys
import tempfile
import threading
import time
from collections import deque
from dataclasses import dataclass
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from app.logs import process_logs
from app.sensors.live.source import Event, LiveSource
from app.sensors.live.status import LiveState
from app.sensors.live.urls import open_live
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import Measurement

log = logging.getLogger(__name__)

HISTORY = 60
"""Measurements that can be had again: six seconds, and an engine's checkpoints are two apart."""
_START_S = 30.0
_STOP_S = 10.0


@dataclass(frozen=True, slots=True)
class LiveAddress:
    """Where a `LiveProcess` is polled; to be handed to the engine's process."""

    path: str
    key: bytes


class LiveProcess:
    """Receives, and records, until `close`. A context manager.

    Attributes:
        address: for `LiveClient`.

    Raises:
        HemislamError: as `open_live`.
    """

    def __init__(self, lidar: str, params: Params, imu: str | None = None, record: Path | None = None) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="hemislam-live-")
        self.address = LiveAddress(str(Path(self._folder.name) / "live"), secrets.token_bytes(16))
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        self._control = ours
        self._process = context.Process(
            target=_logged, args=(theirs, self.address, lidar, params, imu, record), name="hemislam-live", daemon=True
        )
        self._process.start()
        theirs.close()
        try:
            problem = ours.recv() if ours.poll(_START_S) else "The process that receives live data does not start."
        except EOFError:
            problem = "The process that receives live data ended at once; run it again."
        if problem:
            self.close()
            raise HemislamError(problem)

    @property
    def alive(self) -> bool:
        return self._process.is_alive()

    def close(self) -> None:
        """End the receiving and the recording; nothing that came is lost."""
        with contextlib.suppress(OSError):
            self._control.close()
        self._process.join(_STOP_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(1.0)
        self._folder.cleanup()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


class LiveClient:
    """Polls a `LiveProcess` as one would a `LiveSource`. One engine at a time; `state` from anywhere.

    Raises:
        HemislamError: the process has ended.
    """

    def __init__(self, address: LiveAddress, *, engine: bool = True) -> None:
        """engine: whether it polls; while no such client is there, more scans may wait."""
        try:
            self._connection: Connection[Any, Any] = Client(address.path, authkey=address.key)
        except OSError as error:
            raise HemislamError(f"The process that receives live data has ended ({error}).") from None
        self._ask("engine" if engine else "onlooker")

    def poll(self, timeout_s: float = 0.1) -> Event | None:
        """As `LiveSource.poll`."""
        event: Event | None = self._ask("poll", timeout_s)
        return event

    def state(self) -> LiveState:
        state: LiveState = self._ask("state")
        return state

    def rewind(self, after_ns: int) -> bool:
        """Give again what was given of scans that end later; whether that is all, without a gap."""
        return bool(self._ask("rewind", after_ns))

    def close(self) -> None:
        self._connection.close()

    def _ask(self, what: str, value: Any = None) -> Any:
        try:
            self._connection.send((what, value))
            return self._connection.recv()
        except (OSError, EOFError):
            raise HemislamError("The process that receives live data has ended.") from None


class _Desk:
    """What the clients ask for, in the receiving process."""

    def __init__(self, source: LiveSource) -> None:
        self._source = source
        self._lock = threading.Lock()
        self._history: deque[Measurement] = deque(maxlen=HISTORY)
        self._again: deque[Measurement] = deque()
        self._engines = 0

    def serve(self, connection: "Connection[Any, Any]") -> None:
        """Until the client leaves, or dies."""
        engine = False
        try:
            with connection:
                while True:
                    what, value = connection.recv()
                    if what == "engine":
                        engine = True
                        self._count(1)
                    connection.send(self._answer(what, value))
        except (OSError, EOFError):
            return
        finally:
            if engine:
                self._count(-1)

    def _count(self, change: int) -> None:
        with self._lock:
            self._engines += change
            self._source.set_absent(self._engines == 0)

    def _answer(self, what: str, value: Any) -> Any:
        if what == "state":
            return self._source.state()
        if what == "poll":
            with self._lock:
                if self._again:
                    return self._again.popleft()
                event = self._source.poll(value)
                if isinstance(event, Measurement):
                    self._history.append(event)
                return event
        if what == "rewind":
            with self._lock:
                self._again = deque(m for m in self._history if m.scan.end_ns > value)
                return len(self._again) < HISTORY
        return None


def _logged(*arguments: Any) -> None:
    with process_logs("live"):
        _serve(*arguments)


def _serve(
    control: "Connection[Any, Any]", address: LiveAddress, lidar: str, params: Params, imu: str | None,
    record: Path | None,
) -> None:  # fmt: skip
    """The process: until the other end of `control` is closed, be it because its owner died."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C reaches all of a terminal's processes; the owner decides
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with contextlib.suppress(OSError, AttributeError):
        os.nice(-5)  # packets do not wait; allowed to root only
    try:
        source = open_live(lidar, params, imu, record)
    except HemislamError as error:
        control.send(str(error))
        return
    log.info("Receiving from %s", ", ".join(filter(None, (lidar, imu))))
    desk = _Desk(source)
    source.set_absent(True)
    with source, Listener(address.path, authkey=address.key) as listener:
        threading.Thread(target=_accept, args=(listener, desk), daemon=True).start()
        control.send("")
        while True:
            try:
                control.recv()
            except (OSError, EOFError):
                return


def _accept(listener: Listener, desk: _Desk) -> None:
    while True:
        try:
            connection = listener.accept()
        except (OSError, EOFError, multiprocessing.AuthenticationError):
            time.sleep(0.05)
            continue
        threading.Thread(target=desk.serve, args=(connection,), daemon=True).start()
