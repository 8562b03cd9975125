"""Runs jobs side by side, each in a process of its own, with a progress bar for each.

With a process for each job, its peak memory is its own, and a crash costs one column only.
"""

from collections.abc import Iterator
from pathlib import Path
from time import monotonic
from typing import NoReturn

from tqdm import tqdm

from app.child import Child, ChildDied, Link
from app.evaluation.job import Job, clear_remains, finished, run_job
from app.slam.errors import HemislamError

REPORT_EVERY_S = 0.2
_POLL_S = 0.02


class _Running:
    """A job at work. slot: the line of its progress bar."""

    def __init__(self, job: Job, slot: int) -> None:
        self.job, self.slot = job, slot
        self.error = ""
        self._child = Child(_work, job, name="job", title="Its process", grace_s=0.0)
        self._bar: tqdm[NoReturn] = tqdm(
            desc=f"{job.name}, {job.variant}", unit=" frames", leave=False, disable=None, position=slot
        )

    def ended(self) -> bool:
        """Show how far it is. Returns whether it has ended, `error` being why it failed."""
        try:
            message = self._child.receive(_POLL_S)
        except ChildDied as death:
            if not self.error and finished(self.job) is None:
                self.error = str(death)
            self.close()
            return True
        if isinstance(message, str):
            self.error = message
        elif message is not None:
            done, self._bar.total = message
            self._bar.update(done - self._bar.n)
        return False

    def close(self) -> None:
        self._child.close()
        self._bar.close()


def run_jobs(jobs: list[Job], parallel: int, folder: Path) -> dict[tuple[str, str], str]:
    """Run all jobs that are not finished yet, `parallel` at a time.

    Returns:
        Why jobs failed, by (recording, variant); those not named are finished.
    """
    clear_remains(folder)
    waiting = iter([job for job in jobs if not _finished_before(job)])
    failures: dict[tuple[str, str], str] = {}
    running: list[_Running] = []
    try:
        running += _started(waiting, range(parallel))
        while running:
            for one in [one for one in running if one.ended()]:
                if one.error:
                    failures[one.job.name, one.job.variant] = one.error
                tqdm.write(f"{one.job.name}, {one.job.variant}: {one.error or 'finished'}")
                running.remove(one)
                running += _started(waiting, [one.slot])
    finally:
        for one in running:
            one.close()
    return failures


def _finished_before(job: Job) -> bool:
    if finished(job) is None:
        return False
    tqdm.write(f"{job.name}, {job.variant}: finished before")
    return True


def _started(waiting: Iterator[Job], slots: "list[int] | range") -> Iterator[_Running]:
    for slot, job in zip(slots, waiting, strict=False):
        yield _Running(job, slot)


def _work(owner: Link, job: Job) -> None:
    """The process of a job."""
    last = 0.0

    def progress(done: int, total: int) -> None:
        nonlocal last
        if monotonic() - last > REPORT_EVERY_S or done == total:
            last = monotonic()
            owner.send((done, total))

    try:
        run_job(job, progress)
    except HemislamError as error:
        owner.send(str(error))
    except OSError as error:
        owner.send(f"results cannot be written to {job.folder}: {error.strerror}")
