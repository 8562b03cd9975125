"""Runs jobs on an existing Dask cluster (https://distributed.dask.org). Its scheduler and workers are the user's.

A worker runs a job in a folder of its own and sends the files back; they are written here, as if run here. Recordings
are read from their own path where workers have it, else from an fsspec URL, else each worker fetches them from here.
"""

import contextlib
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import monotonic
from typing import Any

from tqdm import tqdm

from app import __version__
from app.evaluation.job import RUN_FILES, Job, clear_remains, code_digest, finished, run_job
from app.slam.errors import HemislamError
from app.slam.provenance import hash_input

CONNECT_S = 15.0
RETRIES = 3
"""How often a job is tried again after its worker died."""
PIECE = 64 << 20
"""Bytes of a recording that travel as one message."""


@dataclass(frozen=True, slots=True)
class Cluster:
    """Attributes:
    address: of the scheduler, such as tcp://scheduler:8786.
    url: folder of the recordings for workers that do not have their path, such as s3://bucket/walks; "" for none.
    wait_s: how long a scheduler that is gone may take to come back.
    """

    address: str
    url: str = ""
    wait_s: float = 120.0

    def run_jobs(self, jobs: list[Job], folder: Path) -> dict[tuple[str, str], str]:
        """Run all jobs that are not finished yet, as `app.evaluation.runner.run_jobs` does.

        Raises:
            HemislamError: the cluster is not there, or a worker has another version of hemislam.
        """
        clear_remains(folder)
        errors: dict[tuple[str, str], str] = {}
        waiting = {job.key: job for job in jobs if finished(job) is None}
        gone_since: float | None = None
        with tqdm(total=len(jobs), initial=len(jobs) - len(waiting), unit=" runs", disable=None) as bar:
            while waiting:
                try:
                    for job, error in self._results(list(waiting.values())):
                        gone_since = None
                        del waiting[job.key]
                        bar.update()
                        if error:
                            errors[job.name, job.variant] = error
                except ConnectionError as error:
                    gone_since = gone_since or monotonic()
                    if monotonic() - gone_since > self.wait_s:
                        raise HemislamError(
                            f"The Dask scheduler at {self.address} is gone; start it and the workers again. What is"
                            " finished is kept, and the same command goes on from there."
                        ) from error
        return errors

    def _results(self, jobs: Sequence[Job]) -> Iterator[tuple[Job, str]]:
        """Jobs as they end, and why they failed. Raises ConnectionError if the scheduler goes meanwhile."""
        from distributed import as_completed
        from distributed.client import FutureCancelledError

        with self._client() as client:
            _check_workers(client)
            sent = {recording: self._sent(client, jobs, recording) for recording in {job.recording for job in jobs}}
            futures = {
                client.submit(
                    _work, job, self.url, sent[job.recording], key=f"hemislam-{job.key}", retries=RETRIES, pure=True
                ): job
                for job in jobs
            }
            for future in as_completed(futures, loop=client.loop):
                job = futures[future]
                try:
                    files = future.result()
                except FutureCancelledError as error:
                    raise ConnectionError from error
                except Exception as error:  # whatever went wrong there; Dask raises what the worker raised
                    yield job, f"The worker failed: {str(error) or type(error).__name__}"
                    continue
                if isinstance(files, str):
                    yield job, files
                else:
                    _keep(job, files)
                    yield job, ""

    @contextlib.contextmanager
    def _client(self) -> Iterator[Any]:
        from distributed import Client

        try:
            client = Client(self.address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise HemislamError(
                f"There is no Dask scheduler at {self.address}; start one with `dask scheduler`."
            ) from error
        try:
            yield client
        finally:
            client.close(timeout=5)

    def _sent(self, client: Any, jobs: Sequence[Job], recording: Path) -> list[Any]:
        """The recording's bytes as futures, if a worker can have it from nowhere else; none if all can."""
        sha256 = next(job.sha256 for job in jobs if job.recording == recording)
        have = client.run(_has, recording, sha256)
        if self.url or all(have.values()):
            return []
        if recording.is_dir():
            lacks = next(worker for worker, has in have.items() if not has)
            raise HemislamError(
                f"Worker {lacks} cannot read {recording}, and folders are not sent; put it where workers share it."
            )
        with recording.open("rb") as file:
            pieces = list(iter(lambda: file.read(PIECE), b""))
        return list(client.scatter(pieces, hash=True))


def _check_workers(client: Any) -> None:
    """Raises HemislamError: there is no worker, or one has another version or no hemislam."""
    deadline = monotonic() + CONNECT_S
    while not client.scheduler_info()["workers"]:
        if monotonic() > deadline:
            raise HemislamError("The Dask cluster has no workers; start some with `dask worker ADDRESS`.")
        with contextlib.suppress(TimeoutError):
            client.wait_for_workers(1, timeout=1)
    try:
        versions = client.run(_version, on_error="return")
    except OSError as error:
        raise ConnectionError from error
    for worker, version in versions.items():
        if isinstance(version, ModuleNotFoundError):
            raise HemislamError(f"Worker {worker} has no hemislam ({version}); install version {__version__} there.")
        if version != (__version__, code_digest()):
            told = f"version {version[0]}" if isinstance(version, tuple) and version[0] != __version__ else "other code"
            raise HemislamError(f"Worker {worker} has {told}, and this is {__version__}; install the same on all.")


def _version() -> tuple[str, str]:
    return __version__, code_digest()


def _has(recording: Path, sha256: str) -> bool:
    return recording.exists() and hash_input(recording) == sha256


def _work(job: Job, url: str, pieces: Sequence[bytes]) -> dict[str, bytes] | str:
    """On a worker: the files of a finished run, or why there are none."""
    with tempfile.TemporaryDirectory(prefix="hemislam-job-") as folder:
        try:
            there = replace(job, recording=_fetched(job, url, pieces), folder=Path(folder) / "run")
            run_job(there, lambda done, total: None)
        except HemislamError as error:
            return str(error)
        except OSError as error:
            return f"{job.recording} cannot be run there: {error.strerror or error}"
        return {name: (there.folder / name).read_bytes() for name in RUN_FILES}


def _fetched(job: Job, url: str, pieces: Sequence[bytes]) -> Path:
    """Where this worker has the recording: its own path, or a copy that is kept by its hash."""
    if _has(job.recording, job.sha256):
        return job.recording
    cache = Path(tempfile.gettempdir()) / "hemislam-recordings"
    path = cache / f"{job.sha256[:16]}-{job.recording.name}"
    if _has(path, job.sha256):
        return path
    cache.mkdir(exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=cache, delete=False) as part:
        if url:
            import fsspec

            with fsspec.open(f"{url.rstrip('/')}/{job.recording.name}") as source:
                shutil.copyfileobj(source, part, PIECE)
        else:
            part.writelines(pieces)
    Path(part.name).replace(path)
    if not _has(path, job.sha256):
        path.unlink()
        raise HemislamError(f"{job.recording.name} is another file at {url or 'the worker'} than here.")
    return path


def _keep(job: Job, files: dict[str, bytes]) -> None:
    """Write a run's files, run.json last: a kill in between leaves no result."""
    job.folder.mkdir(parents=True, exist_ok=True)
    for name in RUN_FILES:
        part = job.folder / f".{name}.part"
        part.write_bytes(files[name])
        part.replace(job.folder / name)
