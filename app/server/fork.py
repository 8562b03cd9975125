"""Two settings side by side: the session A, and its fork B, which follows A from frame to frame.

The engine is deterministic, so a fork is a session file: A's session up to its frame, then other parameters. B is a
second engine's process that opens this file and then seeks to A's frame. A never waits for B.
"""

import re
import shutil
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from app.mapping.breakpoints import Breakpoints
from app.mapping.session_file import (
    FORK_START,
    FORKS,
    SUFFIX,
    Opened,
    SavedSession,
    opened_in,
    read_session,
    session_files,
    write_session,
)
from app.server.keeping import AddNote
from app.server.protocol import (
    Command,
    CompareWith,
    OpenedRecording,
    Pause,
    Play,
    Seek,
    SetBreakpoints,
    SetSpeed,
    Snapshot,
)
from app.server.setup import Seen, Setup
from app.server.worker import RunningEngine
from app.slam.errors import HemislamError
from app.slam.text_files import free_path, shortened

MAIN = "main"
PERIOD_S = 0.02
"""s between two checks of A's frame."""
AGAIN_S = 1.0
"""The command to B is repeated after this time, since a process that dies loses its commands."""
APART = 1_000_000
"""Offset between the session and notice numbers of two engines, so that the page never confuses them."""
_MOST_KEPT = 30
_NOT_KEPT = "This session has no session file, so it cannot be forked."


@dataclass(frozen=True, slots=True)
class Side:
    """A or B. folder: of a fork that was never A; deleted when the fork is kept elsewhere or discarded."""

    engine: RunningEngine
    name: str
    folder: Path | None = None


def forked(a: Snapshot, values: Mapping[str, Any]) -> SavedSession:
    """The session that continues from the frame of `a` with some parameters changed.

    Raises:
        HemislamError: there is no frame yet, the session is not kept in a file, or a value is invalid.
    """
    frame = a.transport.frame
    if frame < 0:
        raise HemislamError("There is no frame to fork at yet; play or step first.")
    if a.live is not None:
        raise HemislamError("A live source cannot be forked; record it, then open the recording.")
    if a.session_file is None:
        raise HemislamError(_NOT_KEPT)
    return read_session(a.session_file).forked(frame, a.params.with_values(dict(values)))


def same_recording(a: Snapshot, b: Snapshot) -> bool:
    """Whether frames of A and B can be compared."""
    if a.recording is None or b.recording is None:
        return False
    ours, theirs = ((one.path.resolve(), one.start_ns, one.start_s) for one in (a.recording, b.recording))
    return ours == theirs


def fits_beside(ours: OpenedRecording | None, theirs: Opened | None) -> bool:
    """Whether a session file is of A's recording from the same start, so that B can follow A."""
    if ours is None or theirs is None:
        return False
    return (ours.path.resolve(), ours.start_s) == (theirs.recording, theirs.start_s)


def follow(a: Snapshot, b: Snapshot) -> Seek | None:
    """The seek that brings B to A's frame; None if B is there. At A's end, B goes to its end, for the last loops."""
    wanted, here = a.transport.frame, b.transport.frame
    if wanted < 0 or not same_recording(a, b) or (b.transport.finished and here <= wanted):
        return None
    if wanted == here:
        end_a, end_b = (one.recording.end_s if one.recording else 0.0 for one in (a, b))
        return Seek(wanted + 1) if a.transport.finished and end_a == end_b else None
    return Seek(wanted)


def engine_number(snapshot: Snapshot) -> int:
    """The number of the engine that made a snapshot: 0 for the first engine; each fork has its own number."""
    return snapshot.session // APART


