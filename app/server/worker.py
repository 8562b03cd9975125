"""The engine in a process of its own, started and watched from here.

Two pipes join the processes. Commands go down; deltas come up, one at a time: the next is sent when
the one before was acknowledged, so that neither side ever waits for the other. When the upper
process dies, however, the pipe for commands ends and the engine's process ends itself.
"""

import contextlib
import math
import multiprocessing.process
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from app import processes
from app.logs import process_logs
from app.server import wire
from app.server.delta import Delta
from app.server.fold import Fold
from app.server.protocol import LIVE, Command, Notice, OpenRecording, Progress, Restart, Shutdown, Snapshot
from app.server.setup import Setup
from app.server.wire import Pipe

MOST_REVIVALS = 25
"""Deaths of the engine's process after which it is not started again by itself."""

Main = Callable[[Pipe, Pipe, Setup], None]


def _run_engine(commands: Pipe, updates: Pipe, setup: Setup) -> None:
    from app.server.engine_process import main  # the parent has no need of the engine and its compiler

    main(commands, updates, setup)


def _logged(main: Main, commands: Pipe, updates: Pipe, setup: Setup) -> None:
    processes.begin("hemislam-engine")
    with process_logs("engine"):
        main(commands, updates, setup)


class EngineProcess:
    """Starts, feeds and watches the engine's process. All methods may be called by any thread.

    Args:
        main: what runs in the process; another one only in tests.
    """

    def __init__(self, setup: Setup, *, main: Main = _run_engine) -> None:
        self._setup = setup
        self._main = main
        self._fold = Fold(Snapshot(params=setup.params), setup.point_budget)
        self._changed = threading.Condition()
        self._sending = threading.Lock()
        self._commands: Pipe | None = None
        self._process: multiprocessing.process.BaseProcess | None = None
        self._revivals = 0
        self._start(setup)

    # --- for its users ---------------------------------------------------------------------------
    @property
    def snapshot(self) -> Snapshot:
        """The newest one."""
        return self._fold.snapshot

    @property
    def pid(self) -> int | None:
        return self._process.pid if self._process else None

    def wait(self, after_revision: int, timeout: float | None = None) -> Snapshot:
        """The newest snapshot, once it is newer than `after_revision` or the time (s) is over."""
        with self._changed:
            self._changed.wait_for(lambda: self.snapshot.revision > after_revision, timeout)
            return self.snapshot

    def send(self, command: Command) -> None:
        """Enqueue a command. A dead engine is started again by Restart and OpenRecording; others are lost on it."""
        if not self.snapshot.engine_alive and isinstance(command, Restart | OpenRecording):
            self.restart(command)
            return
        with self._sending, contextlib.suppress(OSError):
            if self._commands is not None:
                self._commands.send(command)

    def restart(self, command: Restart | OpenRecording | None = None) -> None:
        """A new process in place of this one, with the newest parameters, at the first frame.

        It opens what was open, or what the command names.
        """
        self._end(timeout=0)
        last, setup = self.snapshot, self._setup
        if isinstance(command, OpenRecording):
            setup = replace(setup, recording=command.path, truth=command.truth)
        elif last.recording is not None:
            setup = replace(setup, recording=last.recording.path, truth=last.recording.truth)
        if setup.recording != self._setup.recording:
            setup = replace(setup, start_s=0.0, duration_s=None)
        self._start(
            replace(
                setup,
                params=last.params,
                play=False,
                speed=last.transport.speed,
                breakpoints=last.breakpoints,
                session=last.session,
                notices=last.notices[-1].number if last.notices else 0,
            )
        )
        self._edit(engine_alive=True)

    def close(self, timeout: float = 10.0) -> None:
        """Let the process finish what it is writing and end; end it by force after the time (s)."""
        self._end(timeout)

    # --- the process -----------------------------------------------------------------------------
    def _start(self, setup: Setup) -> None:
        self._running = setup
        context = processes.context()
        commands_in, commands_out = context.Pipe(duplex=False)
        updates_in, updates_out = context.Pipe(duplex=False)
        wire.widen(updates_out)
        process = context.Process(
            target=_logged, args=(self._main, commands_in, updates_out, setup), name="hemislam engine", daemon=True
        )
        with processes.sigint_blocked():
            process.start()
        commands_in.close()
        updates_out.close()
        self._commands, self._process = commands_out, process
        threading.Thread(
            target=self._read, args=(updates_in, commands_out, process), name="engine updates", daemon=True
        ).start()

    def _read(self, updates: Pipe, commands: Pipe, process: multiprocessing.process.BaseProcess) -> None:
        """Fold what the process sends, until it ends."""
        with contextlib.suppress(EOFError, OSError):
            while True:
                delta: Delta = wire.receive(updates)
                with self._sending:
                    commands.send(None)  # acknowledged: the next one may come
                with self._changed:
                    if process is not self._process:  # another one has taken over
                        break
                    self._fold.apply(delta)
                    self._changed.notify_all()
        updates.close()
        process.join()
        if process is self._process:
            last = self.snapshot
            number = last.notices[-1].number + 1 if last.notices else 1
            code = process.exitcode or 0
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            place = last.journal or (LIVE if last.live is not None else None)
            if place is not None and self._revivals < MOST_REVIVALS:
                self._revivals += 1
                text = (
                    f"The engine's process has ended unexpectedly ({how}); it is started again and goes where it was."
                )
                self._edit(
                    notices=(Notice(number, "error", text),), progress=Progress("Starting the engine again", math.nan)
                )
                on_the_way = last.progress is not None or last.transport.frame < 0  # to where the one before was
                self._start(
                    replace(
                        self._setup,
                        recording=place,
                        params=last.params,
                        play=self._running.play if on_the_way else last.transport.playing,
                        speed=last.transport.speed,
                        breakpoints=last.breakpoints,
                        revive=True,
                        session=last.session,
                        notices=number,
                        frames=0 if last.trajectory is None else len(last.trajectory),
                        chunks=len(last.chunks),
                    )
                )
                return
            text = f"The engine's process has ended unexpectedly ({how}); restart it to begin again at the first frame."
            self._edit(
                engine_alive=False,
                progress=None,
                transport=replace(last.transport, playing=False, frames_per_second=0.0),
                notices=(Notice(number, "error", text),),
            )

    def _edit(self, **values: Any) -> None:
        with self._changed:
            self._fold.edit(**values)
            self._changed.notify_all()

    def _end(self, timeout: float) -> None:
        process, self._process = self._process, None  # from now on its end is expected
        if process is None:
            return
        if timeout:
            self.send(Shutdown())
            process.join(timeout)
        if process.is_alive():
            process.kill()
        process.join()
        with self._sending, contextlib.suppress(OSError):
            if self._commands is not None:
                self._commands.close()
                self._commands = None
