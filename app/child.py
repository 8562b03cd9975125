"""One way to run a function in a process of its own.

The owner makes a `Child`; the function there gets a `Link` to its owner. Both send without waiting and receive with a
timeout. Children ignore SIGINT and SIGTERM, which terminals send to all processes of a group: the first process of the
program ends its children in order. A child whose owner dies ends by itself.
"""

import atexit
import contextlib
import gc
import logging
import math
import multiprocessing
import os
import pickle
import queue
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, SpawnContext
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from app.logs import process_logs
from app.slam.errors import HemislamError

GRACE_S: Final = 10.0
"""How long a child may take to finish its work after its owner died or asked it to end."""
_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
_END: Final = object()
"""Sent as an empty message, the last one."""

log = logging.getLogger(__name__)


class LinkClosed(Exception):
    """No more messages will come: the other end is gone, or asks this one to end."""


class ChildDied(HemislamError):
    """A child has ended although its owner did not ask it to.

    Attributes:
        how: "signal 9, SIGKILL" or "exit code 1". exit_code: as in `multiprocessing.Process`.
    """

    def __init__(self, title: str, exit_code: int) -> None:
        self.exit_code = exit_code
        self.how = f"exit code {exit_code}"
        if exit_code < 0:
            known = {member.value: member.name for member in signal.Signals}
            self.how = f"signal {-exit_code}, {known.get(-exit_code, 'unknown')}"
        super().__init__(f"{title} ended unexpectedly ({self.how}).")


class RestartLimit:
    """A child that dies may be started again `most` times within any `within_s` seconds."""

    def __init__(self, most: int, within_s: float = math.inf) -> None:
        self.most = most
        self._within_s = within_s
        self._deaths: deque[float] = deque(maxlen=most + 1)

    def allows(self) -> bool:
        """Count one death, now. Returns whether the child may be started again."""
        self._deaths.append(time.monotonic())
        return len(self._deaths) <= self.most or self._deaths[-1] - self._deaths[0] >= self._within_s


def put(connection: "Connection[Any, Any]", message: object) -> None:
    """Send a message to `take`, which leaves read-only arrays read-only, unlike the connection's own method."""
    connection.send_bytes(pickle.dumps(message, protocol=5))


def take(connection: "Connection[Any, Any]") -> Any:
    """Wait for the next message of `put`. Raises EOFError or OSError: the other end is gone."""
    return pickle.loads(connection.recv_bytes())


class Link:
    """One end of the connection between an owner and its child. Any thread may send; one at a time may receive."""

    def __init__(self, connection: "Connection[Any, Any]") -> None:
        self._connection = connection
        self._unsent: queue.SimpleQueue[object] = queue.SimpleQueue()
        self._writer = threading.Thread(target=self._write, name="messages", daemon=True)
        self._writer.start()

    def send(self, message: object) -> None:
        """Send a message, which must not change any more. Never waits; lost if the other end is gone."""
        self._unsent.put(message)

    def receive(self, timeout: float | None = None) -> Any:
        """The next message; None if none comes within the time (s). Arrays that were read-only still are.

        Raises:
            LinkClosed: there will be none.
        """
        try:
            if not self._connection.poll(timeout):
                return None
            packed = self._connection.recv_bytes()
        except (EOFError, OSError):
            raise LinkClosed from None
        if not packed:
            raise LinkClosed
        return pickle.loads(packed)

    def close(self) -> None:
        """Have the other end's `receive` raise `LinkClosed` after the last message."""
        self._unsent.put(_END)

    def flush(self) -> None:
        """After `close`, wait until the other end has received everything, or is gone."""
        self._writer.join()

    def _write(self) -> None:
        try:
            while (message := self._unsent.get()) is not _END:
                put(self._connection, message)
            self._connection.send_bytes(b"")
        except OSError:
            pass  # the other end is gone, which `receive` reports
        except BaseException:
            log.critical("A message cannot be sent", exc_info=True)
            if multiprocessing.parent_process() is not None:
                os._exit(1)  # the owner reports it


