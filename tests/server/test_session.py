"""What commands do to a session, seen as the page sees it: through snapshots."""

import math
from pathlib import Path

import numpy as np
import pytest
import server_fakes as fakes

from app.server.delta import Fold, Outbox
from app.server.protocol import (
    Command,
    LoadParams,
    OpenRecording,
    Pause,
    Play,
    Restart,
    Save,
    Seek,
    SetParams,
    SetSpeed,
    Snapshot,
    StepFrame,
)
from app.server.run import Run
from app.server.session import Session
from app.slam.params import Params
from app.slam.trajectory import Trajectory, write_tum
from app.slam.types import GROUND


class Desk:
    """A session, its clock, and the page's view of it."""

    def __init__(self, recording: str | None = "walk-60.mcap", truth: Path | None = None, **kwargs: object) -> None:
        self.now = 0.0
        self.runs: list[Run] = []
        self.outbox = Outbox(Params())
        self.fold = Fold()
        self.session = Session(self.outbox, Params(), self._open, clock=lambda: self.now, **kwargs)  # type: ignore[arg-type]
        if recording:
            self.session.open(Path(recording), truth)
            self.settle()

    def _open(self, path: Path, truth: Path | None, params: Params, part: object = None, /) -> Run:
        self.runs.append(fakes.open_fake(path, truth, params))
        return self.runs[-1]

    def settle(self, limit: int = 1000) -> Snapshot:
        """Work until nothing is due at this moment."""
        for _ in range(limit):
            if self.session.work() != 0:
                break
        else:
            raise AssertionError("still busy")
        return self.see()

    def see(self) -> Snapshot:
        if self.outbox.filled:
            self.fold.apply(self.outbox.take())
        return self.fold.snapshot

    def do(self, *commands: Command) -> Snapshot:
        for command in commands:
            self.session.handle(command)
        return self.settle()

    def pass_time(self, seconds: float, step: float = 0.01) -> Snapshot:
        for _ in range(round(seconds / step)):
            self.now += step
            self.settle()
        return self.see()


def last_notice(snapshot: Snapshot) -> str:
    return snapshot.notices[-1].text


def test_an_opened_recording_shows_its_first_frame_and_what_needs_the_user() -> None:
    snapshot = Desk().see()
    assert snapshot.recording is not None and snapshot.recording.frames == 60
    assert snapshot.transport.frame == 0 and not snapshot.transport.playing
    assert snapshot.result is not None and snapshot.result.index == 0
    assert snapshot.progress is None
    assert [n.text for n in snapshot.notices] == ["The unit is unclear. --set recording.acceleration_unit=g"]


@pytest.mark.parametrize(("speed", "frames"), [(1.0, 10), (0.5, 5), (5.0, 50)])
def test_playing_for_a_second_replays_a_second_times_the_speed(speed: float, frames: int) -> None:
    desk = Desk()
    desk.do(SetSpeed(speed), Play())
    assert desk.pass_time(1.0).transport.frame == pytest.approx(frames, abs=1)


def test_as_fast_as_it_can_needs_no_time_and_stops_at_the_end() -> None:
    snapshot = Desk().do(SetSpeed(math.inf), Play())
    assert snapshot.transport.frame == 59
    assert snapshot.transport.finished and not snapshot.transport.playing


def test_after_a_stall_the_replay_goes_on_without_a_burst() -> None:
    desk = Desk()
    desk.do(Play())
    desk.pass_time(1.0)
    before = desk.see().transport.frame
    desk.now += 3.0
    assert desk.settle().transport.frame <= before + 1


def test_pause_stays_and_play_goes_on_from_there() -> None:
    desk = Desk()
    desk.do(Play())
    desk.pass_time(1.0)
    paused = desk.do(Pause()).transport.frame
    assert desk.pass_time(1.0).transport.frame == paused
    desk.do(Play())
    assert desk.pass_time(0.5).transport.frame == pytest.approx(paused + 5, abs=1)


def test_steps_pause_and_add_up() -> None:
    desk = Desk()
    before = desk.do(Play()).transport.frame
    desk.session.handle(StepFrame())
    desk.session.handle(StepFrame(3))
    snapshot = desk.settle()
    assert snapshot.transport.frame == before + 4 and not snapshot.transport.playing


