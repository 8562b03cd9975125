"""What commands do to a session, seen as the page sees it: through snapshots."""

import math
from pathlib import Path

import numpy as np
import pytest
import server_fakes as fakes
from session_desk import Desk, last_notice

from app.mapping.session import Session
from app.server.protocol import (
    Command,
    CompareWith,
    LoadParams,
    Pause,
    Play,
    Restart,
    Seek,
    SetParams,
    SetSpeed,
    Snapshot,
    StepFrame,
)
from app.slam.params import Params
from app.slam.types import GROUND


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
    desk.controller.handle(StepFrame())
    desk.controller.handle(StepFrame(3))
    snapshot = desk.settle()
    assert snapshot.transport.frame == before + 4 and not snapshot.transport.playing


@pytest.mark.parametrize("playing", [True, False])
def test_seeking_ahead_runs_on_with_progress_and_then_goes_on_as_before(playing: bool) -> None:
    desk = Desk()
    if playing:
        desk.do(Play())
    desk.controller.handle(Seek(40))
    for _ in range(20):
        desk.controller.work()
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
    assert len(desk.sessions) == 1, "the recording stays open"
    assert all(ours is theirs for ours, theirs in zip(snapshot.chunks, there.chunks, strict=False)), "sent only once"


def test_pause_ends_a_seek() -> None:
    desk = Desk()
    desk.controller.handle(Seek(50))
    for _ in range(10):
        desk.controller.work()
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
    desk.controller.open(Path("walk-60.mcap"), None)
    snapshot = desk.do(Seek(30), Play())
    assert snapshot.notices[-1].level != "error"
    assert snapshot.transport.frame == 31 and snapshot.transport.playing


def test_dragging_the_time_slider_back_and_forth_ends_where_it_was_let_go() -> None:
    desk = Desk()
    desk.do(Seek(50))
    for frame in (40, 20, 10, 35):
        desk.controller.handle(Seek(frame))
    assert desk.settle().transport.frame == 35
    assert len(desk.sessions) == 1, "not opened again"


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
    desk.controller.handle(SetParams({"ground.sigma": 0.2}))
    assert desk.outbox.urgent
    frame = desk.see().transport.frame
    desk.controller.work()
    snapshot = desk.see()
    assert snapshot.transport.frame == frame, "before the next frame"
    assert snapshot.result is not None
    assert np.mean(snapshot.result.cloud.labels == GROUND) == ground_share_below(snapshot, 0.2)
    desk.do(StepFrame())
    assert desk.sessions[0].engine.steps_with[-1].ground.sigma == 0.2  # type: ignore[attr-defined]


def test_a_frame_parameter_acts_on_the_next_frame_without_relabelling() -> None:
    desk = Desk()
    before = desk.see().result
    desk.do(SetParams({"filter.max_iterations": 7}))
    assert desk.see().result is before
    desk.do(StepFrame())
    assert desk.sessions[0].engine.steps_with[-1].filter.max_iterations == 7  # type: ignore[attr-defined]


def test_a_restart_parameter_waits_for_the_restart() -> None:
    desk = Desk()
    snapshot = desk.do(SetParams({"map.voxel_size": 2.5, "filter.max_iterations": 7}), StepFrame())
    assert snapshot.params.map.voxel_size == 2.5 and snapshot.pending_restart == ("map.voxel_size",)
    used = desk.sessions[0].engine.steps_with[-1]  # type: ignore[attr-defined]
    assert used.map.voxel_size == Params().map.voxel_size and used.filter.max_iterations == 7
    desk.do(Seek(0))
    assert desk.see().pending_restart == ("map.voxel_size",), "going back is no restart"
    snapshot = desk.do(Restart())
    assert snapshot.pending_restart == () and desk.sessions[-1].engine.params.map.voxel_size == 2.5


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


def test_steps_ahead_that_come_on_the_way_go_on_from_there(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk()
    desk.do(Pause())
    gone_back: list[int] = []
    monkeypatch.setattr(Session, "return_to", lambda _, checkpoint: gone_back.append(checkpoint.frame))
    begin = desk.fold.snapshot.transport.frame
    desk.controller.handle(StepFrame(5))
    for _ in range(3):
        desk.controller.work()
    desk.controller.handle(StepFrame(4))
    assert desk.settle().transport.frame == begin + 9
    assert gone_back == []


def test_a_comparison_on_the_way_back_waits_for_no_frame_that_is_forgotten() -> None:
    """The page is told of sixty frames still, and only those up to the one gone to are known."""
    desk = Desk()
    desk.do(SetSpeed(math.inf), Play())
    assert desk.fold.snapshot.transport.frame == 59
    desk.controller.handle(Seek(25))
    desk.controller.work()  # back at a checkpoint, not yet at the frame
    desk.controller.handle(SetParams({"ground.sigma": 0.05}))
    desk.controller.handle(CompareWith(None))
    assert desk.settle().transport.frame == 25
    assert len(desk.do(StepFrame(3)).series["stamp_s"]) == 29
