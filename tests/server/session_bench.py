"""A session on a recording in memory, seen like the page sees it: through snapshots."""

from pathlib import Path

import server_fakes as fakes

from app.mapping.session import Session
from app.server.controller import Controller
from app.server.fold import Fold
from app.server.protocol import Command, Snapshot
from app.server.publisher import Publisher
from app.slam.params import Params


class Bench:
    """A session, its clock, and the page's view of it."""

    def __init__(self, recording: str | None = "walk-60.mcap", truth: Path | None = None, **kwargs: object) -> None:
        self.now = 0.0
        self.sessions: list[Session] = []
        self.page = Publisher(Params())
        self.fold = Fold()
        self.controller = Controller(self.page, Params(), self._open, clock=lambda: self.now, **kwargs)  # type: ignore[arg-type]
        if recording:
            self.controller.open(Path(recording), truth)
            self.settle()

    def _open(self, path: Path, truth: Path | None, params: Params, part: object = None, /) -> Session:
        self.sessions.append(fakes.open_fake(path, truth, params))
        return self.sessions[-1]

    def settle(self, limit: int = 1000) -> Snapshot:
        """Work until nothing is due at this moment."""
        for _ in range(limit):
            if self.controller.work() != 0:
                break
        else:
            raise AssertionError("still busy")
        return self.see()

    def see(self) -> Snapshot:
        if self.page.filled:
            self.fold.apply(self.page.take())
        return self.fold.snapshot

    def do(self, *commands: Command) -> Snapshot:
        for command in commands:
            self.controller.handle(command)
        return self.settle()

    def pass_time(self, seconds: float, step: float = 0.01) -> Snapshot:
        for _ in range(round(seconds / step)):
            self.now += step
            self.settle()
        return self.see()


def last_notice(snapshot: Snapshot) -> str:
    return snapshot.notices[-1].text
