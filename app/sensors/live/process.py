"""A live source in a process of its own.

A busy engine then loses no packet, and one that dies loses neither what is recorded nor its place:
`LiveProcess` is owned by whoever supervises, `LiveClient` is what an engine polls, and a new engine
goes on where its checkpoint was (`LiveClient.place`).

Should this process die itself, another one takes its place at the same address, with what is known of clocks, units
and counts. To an engine it is as if the sensors had been silent meanwhile.
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
from dataclasses import dataclass, replace
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from app import processes
from app.logs import process_logs
from app.sensors.live.counters import Counters
from app.sensors.live.recorder import further
from app.sensors.live.source import Event, Known, LiveSource
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
MOST_DEATHS, WITHIN_S = 5, 60.0
"""So many of them within so long, and the process is not started again."""
ENDED = "The process that receives live data has ended; start hemislam again."
LOST = "it was lost with the engine that had it"
_START_S = 30.0
_STOP_S = 10.0
_TELL_S = 0.2
_AGAIN_S = 0.5
"""How often it tells what it knows, and how long to wait before starting it once more if it does not start."""
_NUMBERS = 1 << 40
"""Of scans, that each process has for its own, so that those of one that died are none of the next."""


@dataclass(frozen=True, slots=True)
class LiveAddress:
    """Where a `LiveProcess` is polled; to be handed to the engine's process."""

    path: str
    key: bytes

    def end(self, reason: str) -> None:
        """Say that nobody will answer there any more."""
        part = Path(f"{self.path}.part")
        with contextlib.suppress(FileNotFoundError):  # it was said, and the folder is gone
            part.write_text(reason, encoding="utf-8")
            part.replace(f"{self.path}.ended")

    def ended(self) -> str:
        """Why nobody will answer there any more; "" if somebody will."""
        try:
            return Path(f"{self.path}.ended").read_text(encoding="utf-8")
        except OSError:
            return "" if Path(self.path).parent.is_dir() else ENDED


class LiveProcess:
    """Receives, and records, until `close`. A context manager.

    A process that dies is followed by another one, which records into a further file (`further`). One that was told
    to end (SIGTERM) is not, nor is one after too many.

    Attributes:
        address: for `LiveClient`.

    Raises:
        HemislamError: as `open_live`.
    """

    def __init__(self, lidar: str, params: Params, imu: str | None = None, record: Path | None = None) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="hemislam-live-")
        self.address = LiveAddress(str(Path(self._folder.name) / "live"), secrets.token_bytes(16))
        self._wanted = (lidar, params, imu)
        self._record = record
        self._known = Known(time.time_ns(), Counters())
        self._closing, self._changing = False, threading.Lock()
        try:
            self._start("")
        except HemislamError:
            self._folder.cleanup()
            raise
        self._watcher = threading.Thread(target=self._watch, name="live process", daemon=True)
        self._watcher.start()

    @property
    def alive(self) -> bool:
        """Whether there is a process, or will be again."""
        return self._watcher.is_alive()

    @property
    def pid(self) -> int | None:
        return self._process.pid

    def close(self) -> None:
        """End the receiving and the recording; nothing that came is lost."""
        self.address.end(ENDED)
        with self._changing, contextlib.suppress(OSError):
            self._closing = True
            self._control.send(None)
        self._watcher.join(_STOP_S)
        if self._watcher.is_alive():
            self._process.kill()
            self._watcher.join(1.0)
        self._folder.cleanup()

    def _start(self, death: str) -> None:
        """Start the process, after another one if there was a `death`. Raises HemislamError: it does not receive."""
        record = further(self._record) if self._record and death else self._record
        context = processes.context()
        ours, theirs = context.Pipe()
        arguments = (theirs, self.address, *self._wanted, record, death, self._known)
        process = context.Process(target=_logged, args=arguments, name="hemislam-live", daemon=True)
        with self._changing:
            if self._closing:
                raise HemislamError(ENDED)
            process.start()
            self._process, self._control = process, ours
        theirs.close()
        try:
            problem = ours.recv() if ours.poll(_START_S) else "The process that receives live data does not start."
        except (EOFError, OSError):  # of one that follows another, this is the next death
            problem = "" if death else "The process that receives live data ended at once; run it again."
        if problem:
            process.kill()
            process.join()
            raise HemislamError(problem)

    def _watch(self) -> None:
        """Start the process again when it dies, until it ends as it was told to, or dies too often."""
        deaths: deque[float] = deque(maxlen=MOST_DEATHS)
        death = self._follow()
        while death and not self._closing:
            log.error("The process that receives live data has ended unexpectedly: %s", death)
            deaths.append(time.monotonic())
            if len(deaths) == MOST_DEATHS and deaths[-1] - deaths[0] < WITHIN_S:
                self.address.end(
                    f"The process that receives live data has ended unexpectedly {MOST_DEATHS} times within a minute"
                    f" (last: {death}); start hemislam again."
                )
                return
            counters = replace(self._known.counters, restarts=self._known.counters.restarts + 1)
            self._known = replace(self._known, counters=counters)
            try:
                self._start(death)
            except HemislamError as error:
                death = str(error)
                time.sleep(_AGAIN_S)
            else:
                death = self._follow()
        self.address.end(ENDED)

    def _follow(self) -> str:
        """Hear what the process knows until it ends. Returns how it died, "" if it did not."""
        with contextlib.suppress(EOFError, OSError):
            while True:
                self._known = self._control.recv()
        self._process.join()
        code = self._process.exitcode or 0
        if code in (0, -signal.SIGTERM):
            return ""
        return f"signal {-code}" if code < 0 else f"exit code {code}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


