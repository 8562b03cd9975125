"""Two settings side by side: B equals A with other parameters, follows A, and does not slow A down.

Tests app/server/protocol.py.
"""

import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import server_fakes as fakes

from app.mapping.kept import Note
from app.mapping.opening import open_session
from app.mapping.session_file import Opened, SessionWriter, State, read_session, session_files
from app.sensors.presets import resolve_params
from app.server.fork import Workspace, follow, forked
from app.server.keeping import AddNote
from app.server.protocol import (
    SERIES,
    Command,
    OpenRecording,
    Pause,
    Play,
    Seek,
    SetParams,
    SetSpeed,
    Snapshot,
    StepFrame,
    Transport,
)
from app.server.publisher import opened_recording
from app.server.setup import Setup
from app.server.worker import EngineProcess
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import StepResult

PATIENCE_S = 60.0
SAMPLE = next((Path(__file__).resolve().parents[2] / "sample_data").glob("*.mcap"))
COARSE = {"filter.plane_tilt": 6.0, "ground.sigma": 0.02}


def until(read: Callable[[], Snapshot | None], wanted: Callable[[Snapshot], bool]) -> Snapshot:
    deadline = time.monotonic() + PATIENCE_S
    while (snapshot := read()) is None or not wanted(snapshot):
        assert time.monotonic() < deadline, (snapshot and snapshot.transport, snapshot and snapshot.notices[-2:])
        time.sleep(0.01)
    return snapshot


def both_at(workspace: Workspace, frame: int) -> tuple[Snapshot, Snapshot]:
    def there(snapshot: Snapshot) -> bool:
        return snapshot.transport.frame == frame and snapshot.result is not None

    return until(lambda: workspace.snapshot, there), until(lambda: workspace.other, there)


class Recorder:
    """An engine that keeps the commands sent to it."""

    pid = None

    def __init__(self, snapshot: Snapshot) -> None:
        self.snapshot = snapshot
        self.sent: list[Command] = []

    def send(self, command: Command) -> None:
        self.sent.append(command)

    def wait(self, after_revision: int, timeout: float) -> Snapshot:
        return self.snapshot

    def close(self) -> None:
        pass


# --- what B is told ------------------------------------------------------------------------------
def at(frame: int, *, frames: int = 100, name: str = "walk") -> Snapshot:
    session = fakes.open_fake(Path(f"walk-{frames}.mcap"), None, Params())
    opened = replace(opened_recording(session), path=Path(f"{name}.mcap"))
    return Snapshot(
        recording=opened,
        transport=Transport(frame=frame),
    )


def test_b_is_sent_to_where_a_is() -> None:
    assert follow(at(14), at(10)) == Seek(14)
    assert follow(at(8), at(20)) == Seek(8)
    assert follow(at(20), at(20)) is None
    assert follow(at(-1), at(0)) is None, "A has no frame yet"
    assert follow(at(101, frames=100), at(99, frames=100)) == Seek(101), "the number of frames is an estimate"


def test_at_the_end_of_a_b_goes_to_its_end() -> None:
    b = at(99)
    ended = replace(b, transport=replace(b.transport, finished=True))
    assert follow(ended, b) == Seek(100)
    assert follow(ended, ended) is None
    shorter = replace(ended, transport=replace(ended.transport, frame=97))
    assert follow(ended, shorter) is None, "it has no more frames"
    assert follow(at(50), ended) == Seek(50)


def test_a_b_that_goes_on_after_the_end_of_a_stays_there() -> None:
    """A was opened on the first ten seconds only."""
    b = at(99, frames=300)
    assert follow(replace(at(99), transport=Transport(frame=99, finished=True)), b) is None


def test_another_recording_or_part_of_it_is_nothing_to_follow() -> None:
    assert follow(at(50, name="other"), at(3)) is None
    a = at(50)
    assert a.recording is not None
    assert follow(replace(a, recording=replace(a.recording, start_s=5.0)), at(3)) is None


