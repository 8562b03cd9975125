"""Files that this program writes: free names, tables as CSV, and text files that are complete or absent."""

import contextlib
import csv
import io
import itertools
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from app.slam.errors import HemislamError

_LONGEST = 180
"""Most bytes of a name that will be extended; file systems allow 255."""


def csv_text(*rows: Iterable[object]) -> str:
    """Rows as CSV, the heading first."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def free_path(stem: Path, suffix: str = "", *, always_numbered: bool = False) -> Path:
    """The first of STEM, STEM-2, STEM-3, ... that does not exist, with the suffix. always_numbered: from STEM-1 on."""
    names = (f"-{number}" if number > 1 or always_numbered else "" for number in itertools.count(1))
    return next(path for name in names if not (path := stem.with_name(f"{stem.name}{name}{suffix}")).exists())


def beside(recording: Path, ending: str) -> Path:
    """The path of a file beside a recording: its name, without the suffix of a file, and this ending."""
    recording = named(recording)
    name = recording.name if recording.is_dir() else recording.stem
    return recording.parent / f"{name}{ending}"


def named(path: Path) -> Path:
    """This path; absolute if its end is no name, as in `.` and `..`."""
    return path.resolve() if path.name in ("", "..") else path


def shortened(name: str) -> str:
    """A name, cut at its end if it is so long that a file name would have no room for an extension."""
    while len(os.fsencode(name)) > _LONGEST:
        name = name[:-1]
    return name


def is_file(path: Path) -> bool:
    """Whether this file exists; false if its name is too long for the file system."""
    with contextlib.suppress(OSError):
        return path.is_file()
    return False


def make_folder(folder: Path) -> list[Path]:
    """Make a folder and return all folders that had to be made, itself first. Raises HemislamError if that fails."""
    try:
        new = [one for one in (folder, *folder.parents) if not one.exists()]
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise HemislamError(f"The folder {folder} cannot be made: {error.strerror}; choose another one.") from None
    return new


def write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Write files by name; older ones stay until all are complete. Raises HemislamError: they cannot be written."""
    parts = {name: folder / f".{name}.part" for name in texts}
    try:
        for name, part in parts.items():
            part.write_text(texts[name], encoding="utf-8", errors="backslashreplace")  # a path need not be UTF-8
        for name, part in parts.items():
            part.replace(folder / name)
    except OSError as error:
        for part in parts.values():
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
        raise HemislamError(f"{', '.join(texts)} cannot be written to {folder}: {error.strerror}.") from error
