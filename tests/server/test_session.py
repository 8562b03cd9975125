"""The effects of commands on a session, seen like the page sees them: through snapshots."""

import math
from pathlib import Path

import numpy as np
import pytest
import server_fakes as fakes
from session_bench import Bench, last_notice

from app.mapping.kept import Measure, Note, Spot
from app.mapping.session import Session
from app.server import player
from app.server.keeping import AddNote, EditMeasure, EditNote
from app.server.protocol import (
    Command,
    CompareWith,
    LoadParams,
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
from app.slam.params import Params
from app.slam.types import GROUND


def test_an_opened_recording_shows_its_first_frame_and_what_needs_the_user() -> None:
    snapshot = Bench().see()
    assert snapshot.recording is not None and snapshot.recording.frames == 60
    assert snapshot.transport.frame == 0 and not snapshot.transport.playing
    assert snapshot.result is not None and snapshot.result.index == 0
    assert snapshot.progress is None
    assert [n.text for n in snapshot.notices] == ["IMU units: The unit is unclear. Settle it under Recording."]


@pytest.mark.parametrize(("speed", "frames"), [(1.0, 10), (0.5, 5), (5.0, 50)])
def test_playing_for_a_second_replays_a_second_times_the_speed(speed: float, frames: int) -> None:
    bench = Bench()
    bench.do(SetSpeed(speed), Play())
    assert bench.pass_time(1.0).transport.frame == pytest.approx(frames, abs=1)


def test_each_notice_names_the_recording_that_was_open() -> None:
    snapshot = Bench().do(SetSpeed(0.0), OpenRecording(Path("walk-30.mcap")))
    told = [(one.recording, one.text.split(" ")[0]) for one in snapshot.notices]
    assert told == [("walk-60.mcap", "IMU"), ("walk-60.mcap", "The"), ("walk-30.mcap", "IMU")]


def test_as_fast_as_it_can_needs_no_time_and_stops_at_the_end() -> None:
    snapshot = Bench().do(SetSpeed(math.inf), Play())
    assert snapshot.transport.frame == 59
    assert snapshot.transport.finished and not snapshot.transport.playing


def test_after_a_stall_the_replay_goes_on_without_a_burst() -> None:
    bench = Bench()
    bench.do(Play())
    bench.pass_time(1.0)
    before = bench.see().transport.frame
    bench.now += 3.0
    assert bench.settle().transport.frame <= before + 1


def test_pause_stays_and_play_goes_on_from_there() -> None:
    bench = Bench()
    bench.do(Play())
    bench.pass_time(1.0)
    paused = bench.do(Pause()).transport.frame
    assert bench.pass_time(1.0).transport.frame == paused
    bench.do(Play())
    assert bench.pass_time(0.5).transport.frame == pytest.approx(paused + 5, abs=1)


def test_steps_pause_and_add_up() -> None:
    bench = Bench()
    before = bench.do(Play()).transport.frame
    bench.controller.handle(StepFrame())
    bench.controller.handle(StepFrame(3))
    snapshot = bench.settle()
    assert snapshot.transport.frame == before + 4 and not snapshot.transport.playing


@pytest.mark.parametrize("playing", [True, False])
def test_seeking_ahead_runs_on_with_progress_and_then_goes_on_as_before(playing: bool) -> None:
    bench = Bench()
    if playing:
        bench.do(Play())
    bench.controller.handle(Seek(40))
    for _ in range(20):
        bench.controller.work()
    halfway = bench.see()
    assert halfway.progress is not None and 0.3 < halfway.progress.fraction < 0.7
    snapshot = bench.settle()
    assert snapshot.transport.frame == (40 + playing) and snapshot.progress is None
    assert snapshot.transport.playing is playing
    assert snapshot.session == 1, "the scene goes on growing"


def test_seeking_back_takes_from_the_scene_what_came_later() -> None:
    bench = Bench()
    bench.do(Seek(50))
    there = bench.fold.snapshot
    snapshot = bench.do(Seek(12))
    assert snapshot.transport.frame == 12 and snapshot.session == 1
    assert np.array_equal(snapshot.trajectory, there.trajectory[:13])
    assert [chunk.index for chunk in snapshot.chunks] == [0, 1, 2]
    assert len(bench.sessions) == 1, "the recording stays open"
    assert all(ours is theirs for ours, theirs in zip(snapshot.chunks, there.chunks, strict=False)), "sent only once"


def test_pause_ends_a_seek() -> None:
    bench = Bench()
    bench.controller.handle(Seek(50))
    for _ in range(10):
        bench.controller.work()
    snapshot = bench.do(Pause())
    assert snapshot.transport.frame == 10 and snapshot.progress is None


@pytest.mark.parametrize("frame", [59, 10_000])
def test_a_seek_to_the_last_frame_or_beyond_ends_the_recording(frame: int) -> None:
    transport = Bench().do(Seek(frame)).transport
    assert (transport.frame, transport.finished) == (59, True)
    assert not Bench().do(Seek(58)).transport.finished


def test_playing_a_finished_recording_goes_back_to_its_start_and_loses_nothing() -> None:
    bench = Bench()
    bench.do(Seek(30), AddNote("here"), Seek(59), Play())
    ended = bench.see()
    assert ended.transport.finished
    snapshot = bench.do(Play())
    assert snapshot.session == ended.session and snapshot.transport.frame <= 1 and not snapshot.transport.finished
    assert snapshot.notes == ended.notes != ()
    assert bench.pass_time(1.0).transport.frame == pytest.approx(10, abs=1)
    assert bench.sessions[0].known == 59, "the frames that were processed are still known"


def test_a_note_is_changed_and_deleted_unless_another_page_has_changed_it() -> None:
    bench = Bench()
    bench.do(Seek(30), AddNote("here"), AddNote("there"))
    here, there = bench.see().notes
    notes = bench.do(EditNote(here, " at the door "), EditNote(here, "x")).notes
    assert [note.text for note in notes] == ["at the door", "there"]
    assert "Another page has changed or deleted that note" in last_notice(bench.see())
    gone = Measure("door", (Spot(0, (0.0, 0.0, 0.0)),))
    assert "Another page has changed or deleted that measure" in last_notice(bench.do(EditMeasure(gone, "gate")))
    assert bench.do(EditNote(notes[0], ""), EditNote(here, "")).notes == (there,)
    (changed,) = bench.do(EditNote(there, "now the first in the list")).notes
    assert changed.text == "now the first in the list", "that another page deleted an earlier one does not matter"


def test_of_two_equal_notes_one_is_deleted() -> None:
    (note, _) = Bench().do(AddNote("here"), AddNote("here"), EditNote(Note(0, "here"), ""), AddNote("there")).notes
    assert note == Note(0, "here")


def test_a_restart_keeps_the_notes() -> None:
    bench = Bench()
    notes = bench.do(Seek(30), AddNote("here")).notes
    assert bench.do(Restart()).notes == notes


def test_a_restart_of_a_live_source_begins_a_map_without_the_notes_of_the_one_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fakes.FakeFeed, "repeatable", False)
    bench = Bench()
    assert bench.do(AddNote("here")).notes
    again = bench.do(Restart())
    assert again.notes == () and again.transport.frame == 0