def test_a_command_that_a_dying_b_lost_is_sent_again(tmp_path: Path) -> None:
    a, b = Recorder(at(5)), Recorder(at(0))
    workspace = Workspace(a, Setup(session_folder=tmp_path), lambda setup: b)
    writer = SessionWriter(tmp_path / "a.hemislam", Opened(tmp_path / "walk.mcap"))
    writer.write(5, State(Params()))
    writer.close()
    (tmp_path / "walk.mcap").touch()
    a.snapshot = replace(a.snapshot, session_file=tmp_path / "a.hemislam")
    workspace.fork("b")
    deadline = time.monotonic() + PATIENCE_S
    while b.sent.count(Seek(5)) < 2:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    workspace.close()


def test_a_fork_tells_what_was_left_out_of_a_session_file(tmp_path: Path) -> None:
    path = tmp_path / "a.hemislam"
    writer = SessionWriter(path, Opened(tmp_path / "walk.mcap"))
    writer.write(5, State(Params()))
    writer.close()
    path.write_text(path.read_text().replace('"slab": 1.0', '"slab": 0.0'))
    (tmp_path / "walk.mcap").touch()
    for begin in (lambda workspace: workspace.fork("b"), lambda workspace: workspace.open(path)):
        a = Recorder(replace(at(5, name=str(tmp_path / "walk")), session_file=path))
        workspace = Workspace(a, Setup(session_folder=tmp_path), lambda setup: Recorder(at(5)))
        begin(workspace)
        (note,) = (command.text for command in a.sent if isinstance(command, AddNote))
        assert "clip box and slab were left out (" in note
        workspace.close()


def test_a_session_is_opened_beside_one_whose_file_cannot_be_written(tmp_path: Path) -> None:
    writer = SessionWriter(tmp_path / "older.hemislam", Opened(tmp_path / "walk.mcap"))
    writer.write(5, State(Params()))
    writer.close()
    (tmp_path / "walk.mcap").touch()
    a = Recorder(at(5, name=str(tmp_path / "walk")))
    workspace = Workspace(a, Setup(session_folder=tmp_path), lambda setup: Recorder(at(5)))
    workspace.open(tmp_path / "older.hemislam")
    assert workspace.names == ("main", "older") and workspace.forked_at == -1
    workspace.close()


def test_a_fork_knows_only_what_came_before_it(tmp_path: Path) -> None:
    first, later, latest = (Params().with_values({"ground.alpha": alpha}) for alpha in (30.0, 40.0, 50.0))
    writer = SessionWriter(tmp_path / "a.hemislam", Opened(tmp_path / "none.mcap"))
    writer.write(80, State(latest, ((0, first), (20, later), (60, latest))))
    writer.close()
    a = Snapshot(params=latest, transport=Transport(frame=40), session_file=tmp_path / "a.hemislam")
    session = forked(a, {"ground.sigma": 0.2})
    assert session.frame == 40 and session.state.history == ((0, first), (20, later))
    assert session.state.params == latest.with_values({"ground.sigma": 0.2})
    with pytest.raises(HemislamError, match="play or step first"):
        forked(replace(a, transport=Transport()), {})
    with pytest.raises(HemislamError, match="has no session file"):
        forked(replace(a, session_file=None), {})


# --- two processes with an engine that knows the answer ------------------------------------------
@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Workspace]:
    """A at frame 20 of 300."""
    start = partial(EngineProcess, main=fakes.fake_main)
    setup = Setup(Path("walk-300.mcap"), session_folder=tmp_path)
    workspace = Workspace(start(setup), setup, start)
    workspace.send(Seek(20))
    until(lambda: workspace.snapshot, lambda s: s.transport.frame == 20)
    yield workspace
    workspace.close()


def speeds(snapshot: Snapshot) -> np.ndarray:
    """The fake engine's memory of the parameters that were in force so far, frame by frame."""
    return snapshot.series["speed"]


