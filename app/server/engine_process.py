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
"""Frames are published no more often than this; answers to the user at once."""


class Updates:
    """Publishes deltas to the owner, one at a time, and takes its commands. The engine never waits for the owner.

    All methods raise `LinkClosed` when the owner is gone or asks the engine to end.
    """

    def __init__(self, owner: Link, page: Publisher) -> None:
        self._owner, self._page = owner, page
        self._inbox: list[Command] = []
        self._acknowledged = True
        self._published = 0.0

    def publish(self) -> float | None:
        """Send what changed, if the owner is ready and it is time.

        Returns:
            Seconds until there is something to publish; None if there is nothing or the owner is not ready, in which
            case its acknowledgement wakes `commands`.
        """
        self._receive(0.0)
        if not self._acknowledged or not self._page.filled:
            return None
        wait = 0.0 if self._page.urgent else self._published + FRAME_PERIOD_S - time.monotonic()
        if wait > 0:
            return wait
        self._published = time.monotonic()
        self._acknowledged = False
        self._owner.send(self._page.take())
        return None

    def commands(self, wait: float | None) -> list[Command]:
        """Commands that have come; if nothing has, waits up to so many seconds (None: without a limit)."""
        self._receive(0.0 if self._inbox else wait)
        commands, self._inbox = self._inbox, []
        return commands

    def _receive(self, wait: float | None) -> None:
        """Take in all messages that have come; if none has, wait for one."""
        while (message := self._owner.receive(wait)) is not None:
            if message == ACKNOWLEDGED:
                self._acknowledged = True
            else:
                self._inbox.append(message)
            wait = 0.0


def main(owner: Link, setup: Setup) -> None:
    """Compile, open the recording, and work until the owner asks to end or is gone."""
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
    """As `main`, with the function that opens a recording and one that prepares it, reporting (name, fraction)."""
    seen = {name: getattr(setup, name) for name in ("session", "notices", "frames", "chunks")}
    page = Publisher(setup.params, **seen)
    updates = Updates(owner, page)
    controller = Controller(page, setup.params, opener, resolve=setup.resolve, session_folder=setup.session_folder)
    controller.handle(SetSpeed(setup.speed))
    controller.handle(SetBreakpoints(setup.breakpoints))
    if prepare is not None:

        def progress(name: str, fraction: float) -> None:
            page.put(progress=Progress(f"Compiling {name}", fraction))
            updates.publish()

        prepare(progress)
        page.put(progress=None)
    if setup.recording is not None:
        controller.open(setup.recording, setup.truth, play=setup.play)
    wait: float | None = 0.0
    try:
        while True:
            waits = [seconds for seconds in (wait, updates.publish()) if seconds is not None]
            for command in updates.commands(min(waits, default=None)):
                controller.handle(command)
            wait = controller.work()
    except LinkClosed:
        controller.close()