class LiveClient:
    """Polls a `LiveProcess` as one would a `LiveSource`. One engine at a time; `state` from anywhere.

    While there is nobody who polls, more scans may wait. While the process is started again, there are none.

    Attributes:
        place: number of the scan given last, counted by the process whoever polls. Set it to that of an engine
            that died, and `poll` goes on behind it; 0 is before the first.

    Raises:
        HemislamError: the process has ended for good.
    """

    def __init__(self, address: LiveAddress) -> None:
        self._address = address
        self._connection: Connection[Any, Any] | None = None
        self._state, self._heard_s = LiveState(), time.monotonic()
        while (place := self._ask("place")) is None:
            time.sleep(0.02)
        self.place: int = place

    def poll(self, timeout_s: float = 0.1) -> Event | None:
        """As `LiveSource.poll`."""
        event: Event | None = None
        if (answer := self._ask("poll", self.place, timeout_s)) is None:
            time.sleep(timeout_s)
        else:
            self.place, event = answer
        return event

    def state(self) -> LiveState:
        """The source's; as long as there is no process, the last one, ageing."""
        state: LiveState | None = self._ask("state")
        if state is None:
            return self._state.unheard(time.monotonic() - self._heard_s)
        self._state, self._heard_s = state, time.monotonic()
        return state

    def kept(self) -> None:
        """Nobody will ask again for the scans up to this place."""
        self._ask("kept", self.place)

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()

    def _ask(self, *request: Any) -> Any:
        """The answer; None as long as there is no process, which is being started again."""
        try:
            if self._connection is None:
                self._connection = Client(self._address.path, authkey=self._address.key)
            self._connection.send(request)
            return self._connection.recv()
        except (OSError, EOFError):
            self.close()
            self._connection = None
            if reason := self._address.ended():
                raise HemislamError(reason) from None
            return None


class Desk:
    """What the clients ask for, in the receiving process.

    Scans, and those let go, are numbered as they are given, from 1 on, and who polls says which he had last: an
    engine that dies, at whatever moment, has taken nothing from the one after it.

    Args:
        first: number of the first one, less one.
    """

    def __init__(self, source: LiveSource, first: int = 0) -> None:
        self._source = source
        self._lock = threading.Lock()
        self._given: dict[int, Measurement | DroppedScan] = {}  # without a gap
        self._whole: deque[int] = deque()  # which of them are scans, not only the news of one
        self._last = first
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

    def known(self) -> Known:
        """What the source knows."""
        with self._lock:
            return self._source.known()

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
    processes.begin("hemislam-live")
    with process_logs("live"):
        _serve(*arguments)


def _serve(
    control: "Connection[Any, Any]", address: LiveAddress, lidar: str, params: Params, imu: str | None,
    record: Path | None, death: str, known: Known,
) -> None:  # fmt: skip
    """The process: until it is told to end, or the other end of `control` is closed, be it because its owner died.

    death: of the process before, "" if there was none. known: what that one knew.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl+C reaches all of a terminal's processes; the owner decides
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with contextlib.suppress(OSError, AttributeError):
        os.nice(-5)  # packets do not wait; allowed to root only
    try:
        source = open_live(lidar, params, imu, record, known)
    except HemislamError as error:
        control.send(str(error))
        return
    log.info("Receiving from %s", ", ".join(filter(None, (lidar, imu))))
    if death:
        lost = f", scans lost that waited for the engine: {known.waiting} by the last count" if known.waiting else ""
        into = f"; recording goes on in {record}" if record else ""
        source.tell(
            "restarted",
            f"the process that receives had ended unexpectedly ({death}) and was started again,"
            f" nothing was received for {(time.time_ns() - known.at_ns) * 1e-9:.1f} s{lost}{into}",
        )
    desk = Desk(source, known.counters.restarts * _NUMBERS)
    source.set_absent(True)
    Path(address.path).unlink(missing_ok=True)  # of the process before
    with source, Listener(address.path, authkey=address.key) as listener:
        threading.Thread(target=accept, args=(listener, desk), daemon=True).start()
        control.send("")
        with contextlib.suppress(OSError):
            while not control.poll(_TELL_S):
                control.send(desk.known())


def accept(listener: Listener, desk: Desk) -> None:
    """Serve all who come, each on a thread of its own, until the process ends."""
    while True:
        try:
            connection = listener.accept()
        except (OSError, EOFError, multiprocessing.AuthenticationError):
            time.sleep(0.05)
            continue
        threading.Thread(target=desk.serve, args=(connection,), daemon=True).start()