def test_a_fork_is_led_swapped_and_discarded(pair: Workspace, tmp_path: Path) -> None:
    pair.fork("wide", {"ground.sigma": 0.2})
    with pytest.raises(HemislamError, match="already"):
        pair.fork("another")
    pair.send(Seek(30))
    a, b = both_at(pair, 30)
    np.testing.assert_array_equal(speeds(a)[:21], speeds(b)[:21])
    assert (speeds(a)[21:] < speeds(b)[21:]).all() and pair.names == ("main", "wide") and pair.forked_at == 20
    pair.send(Seek(5))
    both_at(pair, 5)

    pair.send(SetSpeed(5.0))
    pair.send(Seek(30))
    both_at(pair, 30)
    pair.send(Play())
    until(lambda: pair.snapshot, lambda s: s.transport.playing)
    pair.swap()
    assert pair.names == ("wide", "main")
    playing = until(lambda: pair.snapshot, lambda s: s.transport.frame >= 33)
    assert playing.params.ground.sigma == 0.2 and playing.session != a.session and playing.transport.speed == 5.0
    follows = until(lambda: pair.other, lambda s: s.transport.frame >= 33)
    assert not follows.transport.playing and follows.params == Params()
    np.testing.assert_array_equal(speeds(follows)[:31], speeds(a)[:31])
    pair.send(Pause())

    kept = pair.snapshot.session_file
    pair.discard()
    assert pair.other is None and kept is not None and kept.exists(), "what A is now is not thrown away with the other"
    (first_file,) = tmp_path.glob("*.hemislam")
    assert set(session_files(tmp_path)) == {kept, first_file}, "both are offered; the start of a fork is not"
    until(lambda: pair.snapshot, lambda s: len(s.notes) == 2)
    assert [(note.frame, note.text.split()[0]) for note in pair.snapshot.notes][1:] == [
        (pair.snapshot.transport.frame, "Discarded")
    ]
    first = read_session(a.session_file)  # type: ignore[arg-type]  # None would fail
    assert first.state.notes == (Note(20, "Forked as wide with ground.sigma = 0.2."),)
    with pytest.raises(HemislamError, match="no fork"):
        pair.swap()


def test_a_discarded_fork_leaves_nothing_and_there_can_be_another(pair: Workspace, tmp_path: Path) -> None:
    pair.fork("", {"ground.sigma": 0.2})
    both_at(pair, 20)
    pair.discard()
    assert not list((tmp_path / "forks").iterdir())
    pair.fork("again", {"ground.sigma": 0.15})
    assert both_at(pair, 20)[1].params.ground.sigma == 0.15


@pytest.mark.parametrize("end", [Workspace.discard, Workspace.keep])
def test_what_was_opened_while_a_fork_was_a_outlives_the_fork(pair: Workspace, end: Callable[[Workspace], Any]) -> None:
    pair.fork("wide")
    both_at(pair, 20)
    pair.swap()
    first = pair.snapshot
    assert first.recording is not None and first.session_file is not None
    pair.send(OpenRecording(first.recording.path))
    until(lambda: pair.snapshot, lambda s: s.session != first.session and s.result is not None)
    pair.swap()
    end(pair)
    assert first.session_file.exists()


def test_a_kept_fork_is_a_file_of_its_name_that_replaces_none(pair: Workspace, tmp_path: Path) -> None:
    paths = []
    for frame in (22, 24):
        pair.fork("finer σ / 2", {"ground.sigma": 0.05})
        pair.send(StepFrame(2))
        both_at(pair, frame)
        paths.append(pair.keep())
    assert [path.name for path in paths] == ["walk-300-finer-σ---2.hemislam", "walk-300-finer-σ---2-2.hemislam"]
    assert [read_session(path).frame for path in paths] == [22, 24]
    assert pair.kept() == paths[::-1], "of this recording, but for A's own"
    pair.open(paths[1])
    opened = both_at(pair, 24)[1]
    assert opened.params.ground.sigma == 0.05 and pair.names[1] == paths[1].stem
    pair.discard()
    assert paths[1].exists(), "what was kept is not thrown away"
    pair.send(OpenRecording(paths[0]))
    opened = until(lambda: pair.snapshot, lambda s: s.params.ground.sigma == 0.05 and s.transport.frame == 22)
    assert speeds(opened)[20] < speeds(opened)[22]


