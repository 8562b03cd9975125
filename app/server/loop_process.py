"""The loop back end in a process of its own, beside the frame loop, which it never keeps waiting.

It is a plain subprocess, since the engine's process, which owns it, is a daemon of multiprocessing
and may have no children of that kind. Requests are written by a thread and replies read by another,
so that neither sending a keyframe nor a late reader makes anyone wait. When the owner dies, the
pipe for requests ends and the process ends itself.
"""

import os
import queue
import subprocess
import sys
import threading
from dataclasses import replace
from multiprocessing.connection import Connection, Pipe
from typing import Final

from app import processes
from app.logs import process_logs
from app.server import wire
from app.server.edges import EdgesChange, EdgesReceiver, EdgesSender
from app.slam.loops.messages import LoopState, LoopWorkerDied, Reply, Request

NICENESS: Final = 10
"""The frame loop comes first."""
_ALONE: Final = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "NUMBA", "OPENBLAS", "MKL")}
"""More threads would fight the frame loop's for the cores."""


class LoopProcess:
    """A `LoopClient` whose back end lives in a process of its own. Used by one thread."""

    def __init__(self) -> None:
        requests_in, self._requests = Pipe(duplex=False)
        replies_in, replies_out = Pipe(duplex=False)
        wire.widen(self._requests)
        wire.widen(replies_out)
        ends = (requests_in.fileno(), replies_out.fileno())
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, *map(str, ends)],
            pass_fds=ends,
            stdin=subprocess.DEVNULL,
            env={**os.environ, **_ALONE, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
            process_group=0,  # Ctrl-C goes to all of the terminal's group; this one is ended by its owner
        )
        requests_in.close()
        replies_out.close()
        self._unsent: queue.SimpleQueue[Request | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[Reply | None] = queue.SimpleQueue()  # None: there will be no more
        self._pending, self._ended = 0, False
        self._threads = [
            threading.Thread(target=self._write, name="loop requests", daemon=True),
            threading.Thread(target=self._read, args=(replies_in,), name="loop replies", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def pending(self) -> int:
        """Requests whose replies were not received yet."""
        return self._pending

    def send(self, request: Request) -> None:
        """Hand a request over; its arrays must not change any more. Never waits, not even if the process is dead."""
        self._pending += 1
        self._unsent.put(request)

    def receive(self, timeout: float | None = None) -> Reply | None:
        """The answer to the oldest request that has none yet; None if there is none within the time (s).

        None at once if nothing is pending; `timeout` None waits as long as it takes.

        Raises:
            LoopWorkerDied: it will never come.
        """
        if not self._pending:
            return None
        if self._ended:
            raise self._death()
        try:
            reply = self._answers.get(timeout=timeout)
        except queue.Empty:
            return None
        if reply is None:
            self._ended = True
            raise self._death()
        self._pending -= 1
        return reply

    def close(self) -> None:
        """End the process; pending requests are dropped."""
        self._process.kill()  # it has nothing that outlives it
        self._process.wait()
        self._unsent.put(None)
        for thread in self._threads:
            thread.join()
        self._pending, self._ended = 0, True

    def _death(self) -> LoopWorkerDied:
        code = self._process.wait()
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        return LoopWorkerDied(f"The process that looks for loops has ended unexpectedly ({how}).")

    def _write(self) -> None:
        with self._requests:
            while (request := self._unsent.get()) is not None:
                try:
                    wire.send(self._requests, request)
                except OSError:  # it has ended; the reader says so
                    return

    def _read(self, replies: "Connection[object, object]") -> None:
        edges = EdgesReceiver()

        def whole(reply: Reply, change: EdgesChange | None) -> Reply:
            if not isinstance(reply, LoopState) or change is None:
                return reply
            edges.take(change)
            return replace(reply, edges=edges.edges)

        with replies:
            try:
                while True:
                    self._answers.put(whole(*wire.receive(replies)))
            except (EOFError, OSError):
                self._answers.put(None)


def main() -> None:
    """The process: answers until the pipe for requests, whose file descriptors it is given, ends."""
    requests: Connection[object, object] = Connection(int(sys.argv[1]), writable=False)
    replies: Connection[object, object] = Connection(int(sys.argv[2]), readable=False)
    processes.begin("hemislam-loops")
    os.nice(NICENESS)
    from app.slam.loops.service import LoopService  # the owner has no need of the solver
    from app.slam.loops.warmup import warm_up

    warm_up()
    service = LoopService()
    edges = EdgesSender()

    def answer(request: Request) -> tuple[Reply, EdgesChange | None]:
        reply = service.handle(request)
        if not isinstance(reply, LoopState):
            return reply, None
        return replace(reply, edges=()), edges.change(reply.edges)

    try:
        while True:
            wire.send(replies, answer(wire.receive(requests)))
    except (EOFError, OSError):  # the owner has gone, or wants no more
        return


if __name__ == "__main__":
    with process_logs("loops"):
        main()