class Child(Link):
    """The owner's end of a link to a function that runs in a process of its own. It ends with its owner at the latest.

    Args:
        main: called there with a `Link` and `args`, all picklable. It ends by returning, or by `LinkClosed`.
        name: for `ps` ("hemislam-NAME", 15 characters) and the log. title: for messages.
        fork: fork a process that has imported what the first such child needs, which takes 20 ms, where possible; else
            a new interpreter starts.
        grace_s: how long it may go on working when its owner dies or asks it to end.
    """

    def __init__(
        self,
        main: Callable[..., None],
        *args: Any,
        name: str,
        title: str,
        fork: bool = False,
        grace_s: float = GRACE_S,
    ) -> None:
        context = fork_context(main.__module__) if fork else multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        call = pickle.dumps((main, args))  # to be loaded there, since that may import much
        self._process = context.Process(target=_run, args=(theirs, name, grace_s, call))
        with _signals_blocked(), _main_hidden():
            self._process.start()
        theirs.close()
        super().__init__(ours)
        self._title, self._grace_s = title, grace_s
        self._reaping = threading.Lock()
        _owned.add(self)

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    def receive(self, timeout: float | None = None) -> Any:
        """As `Link.receive`, but raises `ChildDied` if no message will come."""
        try:
            return super().receive(timeout)
        except LinkClosed:
            raise ChildDied(self._title, self._exit_code()) from None

    def news(self) -> Any:
        """The next message if one has come, else None; if the child has died, why, in words."""
        try:
            return self.receive(0.0)
        except ChildDied as death:
            return str(death)

    def close(self, timeout: float | None = None) -> None:
        """Ask the child to end; kill it if it has not ended after the time (s; None: its grace), or at once if 0."""
        super().close()
        if not wait([self._process.sentinel], self._grace_s if timeout is None else timeout):
            self._process.kill()
        self._exit_code()

    def _exit_code(self) -> int:
        super().close()  # whoever sends to it has nothing to do any more
        wait([self._process.sentinel])
        with self._reaping:  # the exit code can be read only once
            self._process.join()
            _owned.discard(self)
            return self._process.exitcode or 0


_owned: set[Child] = set()


@atexit.register
def _end_children() -> None:
    """End the children that are left; multiprocessing would wait for them without a limit."""
    for child in tuple(_owned):
        child.close()


def _run(connection: "Connection[Any, Any]", name: str, grace_s: float, call: bytes) -> None:
    """The process."""
    gc.freeze()  # else its garbage collector writes to the pages of what the fork server imported, which forks share
    gc.enable()
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    multiprocessing.set_start_method("spawn", force=True)  # so that numba makes no semaphore, which a kill would leak
    show_as(f"hemislam-{name}")
    threading.Thread(target=_end_with_owner, args=(grace_s,), name="owner", daemon=True).start()
    owner = Link(connection)
    with process_logs(name):
        try:
            main, args = pickle.loads(call)
            with contextlib.suppress(LinkClosed):
                main(owner, *args)
        finally:
            _end_children()
            owner.close()
            owner.flush()


def _end_with_owner(grace_s: float) -> None:
    owner = multiprocessing.parent_process()
    assert owner is not None
    owner.join()
    time.sleep(grace_s)
    os._exit(1)


def fork_context(module: str) -> ForkServerContext | SpawnContext:
    """The context of `multiprocessing` that forks a process that has imported a module, where possible.

    The first call starts that process and returns at once; of later calls the module does not matter. It has a single
    thread, since forks of thread pools hang.
    """
    if sys.platform != "linux":  # macOS cannot fork a process that has used its frameworks
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["app.fork_server", module])
    with _signals_blocked(), _main_hidden():
        forkserver.ensure_running()
    return context


@contextlib.contextmanager
def _signals_blocked() -> Iterator[None]:
    """A process started meanwhile never sees SIGINT and SIGTERM: it inherits the mask."""
    if os.name != "posix":
        yield
        return
    resource_tracker.ensure_running()  # its start unblocks them
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_hiding = threading.Lock()


@contextlib.contextmanager
def _main_hidden() -> Iterator[None]:
    """A process started meanwhile does not run the owner's script, which so needs no `if __name__ == "__main__"`."""
    with _hiding:
        script = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = script


def show_as(name: str) -> None:
    """Have `ps` and `top` show this process by a name of at most 15 characters; does nothing except on Linux."""
    with contextlib.suppress(OSError):
        Path("/proc/self/comm").write_text(name, encoding="ascii")
