"""Starts and watches the engine in a process of its own.

The process sends the next delta after the last one was acknowledged. So a slow reader gets few large deltas.
"""

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, Protocol

from app.child import Child, ChildDied, Link, RestartLimit
from app.mapping.kept import Kept
from app.server.fold import Fold
from app.server.protocol import ACKNOWLEDGED, LIVE, Command, Notice, OpenRecording, Progress, Restart, Snapshot
from app.server.setup import HELD, Seen, Setup

MOST_RESTARTS: Final = 25
"""Most automatic restarts of the engine's process after its death."""

Main = Callable[[Link, Setup], None]


def _run_engine(owner: Link, setup: Setup) -> None:
    from app.server.engine_process import main  # this process does not need the engine and its compiler

    main(owner, setup)


class RunningEngine(Protocol):
    """The interface of a running engine: `EngineProcess`, or the workspace of two engines."""

    @property
    def snapshot(self) -> Snapshot: ...
    def send(self, command: Command) -> None: ...
    def wait(self, after_revision: int, timeout: float) -> Snapshot: ...
    def close(self) -> None: ...


class EngineProcess:
    """Starts, feeds and watches the engine's process. All methods may be called by any thread.

    Args:
        main: what runs in the process; another one only in tests.
    """

    def __init__(self, setup: Setup, *, main: Main = _run_engine) -> None:
        self._setup = setup
        self._main = main
        opening = Snapshot(params=setup.params, progress=Progress.opening(setup.recording))
        self._fold = Fold(opening, HELD * setup.point_budget)
        self._changed = threading.Condition()
        self._restarts, self._restarting = RestartLimit(MOST_RESTARTS), threading.Lock()
        self._child: Child | None = None
        self._start(setup)

    @property
    def snapshot(self) -> Snapshot:
        return self._fold.snapshot

    @property
    def pid(self) -> int | None:
        child = self._child
        return child.pid if child else None

    def wait(self, after_revision: int, timeout: float | None = None) -> Snapshot:
        """The newest snapshot, once it is newer than `after_revision` or the time (s) is over."""
        with self._changed:
            self._changed.wait_for(lambda: self.snapshot.revision > after_revision, timeout)
            return self.snapshot

    def send(self, command: Command) -> None:
        """Enqueue a command. Restart and OpenRecording restart a dead engine; other commands to it are lost."""
        if isinstance(command, Restart | OpenRecording):
            with self._restarting:  # a second caller then finds a live process
                if not self.snapshot.engine_alive:
                    self.restart(command)
                    return
        if (child := self._child) is not None:
            child.send(command)

    def restart(self, command: Restart | OpenRecording | None = None) -> None:
        """Start a new process with the newest parameters at the first frame of the command's or the open recording."""
        self.close(timeout=0)
        last, setup = self.snapshot, self._next_setup(play=False)
        if isinstance(command, OpenRecording):
            setup = replace(setup, recording=command.path, truth=command.truth)
        elif last.recording is not None:
            setup = replace(setup, recording=last.recording.path, truth=last.recording.truth)
        if setup.recording != self._setup.recording:
            setup = replace(setup, start_s=0.0, duration_s=None)
        self._start(setup)
        self._edit(engine_alive=True)

    def close(self, timeout: float | None = None) -> None:
        """Let the process finish writing and exit; kill it after the time (s)."""
        child, self._child = self._child, None  # from now on, its exit is expected
        if child is not None:
            child.close(timeout)

    def _start(self, setup: Setup) -> None:
        self._started_with = setup
        self._child = child = Child(self._main, setup, name="engine", title="The engine's process", fork=True)
        threading.Thread(target=self._follow, args=(child,), name="engine updates", daemon=True).start()

    def _follow(self, child: Child) -> None:
        try:
            while True:
                delta = child.receive()
                child.send(ACKNOWLEDGED)
                with self._changed:
                    if child is not self._child:  # another process has taken over
                        return
                    self._fold.apply(delta)
                    self._changed.notify_all()
        except ChildDied as death:
            if child is self._child:
                self._died(death)

    def _died(self, death: ChildDied) -> None:
        """Report the death, and restart the process if its session was kept."""
        last = self.snapshot
        place = last.session_file or (LIVE if last.live is not None else None)
        restarts = place is not None and self._restarts.allows()
        again, ended = "It is restarted and returns to where it was.", "Restart it to begin at the first frame."
        notices = (Notice(last.last_notice + 1, "error", f"{death} {again if restarts else ended}"),)
        if not restarts:
            transport = replace(last.transport, playing=False, frames_per_second=0.0)
            self._edit(engine_alive=False, progress=None, transport=transport, notices=notices)
            return
        self._edit(notices=notices, progress=Progress("Starting the engine again", math.nan))
        on_the_way = last.progress is not None or last.transport.frame < 0  # to the previous process's frame
        setup = self._next_setup(play=self._started_with.play if on_the_way else last.transport.playing)
        seen = replace(setup.seen, frames=len(last.trajectory), chunks=len(last.chunks))
        self._start(replace(setup, recording=place, revive=True, seen=seen))

    def _next_setup(self, *, play: bool) -> Setup:
        """The setup of the next process, with the present parameters and settings."""
        last = self.snapshot
        return replace(
            self._setup,
            params=last.params,
            play=play,
            speed=last.transport.speed,
            breakpoints=last.breakpoints,
            seen=Seen(last.session, last.last_notice),
            kept=Kept(**last.kept()),
        )

    def _edit(self, **values: Any) -> None:
        with self._changed:
            self._fold.edit(**values)
            self._changed.notify_all()