@pytest.mark.parametrize("playing", [True, False])
def test_seeking_ahead_runs_on_with_progress_and_then_goes_on_as_before(playing: bool) -> None:
    desk = Desk()
    if playing:
        desk.do(Play())
    desk.session.handle(Seek(40))
    for _ in range(20):
        desk.session.work()
    halfway = desk.see()
    assert halfway.progress is not None and 0.3 < halfway.progress.fraction < 0.7
    snapshot = desk.settle()
    assert snapshot.transport.frame == (40 + playing) and snapshot.progress is None
    assert snapshot.transport.playing is playing
    assert snapshot.session == 1, "the scene goes on growing"


def test_seeking_back_takes_from_the_scene_what_came_later() -> None:
    desk = Desk()
    desk.do(Seek(50))
    there = desk.fold.snapshot
    snapshot = desk.do(Seek(12))
    assert snapshot.transport.frame == 12 and snapshot.session == 1
    assert snapshot.trajectory is not None and there.trajectory is not None
    assert np.array_equal(snapshot.trajectory, there.trajectory[:13])
    assert [chunk.index for chunk in snapshot.chunks] == [0, 1, 2]
    assert len(desk.runs) == 1, "the recording stays open"
    assert all(ours is theirs for ours, theirs in zip(snapshot.chunks, there.chunks, strict=False)), "sent only once"


def test_pause_ends_a_seek() -> None:
    desk = Desk()
    desk.session.handle(Seek(50))
    for _ in range(10):
        desk.session.work()
    snapshot = desk.do(Pause())
    assert snapshot.transport.frame == 10 and snapshot.progress is None


def test_a_seek_beyond_the_end_goes_to_the_last_frame() -> None:
    assert Desk().do(Seek(10_000)).transport.frame == 59


def test_playing_a_finished_recording_starts_it_again() -> None:
    desk = Desk()
    desk.do(Seek(59), Play())
    assert desk.see().transport.finished
    snapshot = desk.do(Play())
    assert snapshot.session == 2 and snapshot.transport.frame <= 1
    assert desk.pass_time(1.0).transport.frame == pytest.approx(10, abs=1)


def test_everything_the_page_draws_arrives() -> None:
    snapshot = Desk().do(Seek(20))
    assert snapshot.trajectory is not None and snapshot.keyframe_poses is not None
    expected = np.array([fakes.pose(index)[:3, 3] for index in range(21)])
    np.testing.assert_allclose(snapshot.trajectory, expected)
    np.testing.assert_allclose(snapshot.keyframe_poses, [fakes.pose(index) for index in (0, 5, 10, 15, 20)])
    assert len(snapshot.chunks) == 5
    arc = np.linalg.norm(np.diff(expected, axis=0), axis=1).sum()
    assert snapshot.series["distance"][-1] == pytest.approx(arc)
    assert snapshot.series["stamp_s"][-1] == pytest.approx(2.0)
    assert snapshot.series["speed"][-1] == pytest.approx(0.1)
    assert snapshot.series["degeneracy"][-1] == 1.0 and snapshot.series["total_ms"][-1] == 1.0
    assert snapshot.result is not None and snapshot.result.keyframe is None


def test_commands_given_while_a_recording_opens_act_once_it_is_open() -> None:
    desk = Desk(recording=None)
    desk.session.open(Path("walk-60.mcap"), None)
    snapshot = desk.do(Seek(30), Play())
    assert snapshot.notices[-1].level != "error"
    assert snapshot.transport.frame == 31 and snapshot.transport.playing


def test_dragging_the_time_slider_back_and_forth_ends_where_it_was_let_go() -> None:
    desk = Desk()
    desk.do(Seek(50))
    for frame in (40, 20, 10, 35):
        desk.session.handle(Seek(frame))
    assert desk.settle().transport.frame == 35
    assert len(desk.runs) == 1, "not opened again"


# --- parameters ----------------------------------------------------------------------------------
def ground_share_below(snapshot: Snapshot, height: float) -> float:
    assert snapshot.result is not None
    return float(np.mean(snapshot.result.cloud.points[:, 2] < height))


@pytest.mark.parametrize("playing", [True, False])
def test_a_ground_slider_relabels_the_present_frame_at_once_and_the_engine_uses_it(playing: bool) -> None:
    desk = Desk()
    desk.do(StepFrame(3))
    if playing:
        desk.do(Play())
    desk.session.handle(SetParams({"ground.sigma": 0.2}))
    assert desk.outbox.urgent
    frame = desk.see().transport.frame
    desk.session.work()
    snapshot = desk.see()
    assert snapshot.transport.frame == frame, "before the next frame"
    assert snapshot.result is not None
    assert np.mean(snapshot.result.cloud.labels == GROUND) == ground_share_below(snapshot, 0.2)
    desk.do(StepFrame())
    assert desk.runs[0].engine.steps_with[-1].ground.sigma == 0.2  # type: ignore[attr-defined]


