"""The part of the disk that the page may see."""

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from app.mapping.session_file import SUFFIX, SavedSession, read_session, session_files
from app.sensors.source import SUFFIXES
from app.slam.errors import HemislamError

RECORDINGS = (*SUFFIXES, SUFFIX)
"""Files that can be opened, session files included. A ROS 2 folder can be opened too."""
TRAJECTORIES = (".tum",)
_RECENT = 20


@dataclass(frozen=True, slots=True)
class FolderEntry:
    """A line of the file browser: a file to choose, with its size in bytes, or a folder to look into.

    outside: the line is a link to a file outside the folders, which cannot be opened.
    """

    path: Path
    is_choice: bool
    size: int = 0
    outside: bool = False


class Folders:
    """Folders given on the command line. Nothing outside is listed or opened, not even through links.

    Raises:
        HemislamError: one of them is not a folder.
    """

    def __init__(self, roots: Iterable[Path]) -> None:
        self.roots = tuple(dict.fromkeys(root.resolve() for root in roots))
        for root in self.roots:
            if not root.is_dir():
                raise HemislamError(f"{root} is not a folder; give a folder that holds recordings.")

    def and_also(self, folder: Path) -> "Folders":
        """These folders and one more, if it exists."""
        return Folders((*self.roots, folder)) if folder.is_dir() else self

    def inside(self, path: Path | str) -> Path:
        """The real path of `path`, which is relative to the first folder if it is not absolute.

        Raises:
            HemislamError: it does not exist or lies outside; the message does not say which.
        """
        try:
            real = (self.roots[0] / path if self.roots else Path(path)).resolve(strict=True)
        except (OSError, RuntimeError, ValueError):
            real = None
        if real is None or not self._holds(real):
            raise HemislamError(
                f"There is no {path} in the folders that hemislam may open; start it with --folder to add one."
            )
        return real

    def openable(self, path: Path | str) -> Path:
        """As `inside`. Files that a session file reads must be inside too. Raises as `inside`."""
        real = self.inside(path)
        if real.suffix == SUFFIX:
            session = read_session(real)
            self.inside(session.opened.recording)
            if session.state.survey is not None and session.state.survey.gnss is not None:
                self.inside(session.state.survey.gnss)
        return real

    def listing(self, folder: Path | str, suffixes: tuple[str, ...] = RECORDINGS) -> list[FolderEntry]:
        """The contents of a folder inside: first folders, then files that may be chosen, each sorted by name.

        Unreadable entries and dangling links are left out.

        Raises:
            HemislamError: as `inside`, or the folder cannot be read.
        """
        place = self.inside(folder)
        try:
            seen = [path for path in place.iterdir() if not path.name.startswith(".")]
            found = [entry for path in seen if (entry := self._entry(path, suffixes))]
        except OSError as error:
            raise HemislamError(f"The folder {place} cannot be read: {error.strerror}.") from None
        return sorted(found, key=lambda entry: (entry.is_choice, entry.path.name.casefold()))

    def sessions(self, kept: Path) -> list[tuple[Path, SavedSession]]:
        """The newest session files in a folder, newest first, if they have begun and their recording is inside."""
        found = []
        for path in session_files(kept)[:_RECENT]:
            try:
                saved = read_session(path)
                self.inside(saved.opened.recording)
            except HemislamError:
                continue
            if saved.known > 0:
                found.append((path, saved))
        return found

    def recordings(self) -> list[Path]:
        """All recordings below all folders that can be read, sorted by path."""
        found: list[Path] = []
        waiting = list(self.roots)
        seen = set(waiting)
        while waiting:
            with contextlib.suppress(HemislamError):
                for entry in self.listing(waiting.pop()):
                    if entry.is_choice:
                        found.append(entry.path)
                    elif not entry.outside and (real := entry.path.resolve()) not in seen:
                        seen.add(real)
                        waiting.append(real)
        return sorted(set(found))

    def _holds(self, real: Path) -> bool:
        return any(real.is_relative_to(root) for root in self.roots)

    def _entry(self, path: Path, suffixes: tuple[str, ...]) -> FolderEntry | None:
        with contextlib.suppress(OSError, RuntimeError):  # a folder of another user; a link to itself
            if not self._holds(path.resolve()):
                return FolderEntry(path, False, outside=True) if path.suffix in suffixes else None
            if path.is_dir():
                is_recording = suffixes == RECORDINGS and (path / "metadata.yaml").is_file()
                size = sum(file.stat().st_size for file in path.iterdir() if file.is_file()) if is_recording else 0
                return FolderEntry(path, is_recording, size)
            if path.suffix.lower() in suffixes and path.is_file():
                return FolderEntry(path, True, path.stat().st_size)
        return None
