"""Sessions on a live source: a feed without an end, and the files by which another process takes a session over."""

import contextlib
import logging
import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from app.mapping.feed import Feed, FeedInfo, Quiet
from app.mapping.loops import RestartingLoops
from app.mapping.session import Checkpoint, Session
from app.sensors.live.process import LiveAddress, LiveClient
from app.sensors.live.status import LiveState
from app.slam.engine import Engine
from app.slam.errors import HemislamError
from app.slam.keyframes import KeyframeStore
from app.slam.loops.keyframe_log import KeyframeLog
from app.slam.loops.messages import LoopClient
from app.slam.loops.types import LoopEdit
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement

POLL_S = 0.02
"""How long to wait for the next scan before looking for commands."""
EVERY = 10
"""Frames between two checkpoints. The receiving process can give six seconds of scans again."""
KEYFRAMES, CHECKPOINT, ROWS = "keyframes", "checkpoint", "rows"

log = logging.getLogger(__name__)


class LiveFeed(Feed):
    """Scans from a process that receives them. A place is the number of the newest scan, and when the first began."""

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
        return event if isinstance(event, Measurement | DroppedScan) else Quiet(event)

    def place(self) -> tuple[int, int]:
        return self._client.place, self._info.start_ns

    def go_to(self, place: tuple[int, int]) -> None:
        self._client.place, start_ns = place
        self._info = replace(self._info, start_ns=start_ns)

    def forget_before(self) -> None:
        """Scans up to here are not asked for again."""
        with contextlib.suppress(HemislamError):  # the source has ended; the next scan that is asked for tells
            self._client.kept()

    def live_state(self) -> LiveState:
        return self._client.state()

    def close(self) -> None:
        self._client.close()


@dataclass(frozen=True, slots=True)
class _Kept:
    """What a file holds beside keyframes and rows, which are appended to files of their own: what is written
    each time must not grow with the session. rows_end: bytes of the file of rows that belong to it.
    """

    checkpoint: Checkpoint
    params: Params
    history: tuple[tuple[int, Params], ...]
    edits: tuple[tuple[LoopEdit, ...], tuple[LoopEdit, ...]]
    rows_end: int


class Handover:
    """Writes now and then what another process needs to take a live session over, and reads it there.

    It stands in the place of checkpoints, but there is no going back by it.
    """

    def __init__(self, session: Session, feed: LiveFeed, folder: Path) -> None:
        self._session, self._feed, self._folder = session, feed, folder
        self._rows_end = self._rows_written = 0

    def wanted(self, frame: int, *, near: bool = False) -> bool:
        return frame >= 0 and frame % EVERY == 0

    def add(self, frame: int, checkpoint: Checkpoint) -> None:
        """Write the session as it is."""
        session, part = self._session, self._folder / f"{CHECKPOINT}.part"
        try:
            self._append_rows()
            kept = _Kept(checkpoint, session.params, session.history, session.edits, self._rows_end)
            with part.open("wb") as file:
                pickle.dump(kept, file, protocol=5)
            part.replace(self._folder / CHECKPOINT)
        except OSError as error:
            log.warning("A checkpoint for another process cannot be written: %s", error)
        else:
            self._feed.forget_before()

    def take_over(self) -> bool:
        """Go on where a process that died was. False if it left nothing to go on from."""
        session = self._session
        try:
            with (self._folder / CHECKPOINT).open("rb") as file:
                kept = pickle.load(file)
            assert isinstance(kept, _Kept)
            if kept.checkpoint.engine.keyframes > len(session.engine.keyframes):
                return False
            self._read_rows(kept.rows_end)
        except (OSError, EOFError, pickle.UnpicklingError):
            return False
        session.return_to(kept.checkpoint)
        session.choose(kept.params)
        session.history = kept.history
        if any(kept.edits):
            session.edit_loops(*kept.edits)
        return True

    def before(self, frame: int) -> None:
        return None

    def get(self, frame: int) -> Any:
        raise KeyError(frame)

    def forget_after(self, frame: int) -> None:
        """Parameters that change from here on do not change what was written."""

    def close(self) -> None:
        """The files stay."""

    def _append_rows(self) -> None:
        """Behind the rows that are there. A process that died may have left a piece behind them, which is cut off."""
        with (self._folder / ROWS).open("r+b" if self._rows_end else "wb") as file:
            file.seek(self._rows_end)
            file.truncate()
            session, first = self._session, self._rows_written
            pickle.dump(session.frames[first:], file, protocol=5)
            self._rows_end, self._rows_written = file.tell(), len(session.frames)

    def _read_rows(self, end: int) -> None:
        with (self._folder / ROWS).open("rb") as file:
            while file.tell() < end:
                frames = pickle.load(file)
                self._session.frames.extend(frames)
                self._rows_written += len(frames)
        self._rows_end = end


def open_live_session(
    address: LiveAddress,
    name: Path,
    params: Params,
    folder: Path,
    *,
    loops: Callable[[KeyframeLog], LoopClient] = RestartingLoops,
    take_over: bool = False,
) -> Session:
    """Map what comes from now on, or go on where a process that died was.

    Args:
        name: of the source, in place of a recording's path. folder: for what must outlive the process.
        loops: makes the client that looks for loops, if `loops.enabled`. take_over: go on, if that is possible.

    Raises:
        HemislamError: the receiving process has ended.
    """
    if not take_over:
        _clear(folder)
    session, feed, handover = _begin(address, name, params, folder, loops)
    if take_over and not handover.take_over():
        session.close()
        _clear(folder)
        session, feed, handover = _begin(address, name, params, folder, loops)
        feed.go_to((0, 0))  # all that was given to the process that died before its first checkpoint
    elif not take_over:
        feed.forget_before()  # scans of an earlier session
    return session


def _begin(
    address: LiveAddress, name: Path, params: Params, folder: Path, loops: Callable[[KeyframeLog], LoopClient]
) -> tuple[Session, LiveFeed, Handover]:
    feed = LiveFeed(LiveClient(address), name)
    engine = Engine(params, KeyframeStore(folder / KEYFRAMES))
    session = Session(feed, engine, loops=loops if params.loops.enabled else None)
    session.checkpoints = handover = Handover(session, feed, folder)
    return session, feed, handover


def _clear(folder: Path) -> None:
    for name in (KEYFRAMES, CHECKPOINT, ROWS):
        (folder / name).unlink(missing_ok=True)