def test_what_can_not_be_is_said(pair: Workspace) -> None:
    for act in (pair.swap, pair.discard, pair.keep):
        with pytest.raises(HemislamError, match="no fork"):
            act()
    with pytest.raises(HemislamError):
        pair.fork("x", {"ground.sigma": -1})
    assert pair.other is None


# --- the real engine -----------------------------------------------------------------------------
@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Workspace]:
    folder = tmp_path_factory.mktemp("sessions")
    params = resolve_params(SAMPLE, None, None, ["loops.enabled=false"])  # as yet, the walk comes back nowhere
    setup = Setup(SAMPLE, params=params, duration_s=6.0, session_folder=folder)
    workspace = Workspace(EngineProcess(setup), setup, EngineProcess)
    yield workspace
    workspace.close()


def same(a: Snapshot, b: Snapshot) -> None:
    """To the last bit, but for how long it took."""
    assert a.result is not None and b.result is not None
    np.testing.assert_array_equal(a.trajectory, b.trajectory)
    for name in SERIES:
        if not name.endswith("_ms"):
            np.testing.assert_array_equal(a.series[name], b.series[name], name)
    assert a.result.index == b.result.index
    for name in ("points", "labels", "intensity", "ring"):
        np.testing.assert_array_equal(getattr(a.result.cloud, name), getattr(b.result.cloud, name), name)
    np.testing.assert_array_equal(a.result.state.b_gyro, b.result.state.b_gyro)
    assert len(a.chunks) == len(b.chunks)


def test_a_fork_with_the_same_parameters_is_the_same_and_with_others_what_a_fresh_run_gives(real: Workspace) -> None:
    real.send(Seek(12))
    until(lambda: real.snapshot, lambda s: s.transport.frame == 12)
    real.fork("twin")
    for frame in (12, 13, 20):
        real.send(Seek(frame))
        same(*both_at(real, frame))
    real.send_other(SetParams(COARSE))
    until(lambda: real.other, lambda s: s.params.ground.sigma == 0.02)
    real.send(Seek(32))
    a, b = both_at(real, 32)

    session = open_session(SAMPLE, a.params, 0.0, 6.0)
    positions, turns = [], []
    while session.frame < 32:
        if session.frame == 20:
            session.choose(a.params.with_values(COARSE))
        result = session.advance()
        assert isinstance(result, StepResult)
        positions.append(result.T_map_imu[:3, 3])
        turns.append(result.state.R_odom_imu)
    session.close()
    np.testing.assert_array_equal(b.trajectory, positions)
    assert np.abs(a.trajectory - b.trajectory)[21:].max() > 1e-6, "the parameters were meant to change something"
    np.testing.assert_array_equal(a.trajectory[:21], b.trajectory[:21])
    from scipy.spatial.transform import Rotation

    told = np.column_stack([b.series[f"turn_{axis}"] for axis in "xyz"])
    np.testing.assert_allclose(Rotation.from_rotvec(told).as_matrix(), turns, atol=1e-9)


def test_a_killed_b_leaves_a_going_and_comes_back(real: Workspace) -> None:
    before, b = both_at(real, real.snapshot.transport.frame)
    pid = real._sides[1].engine.pid  # type: ignore[union-attr]
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    real.send(StepFrame(4))
    frame = before.transport.frame + 4
    a = until(lambda: real.snapshot, lambda s: s.transport.frame == frame)
    assert a.session == before.session and len(a.notices) == len(before.notices)
    _, again = both_at(real, frame)
    assert any("restarted" in notice.text for notice in again.notices)
    assert again.params == b.params
    np.testing.assert_array_equal(again.trajectory[: len(b.trajectory)], b.trajectory)


def test_a_kept_fork_opens_where_it_was(real: Workspace) -> None:
    _, b = both_at(real, real.snapshot.transport.frame)
    path = real.keep("coarse")
    assert path.name == f"{SAMPLE.stem}-coarse.hemislam" and real.other is None
    engine = EngineProcess(Setup(path, params=b.params))
    try:
        opened = until(lambda: engine.snapshot, lambda s: s.transport.frame == b.transport.frame and s.progress is None)
        same(opened, b)
        assert opened.params == b.params
    finally:
        engine.close()