def test_a_frame_parameter_acts_on_the_next_frame_without_relabelling() -> None:
    desk = Desk()
    before = desk.see().result
    desk.do(SetParams({"filter.max_iterations": 7}))
    assert desk.see().result is before
    desk.do(StepFrame())
    assert desk.runs[0].engine.steps_with[-1].filter.max_iterations == 7  # type: ignore[attr-defined]


def test_a_restart_parameter_waits_for_the_restart() -> None:
    desk = Desk()
    snapshot = desk.do(SetParams({"map.voxel_size": 2.5, "filter.max_iterations": 7}), StepFrame())
    assert snapshot.params.map.voxel_size == 2.5 and snapshot.pending_restart == ("map.voxel_size",)
    used = desk.runs[0].engine.steps_with[-1]  # type: ignore[attr-defined]
    assert used.map.voxel_size == Params().map.voxel_size and used.filter.max_iterations == 7
    desk.do(Seek(0))
    assert desk.see().pending_restart == ("map.voxel_size",), "going back is no restart"
    snapshot = desk.do(Restart())
    assert snapshot.pending_restart == () and desk.runs[-1].engine.params.map.voxel_size == 2.5


def test_taking_back_a_restart_parameter_leaves_nothing_pending() -> None:
    desk = Desk()
    default = Params().map.voxel_size
    assert desk.do(SetParams({"map.voxel_size": 2.5})).pending_restart
    assert desk.do(SetParams({"map.voxel_size": default})).pending_restart == ()


@pytest.mark.parametrize(
    ("command", "named"),
    [
        (SetParams({"ground.alpha": 900}), "ground.alpha"),
        (SetParams({"ground.alfa": 30}), "ground.alpha"),
        (LoadParams("ground: {sigma: wide}"), "ground.sigma"),
        (LoadParams("ground: ["), "YAML"),
        (SetSpeed(0.0), "speed"),
        (SetSpeed(math.nan), "speed"),
    ],
)
def test_a_value_that_can_not_be_used_is_refused_by_name(command: Command, named: str) -> None:
    desk = Desk()
    before = desk.see()
    snapshot = desk.do(command)
    assert snapshot.notices[-1].level == "error" and named in last_notice(snapshot)
    assert snapshot.params == before.params and snapshot.transport == before.transport


def test_loaded_yaml_replaces_all_parameters() -> None:
    desk = Desk()
    desk.do(SetParams({"ground.alpha": 30}))
    snapshot = desk.do(LoadParams("ground: {sigma: 0.05}"))
    assert snapshot.params == Params().with_values({"ground.sigma": 0.05})


# --- recordings ----------------------------------------------------------------------------------
def test_opening_another_recording_empties_the_scene_and_pauses() -> None:
    desk = Desk()
    desk.do(Play())
    desk.pass_time(1.0)
    snapshot = desk.do(OpenRecording(Path("walk-30.mcap")))
    assert snapshot.recording is not None and snapshot.recording.path == Path("walk-30.mcap")
    assert snapshot.transport.frame == 0 and not snapshot.transport.playing
    assert snapshot.trajectory is not None and len(snapshot.trajectory) == 1 and len(snapshot.chunks) == 1


def test_a_file_that_can_not_be_opened_leaves_the_session_as_it_is() -> None:
    desk = Desk()
    desk.do(Play())
    desk.pass_time(1.0)
    snapshot = desk.do(OpenRecording(Path("notes.txt")))
    assert last_notice(snapshot) == "notes.txt is not a recording; choose another file."
    assert snapshot.session == 1 and snapshot.progress is None and snapshot.transport.playing
    before = snapshot.transport.frame
    assert desk.pass_time(1.0).transport.frame > before


def test_another_recording_brings_its_own_device_but_keeps_what_was_tuned() -> None:
    def resolve(path: Path) -> Params:
        return Params().with_values({"sensor.translation": (1.0, 0.0, 0.0)} if path.stem == "walk-30" else {})

    desk = Desk(resolve=resolve)
    desk.do(SetParams({"ground.alpha": 33, "sensor.translation": (0.0, 0.0, 5.0)}))
    snapshot = desk.do(OpenRecording(Path("walk-30.mcap")))
    assert snapshot.params.sensor.translation == (1.0, 0.0, 0.0)
    assert snapshot.params.ground.alpha == 33
    assert snapshot.pending_restart == ()


