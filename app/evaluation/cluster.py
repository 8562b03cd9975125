"""Runs jobs on an existing Dask cluster (https://distributed.dask.org). Its scheduler and workers are the user's.

A worker runs a job in a folder of its own and sends the files back; they are written here, as if the job had run here.
A worker reads a recording from its original path if it can, else from an fsspec URL; else it gets a copy.

A job is given to one idle worker, not to the cluster as a whole. So workers may join at any time, and the version and
the recording of each worker are checked before it gets work.
"""

import contextlib
import logging
import math
import os
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from tqdm import tqdm

from app import __version__
from app.evaluation.job import RUN_FILES, Job, code_digest, finished, reopen
from app.evaluation.run_job import run_job
from app.slam.errors import HemislamError
from app.slam.provenance import hash_input

CONNECT_S = 15.0
LOOK_S = 0.5
"""How often to check whether workers have joined or left."""
TAKE_S = 20.0
"""How long a worker may take to hand over the files of a run. A dead worker never does."""
PIECE = 16 << 20
"""Bytes of a recording that are sent at a time."""
PATIENCE_S = 120.0
"""How long to wait for the return of a scheduler or of workers that are gone."""
MOST_DEATHS = 3
"""A job is given up after this many workers died while running it."""
_NO_WORKERS = "The Dask cluster has no workers; start some with `dask worker ADDRESS --nthreads 1`."


class _Gone(Exception):
    """The scheduler or all workers are gone, or not there yet. `str` gives a sentence for the user."""


class _Died(Exception):
    """A worker no longer answers."""


def run_on_cluster(jobs: list[Job], *, address: str, url: str = "") -> dict[tuple[str, str], str]:
    """Run all jobs that are not finished yet, as `app.evaluation.runner.run_jobs` does.

    Args:
        address: of the scheduler, such as tcp://scheduler:8786.
        url: folder of the recordings for workers that do not have their path, such as s3://bucket/walks; "" for none.

    Raises:
        HemislamError: the cluster is not there, a worker has another version of hemislam, or lacks a recording.
    """
    errors: dict[tuple[str, str], str] = {}
    waiting = {job.folder: job for job in jobs if finished(job) is None}
    deaths = Counter[Path]()
    patient_until, told = -math.inf, ""  # at the start, the cluster must be there
    with tqdm(total=len(jobs), initial=len(jobs) - len(waiting), unit=" runs", disable=None) as bar:
        while waiting:
            try:
                with _connected(address) as client:
                    patient_until = math.inf
                    for job, error in _results(client, list(waiting.values()), url, deaths):
                        del waiting[job.folder]
                        bar.update()
                        if error:
                            errors[job.name, job.variant] = error
            except _Gone as gone:
                patient_until = min(patient_until, time.monotonic() + PATIENCE_S)
                if time.monotonic() > patient_until:
                    kept = " Finished runs are kept; the same command continues." if len(waiting) < len(jobs) else ""
                    raise HemislamError(f"{gone}{kept}") from None
                if str(gone) != told:
                    told = str(gone)
                    tqdm.write(f"{told} Waiting for it up to {PATIENCE_S:.0f} s …", file=sys.stderr)
                time.sleep(LOOK_S)
    return errors


