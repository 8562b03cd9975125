"""A live source in a process of its own.

A busy engine then loses no packet, and one that dies loses neither what is recorded nor its place:
`LiveProcess` is owned by whoever supervises, `LiveClient` is what an engine polls, and a new engine
goes on where its checkpoint was (`LiveClient.place`).
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
from app.slam.types import DroppedScan, Measurement

log = logging.getLogger(__name__)

HISTORY = 60
"""Scans that can be had again: six seconds, and an engine's checkpoints are one apart."""
MOST_GIVEN = 100_000
"""The same with those that were let go, of which nothing is kept but their time."""
ENDED = "The process that receives live data has ended; start hemislam again."
LOST = "it was lost with the engine that had it"
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

    While there is nobody who polls, more scans may wait.

    Attributes:
        place: number of the scan given last, counted by the process whoever polls. Set it to that of an engine
            that died, and `poll` goes on behind it; 0 is before the first.

    Raises:
        HemislamError: the process has ended.
    """

    def __init__(self, address: LiveAddress) -> None:
        try:
            self._connection: Connection[Any, Any] = Client(address.path, authkey=address.key)
        except OSError:
            raise HemislamError(ENDED) from None
        self.place: int = self._ask("place")

    def poll(self, timeout_s: float = 0.1) -> Event | None:
        """As `LiveSource.poll`."""
        event: Event | None
        self.place, event = self._ask("poll", self.place, timeout_s)
        return event

    def state(self) -> LiveState:
        state: LiveState = self._ask("state")
        return state

    def kept(self) -> None:
        """Nobody will ask again for the scans up to this place."""
        self._ask("kept", self.place)

    def close(self) -> None:
        self._connection.close()

    def _ask(self, *request: Any) -> Any:
        try:
            self._connection.send(request)
            return self._connection.recv()
        except (OSError, EOFError):
            raise HemislamError(ENDED) from None


class Desk:
    """What the clients ask for, in the receiving process.

    Scans, and those let go, are numbered as they are given, from 1 on, and who polls says which he had last: an
    engine that dies, at whatever moment, has taken nothing from the one after it.
    """

    def __init__(self, source: LiveSource) -> None:
        self._source = source
        self._lock = threading.Lock()
        self._given: dict[int, Measurement | DroppedScan] = {}  # without a gap
        self._whole: deque[int] = deque()  # which of them are scans, not only the news of one
        self._last = 0
        self._polling = 0

    def serve(self, connection: "Connection[Any, Any]") -> None:
        """Until the client leaves, or dies."""
        polls = False
        try:
            with connection:
                while True:
                    request = connection.recv()
                    if request[0] == "poll" and not polls:
                        polls = True
                        self._count(1)
                    connection.send(self._answer(*request))
        except (OSError, EOFError):
            return
        finally:
            if polls:
                self._count(-1)

    def _count(self, change: int) -> None:
        with self._lock:
            self._polling += change
            self._source.set_absent(self._polling == 0)

    def _answer(self, what: str, place: int = 0, timeout_s: float = 0.0) -> Any:
        if what == "state":
            return self._source.state()
        with self._lock:
            if what == "poll":
                return self._next(place, timeout_s)
            if what == "kept":
                self._let_go(place)
            return self._last

    def _next(self, place: int, timeout_s: float) -> tuple[int, Event | None]:
        """What comes behind that place, and its own."""
        if self._given and place < self._last:
            place = max(place + 1, next(iter(self._given)))
            return place, self._given[place]
        event = self._source.poll(timeout_s)
        if isinstance(event, Measurement | DroppedScan):
            self._last += 1
            self._given[self._last] = event
        if isinstance(event, Measurement):
            self._whole.append(self._last)
        if len(self._whole) > HISTORY:
            oldest = self._whole.popleft()
            self._given[oldest] = DroppedScan(_stamp(self._given[oldest]), LOST)
        self._let_go(self._last - MOST_GIVEN)
        return self._last, event

    def _let_go(self, place: int) -> None:
        while self._given and (first := next(iter(self._given))) <= place:
            del self._given[first]
        while self._whole and self._whole[0] <= place:
            self._whole.popleft()


def _stamp(event: Measurement | DroppedScan) -> int:
    return event.scan.stamp_ns if isinstance(event, Measurement) else event.stamp_ns


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
    desk = Desk(source)
    source.set_absent(True)
    with source, Listener(address.path, authkey=address.key) as listener:
        threading.Thread(target=accept, args=(listener, desk), daemon=True).start()
        control.send("")
        while True:
            try:
                control.recv()
            except (OSError, EOFError):
                return


def accept(listener: Listener, desk: Desk) -> None:
    """Serve all who come, each on a thread of its own, until the process ends."""
    while True:
        try:
            connection = listener.accept()
        except (OSError, EOFError, multiprocessing.AuthenticationError):
            time.sleep(0.05)
            continue
        threading.Thread(target=desk.serve, args=(connection,), daemon=True).start()
