"""Runs jobs in parallel, each in a process of its own, with a progress bar for each and one for all.

With a process per job, the peak memory is that of the job alone, and a crash costs only one column.
"""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from time import monotonic
from typing import NoReturn

from tqdm import tqdm

from app.child import Child, ChildDied, Link
from app.evaluation.job import Job, finished
from app.evaluation.run_job import run_job
from app.slam.errors import HemislamError

REPORT_EVERY_S = 0.2
tqdm.set_lock(threading.RLock())  # the default, a semaphore, would outlive a kill


RunJobs = Callable[[list[Job]], dict[tuple[str, str], str]]
"""Runs jobs on this machine or on a cluster."""


def run_jobs(
    jobs: list[Job],
    *,
    parallel: int,
    quiet: bool = False,
    ended: Callable[[bool], None] = lambda ran: None,
) -> dict[tuple[str, str], str]:
    """Run all jobs that are not finished yet, `parallel` at a time.

    Args:
        quiet: print nothing. ended: called for each job that has ended, with whether it ran now or had finished before.

    Returns:
        Why jobs failed, by (recording, variant); all others are finished.
    """
    todo = [job for job in jobs if finished(job) is None]
    before = len(jobs) - len(todo)
    for _ in range(before):
        ended(False)
    if before and not quiet:
        tqdm.write(f"{before} of {len(jobs)} runs were finished before")
    stop, errors = threading.Event(), dict[tuple[str, str], str]()
    every = tqdm(
        desc="All runs", total=len(jobs), initial=before, unit=" runs", smoothing=0, disable=quiet or None
    )  # smoothing 0: the time left is estimated from the mean of all runs
    with every, ThreadPoolExecutor(parallel) as pool:
        try:
            running = {pool.submit(_run, stop, quiet, job): job for job in todo}
            for future in as_completed(running):
                if error := future.result():
                    errors[running[future].name, running[future].variant] = error
                every.update()
                ended(True)
        except BaseException:  # Ctrl-C
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return errors


def _run(stop: threading.Event, quiet: bool, job: Job) -> str:
    """Run a job in a process until it ends or `stop` is set. Returns why it failed, "" if it did not."""
    title, error = f"{job.name}, {job.variant}", ""
    child = Child(_work, job, name="job", title="Its process", fork=True, grace_s=0.0)
    bar: tqdm[NoReturn]
    with tqdm(desc=title, unit=" frames", leave=False, disable=quiet or None) as bar:
        try:
            while not stop.is_set():
                message = child.receive(REPORT_EVERY_S)
                if isinstance(message, str):
                    error = message
                elif message is not None:
                    done, bar.total = message
                    bar.update(done - bar.n)
        except ChildDied as death:
            if not error and finished(job) is None:
                error = str(death)
        finally:
            child.close()
    if not quiet:
        tqdm.write(f"{title}: {error or 'finished'}")
    return error


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
