"""The file of the session that is open, written while it goes on."""

from pathlib import Path

from app.server.delta import Outbox
from app.server.journal import Journal, Opened, State, new_path, size_of
from app.server.protocol import Command
from app.server.run import Run


class Keeper:
    """Begins a session file with every run that is opened, and notes in it what happens.

    Args:
        folder: for the files; None: nothing is kept.
    """

    def __init__(self, outbox: Outbox, folder: Path | None) -> None:
        self._outbox = outbox
        self._folder = folder
        self._journal: Journal | None = None

    def begin(self, run: Run) -> None:
        """Another run is open; a live one has no file, since there is no repeating it."""
        self.close()
        self._outbox.put(journal=None)
        if self._folder is not None and not run.live:
            path = new_path(self._folder, run.opened.path)
            self._journal = Journal(path, opened_of(run))
            self._outbox.put(journal=path)
            if self._journal.error:
                self._outbox.notice("warning", self._journal.error)

    def did(self, run: Run, command: Command) -> None:
        """Note what the user did."""
        if self._journal is not None:
            self._journal.did(run.frame, command)

    def note(self, frame: int, state: State, *, settled: bool = False) -> None:
        """Note where the session stands, see `Journal.note`."""
        if self._journal is not None:
            self._journal.note(frame, state, settled=settled)

    @property
    def keeping(self) -> bool:
        return self._journal is not None

    def close(self) -> None:
        if self._journal is not None:
            self._journal.close()
            self._journal = None


def opened_of(run: Run) -> Opened:
    """What a session file says of where a run comes from."""
    opened = run.opened
    return Opened(opened.path.resolve(), opened.truth and opened.truth.resolve(), *run.part, size_of(opened.path))
