"""The main loop of the engine's process."""

import time
from collections.abc import Callable
from pathlib import Path

from app.child import Link, LinkClosed
from app.mapping.live import open_live_session
from app.mapping.opening import open_session
from app.mapping.session import Session
from app.server.controller import Controller, OpenSession
from app.server.protocol import ACKNOWLEDGED, LIVE, Command, Progress, SetBreakpoints, SetSpeed
from app.server.publisher import Publisher
from app.server.setup import Setup
from app.slam.params import Params
from app.slam.warmup import compile_kernels

FRAME_PERIOD_S = 0.04
"""s: least period between published frames; answers to the user are published at once."""


class Updates:
    """Publishes deltas to the owner, one at a time, and takes its commands. The engine never waits for it."""

    def __init__(self, owner: Link, page: Publisher) -> None:
        self._owner, self._page = owner, page
        self._acknowledged, self._published = True, 0.0

    def exchange(self, wait: float | None) -> list[Command]:
        """Send the changes if the owner is ready and a delta is due. Returns the commands received.

        Args:
            wait: s to wait for commands if there are none; None: without limit. Shorter if there is something to send.

        Raises:
            LinkClosed: the owner is gone, or asks the engine to end.
        """
        commands = self._receive(0.0)
        if self._acknowledged and self._page.filled:
            due = 0.0 if self._page.urgent else self._published + FRAME_PERIOD_S - time.monotonic()
            if due > 0:
                wait = due if wait is None else min(wait, due)
            else:
                self._published, self._acknowledged = time.monotonic(), False
                self._owner.send(self._page.take())
        return commands or self._receive(wait)

    def _receive(self, wait: float | None) -> list[Command]:
        """All commands received; if there is no message, wait for one."""
        commands = []
        while (message := self._owner.receive(wait)) is not None:
            if message == ACKNOWLEDGED:
                self._acknowledged = True
            else:
                commands.append(message)
            wait = 0.0
        return commands


def main(owner: Link, setup: Setup) -> None:
    """Compile, open the recording, and work until the owner is gone or asks the engine to end."""
    revive = setup.revive

    def opener(path: Path, truth: Path | None, params: Params, part: tuple[float, float | None] | None) -> Session:
        nonlocal revive
        if path == LIVE and setup.live is not None and setup.live_folder is not None:
            take_over, revive = revive, False
            return open_live_session(setup.live, LIVE, params, setup.live_folder, take_over=take_over)
        part = part or ((setup.start_s, setup.duration_s) if path == setup.recording else (0.0, None))
        return open_session(path, params, *part, truth=truth, checkpoint_bytes=setup.checkpoint_bytes)

    run_loop(owner, setup, opener, compile_kernels)


def run_loop(
    owner: Link,
    setup: Setup,
    opener: OpenSession,
    prepare: Callable[[Callable[[str, float], None]], None] | None = None,
) -> None:
    """As `main`, with given functions that open a recording and prepare the engine, reporting (name, fraction)."""
    page = Publisher(setup.params, setup.seen)
    updates = Updates(owner, page)
    controller = Controller(
        page, setup.params, opener, resolve=setup.resolve, session_folder=setup.session_folder, kept=setup.kept
    )
    controller.handle(SetSpeed(setup.speed))
    controller.handle(SetBreakpoints(setup.breakpoints))
    early: list[Command] = []
    if prepare is not None:

        def progress(_: str, fraction: float) -> None:
            page.put(progress=Progress("Preparing the engine, once after installing: about half a minute", fraction))
            early.extend(updates.exchange(0.0))

        prepare(progress)
    page.put(progress=None)
    if setup.recording is not None:
        controller.open(setup.recording, setup.truth, play=setup.play)
    try:
        commands = early + updates.exchange(0.0)
        while True:
            for command in commands:
                controller.handle(command)
            controller.relabel()
            commands = updates.exchange(0.0 if commands else controller.work())  # announce long work to the page first
    except LinkClosed:
        controller.close()
