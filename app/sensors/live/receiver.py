"""The code that runs in the process that receives live data (`app.sensors.live.process`)."""

import contextlib
import logging
import multiprocessing
import os
import threading
import time
from collections import deque
from multiprocessing.connection import Connection, Listener
from pathlib import Path
from typing import Any, Final

from app.child import Link, put, take
from app.sensors.live.address import LiveAddress
from app.sensors.live.source import Event, Known, LiveSource
from app.sensors.live.urls import open_live
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement

log = logging.getLogger(__name__)

HISTORY = 120
"""Number of scans, including dropped ones, that can be given again: an engine makes a checkpoint every ten frames."""
LOST: Final = "it was lost with the engine that had it"
_REPORT_S = 0.2
"""How often the state is sent to the owner."""
_NUMBERS = 1 << 40
"""Scan numbers reserved for each process, so that the next one does not use those of one that died."""


def receive(
    owner: Link, address: LiveAddress, lidar: str, params: Params, imu: str | None,
    record: Path | None, death: str, known: Known,
) -> None:  # fmt: skip
    """Receive until the owner ends this process. The first message is "", or why the source cannot be opened.

    Args:
        death: how the previous process died; "" if there was none. known: the state of that process.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.nice(-5)  # packets do not wait; only root may do this
    try:
        source = open_live(lidar, params, imu, record, known)
    except HemislamError as error:
        owner.send(str(error))
        return
    log.info("Receiving from %s", ", ".join(filter(None, (lidar, imu))))
    if death:
        source.tell("restarted", _restarted(death, known, record))
    server = ScanServer(source, known.state.counters.restarts * _NUMBERS)
    Path(address.path).unlink(missing_ok=True)  # of the process before
    with source, Listener(address.path, authkey=address.key) as listener:
        threading.Thread(target=accept, args=(listener, server), daemon=True).start()
        owner.send("")
        while owner.receive(_REPORT_S) is None:
            owner.send(server.known())


def _restarted(death: str, known: Known, record: Path | None) -> str:
    silent = f"the receiving process died ({death}) and was started again; nothing was received for "
    silent += f"{(time.time_ns() - known.at_ns) * 1e-9:.1f} s"
    waiting = known.state.backlog
    lost = f"; scans lost that waited for the engine: {waiting} by the last count" if waiting else ""
    into = f"; the recording continues in {record}" if record else ""
    return f"{silent}{lost}{into}"


def accept(listener: Listener, server: "ScanServer") -> None:
    """Serve all clients, each on a thread of its own, until the process ends."""
    while True:
        try:
            connection = listener.accept()
        except (OSError, EOFError, multiprocessing.AuthenticationError):
            time.sleep(0.05)
            continue
        threading.Thread(target=server.serve, args=(connection,), daemon=True).start()


class ScanServer:
    """Answers the requests of `LiveClient`.

    Scans and dropped scans are numbered from 1 as they are given, and a client states the last number that it has. So a
    scan that an engine took just before it died is given again to the next engine.

    Args:
        first: number of the first scan, minus one.
    """

    def __init__(self, source: LiveSource, first: int = 0) -> None:
        self._source = source
        self._lock = threading.Lock()
        self._given: deque[Measurement | DroppedScan] = deque(maxlen=HISTORY)  # the newest
        self._last = self._kept = first  # numbers of the newest, and of the newest that no engine needs again

    def serve(self, connection: "Connection[Any, Any]") -> None:
        """Answer a client until it leaves or dies."""
        with contextlib.suppress(OSError, EOFError), connection:
            while True:
                put(connection, self._answer(*take(connection)))

    def known(self) -> Known:
        """The state of the source."""
        with self._lock:
            return self._source.known()

    def _answer(self, what: str, place: int = 0, timeout_s: float = 0.0) -> Any:
        if what == "state":
            return self._source.state()
        with self._lock:
            if what == "poll":
                return self._next(place, timeout_s)
            if what == "kept":
                self._kept = max(self._kept, place)
                while self._given and self._last - len(self._given) < self._kept:
                    self._given.popleft()
            return self._last

    def _next(self, place: int, timeout_s: float) -> tuple[int, Event | None]:
        """The event after that place, and its own place."""
        place = max(place, self._kept) + 1
        if place <= self._last:
            behind = place - 1 - self._last + len(self._given)
            if behind >= 0:
                return place, self._given[behind]
            oldest = self._given[0]
            return place, DroppedScan((oldest.scan if isinstance(oldest, Measurement) else oldest).stamp_ns, LOST)
        event = self._source.poll(timeout_s)
        if isinstance(event, Measurement | DroppedScan):
            self._last += 1
            self._given.append(event)
        return self._last, event