class Workspace:
    """A and, while there is a fork, B. The page and scripts use it like the engine A.

    All methods may be called by any thread.

    Args:
        engine: A, at first the main session. setup: with which A was started; B is started with it too.
        start: starts an engine.
    """

    def __init__(self, engine: RunningEngine, setup: Setup, start: Callable[[Setup], RunningEngine]) -> None:
        self._setup = setup
        self._start = start
        self._sides: tuple[Side, Side | None] = (Side(engine, MAIN), None)
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._forks = 0
        self.forked_at = -1  # B was opened, not forked

    # --- A, as the page and scripts use it -------------------------------------------------------
    @property
    def snapshot(self) -> Snapshot:
        """A's newest snapshot."""
        return self._sides[0].engine.snapshot

    def send(self, command: Command) -> None:
        """Enqueue a command for A; `CompareWith` is sent to B as well."""
        self._sides[0].engine.send(command)
        if isinstance(command, CompareWith):
            self.send_other(command)

    def wait(self, after_revision: int, timeout: float) -> Snapshot:
        """The newest snapshot of A, once it is newer than `after_revision` or the time (s) is over."""
        return self._sides[0].engine.wait(after_revision, timeout)

    # --- B ---------------------------------------------------------------------------------------
    @property
    def other(self) -> Snapshot | None:
        """B's newest snapshot; None while there is no fork."""
        b = self._sides[1]
        return b.engine.snapshot if b is not None else None

    @property
    def names(self) -> tuple[str, str]:
        """The names of A and B."""
        a, b = self._sides
        return a.name, b.name if b is not None else ""

    def send_other(self, command: Command) -> None:
        """Enqueue a command for B, for example to change its parameters. B's frame follows A's."""
        b = self._sides[1]
        if b is not None:
            b.engine.send(command)

    def fork(self, name: str, values: Mapping[str, Any] | None = None) -> None:
        """Start B at A's frame, with these parameters by dotted name in place of A's, from the next frame on.

        Raises:
            HemislamError: there is a fork already, A cannot be forked, or its file cannot be written.
        """
        with self._lock:
            a, folder = self._place(name)
            session = forked(a.engine.snapshot, values or {})
            file = folder / FORK_START
            write_session(file, session)
            self._begin(file, session, name, folder, session.frame)
            changed = ", ".join(f"{path} = {value}" for path, value in (values or {}).items())
            note = f"Forked as {self.names[1]}{f' with {changed}' if changed else ''}."
            a.engine.send(AddNote(f"{note} {session.left_out}"))

    def open(self, path: Path) -> None:
        """Start B on a session file of A's recording. Raises HemislamError: the recording differs, or B exists."""
        with self._lock:
            a, folder = self._place(path.stem)
            session, ours = read_session(path), a.engine.snapshot.recording
            theirs = session.opened
            if not fits_beside(ours, theirs):
                raise HemislamError(f"{path.name} is of {theirs.recording} from {theirs.start_s:g} s; open that first.")
            self._begin(path, session, path.stem, folder, -1)
            a.engine.send(AddNote(f"Opened {path.name} beside this session. {session.left_out}"))

    def kept(self) -> list[Path]:
        """Session files of A's recording, from the same start, that can be opened as B, the newest first."""
        a, folder = self._sides[0].engine.snapshot, self._setup.session_folder
        if folder is None:
            return []
        ours = a.session_file.resolve() if a.session_file is not None else None
        others = [file for file in session_files(folder) if file.resolve() != ours][:_MOST_KEPT]
        return [file for file in others if fits_beside(a.recording, opened_in(file))]

    def swap(self) -> None:
        """Swap the two: B becomes A, at A's frame or on the way to where A was going, and A becomes B and follows.

        Raises:
            HemislamError: there is no fork, or it has no frame yet.
        """
        with self._lock:
            a, b = self._need_fork()
            before, after = a.engine.snapshot, b.engine.snapshot
            if not after.engine_alive or after.transport.frame < 0:
                raise HemislamError("B has no frame to show; wait for its first one, or discard it.")
            a.engine.send(Pause())
            b.engine.send(SetSpeed(before.transport.speed))
            b.engine.send(SetBreakpoints(before.breakpoints))
            aim = before.progress.frame if before.progress is not None else None
            frame = before.transport.frame if aim is None else aim
            if same_recording(before, after) and frame != after.transport.frame:
                b.engine.send(Seek(frame))
            if before.transport.playing:
                b.engine.send(Play())
            self._sides = (replace(b, folder=None), a)  # what A writes, also for other recordings, is kept
            b.engine.send(AddNote(f"Swapped: replaces {a.name}."))

    def discard(self) -> None:
        """End B and delete its files, unless it was A before. Raises HemislamError without a fork."""
        with self._lock:
            b = self._end()
            if b.folder is not None:
                shutil.rmtree(b.folder, ignore_errors=True)
            self.send(AddNote(f"Discarded {b.name}."))

    def keep(self, name: str = "") -> Path:
        """End B and keep its session in a new file beside the others, which is returned.

        Raises:
            HemislamError: there is no fork, or the file cannot be written; B's own files stay then.
        """
        with self._lock:
            b = self._end()
            session_file = b.engine.snapshot.session_file or (b.folder / FORK_START if b.folder else None)
            if session_file is None or self._setup.session_folder is None:
                raise HemislamError("B has no session file.")
            session = read_session(session_file)
            stem = f"{shortened(session.opened.recording.stem)}-{_plain(name.strip() or b.name)}"
            path = free_path(self._setup.session_folder / stem, SUFFIX)
            try:
                write_session(path, session)
            except HemislamError as error:
                raise HemislamError(f"{error} The fork is still in {session_file}.") from None
            if b.folder is not None:
                shutil.rmtree(b.folder, ignore_errors=True)
            self.send(AddNote(f"Kept {b.name} as {path.name}."))
            return path

    def close(self) -> None:
        """End both; a fork that was neither kept nor discarded stays in its folder and can be opened again."""
        with self._lock:
            self._ended.set()
            for side in self._sides:
                if side is not None:
                    side.engine.close()

    def _place(self, name: str) -> tuple[Side, Path]:
        """A, and a folder for a new B, which does not exist yet."""
        a, b = self._sides
        if b is not None:
            raise HemislamError("There is a fork already; keep or discard it first.")
        if self._setup.session_folder is None:
            raise HemislamError(_NOT_KEPT)
        self._forks += 1
        stamp = f"{datetime.now():%Y%m%d-%H%M%S}"
        return a, free_path(self._setup.session_folder / FORKS / f"{stamp}-{_plain(name.strip())}")

    def _begin(self, file: Path, session: SavedSession, name: str, folder: Path, forked_at: int) -> None:
        engine = self._start(
            replace(
                self._setup,
                recording=file.resolve(),
                truth=None,  # the session file names it
                params=session.state.params,
                play=False,
                breakpoints=Breakpoints(),
                session_folder=folder.resolve(),
                seen=Seen(APART * self._forks, APART * self._forks),
                live=None,
                live_folder=None,
            )
        )
        self.forked_at = forked_at
        self._sides = (self._sides[0], Side(engine, name.strip() or f"fork {self._forks}", folder))
        self._ended = threading.Event()
        threading.Thread(target=self._follow, args=(self._ended,), name="fork", daemon=True).start()

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
        sent, sent_at = None, 0.0
        while not ended.wait(PERIOD_S):
            with self._lock:
                a, b = self._sides
                if b is None or ended.is_set():
                    return
                now, there = time.monotonic(), b.engine.snapshot
                command = follow(a.engine.snapshot, there)
                lost = there.progress is None and now - sent_at >= AGAIN_S
                if command is not None and (command != sent or lost):
                    b.engine.send(command)
                    sent, sent_at = command, now


def _plain(name: str) -> str:
    """A name that any file system accepts."""
    return re.sub(r"[^\w.-]", "-", name).strip(".-")[:60] or "fork"
