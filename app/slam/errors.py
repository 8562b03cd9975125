"""The one error class whose messages are written for users."""

import shlex
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LONGEST = 2000


def printable(text: str) -> str:
    """A text from outside, with characters that would drive a terminal or break the line shown as escapes."""
    if text.isprintable():
        return text
    return "".join(one if one.isprintable() else one.encode("unicode_escape").decode() for one in text)


def quoted(path: Path) -> str:
    """A path as a shell takes it, for a command in a message."""
    return shlex.quote(str(path))


def refusal(error: OSError) -> str:
    """An error of the operating system, as a sentence."""
    where = f" ({error.filename})" if error.filename else ""
    return f"The system refused: {error.strerror or error}{where}; check space, permissions and limits (ulimit -a)."


@contextmanager
def writing_to(path: Path | None) -> Iterator[None]:
    """Name the file or folder, or the folder of temporary files if None, in errors of writing that name none."""
    try:
        yield
    except OSError as error:
        temporary = f"{tempfile.gettempdir()}, for temporary files; TMPDIR chooses another folder"
        error.filename = error.filename or (temporary if path is None else str(path))
        raise


class HemislamError(Exception):
    """Something that the user gave cannot be used.

    The message is one sentence that says what is wrong, where, and what to do. The command line
    prints it and exits with code 2; the page shows it as a notification and the session goes on.
    Control characters in it are escaped, and a long message is cut in the middle.
    """

    def __init__(self, sentence: str) -> None:
        shown = printable(sentence)
        super().__init__(shown if len(shown) <= LONGEST else f"{shown[: LONGEST - 300]} … {shown[-300:]}")
