"""Two settings side by side: the session A, and a fork of it, B, that goes where A goes.

The engine is deterministic, so a fork is a session file: where A stands, with other parameters. B is
one more engine's process that opens it, comes to A's frame by itself, and then only ever seeks to the
frame that A is at. A never waits for B.
"""

import shutil
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol

from app.server.breakpoints import Breakpoints
from app.server.journal import SUFFIX, SavedSession, read_session, write_session
from app.server.protocol import Command, Pause, Play, Seek, SetBreakpoints, SetSpeed, Snapshot, StepFrame
from app.server.setup import Setup
from app.slam.errors import HemislamError

MAIN = "main"
FOLDER = "forks"
"""Below the folder of session files: forks that are neither kept nor discarded."""
PERIOD_S = 0.02
"""How often to look where A is."""
STUCK_S = 1.0
"""B is told again where to go if nothing came of it for so long: what is sent to a process that dies is lost."""
APART = 1_000_000
"""Between the session and notice numbers of one engine and the next, so that the page never takes one for another."""


class Engine(Protocol):
    """An engine's process as its users know it (`app.server.worker.EngineProcess`)."""

    @property
    def snapshot(self) -> Snapshot: ...
    @property
    def pid(self) -> int | None: ...
    def send(self, command: Command) -> None: ...
    def wait(self, after_revision: int, timeout: float) -> Snapshot: ...
    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Side:
    """Attributes:
    name: for people. folder: of its own, gone when it is discarded; None for the first session.
    """

    engine: Engine
    name: str
    folder: Path | None = None


def forked(a: Snapshot, values: Mapping[str, Any]) -> SavedSession:
    """The session that goes on from where `a` stands with some parameters changed.

    Raises:
        HemislamError: there is no frame yet, the session is not kept in a file, or a value is not possible.
    """
    frame = a.transport.frame
    if frame < 0:
        raise HemislamError("There is no frame to fork at yet; play or step first.")
    if a.journal is None:
        raise HemislamError("This session is not kept in a file, so it can not be forked; serve keeps one.")
    saved = read_session(a.journal)
    history = tuple(entry for entry in saved.state.history if entry[0] <= frame)
    state = replace(saved.state, params=a.params.with_values(dict(values)), history=history)
    return SavedSession(saved.opened, state, frame)


def same_recording(a: Snapshot, b: Snapshot) -> bool:
    """Whether frames of one can be compared with those of the other."""
    if a.recording is None or b.recording is None:
        return False
    return a.recording.path.resolve() == b.recording.path.resolve() and a.recording.start_ns == b.recording.start_ns


def engine_number(snapshot: Snapshot) -> int:
    """Which engine a snapshot is of: 0 is the first one, each fork has a number of its own."""
    return snapshot.session // APART


class Follower:
    """Says what brings B to A's frame: one journey at a time, but back at once.

    Args:
        frame: that B goes to by itself at first.
    """

    def __init__(self, frame: int) -> None:
        self._target = frame
        self._revision, self._since = -1, 0.0

    def next(self, a: Snapshot, b: Snapshot, now: float) -> Command | None:
        """What to send B now (monotonic s), if anything."""
        if b.revision != self._revision:
            self._revision, self._since = b.revision, now
        wanted, here = a.transport.frame, b.transport.frame
        if wanted < 0 or not same_recording(a, b) or wanted == here == self._target:
            return None
        stuck = here != wanted and b.progress is None and now - self._since >= STUCK_S
        arrived = here == self._target
        back = wanted < max(here, self._target)
        if not stuck and (wanted == self._target or not (arrived or back)):
            return None
        self._since = now
        self._target = wanted
        last = b.recording.frames - 1 if b.recording else wanted
        if wanted > last:  # the number of frames is an estimate, which a seek keeps to
            self._target = wanted if here >= last else last
            return StepFrame(wanted - here) if here >= last else Seek(last)
        return Seek(wanted)