def test_a_note_before_the_first_frame_belongs_to_it() -> None:
    (note,) = Bench().do(Pause(), Restart(), AddNote("at the start")).notes
    assert note.frame == 0


def test_everything_the_page_draws_arrives() -> None:
    snapshot = Bench().do(Seek(20))
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
    bench = Bench(recording=None)
    bench.controller.open(Path("walk-60.mcap"), None)
    snapshot = bench.do(Seek(30), Play())
    assert snapshot.notices[-1].level != "error"
    assert snapshot.transport.frame == 31 and snapshot.transport.playing


def test_dragging_the_time_slider_back_and_forth_ends_where_it_was_let_go() -> None:
    bench = Bench()
    bench.do(Seek(50))
    for frame in (40, 20, 10, 35):
        bench.controller.handle(Seek(frame))
    assert bench.settle().transport.frame == 35
    assert len(bench.sessions) == 1, "not opened again"


# --- parameters ----------------------------------------------------------------------------------
def ground_share_below(snapshot: Snapshot, height: float) -> float:
    assert snapshot.result is not None
    return float(np.mean(snapshot.result.cloud.points[:, 2] < height))


@pytest.mark.parametrize("playing", [True, False])
def test_a_ground_slider_relabels_the_present_frame_at_once_and_the_engine_uses_it(playing: bool) -> None:
    bench = Bench()
    bench.do(StepFrame(3))
    if playing:
        bench.do(Play())
    bench.controller.handle(SetParams({"ground.sigma": 0.2}))
    assert bench.page.urgent
    frame = bench.see().transport.frame
    bench.controller.work()
    snapshot = bench.see()
    assert snapshot.transport.frame == frame, "before the next frame"
    assert snapshot.result is not None
    assert np.mean(snapshot.result.cloud.labels == GROUND) == ground_share_below(snapshot, 0.2)
    bench.do(StepFrame())
    assert bench.sessions[0].engine.steps_with[-1].ground.sigma == 0.2  # type: ignore[attr-defined]


