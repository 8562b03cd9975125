"""A live source in a process of its own.

So a busy engine loses no packet, and an engine that dies loses neither the recording nor its place. The server owns the
`LiveProcess`, the engine polls it through a `LiveClient`, and the next engine sets `LiveClient.place` to the place of
its checkpoint.

If the receiving process itself dies, another one takes over at the same address. It gets the clocks, units and counts
of its predecessor. To the engine, it looks as if the sensors had been silent.
"""

import logging
import secrets
import tempfile
import threading
import time
from contextlib import AbstractContextManager
from dataclasses import replace
from multiprocessing.connection import Client, Connection
from pathlib import Path
from typing import Any

from app.child import Child, ChildDied, Link, RestartLimit, put, take
from app.sensors.live.address import ENDED, TITLE, LiveAddress
from app.sensors.live.source import Event, Known
from app.sensors.live.status import LiveState
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.text_files import free_path

log = logging.getLogger(__name__)

MOST_RESTARTS, WITHIN_S = 4, 60.0
"""If the process dies once more within this time (s), it is not started again."""
_START_S, _STOP_S = 30.0, 10.0
"""s that the process may take to open the source, and to finish the recording."""
_RETRY_S = 0.5
"""s between two attempts to start it again."""


class LiveProcess(AbstractContextManager["LiveProcess"]):
    """Receives, and records, until `close`.

    A process that dies is replaced by another one, which records into a further file, `NAME-2.mcap`.

    Attributes:
        address: for `LiveClient`.

    Raises:
        HemislamError: as `open_live`.
    """

    def __init__(self, lidar: str, params: Params, imu: str | None = None, record: Path | None = None) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="hemislam-live-")
        self.address = LiveAddress(str(Path(self._folder.name) / "live"), secrets.token_bytes(16))
        self._source = (lidar, params, imu)
        self._record = record
        self._known = Known(time.time_ns(), LiveState())
        self._restarts = RestartLimit(MOST_RESTARTS, WITHIN_S)
        self._closing = False
        try:
            self._child = self._start("")
        except HemislamError:
            self._folder.cleanup()
            raise
        self._watcher = threading.Thread(target=self._watch, name="live process", daemon=True)
        self._watcher.start()

    @property
    def pid(self) -> int | None:
        return self._child.pid

    def close(self) -> None:
        """End the receiving and the recording; nothing that was received is lost."""
        self.address.end(ENDED)
        self._closing = True
        self._watcher.join()
        self._folder.cleanup()

    def _start(self, death: str) -> Child:
        """Start the process, after another one if there was a `death`. Raises HemislamError: it does not receive."""
        record = self._record
        if record and death:
            record = free_path(record.with_suffix(""), record.suffix)
        arguments = (self.address, *self._source, record, death, self._known)
        child = Child(_receive, *arguments, name="live", title=TITLE, fork=True)
        problem = child.receive(_START_S)
        if problem == "":
            return child
        child.close(timeout=0)
        raise HemislamError(problem or f"{TITLE} does not start; run it again.")

    def _watch(self) -> None:
        """Store what the process knows, and restart it when it dies, until `close` or until it dies too often."""
        while not self._closing:
            try:
                self._known = self._child.receive(1.0) or self._known
            except ChildDied as death:
                if not self._closing and not self._started_again(death.how):
                    return
        self._child.close(_STOP_S)

    def _started_again(self, death: str) -> bool:
        """Start another process in place of the one that died. Returns whether there is one."""
        while not self._closing:
            log.error("%s ended unexpectedly: %s", TITLE, death)
            if not self._restarts.allows():
                times = f"{self._restarts.most + 1} times within a minute (last: {death})"
                self.address.end(f"{TITLE} ended unexpectedly {times}; start hemislam again.")
                return False
            state = self._known.state
            counters = replace(state.counters, restarts=state.counters.restarts + 1)
            self._known = replace(self._known, state=replace(state, counters=counters))
            try:
                self._child = self._start(death)
                return True
            except HemislamError as error:
                death = error.how if isinstance(error, ChildDied) else str(error)
                time.sleep(_RETRY_S)
        return True

    def __exit__(self, *_: object) -> None:
        self.close()


def _receive(owner: Link, *arguments: Any) -> None:
    from app.sensors.live.receiver import receive  # the server has no need of it

    receive(owner, *arguments)


class LiveClient:
    """Polls a `LiveProcess` like a `LiveSource`. One engine at a time may poll; `state` may be read from anywhere.

    While the process is being restarted, there are no scans.

    Attributes:
        place: number of the scan that was given last, as the receiving process counts them; 0 before the first.
            If it is set to the place of an engine that died, `poll` continues after that scan.

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
        """The source's state; while there is no process, the last one, with its age."""
        state: LiveState | None = self._ask("state")
        if state is None:
            return self._state.unheard(time.monotonic() - self._heard_s)
        self._state, self._heard_s = state, time.monotonic()
        return state

    def kept(self) -> None:
        """Tell the process that scans up to this place will not be requested again."""
        self._ask("kept", self.place)

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()

    def _ask(self, *request: Any) -> Any:
        """The answer; None while the process is being restarted."""
        try:
            if self._connection is None:
                self._connection = Client(self._address.path, authkey=self._address.key)
            put(self._connection, request)
            return take(self._connection)
        except (OSError, EOFError):
            self.close()
            self._connection = None
            if reason := self._address.ended():
                raise HemislamError(reason) from None
            return None