def _results(client: Any, jobs: Sequence[Job], url: str, deaths: Counter[Path]) -> Iterator[tuple[Job, str]]:
    """Yield jobs as they end, with the reason if they failed. Raises _Gone.

    Args:
        deaths: of workers so far, by the folder of the job that they ran. Further ones are added.
    """
    waiting, running = deque(jobs), dict[str, tuple[Job, Any]]()
    news = threading.Event()
    while waiting or running:
        there = _workers(client)
        for worker in running.keys() - there.keys():
            job, _ = running.pop(worker)
            deaths[job.folder] += 1
            if deaths[job.folder] == MOST_DEATHS:
                yield job, f"{MOST_DEATHS} workers died while running it; they may have too little memory."
            else:
                waiting.appendleft(job)
        if not there:
            raise _Gone(_NO_WORKERS)
        for worker in sorted(there.keys() - running.keys())[: len(waiting)]:
            with contextlib.suppress(_Died):
                _check(client, worker, there[worker]["nthreads"])
                if not url:
                    _bring(client, worker, waiting[0])
                job = waiting.popleft()
                key = f"hemislam-{job.key}-{job.name}-{job.variant}-{deaths[job.folder]}"
                future = client.submit(_work, job, url, key=key, workers=[worker])
                future.add_done_callback(lambda _: news.set())
                running[worker] = job, future
        news.wait(LOOK_S)
        news.clear()
        for worker, (job, future) in list(running.items()):
            if future.done() and (error := _taken(job, future)) is not None:
                del running[worker]
                yield job, error


@contextlib.contextmanager
def _connected(address: str) -> Iterator[Any]:
    """A connected client with at least one worker. Raises _Gone: the scheduler or all workers are not there."""
    from distributed import Client
    from distributed.comm import CommClosedError

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # errors are reported here in a sentence instead
    gone = f"There is no Dask scheduler at {address}; start one with `dask scheduler`."
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError):
        raise _Gone(gone) from None
    try:
        with contextlib.suppress(TimeoutError):
            client.wait_for_workers(1, timeout=CONNECT_S)
        if not _workers(client):
            raise _Gone(_NO_WORKERS)
        yield client
    except (CommClosedError, TimeoutError):
        raise _Gone(gone) from None
    finally:
        client.close(timeout=5)


def _bring(client: Any, worker: str, job: Job) -> None:
    """Copy a job's recording piece by piece to a worker that has no other access to it. Raises _Died."""
    if _ask(client, worker, _here, job):
        return
    if job.recording.is_dir():
        raise HemislamError(
            f"Worker {worker} cannot read {job.recording}, and folders are not copied; make it readable there."
        )
    with job.recording.open("rb") as file:
        while piece := file.read(PIECE):
            if problem := _ask(client, worker, _append, job, file.tell() - len(piece), piece):
                raise HemislamError(f"Worker {worker} cannot keep a copy of {job.recording}: {problem}.")
    _ask(client, worker, _settle, job)


def _ask(client: Any, worker: str, function: Callable[..., Any], *about: Any) -> Any:
    """Call the function on this worker and return its result. Raises _Died."""
    answer = client.run(function, *about, workers=[worker], on_error="return").get(worker, OSError())
    if isinstance(answer, OSError):
        raise _Died
    if isinstance(answer, Exception):
        raise answer
    return answer


def _workers(client: Any) -> dict[str, Any]:
    """The scheduler's information on its workers, by address."""
    return dict(client.scheduler_info(n_workers=-1).get("workers", {}))


def _check(client: Any, worker: str, threads: int) -> None:
    """Check that a worker can be used. Raises _Died.

    Raises:
        HemislamError: it has another version or no hemislam, or runs several jobs at a time.
    """
    if threads > 1:
        raise HemislamError(
            f"Worker {worker} runs {threads} jobs at a time in one process, which spoils their times;"
            " start it with --nthreads 1."
        )
    try:
        version, code = _ask(client, worker, _version)
    except ModuleNotFoundError as error:
        raise HemislamError(
            f"Worker {worker} has no hemislam ({error}); install version {__version__} there."
        ) from None
    if (version, code) != (__version__, code_digest()):
        other = "other code" if version == __version__ else f"version {version}"
        raise HemislamError(f"Worker {worker} has {other}, and this is {__version__}; install the same on all.")


