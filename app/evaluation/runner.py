"""Runs jobs side by side, each in a process of its own, with a progress bar for each.

A process a job: its peak memory is the job's own, a crash is one column's, and a parent that is
killed takes its children with it, since they can no longer report to it.
"""

import multiprocessing
import os
import signal
from collections.abc import Iterable
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from time import monotonic
from typing import NoReturn

from tqdm import tqdm

from app.evaluation.job import Job, clear_remains, finished, run_job
from app.slam.errors import HemislamError

REPORT_EVERY_S = 0.2


@dataclass(slots=True)
class _Running:
    job: Job
    process: BaseProcess
    connection: Connection
    slot: int
    bar: "tqdm[NoReturn]"
    error: str = ""


def run_jobs(jobs: list[Job], parallel: int, folder: Path) -> dict[tuple[str, str], str]:
    """Run all that are not finished yet, `parallel` at a time.

    Returns:
        Why runs failed, by (recording, variant); those that are not named are finished.
    """
    clear_remains(folder)
    waiting = []
    for job in jobs:
        if finished(job) is None:
            waiting.append(job)
        else:
            tqdm.write(f"{job.name}, {job.variant}: finished before")
    failures: dict[tuple[str, str], str] = {}
    slots = list(range(parallel))
    running: dict[Connection, _Running] = {}
    try:
        while waiting or running:
            while waiting and slots:
                started = _start(waiting.pop(0), slots.pop(0))
                running[started.connection] = started
            for connection in _ready(running):
                worker = running[connection]
                if _listen(worker):
                    continue
                del running[connection]
                slots.append(worker.slot)
                error = _end(worker)
                if error:
                    failures[worker.job.name, worker.job.variant] = error
                tqdm.write(f"{worker.job.name}, {worker.job.variant}: {error or 'finished'}")
    finally:
        for worker in running.values():
            worker.process.terminate()
            worker.process.join()
            worker.bar.close()
    return failures


def _ready(running: dict[Connection, _Running]) -> Iterable[Connection]:
    return [connection for connection in wait(list(running)) if isinstance(connection, Connection)]


def _start(job: Job, slot: int) -> _Running:
    context = multiprocessing.get_context("spawn")  # a forked OpenMP pool hangs
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(job, theirs), daemon=True)
    process.start()
    theirs.close()
    bar = tqdm(desc=f"{job.name}, {job.variant}", unit=" frames", leave=False, disable=None, position=slot)
    return _Running(job, process, ours, slot, bar)


def _listen(worker: _Running) -> bool:
    """Take in one message; whether more may come."""
    try:
        message = worker.connection.recv()
    except (EOFError, OSError):
        return False
    if isinstance(message, str):
        worker.error = message
    else:
        done, worker.bar.total = message
        worker.bar.update(done - worker.bar.n)
    return True


def _end(worker: _Running) -> str:
    worker.process.join()
    worker.connection.close()
    worker.bar.close()
    if worker.error:
        return worker.error
    if finished(worker.job) is None:
        return f"its process ended before it was done (exit code {worker.process.exitcode})"
    return ""


def _work(job: Job, connection: Connection) -> None:
    """The process of a job."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends it
    last = 0.0

    def progress(done: int, total: int) -> None:
        nonlocal last
        if monotonic() - last > REPORT_EVERY_S or done == total:
            last = monotonic()
            try:
                connection.send((done, total))
            except OSError:
                os._exit(1)  # nobody waits for this any more

    try:
        run_job(job, progress)
    except HemislamError as error:
        connection.send(str(error))
    except OSError as error:
        connection.send(f"results can not be written to {job.folder}: {error.strerror}")
    finally:
        connection.close()
