"""Recordings dropped on the page: they arrive in pieces, each within the size limit of a request."""

import glob
import shutil
from pathlib import Path
from typing import Final

from app.server.folders import RECORDINGS, TRAJECTORIES, Folders
from app.slam.errors import HemislamError

SUFFIXES: Final = (*RECORDINGS, *TRAJECTORIES, ".yaml", ".json")
"""Suffixes of recordings and sessions, and of files that belong to them: truth, parameters, an Ouster's metadata."""
_LONGEST_NAME: Final = 200
"""Most bytes of a name; with our additions, it must stay within the 255 bytes that file systems allow."""
_LEFT_FREE: Final = 1 << 30
"""Bytes on the disk that uploads leave free."""


def receive(folders: Folders, name: str, offset: int, size: int, piece: bytes, copy: str = "") -> None:
    """Append a piece to a file in the first folder. After the last piece, the file gets its final name.

    Args:
        offset: bytes that came before. size: of the whole file, bytes.
        copy: identifies this copy among others of the same name. The copy that began last continues.

    Raises:
        HemislamError: the name or the size is not allowed, a piece is missing, or the file cannot be written.
    """
    there = _place(folders, name)
    if there.exists() or there.is_symlink():
        raise HemislamError(f"{name} is in {there.parent} already; open it there, or rename the one that you drop.")
    if offset + len(piece) > size:
        raise HemislamError(f"{name} has grown while it was copied; drop it again when it is complete.")
    part = there.with_name(f".{name}.{copy}.part")  # names that begin with a dot are not listed
    try:
        if offset == 0:
            if shutil.disk_usage(there.parent).free < size + _LEFT_FREE:
                raise HemislamError(f"{name} does not fit on the disk of {there.parent}; make room there.")
            discard(folders, name)
        elif not part.exists() or part.stat().st_size != offset:
            raise HemislamError(f"A piece of {name} is missing; drop it again.")
        with part.open("ab") as file:
            file.write(piece)
        if offset + len(piece) == size:
            part.rename(there)
    except OSError as error:
        raise HemislamError(f"{name} cannot be written to {there.parent}: {error.strerror}.") from None


def discard(folders: Folders, name: str) -> None:
    """Remove the pieces of an incomplete file. Raises HemislamError as `receive` does."""
    there = _place(folders, name)
    for part in there.parent.glob(f".{glob.escape(name)}.*.part"):
        part.unlink(missing_ok=True)


def _place(folders: Folders, name: str) -> Path:
    if Path(name).name != name or name.startswith(".") or not name.isprintable() or len(name.encode()) > _LONGEST_NAME:
        raise HemislamError("The file needs an ordinary name; rename it.")
    if not name.lower().endswith(SUFFIXES):
        raise HemislamError(f"{name} is no recording; drop a file that ends in {', '.join(RECORDINGS)}.")
    if not folders.roots:
        raise HemislamError("There is no folder to copy to; start hemislam with --folder.")
    return folders.roots[0] / name