class Workspace:
    """A and, while there is a fork, B. To the page and to scripts it is the engine A.

    All methods may be called by any thread.

    Args:
        engine: A, at first the main session. setup: that it was started with; B is started alike.
        start: starts an engine.
    """

    def __init__(self, engine: Engine, setup: Setup, start: Callable[[Setup], Engine]) -> None:
        self._setup = setup
        self._start = start
        self._sides: tuple[Side, Side | None] = (Side(engine, MAIN), None)
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._follower = Follower(-1)
        self._forks = 0
        self.forked_at = -1

    # --- A, as the page and scripts use it -------------------------------------------------------
    @property
    def snapshot(self) -> Snapshot:
        """The newest one of A."""
        return self._sides[0].engine.snapshot

    @property
    def pid(self) -> int | None:
        return self._sides[0].engine.pid

    def send(self, command: Command) -> None:
        """Enqueue a command for A."""
        self._sides[0].engine.send(command)

    def wait(self, after_revision: int, timeout: float) -> Snapshot:
        """The newest snapshot of A, once it is newer than `after_revision` or the time (s) is over."""
        return self._sides[0].engine.wait(after_revision, timeout)

    # --- B ---------------------------------------------------------------------------------------
    @property
    def other(self) -> Snapshot | None:
        """The newest one of B; None while there is no fork."""
        b = self._sides[1]
        return b.engine.snapshot if b is not None else None

    @property
    def names(self) -> tuple[str, str]:
        """Of A and B."""
        a, b = self._sides
        return a.name, b.name if b is not None else ""

    def send_other(self, command: Command) -> None:
        """Enqueue a command for B: its parameters. Where it goes is A's affair."""
        b = self._sides[1]
        if b is not None:
            b.engine.send(command)

    def fork(self, name: str, values: Mapping[str, Any] | None = None) -> None:
        """Start B where A is, with these parameters by dotted name in place of A's, from the next frame on.

        Raises:
            HemislamError: there is a fork already, A can not be forked, or its file can not be written.
        """
        with self._lock:
            a, b = self._sides
            if b is not None:
                raise HemislamError("There is a fork already; keep or discard it first.")
            if self._setup.journals is None:
                raise HemislamError("This session is not kept in a file, so it can not be forked; serve keeps one.")
            session = forked(a.engine.snapshot, values or {})
            self._forks += 1
            name = name.strip() or f"fork {self._forks}"
            folder = _free(self._setup.journals / FOLDER / f"{datetime.now():%Y%m%d-%H%M%S}-{_plain(name)}", "")
            file = folder / f"start{SUFFIX}"
            try:
                folder.mkdir(parents=True)
                write_session(file, session)
            except OSError as error:
                raise HemislamError(f"The fork can not be written to {folder}: {error.strerror}.") from None
            engine = self._start(
                replace(
                    self._setup,
                    recording=file.resolve(),
                    truth=None,  # the file says which
                    params=session.state.params,
                    play=False,
                    breakpoints=Breakpoints(),
                    journals=folder.resolve(),
                    session=APART * self._forks,
                    notices=APART * self._forks,
                )
            )
            self.forked_at, self._follower = session.frame, Follower(session.frame)
            self._sides = (a, Side(engine, name, folder))
            self._ended = threading.Event()
            threading.Thread(target=self._follow, args=(self._ended,), name="fork", daemon=True).start()

    def swap(self) -> None:
        """B becomes A: it goes on where A is, as A did, and A follows. Raises HemislamError without a fork."""
        with self._lock:
            a, b = self._need_fork()
            before, after = a.engine.snapshot, b.engine.snapshot
            if not after.engine_alive or after.transport.frame < 0:
                raise HemislamError("B has no frame to show; wait for its first one, or discard it.")
            a.engine.send(Pause())
            b.engine.send(SetSpeed(before.transport.speed))
            b.engine.send(SetBreakpoints(before.breakpoints))
            if same_recording(before, after) and before.transport.frame != after.transport.frame:
                b.engine.send(Seek(before.transport.frame))
            if before.transport.playing:
                b.engine.send(Play())
            self._follower = Follower(before.transport.frame)
            self._sides = (b, a)

    def discard(self) -> None:
        """End B; what it came to is gone. Raises HemislamError without a fork."""
        with self._lock:
            b = self._end()
            if b.folder is not None:
                shutil.rmtree(b.folder, ignore_errors=True)

    def keep(self, name: str = "") -> Path:
        """End B and keep its session as a file, which can be opened again.

        Returns:
            The file, beside the other session files; no older one is replaced.

        Raises:
            HemislamError: there is no fork, or the file can not be written; B's own files stay then.
        """
        with self._lock:
            b = self._end()
            journal = b.engine.snapshot.journal or (b.folder / f"start{SUFFIX}" if b.folder else None)
            if journal is None or self._setup.journals is None:
                raise HemislamError("B was not kept in a file.")
            session = read_session(journal)
            stem = f"{session.opened.recording.stem}-{_plain(name.strip() or b.name)}"
            path = _free(self._setup.journals / stem, SUFFIX)
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                write_session(path, session)
            except OSError as error:
                raise HemislamError(
                    f"The fork can not be kept as {path}: {error.strerror}; it still is in {journal}."
                ) from None
            if b.folder is not None:
                shutil.rmtree(b.folder, ignore_errors=True)
            return path

    def close(self) -> None:
        """End both; a fork that was neither kept nor discarded stays in its folder, to be opened again."""
        with self._lock:
            self._ended.set()
            for side in self._sides:
                if side is not None:
                    side.engine.close()

    # --- inside ----------------------------------------------------------------------------------
    def _need_fork(self) -> tuple[Side, Side]:
        a, b = self._sides
        if b is None:
            raise HemislamError("There is no fork; fork first.")
        return a, b

    def _end(self) -> Side:
        a, b = self._need_fork()
        self._ended.set()
        self._sides = (a, None)
        b.engine.close()
        return b

    def _follow(self, ended: threading.Event) -> None:
        while not ended.wait(PERIOD_S):
            with self._lock:
                a, b = self._sides
                if b is None or ended.is_set():
                    return
                command = self._follower.next(a.engine.snapshot, b.engine.snapshot, time.monotonic())
                if command is not None:
                    b.engine.send(command)


def _plain(name: str) -> str:
    """A name that any file system takes."""
    return "".join(letter if letter.isalnum() or letter in "-_." else "-" for letter in name).strip(".-")[:60] or "fork"


def _free(path: Path, suffix: str) -> Path:
    """The path with the suffix, numbered if there is such a file already."""
    tries = (path.with_name(f"{path.name}{more}{suffix}") for more in ("", *(f"-{n}" for n in range(2, 1000))))
    return next(one for one in tries if not one.exists())
