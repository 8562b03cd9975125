"""Where numba keeps compiled kernels when it can write neither beside their source nor in the user's cache folder."""

import contextlib
import os
import stat
import tempfile
from collections.abc import MutableMapping
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"


def fall_back(environ: MutableMapping[str, str], package: Path) -> Path | None:
    """Let numba use a temporary folder if it would have none. Call this before numba is imported.

    Args:
        environ: of this process, and so of those that it starts. package: the folder that holds the kernels' source.

    Returns:
        The temporary folder, or None if numba has a folder without it.
    """
    user = Path(environ.get("XDG_CACHE_HOME") or Path(environ.get("HOME", "/")) / ".cache") / "numba"
    if VARIABLE in environ or os.access(package, os.W_OK) or _can_make(user):
        return None
    folder = _private_folder()
    environ[VARIABLE] = str(folder)
    return folder


def _can_make(folder: Path) -> bool:
    existing = next(path for path in (folder, *folder.parents) if os.access(path, os.F_OK))
    return os.access(existing, os.W_OK | os.X_OK)


def _private_folder() -> Path:
    """A folder that only this user can write to, since numba runs what it finds there. The same one at each start."""
    user = os.getuid() if hasattr(os, "getuid") else 0  # as `st_uid` is on Windows
    folder = Path(tempfile.gettempdir()) / f"hemislam-kernels-{user}"
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    if found.st_uid == user and stat.S_ISDIR(found.st_mode) and (os.name == "nt" or not found.st_mode & 0o077):
        return folder
    return Path(tempfile.mkdtemp(prefix="hemislam-kernels-"))
