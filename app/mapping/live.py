"""Sessions on a live source: a feed without an end, and a file by which another process takes a session over."""

import contextlib
import logging
import pickle
import sqlite3
from dataclasses import replace
from pathlib import Path

from app.mapping.feed import Feed, FeedInfo, Quiet
from app.mapping.loops import RestartingLoops
from app.mapping.session import Session
from app.sensors.live.address import LiveAddress
from app.sensors.live.intake import BUSY
from app.sensors.live.process import LiveClient
from app.sensors.live.status import LiveState
from app.slam.engine import Engine
from app.slam.errors import HemislamError
from app.slam.keyframes import KeyframeStore
from app.slam.loops.edits import Edits
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement

POLL_S = 0.02
"""How long to wait for the next scan before looking for commands."""
EVERY = 10
"""Frames between two checkpoints. The receiving process can send the last six seconds of scans again."""
KEYFRAMES, HANDOVER = "keyframes", "handover.sqlite"

log = logging.getLogger(__name__)


class LiveFeed(Feed):
    """Scans from a process that receives them. A place is the newest scan's number and the time of the first scan."""

    def __init__(self, client: LiveClient, name: Path) -> None:
        self._client = client
        self._info = FeedInfo(name)

    @property
    def info(self) -> FeedInfo:
        return self._info

    def next(self) -> Measurement | DroppedScan | Quiet:
        event = self._client.poll(POLL_S)
        if isinstance(event, Measurement) and not self._info.start_ns:
            self._info = replace(self._info, start_ns=event.scan.stamp_ns)
        if isinstance(event, DroppedScan) and event.reason == BUSY and not self._info.start_ns:
            return Quiet()  # this map did not miss it: nothing was mapped then
        return event if isinstance(event, Measurement | DroppedScan) else Quiet(event)

    def place(self) -> tuple[int, int]:
        return self._client.place, self._info.start_ns

    def go_to(self, place: tuple[int, int]) -> None:
        self._client.place, start_ns = place
        self._info = replace(self._info, start_ns=start_ns)

    def acknowledge(self) -> None:
        """Tell the source that scans up to here will not be requested again."""
        with contextlib.suppress(HemislamError):  # the source has ended; the next request reports that
            self._client.kept()

    def live_state(self) -> LiveState:
        return self._client.state()

    def close(self) -> None:
        self._client.close()


class LiveSession(Session):
    """A session on a live source. It only goes forward, and another process can take it over if this one dies.

    Args:
        folder: for what must outlive the process.
    """

    def __init__(self, feed: LiveFeed, params: Params, folder: Path) -> None:
        self._live = feed
        self._written = 0  # frames
        self._file = sqlite3.connect(folder / HANDOVER, isolation_level=None)
        self._file.executescript(
            "PRAGMA synchronous = OFF; CREATE TABLE IF NOT EXISTS frames (pickled BLOB);"
            "CREATE TABLE IF NOT EXISTS kept (id INTEGER PRIMARY KEY, pickled BLOB)"
        )
        loops = RestartingLoops if params.loops.enabled else None
        super().__init__(feed, Engine(params, KeyframeStore(folder / KEYFRAMES)), loops=loops)

    def _remember(self, *, near: bool = False) -> None:
        """Write what another process needs to continue from here. Its size must not grow with the session."""
        if self.frame < 0 or self.frame % EVERY:
            return
        kept = (self.checkpoint(), self.params, self.history, self.edits, self.keyframes.edits, self.survey)
        try:
            with self._file:
                self._file.execute("BEGIN")
                frames = ((pickle.dumps(frame),) for frame in self.frames[self._written :])
                self._file.executemany("INSERT INTO frames VALUES (?)", frames)
                self._file.execute("REPLACE INTO kept VALUES (0, ?)", (pickle.dumps(kept),))
        except sqlite3.Error as error:
            log.warning("A checkpoint for another process cannot be written: %s", error)
        else:
            self._written = len(self.frames)
            self._live.acknowledge()

    def take_over(self) -> bool:
        """Continue where a process died. False if it left nothing to continue from."""
        try:
            ((pickled,),) = self._file.execute("SELECT pickled FROM kept")
            checkpoint, params, history, edits, labels, survey = pickle.loads(pickled)
            frames = [pickle.loads(row) for (row,) in self._file.execute("SELECT pickled FROM frames ORDER BY rowid")]
        except (sqlite3.Error, ValueError, pickle.UnpicklingError):
            return False
        if checkpoint.engine.keyframes > len(self.engine.keyframes):
            return False
        self.frames.extend(frames)
        self._written = len(frames)
        self.return_to(checkpoint)
        self.choose(params)
        self.history, self.keyframes.edits, self.survey = history, labels, survey
        if edits != Edits():
            self.edit_loops(edits.done, edits.undone)
        return True

    def close(self) -> None:
        super().close()
        self._file.close()


def open_live_session(
    address: LiveAddress, name: Path, params: Params, folder: Path, *, take_over: bool = False
) -> LiveSession:
    """Map scans from now on, or continue where a process died.

    Args:
        name: of the source, in place of a recording's path. folder: for what must outlive the process.
        take_over: continue, if that is possible.

    Raises:
        HemislamError: the receiving process has ended.
    """
    if take_over:
        session = LiveSession(LiveFeed(LiveClient(address), name), params, folder)
        if session.take_over():
            return session
        session.close()
    for file in (KEYFRAMES, HANDOVER, f"{HANDOVER}-journal"):
        (folder / file).unlink(missing_ok=True)
    feed = LiveFeed(LiveClient(address), name)
    session = LiveSession(feed, params, folder)
    if take_over:
        feed.go_to((0, 0))  # receive again all scans that the dead process had before its first checkpoint
    else:
        feed.acknowledge()  # scans of an earlier session
    return session