def test_a_frame_parameter_acts_on_the_next_frame_without_relabelling() -> None:
    bench = Bench()
    before = bench.see().result
    bench.do(SetParams({"filter.max_iterations": 7}))
    assert bench.see().result is before
    bench.do(StepFrame())
    assert bench.sessions[0].engine.steps_with[-1].filter.max_iterations == 7  # type: ignore[attr-defined]


def test_a_restart_parameter_waits_for_the_restart() -> None:
    bench = Bench()
    snapshot = bench.do(SetParams({"map.voxel_size": 2.5, "filter.max_iterations": 7}), StepFrame())
    assert snapshot.params.map.voxel_size == 2.5 and snapshot.pending_restart == ("map.voxel_size",)
    used = bench.sessions[0].engine.steps_with[-1]  # type: ignore[attr-defined]
    assert used.map.voxel_size == Params().map.voxel_size and used.filter.max_iterations == 7
    bench.do(Seek(0))
    assert bench.see().pending_restart == ("map.voxel_size",), "going back is no restart"
    snapshot = bench.do(Restart())
    assert snapshot.pending_restart == () and bench.sessions[-1].engine.params.map.voxel_size == 2.5


@pytest.mark.parametrize("frame", [0, 30, 59])
def test_a_restart_that_stays_returns_to_the_frame_shown(frame: int) -> None:
    bench = Bench()
    shown = bench.do(Seek(frame)).transport
    restarted = bench.do(Restart(stay=True))
    assert len(bench.sessions) == 2 and restarted.session == 2
    assert (restarted.transport.frame, restarted.transport.finished) == (frame, shown.finished)
    assert bench.do(Restart()).transport.frame == 0


def test_a_restart_that_stays_goes_on_to_the_frame_that_the_session_was_going_to() -> None:
    bench = Bench()
    bench.controller.handle(Seek(50))
    for _ in range(9):
        bench.controller.work()
    assert 0 < bench.see().transport.frame < 50
    assert bench.do(Restart(stay=True)).transport.frame == 50


def test_taking_back_a_restart_parameter_leaves_nothing_pending() -> None:
    bench = Bench()
    default = Params().map.voxel_size
    assert bench.do(SetParams({"map.voxel_size": 2.5})).pending_restart
    assert bench.do(SetParams({"map.voxel_size": default})).pending_restart == ()


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
    bench = Bench()
    before = bench.see()
    snapshot = bench.do(command)
    assert snapshot.notices[-1].level == "error" and named in last_notice(snapshot)
    assert snapshot.params == before.params and snapshot.transport == before.transport


def test_loaded_yaml_replaces_all_parameters() -> None:
    bench = Bench()
    bench.do(SetParams({"ground.alpha": 30}))
    snapshot = bench.do(LoadParams("ground: {sigma: 0.05}"))
    assert snapshot.params == Params().with_values({"ground.sigma": 0.05})


def test_steps_ahead_that_come_on_the_way_go_on_from_there(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    bench.do(Pause())
    gone_back: list[int] = []
    monkeypatch.setattr(Session, "return_to", lambda _, checkpoint: gone_back.append(checkpoint.frame))
    begin = bench.fold.snapshot.transport.frame
    bench.controller.handle(StepFrame(5))
    for _ in range(3):
        bench.controller.work()
    bench.controller.handle(StepFrame(4))
    assert bench.settle().transport.frame == begin + 9
    assert gone_back == []


def test_a_comparison_on_the_way_back_waits_for_no_frame_that_is_forgotten() -> None:
    """The page is told of sixty frames still, and only those up to the one gone to are known."""
    bench = Bench()
    bench.do(SetSpeed(math.inf), Play())
    assert bench.fold.snapshot.transport.frame == 59
    bench.controller.handle(Seek(25))
    bench.controller.work()  # back at a checkpoint, not yet at the frame
    bench.controller.handle(SetParams({"ground.sigma": 0.05}))
    bench.controller.handle(CompareWith(None))
    assert bench.settle().transport.frame == 25
    assert len(bench.do(StepFrame(3)).series["stamp_s"]) == 29


def test_a_doubt_is_told_while_it_plays_and_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(player, "doubts", lambda log, _: (f"It moves at {len(log)} m/s.",) if len(log) > 150 else ())
    bench = Bench("walk-250.mcap")
    bench.do(Seek(190))
    assert not [notice for notice in bench.see().notices if "doubtful" in notice.text]
    bench.do(Seek(240))
    bench.do(SetSpeed(math.inf), Play())
    told = [notice.text for notice in bench.see().notices if "doubtful" in notice.text]
    assert told == ["This run is doubtful. It moves at 201 m/s."]
