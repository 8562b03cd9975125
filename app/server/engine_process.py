"""The main loop of the engine's process."""

import logging
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from app.server import wire
from app.server.delta import Delta, Outbox
from app.server.live import open_live_run
from app.server.protocol import LIVE, Command, Progress, SetBreakpoints, SetSpeed, Shutdown
from app.server.run import Run, open_run
from app.server.session import OpenRun, Session
from app.server.setup import Setup
from app.server.wire import Pipe
from app.slam.params import Params
from app.slam.warmup import compile_kernels

FRAME_PERIOD_S = 0.04
"""Frames are published no more often than this; answers to the user at once."""

LAST_BREATH_S = 5.0
"""After the parent has gone, so long may the work under way take."""


log = logging.getLogger(__name__)


class Link:
    """The two pipes, seen from the engine: nothing here ever makes it wait."""

    def __init__(self, commands: Pipe, updates: Pipe, outbox: Outbox) -> None:
        self._commands, self._updates = commands, updates
        self._outbox = outbox
        self._inbox: queue.SimpleQueue[Command | None] = queue.SimpleQueue()
        self._deltas: queue.SimpleQueue[Delta] = queue.SimpleQueue()
        self._free = True
        self._published = 0.0
        self.ending = False
        threading.Thread(target=self._receive, name="commands", daemon=True).start()
        threading.Thread(target=self._send, name="updates", daemon=True).start()

    def publish(self) -> float | None:
        """Send what changed, if the reader is ready and it is time.

        Returns:
            Seconds until there is something to publish; None if there is nothing or the reader is
            not ready, which wakes `commands`.
        """
        if not self._free or not self._outbox.filled:
            return None
        wait = 0.0 if self._outbox.urgent else self._published + FRAME_PERIOD_S - time.monotonic()
        if wait > 0:
            return wait
        self._published = time.monotonic()
        self._free = False
        self._deltas.put(self._outbox.take())
        return None

    def commands(self, wait: float | None) -> list[Command]:
        """Commands that have come; if there are none, waits up to so many seconds (None: any time)."""
        taken: list[Command] = []
        try:
            entry = self._inbox.get(block=wait != 0, timeout=wait)
            while True:
                if entry is not None:
                    taken.append(entry)
                entry = self._inbox.get_nowait()
        except queue.Empty:
            return taken

    def _receive(self) -> None:
        """None is an acknowledgement; it is passed on, so that the loop wakes up."""
        try:
            while True:
                command = self._commands.recv()
                if command is None:
                    self._free = True
                self.ending |= isinstance(command, Shutdown)
                self._inbox.put(command)
        except (EOFError, OSError):
            self.ending = True
            self._inbox.put(Shutdown())
            time.sleep(LAST_BREATH_S)
            os._exit(1)

    def _send(self) -> None:
        try:
            while True:
                wire.send(self._updates, self._deltas.get())
        except OSError:
            pass  # the parent has gone; _receive sees it too
        except BaseException:
            log.critical("What changed can not be sent", exc_info=True)
            os._exit(1)


def main(commands: Pipe, updates: Pipe, setup: Setup) -> None:
    """Compile, open the recording, and work until told to end or the parent has gone."""
    opened_before: list[Path] = []

    def opener(
        path: Path, truth: Path | None, params: Params, part: tuple[float, float | None] | None = None, /
    ) -> Run:
        if path == LIVE and setup.live is not None and setup.live_folder is not None:
            revive = setup.revive and not opened_before
            opened_before.append(path)
            return open_live_run(setup.live, params, setup.live_folder, revive=revive)
        part = part or ((setup.start_s, setup.duration_s) if path == setup.recording else (0.0, None))
        return open_run(path, truth, params, *part, checkpoint_bytes=setup.checkpoint_bytes)

    run_loop(commands, updates, setup, opener, compile_kernels)


def run_loop(
    commands: Pipe,
    updates: Pipe,
    setup: Setup,
    opener: OpenRun,
    prepare: Callable[[Callable[[str, float], None]], None] | None = None,
) -> None:
    """As `main`, with what opens a recording, and what must be prepared with progress (name, fraction) before."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # sent to a whole group; our parent says when to end
    outbox = Outbox(
        setup.params,
        chunk_voxel=setup.chunk_voxel,
        session=setup.session,
        notices=setup.notices,
        frames=setup.frames,
        chunks=setup.chunks,
    )
    link = Link(commands, updates, outbox)
    session = Session(
        outbox,
        setup.params,
        opener,
        resolve=setup.resolve,
        journals=setup.journals,
    )
    session.handle(SetSpeed(setup.speed))
    session.handle(SetBreakpoints(setup.breakpoints))
    if prepare is not None:

        def progress(name: str, fraction: float) -> None:
            outbox.put(progress=Progress(f"Compiling {name}", fraction))
            link.publish()
            if link.ending:
                sys.exit(0)

        prepare(progress)
        outbox.put(progress=None)
    if setup.recording is not None:
        session.open(setup.recording, setup.truth, play=setup.play)
    wait: float | None = 0.0
    while True:
        for command in link.commands(_sooner(wait, link.publish())):
            if isinstance(command, Shutdown):
                session.close()
                return
            session.handle(command)
        wait = session.work()


def _sooner(a: float | None, b: float | None) -> float | None:
    """The shorter of two waits; None is for ever."""
    return min((wait for wait in (a, b) if wait is not None), default=None)
