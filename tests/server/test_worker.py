"""The engine in a process of its own: with real pipes and real kills.

Tests app/server/engine_process.py, app/server/setup.py, app/slam/warmup.py.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import server_fakes as fakes

from app.child import LinkClosed
from app.server.engine_process import run_loop
from app.server.protocol import (
    ACKNOWLEDGED,
    Delta,
    OpenRecording,
    Pause,
    Play,
    Restart,
    Seek,
    SetParams,
    SetSpeed,
    Snapshot,
    StepFrame,
)
from app.server.setup import Setup
from app.server.worker import EngineProcess

PATIENCE_S = 20.0


def until(engine: EngineProcess, wanted: Callable[[Snapshot], bool]) -> Snapshot:
    """The first snapshot that is as wanted; fails if none comes."""
    deadline = time.monotonic() + PATIENCE_S
    snapshot = engine.snapshot
    while not wanted(snapshot):
        assert time.monotonic() < deadline, snapshot
        snapshot = engine.wait(snapshot.revision, timeout=1.0)
    return snapshot


@pytest.fixture(scope="module")
def process() -> Iterator[EngineProcess]:
    started = EngineProcess(Setup(), main=fakes.fake_main)
    yield started
    started.close()


@pytest.fixture
def engine(process: EngineProcess) -> EngineProcess:
    """At the first frame of a recording of 300, alive whatever the test before did to it."""
    before = process.snapshot.session
    process.send(OpenRecording(Path("walk-300.mcap")))
    until(process, lambda s: s.session > before and s.transport.frame == 0 and s.engine_alive)
    process.send(SetSpeed(1.0))
    return process


def test_from_the_first_moment_it_says_what_is_being_opened() -> None:
    engine = EngineProcess(Setup(recording=Path("walk-3.mcap")), main=fakes.fake_main)
    first = engine.snapshot
    engine.close()
    assert first.recording is None and first.progress is not None and "walk-3.mcap" in first.progress.title


def test_everything_arrives_whole_and_read_only(engine: EngineProcess) -> None:
    engine.send(SetSpeed(float("inf")))
    engine.send(Play())
    snapshot = until(engine, lambda s: s.transport.finished and len(s.chunks) == 60)  # the last ones may follow the end
    np.testing.assert_array_equal(snapshot.trajectory, [fakes.pose(index)[:3, 3] for index in range(300)])
    assert [chunk.index for chunk in snapshot.chunks] == list(range(60))
    assert all(len(column) == 300 for column in snapshot.series.values())
    assert snapshot.result is not None
    arrays = [snapshot.trajectory, snapshot.chunks[0].points, snapshot.result.cloud.points, snapshot.result.T_map_odom]
    arrays += [snapshot.series["distance"], snapshot.keyframe_poses]
    assert not any(array.flags.writeable for array in arrays)


def test_a_snapshot_once_taken_never_changes(engine: EngineProcess) -> None:
    early = until(engine, lambda s: s.trajectory is not None and len(s.trajectory) == 1)
    kept = early.trajectory.copy()
    engine.send(Seek(299))
    until(engine, lambda s: s.transport.frame == 299)
    np.testing.assert_array_equal(early.trajectory, kept)


def test_commands_act_while_it_plays_as_fast_as_it_can(engine: EngineProcess) -> None:
    engine.send(Seek(250))
    engine.send(SetParams({"ground.alpha": 20}))
    engine.send(Pause())
    snapshot = until(engine, lambda s: s.params.ground.alpha == 20 and s.progress is None)
    assert snapshot.transport.frame < 250


def test_a_killed_engine_is_reported_and_can_be_started_again(engine: EngineProcess) -> None:
    engine.send(SetParams({"ground.alpha": 20}))
    engine.send(StepFrame(10))
    until(engine, lambda s: s.transport.frame == 10)
    assert engine.pid is not None
    os.kill(engine.pid, signal.SIGKILL)
    dead = until(engine, lambda s: not s.engine_alive)
    assert dead.notices[-1].level == "error" and "signal 9" in dead.notices[-1].text
    assert len(dead.trajectory) == 11, "what was there stays"
    engine.send(StepFrame())  # to nobody
    engine.send(Restart())
    alive = until(engine, lambda s: s.engine_alive and s.session > dead.session and s.transport.frame == 0)
    assert alive.params.ground.alpha == 20
    assert [n.number for n in alive.notices] == list(range(1, len(alive.notices) + 1))
    engine.send(StepFrame())
    until(engine, lambda s: s.transport.frame == 1)


def test_two_pages_that_restart_a_dead_engine_start_one(engine: EngineProcess, monkeypatch: pytest.MonkeyPatch) -> None:
    assert engine.pid is not None
    os.kill(engine.pid, signal.SIGKILL)
    dead = until(engine, lambda s: not s.engine_alive)
    started, start = [], engine._start
    monkeypatch.setattr(engine, "_start", lambda setup: (started.append(setup), time.sleep(0.1), start(setup)))
    pages = [threading.Thread(target=engine.send, args=(Restart(),)) for _ in range(2)]
    for page in pages:
        page.start()
    for page in pages:
        page.join()
    until(engine, lambda s: s.session > dead.session and s.transport.frame == 0)
    assert len(started) == 1


def test_opening_another_recording_revives_a_dead_engine(engine: EngineProcess) -> None:
    assert engine.pid is not None
    os.kill(engine.pid, signal.SIGKILL)
    until(engine, lambda s: not s.engine_alive)
    engine.send(OpenRecording(Path("walk-30.mcap")))
    until(engine, lambda s: s.recording is not None and s.recording.path == Path("walk-30.mcap") and s.engine_alive)


PARENT = """
import signal, sys, time
sys.path[:0] = {path!r}
import server_fakes as fakes
from pathlib import Path
from app.server.setup import Setup
from app.server.worker import EngineProcess
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job is started to ignore it
    engine = EngineProcess(Setup(recording=Path("walk-300.mcap")), main=fakes.fake_main)
    until = time.monotonic() + {patience}
    while engine.snapshot.transport.frame < 0:
        assert time.monotonic() < until, engine.snapshot.notices
        time.sleep(0.01)
    try:
        print(engine.pid, flush=True)
        time.sleep(60)
    except KeyboardInterrupt:
        engine.close()
        print("closed", engine.snapshot.engine_alive, flush=True)
