"""A run on a live source: frames come when they come, and there is no going back."""

import contextlib
import logging
import pickle
from dataclasses import dataclass, replace
from pathlib import Path

from app.mapping.loops import RestartingLoops
from app.sensors.findings import Finding
from app.sensors.live.process import LiveAddress, LiveClient
from app.sensors.live.status import LiveState, Status
from app.server.protocol import LIVE, OpenedRecording
from app.server.run import Quiet, Run
from app.slam.engine import Checkpoint, Engine
from app.slam.errors import HemislamError
from app.slam.keyframes import KeyframeStore
from app.slam.loops.types import LoopEdit
from app.slam.params import Params
from app.slam.results import LogState
from app.slam.types import DroppedScan, Measurement

POLL_S = 0.02
"""How long to wait for the next scan before looking for commands."""


EVERY = 10
"""Frames between two checkpoints; the receiving process can give six seconds of scans again."""
KEYFRAMES, CHECKPOINT, ROWS = "keyframes", "checkpoint", "rows"

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Kept:
    """A live run as an engine that takes over needs it, but for keyframes and rows, which are appended to files of
    their own: what is written each time must not grow with the walk.

    Attributes:
        place: of the newest scan, see `LiveClient`. rows_end: bytes of the file of rows that belong to it.
    """

    frame: int
    place: int
    rows_end: int
    engine: Checkpoint
    params: Params
    history: tuple[tuple[int, Params], ...]
    opened: OpenedRecording
    log: LogState
    edits: tuple[tuple[LoopEdit, ...], tuple[LoopEdit, ...]]


@dataclass(frozen=True, slots=True)
class _Endless:
    """What `Run` asks of a recording, of one that is still going on."""

    path: Path = LIVE
    start_ns: int = 0
    duration_s: float = 0.0
    scan_count: int = 0
    findings: tuple[Finding, ...] = ()

    def measurements(self, *_: object, **__: object) -> None:
        return None

    def close(self) -> None:
        pass


class LiveRun(Run):
    """Takes scans from a `LiveProcess`."""

    live = True

    def __init__(self, client: LiveClient, engine: Engine, folder: Path) -> None:
        super().__init__(_Endless(), engine)  # type: ignore[arg-type]
        self._client = client
        self._folder = folder
        self._rows_end = 0
        self._rows_kept = 0
        if engine.loops is not None:
            engine.loops.never_go_back()

    def peek(self) -> Measurement | DroppedScan | Quiet | None:
        """As of a recording; `Quiet` if there is no scan just now."""
        if self._waiting is None:
            event = self._client.poll(POLL_S)
            if isinstance(event, DroppedScan):
                self._drop(event)
                return event
            if not isinstance(event, Measurement):
                return Quiet(event)
            if self.frame < 0:
                self._begin(event.scan.stamp_ns)
            self._waiting = event
        return self._waiting

    def _begin(self, start_ns: int) -> None:
        self.opened = replace(self.opened, start_ns=start_ns)

    def grown(self) -> None:
        """What was opened has become longer."""
        seconds = (self._end_ns - self.opened.start_ns) * 1e-9 if len(self.log) else 0.0
        self.opened = replace(self.opened, frames=self.frame + 1, duration_s=seconds)

    def state(self) -> LiveState:
        """How the source is doing. Raises HemislamError: it has ended."""
        return self._client.state()

    def remember(self, *, near: bool = False) -> None:
        """Now and then put on disk what an engine that takes over needs. Going back is not possible."""
        if self.frame < 0 or self.frame % EVERY or self._waiting is not None:
            return
        part = self._folder / "checkpoint.part"
        try:
            self._keep_rows()
            with part.open("wb") as file:  # not by way of bytes: the local map is some ten megabytes
                pickle.dump(self._state(), file, protocol=5)
            part.replace(self._folder / CHECKPOINT)
        except OSError as error:
            log.warning("What a new engine would need can not be kept: %s", error)
            return
        with contextlib.suppress(HemislamError):  # it has ended, which is told when it is asked for the next scan
            self._client.kept()

    def _state(self) -> _Kept:
        loops = self.engine.loops.state if self.engine.loops else None
        return _Kept(
            frame=self.frame,
            place=self._client.place,
            rows_end=self._rows_end,
            engine=self.engine.checkpoint(),
            params=self.params,
            history=self.history,
            opened=self.opened,
            log=self.log.checkpoint(),
            edits=(loops.undo, loops.redo) if loops else ((), ()),
        )

    @property
    def _end_ns(self) -> int:
        return int(self.log.stamps_ns[-1])

    def _keep_rows(self) -> None:
        """Put what is new behind what is kept; a piece behind that may be there, of an engine that died meanwhile."""
        with (self._folder / ROWS).open("r+b" if self._rows_end else "wb") as file:
            file.seek(self._rows_end)
            file.truncate()
            pickle.dump((self.log.rows(self._rows_kept), self.frames[self._rows_kept :]), file, protocol=5)
            end = file.tell()
        self._rows_end, self._rows_kept = end, len(self.log)

    def _read_rows(self, end: int) -> None:
        with (self._folder / ROWS).open("rb") as file:
            while file.tell() < end:
                rows, frames = pickle.load(file)
                self.log.extend(rows)
                self.frames.extend(frames)
        self._rows_end, self._rows_kept = end, len(self.log)

    def revive(self) -> bool:
        """Go on where an engine that died was; whether there is anything to go on from."""
        try:
            with (self._folder / CHECKPOINT).open("rb") as file:
                kept = pickle.load(file)
            assert isinstance(kept, _Kept)
            if kept.engine.keyframes > len(self.engine.keyframes):
                return False
            self._read_rows(kept.rows_end)
        except (OSError, EOFError, pickle.UnpicklingError):
            return False
        self.log.restore(kept.log)
        self.engine.restore(kept.engine)
        self.choose(kept.params)
        self.frame = kept.frame
        self.history, self.opened = kept.history, kept.opened
        if any(kept.edits):
            self.edit_loops(*kept.edits)
        self._client.place = kept.place
        return True

    def go_before(self, frame: int) -> None:
        raise HemislamError("A live source has no past; open its recording to go back in it.")

    def close(self) -> None:
        self._client.close()
        super().close()


def open_live_run(address: LiveAddress, params: Params, folder: Path, *, revive: bool = False) -> LiveRun:
    """Map what comes from now on, or go on where an engine that died was.

    Args:
        folder: for what must outlive the process. revive: go on, if that is possible.

    Raises:
        HemislamError: the receiving process has ended.
    """
    if not revive:
        _clear(folder)
    run, client = _begun(address, params, folder)
    if not revive:
        client.kept()  # what an earlier walk was given is not of this one
    elif not run.revive():
        run.close()
        _clear(folder)
        run, client = _begun(address, params, folder)
        client.place = 0  # all that was given to the engine that died before its first checkpoint
    return run


def _begun(address: LiveAddress, params: Params, folder: Path) -> tuple[LiveRun, LiveClient]:
    client = LiveClient(address)
    engine = Engine(
        params,
        RestartingLoops if params.loops.enabled else None,
        KeyframeStore(folder / KEYFRAMES),
    )
    return LiveRun(client, engine, folder), client


def _clear(folder: Path) -> None:
    for name in (KEYFRAMES, CHECKPOINT, ROWS):
        (folder / name).unlink(missing_ok=True)


def tells(status: Status) -> bool:
    """Whether a status is a warning, not only news."""
    return status.kind in ("disconnected", "silent", "jump", "recording", "units", "restarted")