def _taken(job: Job, future: Any) -> str | None:
    """Write the files from a worker. Raises _Gone.

    Returns:
        "" if there are files, else why there are none; None: the worker died before it handed the files over.
    """
    if future.status == "cancelled":
        raise _Gone("The Dask scheduler is gone; start it and its workers again.")
    try:
        files = future.result(timeout=TAKE_S)
    except Exception as error:  # anything may have gone wrong there; Dask re-raises the worker's error
        if isinstance(error, TimeoutError) and future.status != "error":
            return None
        return f"The worker failed: {str(error) or type(error).__name__}"
    if isinstance(files, str):
        return files
    reopen(job)
    for name in RUN_FILES:
        (job.folder / name).write_bytes(files[name])
    return ""


def _version() -> tuple[str, str]:
    return __version__, code_digest()


def _here(job: Job) -> Path | None:
    """Where this worker has the recording: at its own path, or a copy; None if nowhere."""
    for path in (job.recording, _copy_of(job)):
        if path.exists() and _hash(path, path.stat().st_size, path.stat().st_mtime_ns) == job.sha256:
            return path
    return None


@cache
def _hash(path: Path, size: int, changed_ns: int) -> str | None:
    """Hash of a recording, computed again only if the file has changed."""
    return hash_input(path)


def _copy_of(job: Job) -> Path:
    """Where a worker keeps its copy of a recording."""
    return Path(tempfile.gettempdir()) / "hemislam-recordings" / f"{job.sha256[:16]}-{job.recording.name}"


def _part_of(job: Job) -> Path:
    """This worker's unfinished copy; other workers on the same machine may be writing their own."""
    copy = _copy_of(job)
    copy.parent.mkdir(exist_ok=True)
    return copy.with_name(f"{copy.name}.part-{os.getpid()}")


def _append(job: Job, offset: int, piece: bytes) -> str:
    """Write a piece of a recording, the first one into a new file. Returns why it cannot be written, "" if it was."""
    try:
        with _part_of(job).open("ab" if offset else "wb") as file:
            file.write(piece)
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _settle(job: Job) -> None:
    """All pieces have arrived: give the copy its final name."""
    _part_of(job).replace(_copy_of(job))


def _work(job: Job, url: str) -> dict[str, bytes] | str:
    """Run a job on a worker. Returns the files of the finished run, or why there are none."""
    with tempfile.TemporaryDirectory(prefix="hemislam-job-") as folder:
        try:
            there = replace(job, recording=_found(job, url), folder=Path(folder) / "run")
            if there.key != job.key:
                return f"The worker has another version of {job.baseline}; install the same on all."
            run_job(there, lambda done, total: None)
        except HemislamError as error:
            return str(error)
        except OSError as error:
            return f"{job.recording} cannot be run there: {error.strerror or error}"
        return {name: (there.folder / name).read_bytes() for name in RUN_FILES}


def _found(job: Job, url: str) -> Path:
    """Path of the recording on this worker; it is fetched from the URL if necessary.

    Raises:
        HemislamError: there is no recording with the right content, or it cannot be fetched.
    """
    path = _here(job)
    if path is None and url:
        _fetch(f"{url.rstrip('/')}/{job.recording.name}", job)
        path = _here(job)
    if path is None:
        raise HemislamError(f"The worker has no {job.recording.name} with the same content as here.")
    return path


def _fetch(address: str, job: Job) -> None:
    """Copy a recording from an address of fsspec.

    Raises:
        HemislamError: it cannot be copied.
    """
    from fsspec.core import url_to_fs

    part = _part_of(job)
    try:
        system, path = url_to_fs(address)
        system.get_file(path, str(part))  # also works with servers that only send whole files
    except Exception as error:  # each kind of address raises its own errors
        part.unlink(missing_ok=True)
        # fsspec says "not found" even for, say, an untrusted certificate; for gs:// or s3://, it says what to install
        cause = None if isinstance(error, ImportError) else error.__cause__
        why = cause or ("it is not there" if isinstance(error, FileNotFoundError) else error)
        raise HemislamError(f"The worker cannot fetch {address}: {str(why) or type(why).__name__}") from None
    _settle(job)
