"""A real Dask scheduler and its workers give the same tables as one machine, even if processes are killed.

Tests app/evaluation/cluster.py.
"""

import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result
from typer.testing import CliRunner

from app.__main__ import cli
from app.evaluation import cluster
from app.evaluation.cluster import run_on_cluster
from app.evaluation.job import Job, finished
from app.sensors.presets import resolve_params
from app.slam.errors import HemislamError
from app.slam.provenance import hash_input
from tests.cli.conftest import ROOT, write_walk


class Site:
    """A scheduler and workers as processes. `path` keeps what they say."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port: int = free.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{self.port}"
        self.begin()

    def worker(self) -> "subprocess.Popen[bytes]":
        return self.start("worker", self.address, "--no-nanny", "--nthreads", "1", "--no-dashboard")

    def start(self, what: str, *words: str) -> "subprocess.Popen[bytes]":
        log = (self._folder / f"{what}.log").open("ab")
        command = [sys.executable, "-m", f"distributed.cli.dask_{what}", *words]
        return subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log)

    def restart(self, after_s: float) -> None:
        """As an orchestrator does: the workers go with their scheduler and one comes back with it, a while later."""
        for process in (self.scheduler, *self.workers):
            process.kill()
            process.wait()
        threading.Timer(after_s, self.begin, (1,)).start()

    def begin(self, workers: int = 2) -> None:
        self.scheduler = self.start("scheduler", "--port", str(self.port), "--no-dashboard")
        self.workers = [self.worker() for _ in range(workers)]

    def stop(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    started = Site(tmp_path_factory.mktemp("site"))
    yield started
    started.stop()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "walk.mcap"
    write_walk(path)
    return path


def evaluate(recording: Path, out: Path, *words: str) -> Result:
    return CliRunner().invoke(cli, ["evaluate", str(recording), "--out", str(out), "--duration", "1.5", *words])


def job_of(recording: Path, folder: Path) -> Job:
    sha256 = hash_input(recording)
    assert sha256 is not None
    params = resolve_params(recording, None, None, [])
    return Job(recording, sha256, "walk", folder.name, params, folder, duration_s=1.0)


def test_a_cluster_gives_the_tables_of_one_machine_though_processes_die(
    site: Site, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker is killed when the first run has come, and everything is restarted when the second has."""
    kept, take = list[str](), cluster._taken
    monkeypatch.setattr(cluster, "TAKE_S", 2.0)

    def take_and_kill(job: Job, future: Any) -> str | None:
        if (error := take(job, future)) != "":
            return error
        kept.append(job.variant)
        if len(kept) == 1:
            site.workers[0].send_signal(signal.SIGKILL)
        elif len(kept) == 2:
            monkeypatch.setattr(cluster, "CONNECT_S", 1.0)
            site.restart(after_s=2.5)  # one attempt to connect fails, at least
        return ""

    monkeypatch.setattr(cluster, "_taken", take_and_kill)
    result = evaluate(recording, tmp_path / "cluster", "--cluster", site.address)
    assert result.exit_code == 0, result.output
    assert len(kept) == len(set(kept)) == 4, "every run is done once"
    assert evaluate(recording, tmp_path / "here").exit_code == 0
    for name in ("accuracy.csv", "map_sharpness.csv"):
        assert (tmp_path / "cluster" / name).read_bytes() == (tmp_path / "here" / name).read_bytes()


def test_a_worker_without_the_recording_is_sent_it(
    site: Site, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And a column that repeats another one is run, too."""
    away = tmp_path / "walk.mcap"
    away.write_bytes(recording.read_bytes())
    bring = cluster._bring

    def bring_once(client: Any, worker: str, job: Job) -> None:
        if away.exists():  # all workers are on this machine, and have one copy
            bring(client, worker, job)
            away.unlink()

    monkeypatch.setattr(cluster, "_bring", bring_once)
    monkeypatch.setattr(cluster, "_here", lambda job: None)
    monkeypatch.setattr(cluster, "PIECE", 100_000)
    jobs = [job_of(away, tmp_path / name) for name in ("first", "again")]
    assert run_on_cluster(jobs, address=site.address) == {}
    assert [finished(job) is not None for job in jobs] == [True, True]


def test_a_worker_fetches_a_recording_from_a_url(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And keeps it by its hash; a file with another content is refused."""
    monkeypatch.setattr(cluster.tempfile, "gettempdir", lambda: str(tmp_path))
    job = job_of(recording, tmp_path / "runs" / "walk")
    gone = Job(tmp_path / "gone" / recording.name, job.sha256, "walk", "walk", job.params, job.folder, duration_s=1.0)
    data = recording.read_bytes()
    assert cluster._found(gone, recording.parent.as_uri()).read_bytes() == data
    cluster._copy_of(gone).write_bytes(data[:1000])
    with pytest.raises(HemislamError, match="same content"):
        cluster._found(gone, "")
    with pytest.raises(HemislamError, match="it is not there"):
        cluster._found(gone, f"{tmp_path.as_uri()}/elsewhere")
    with pytest.raises(HemislamError, match="Protocol not known"):
        cluster._found(gone, "cloud9://walks")
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    with pytest.raises(HemislamError, match="install gcsfs"):
        cluster._found(gone, "gs://walks")
    assert not list(tmp_path.glob("**/*.part-*")), "nothing is left half fetched"


def test_a_recording_that_cannot_be_used_costs_its_own_run_only(site: Site, recording: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty.mcap"
    empty.write_bytes(b"")
    good, bad = job_of(recording, tmp_path / "good"), job_of(empty, tmp_path / "bad")
    errors = run_on_cluster([good, bad], address=site.address)
    assert finished(good) is not None
    assert list(errors) == [("walk", "bad")] and "empty.mcap" in errors["walk", "bad"]


class Fragile:
    """A client whose only worker dies of each job, and is back for the next connection."""

    def __init__(self) -> None:
        self.workers = {"only": {"nthreads": 1}}

    def scheduler_info(self, n_workers: int) -> dict[str, Any]:
        return {"workers": self.workers}

    def run(self, function: Callable[..., Any], *about: Any, workers: list[str], on_error: str) -> dict[str, Any]:
        return {workers[0]: function(*about)}

    def submit(self, *_: Any, **__: Any) -> "Future[None]":
        self.workers = {}
        return Future()


def test_a_job_that_kills_the_only_worker_each_time_is_given_up(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "_connected", lambda address: nullcontext(Fragile()))
    monkeypatch.setattr(cluster, "LOOK_S", 0.01)
    jobs = [job_of(recording, tmp_path / name) for name in ("first", "again")]
    errors = run_on_cluster(jobs, address="tcp://nowhere")
    assert [variant for _, variant in errors] == ["first", "again"]
    assert all("3 workers died" in error for error in errors.values())


def test_no_scheduler_and_other_versions_are_reported_in_a_sentence(
    site: Site, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster, "CONNECT_S", 1.0)
    result = evaluate(recording, tmp_path / "none", "--cluster", "tcp://127.0.0.1:9")
    assert result.exit_code == 2 and "no Dask scheduler at tcp://127.0.0.1:9" in result.output
    monkeypatch.setattr(cluster, "CONNECT_S", 15.0)
    monkeypatch.setattr(cluster, "__version__", "99.0")
    with pytest.raises(HemislamError, match=r"has version .*, and this is 99.0"):
        run_on_cluster([job_of(recording, tmp_path / "run")], address=site.address)
    result = evaluate(recording, tmp_path / "data", "--cluster-data", "s3://bucket")
    assert result.exit_code == 2 and "belongs to --cluster" in result.output