"""


@pytest.fixture
def parent(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A process in a terminal session of its own, and the id of its engine's process."""
    script = tmp_path / "parent.py"
    root = Path(__file__).resolve().parents[2]
    script.write_text(PARENT.format(path=[str(root), str(Path(__file__).parent)], patience=PATIENCE_S))
    process = subprocess.Popen(
        [sys.executable, str(script)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert process.stdout is not None
        yield process, int(process.stdout.readline())
    finally:
        process.kill()
        process.communicate()


def gone(pid: int) -> bool:
    """Whether a process that is not our child ends before our patience does."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        try:
            if Path(f"/proc/{pid}/stat").read_text().split()[2] == "Z":
                return True
        except FileNotFoundError:
            return True
        time.sleep(0.02)
    return False


def test_a_killed_parent_leaves_no_engine_behind(parent: tuple[subprocess.Popen[str], int]) -> None:
    process, engine_pid = parent
    process.kill()
    process.wait()
    assert gone(engine_pid)


def test_ctrl_c_ends_both_without_a_traceback(parent: tuple[subprocess.Popen[str], int]) -> None:
    process, engine_pid = parent
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to everything in the foreground
    out, err = process.communicate(timeout=PATIENCE_S)
    assert out == "closed True\n" and err == "" and process.returncode == 0
    assert gone(engine_pid)


def test_the_page_is_reported_that_a_recording_is_being_opened_before_it_is_open() -> None:
    class Owner:
        """Acknowledges each delta, opens a recording once nothing else is due, and leaves when that is done."""

        def __init__(self) -> None:
            self.deltas: list[Delta] = []
            self._messages: list[object] = []
            self._orders: list[object] = [OpenRecording(Path("walk-30.mcap"))]

        def send(self, delta: Delta) -> None:
            self.deltas.append(delta)
            self._messages.append(ACKNOWLEDGED)

        def receive(self, wait: float | None) -> object:
            if self._messages:
                return self._messages.pop(0)
            if wait is None and not self._orders:
                raise LinkClosed
            return self._orders.pop() if wait is None else None

    owner = Owner()
    run_loop(owner, Setup(), fakes.open_fake)  # type: ignore[arg-type]
    told = [delta.replaced["progress"] for delta in owner.deltas if delta.replaced.get("progress")]
    assert [progress.title for progress in told] == ["Opening walk-30.mcap"]
    opened = next(index for index, delta in enumerate(owner.deltas) if delta.replaced.get("recording"))
    assert owner.deltas[opened - 1].replaced["progress"] is told[0]
