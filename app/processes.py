"""How the program starts further processes of its own: as forks of one that has imported already, where it can.

Importing the engine takes as long as all the rest of its start. Where the system can fork, one process imports it
once, before anybody waits, and does nothing else from then on; those who are started are its copies and share what
was imported. It runs nothing on several threads, since a copy of a pool of threads hangs.
"""

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import ForkServerContext, SpawnContext
from pathlib import Path
from typing import Final

IMPORTED: Final = ("app.server.engine_process", "app.nursery")
"""By the process that is forked. The receiver of live data needs a part of the same."""


def context() -> ForkServerContext | SpawnContext:
    """Of multiprocessing, with which to start processes that must begin soon.

    The process that is forked begins with the first call, and has the environment of then. Returns at once.
    """
    if sys.platform != "linux":  # macOS can not fork what has used its frameworks
        return multiprocessing.get_context("spawn")
    forking = multiprocessing.get_context("forkserver")
    forking.set_forkserver_preload(list(IMPORTED))
    with sigint_blocked():
        forkserver.ensure_running()
    return forking


@contextlib.contextmanager
def sigint_blocked() -> Iterator[None]:
    """A process started meanwhile does not see Ctrl-C, not even while it is still importing.

    The terminal sends it to all processes of the foreground; ours is told to end by its parent.
    """
    if os.name != "posix":
        yield
        return
    resource_tracker.ensure_running()  # its start, else a part of the process's, would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def begin(name: str) -> None:
    """To be called first by a process that was started: it shows its name, and what it starts is no copy of it.

    numba then needs no semaphore either, which would outlive it when it is killed.
    """
    multiprocessing.set_start_method("spawn", force=True)
    show_as(name)


def show_as(name: str) -> None:
    """Have `ps` and `top` show this process by a name of at most 15 characters; does nothing but on Linux."""
    with contextlib.suppress(OSError):
        Path("/proc/self/comm").write_text(name, encoding="ascii")