def test_a_recording_damaged_in_the_middle_keeps_what_was_read() -> None:
    snapshot = Desk("broken-60-20.mcap").do(SetSpeed(math.inf), Play())
    assert "damaged at frame 20" in last_notice(snapshot)
    assert snapshot.transport.frame == 19 and not snapshot.transport.playing and snapshot.transport.finished
    assert snapshot.trajectory is not None and len(snapshot.trajectory) == 20


def test_an_engine_that_fails_on_a_frame_pauses_and_can_go_on() -> None:
    desk = Desk("failing-60-20.mcap")
    snapshot = desk.do(SetSpeed(math.inf), Play())
    assert "FloatingPointError: the covariance is not positive" in last_notice(snapshot)
    assert snapshot.transport.frame == 19 and not snapshot.transport.playing
    assert desk.do(Play()).transport.frame == 58, "one of 60 was left out"


def test_a_dropped_scan_is_counted_and_explained() -> None:
    snapshot = Desk("dropped-60-20.mcap").do(SetSpeed(math.inf), Play())
    assert snapshot.transport.dropped == 1 and snapshot.transport.frame == 58
    assert any("no IMU samples cover it" in notice.text for notice in snapshot.notices)


@pytest.mark.parametrize("command", [Play(), StepFrame(), Seek(3), Restart(), Save(Path("x"))])
def test_without_a_recording_a_command_asks_for_one(command: Command) -> None:
    assert "No recording is open" in last_notice(Desk(recording=None).do(command))


# --- truth and results ---------------------------------------------------------------------------
def truth_file(folder: Path, frames: int, wobble: float = 0.0) -> Path:
    """The fake walk's own poses, seen from another frame, with an error of `wobble` m up and down."""
    T_truth_map = np.eye(4)
    T_truth_map[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T_truth_map[:3, 3] = [100, 200, 300]
    poses = [T_truth_map @ fakes.pose(index) for index in range(frames)]
    for index, T in enumerate(poses):
        T[2, 3] += wobble * (-1) ** index
    path = folder / "truth.tum"
    write_tum(path, Trajectory.from_poses(fakes.START_NS + np.arange(frames) * fakes.FRAME_NS, poses))
    return path


def test_the_error_to_truth_is_what_remains_after_alignment(tmp_path: Path) -> None:
    snapshot = Desk(truth=truth_file(tmp_path, 60)).do(Seek(59))
    assert np.isnan(snapshot.series["error_m"][:3]).all(), "nothing to align before the walk has begun"
    assert snapshot.series["error_m"][-1] == pytest.approx(0.0, abs=1e-6)
    assert snapshot.T_map_truth is not None
    np.testing.assert_allclose(
        snapshot.T_map_truth[:3, :3] @ [100, 200, 300] + snapshot.T_map_truth[:3, 3], 0, atol=1e-6
    )


def test_an_error_of_a_centimetre_is_reported_as_such(tmp_path: Path) -> None:
    snapshot = Desk(truth=truth_file(tmp_path, 60, wobble=0.01)).do(Seek(59))
    assert snapshot.series["error_m"][-1] == pytest.approx(0.01, rel=0.1)


def test_results_are_written_while_replay_goes_on(tmp_path: Path) -> None:
    recording = tmp_path / "walk-60.mcap"
    recording.write_bytes(b"something to hash")
    desk = Desk(str(recording))
    desk.do(Seek(30))
    snapshot = desk.do(Save(tmp_path / "out"), Save(tmp_path / "short", trajectory_only=True))
    while len(snapshot.saved) < 2:
        snapshot = desk.do(StepFrame())
    assert [saved.error for saved in snapshot.saved] == ["", ""]
    assert {file.name for file in (tmp_path / "out").iterdir()} == {
        "trajectory.tum", "timings.csv", "map.ply", "report.json", "session.hemislam",
    }  # fmt: skip
    assert {file.name for file in (tmp_path / "short").iterdir()} == {"trajectory.tum"}
    assert len((tmp_path / "out/trajectory.tum").read_text().splitlines()) == 31


def test_a_folder_that_can_not_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    desk = Desk()
    desk.session.handle(Save(tmp_path / "file"))
    while not desk.see().saved:
        desk.session.work()
    assert str(tmp_path / "file") in desk.see().saved[0].error
    assert str(tmp_path / "file") in last_notice(desk.see())
