"""Files that a session reads and writes: recordings, truth, results; and the behaviour if they cannot be used."""

import errno
import io
import math
import threading
from pathlib import Path

import numpy as np
import pytest
import server_fakes as fakes
from session_bench import Bench, last_notice

from app.export.points import Choice
from app.mapping.breakpoints import Breakpoints
from app.mapping.kept import Note
from app.mapping.session_file import read_session
from app.server.fork import forked
from app.server.keeping import AddNote
from app.server.protocol import (
    Calibrated,
    Command,
    CompareWith,
    OpenRecording,
    Pause,
    Play,
    Progress,
    Restart,
    Save,
    Seek,
    SetBreakpoints,
    SetParams,
    SetSpeed,
    StepFrame,
)
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.trajectory import Trajectory, write_tum
from app.ui.files import last_saved


# --- recordings ----------------------------------------------------------------------------------
def test_opening_another_recording_empties_the_scene_and_pauses() -> None:
    bench = Bench()
    bench.do(Play())
    bench.pass_time(1.0)
    snapshot = bench.do(OpenRecording(Path("walk-30.mcap")))
    assert snapshot.recording is not None and snapshot.recording.path == Path("walk-30.mcap")
    assert snapshot.transport.frame == 0 and not snapshot.transport.playing
    assert len(snapshot.trajectory) == 1 and len(snapshot.chunks) == 1


def test_a_file_that_can_not_be_opened_leaves_the_session_as_it_is() -> None:
    bench = Bench()
    bench.do(Play())
    bench.pass_time(1.0)
    snapshot = bench.do(OpenRecording(Path("notes.txt")))
    assert last_notice(snapshot) == "notes.txt is not a recording; choose another file."
    assert snapshot.session == 1 and snapshot.progress is None and snapshot.transport.playing
    before = snapshot.transport.frame
    assert bench.pass_time(1.0).transport.frame > before


def test_another_recording_brings_its_own_device_but_keeps_what_was_tuned() -> None:
    def resolve(path: Path) -> Params:
        return Params().with_values({"sensor.translation": (1.0, 0.0, 0.0)} if path.stem == "walk-30" else {})

    bench = Bench(resolve=resolve)
    bench.do(SetParams({"ground.alpha": 33, "sensor.translation": (0.0, 0.0, 5.0)}))
    snapshot = bench.do(OpenRecording(Path("walk-30.mcap")))
    assert snapshot.params.sensor.translation == (1.0, 0.0, 0.0)
    assert snapshot.params.ground.alpha == 33
    assert snapshot.pending_restart == ()


def test_the_same_recording_opened_again_keeps_its_calibration() -> None:
    bench = Bench(resolve=lambda path: Params())
    bench.do(SetParams({"sensor.translation": (0.0, 0.0, 5.0)}), Calibrated("The LiDAR seems to be at 5 m."))
    for again in (OpenRecording(Path("walk-60.mcap")), Restart()):
        assert bench.do(again).params.sensor.translation == (0.0, 0.0, 5.0)
        assert bench.sessions[-1].results().info.calibration == "The LiDAR seems to be at 5 m."
    bench.do(OpenRecording(Path("walk-30.mcap")))
    assert bench.sessions[-1].results().info.calibration == ""


def test_a_recording_damaged_in_the_middle_keeps_what_was_read() -> None:
    snapshot = Bench("broken-60-20.mcap").do(SetSpeed(math.inf), Play())
    assert "damaged at frame 20" in last_notice(snapshot)
    assert snapshot.transport.frame == 19 and not snapshot.transport.playing and snapshot.transport.finished
    assert len(snapshot.trajectory) == 20


def test_an_engine_that_fails_on_a_frame_pauses_and_can_go_on() -> None:
    bench = Bench("failing-60-20.mcap")
    snapshot = bench.do(SetSpeed(math.inf), Play())
    assert "FloatingPointError: the covariance is not positive" in last_notice(snapshot)
    assert snapshot.transport.frame == 19 and not snapshot.transport.playing
    assert bench.do(Play()).transport.frame == 58, "one of 60 was left out"


def test_a_dropped_scan_is_counted_and_explained() -> None:
    snapshot = Bench("dropped-60-20.mcap").do(SetSpeed(math.inf), Play())
    assert snapshot.transport.dropped == 1 and snapshot.transport.frame == 58
    assert any("no IMU samples cover it" in notice.text for notice in snapshot.notices)


@pytest.mark.parametrize("command", [Play(), StepFrame(), Seek(3), Restart(), Save(Path("x"))])
def test_without_a_recording_a_command_asks_for_one(command: Command) -> None:
    assert "No recording is open" in last_notice(Bench(recording=None).do(command))


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
    bench = Bench(truth=truth_file(tmp_path, 60))
    snapshot = bench.do(Seek(59))
    first = bench.do(Seek(0))
    assert first.T_map_truth is None and np.isnan(first.series["error_m"]).all(), "nothing to align yet"
    np.testing.assert_allclose(snapshot.series["error_m"], 0.0, atol=1e-6)
    assert snapshot.T_map_truth is not None
    np.testing.assert_allclose(
        snapshot.T_map_truth[:3, :3] @ [100, 200, 300] + snapshot.T_map_truth[:3, 3], 0, atol=1e-6
    )


def test_an_error_of_a_centimetre_is_reported_as_such(tmp_path: Path) -> None:
    snapshot = Bench(truth=truth_file(tmp_path, 60, wobble=0.01)).do(Seek(59))
    assert snapshot.series["error_m"][-1] == pytest.approx(0.01, rel=0.1)


def test_a_session_is_reopened_with_its_speed_and_breakpoints(tmp_path: Path) -> None:
    recording = tmp_path / "walk-60.mcap"
    recording.write_bytes(b"something to hash")
    bench = Bench(str(recording), session_folder=tmp_path / "sessions")
    chosen = Breakpoints(no_ground=True, error=0.2)
    snapshot = bench.do(SetBreakpoints(chosen), SetSpeed(math.inf), Seek(30))
    bench.controller.close()
    again = Bench(str(snapshot.session_file)).see()
    assert (again.breakpoints, again.transport.speed, again.transport.frame) == (chosen, math.inf, 30)
    assert not again.transport.playing


def test_what_a_script_fetches_does_not_take_the_place_of_the_results_that_were_saved(tmp_path: Path) -> None:
    """REST removes its folder at once, so the page must neither tell of it nor offer its files."""
    recording = tmp_path / "walk-60.mcap"
    recording.write_bytes(b"something to hash")
    bench = Bench(str(recording))
    bench.do(Seek(10))
    snapshot = bench.do(Save(tmp_path / "mine"), Save(tmp_path / "fetched", formats=("tum",), fetched=True))
    while len(snapshot.saved) < 2:
        snapshot = bench.do(StepFrame())
    assert (tmp_path / "fetched" / "trajectory.tum").is_file()
    told = [notice.text for notice in snapshot.notices if notice.text.startswith("Saved in")]
    assert told == [f"Saved in {tmp_path / 'mine'}."]
    assert last_saved(snapshot) == tmp_path / "mine"


def test_results_are_written_while_replay_goes_on(tmp_path: Path) -> None:
    recording = tmp_path / "walk-60.mcap"
    recording.write_bytes(b"something to hash")
    bench = Bench(str(recording))
    bench.do(Seek(30))
    snapshot = bench.do(Save(tmp_path / "out"), Save(tmp_path / "short", formats=("tum",)))
    while len(snapshot.saved) < 2:
        snapshot = bench.do(StepFrame())
    assert [saved.error for saved in snapshot.saved] == ["", ""]
    assert [notice.text for notice in snapshot.notices[-2:]] == [
        f"Saved in {tmp_path / name}." for name in ("out", "short")
    ]
    assert {file.name for file in (tmp_path / "out").iterdir()} == {
        "trajectory.tum", "timings.csv", "map.ply", "report.json", "session.hemislam",
    }  # fmt: skip
    assert {file.name for file in (tmp_path / "short").iterdir()} == {"trajectory.tum"}
    assert len((tmp_path / "out/trajectory.tum").read_text().splitlines()) == 31


def test_formats_of_other_programs_are_written_and_what_they_lack_is_said(tmp_path: Path) -> None:
    recording = tmp_path / "walk-60.mcap"
    recording.write_bytes(b"something to hash")
    bench = Bench(str(recording))
    bench.do(Seek(30))
    save, shares = Save(tmp_path / "laz", ("laz", "csv"), Choice(0.1)), set()
    snapshot = bench.do(save, Save(tmp_path / "gpx", ("gpx",)))
    while len(snapshot.saved) < 2:
        shares.add(snapshot.progress.fraction if snapshot.progress else None)
        snapshot = bench.do(StepFrame())
    assert snapshot.progress is None and shares != {None}
    assert {file.name for file in (tmp_path / "laz").iterdir()} == {"map.laz", "trajectory.csv"}
    assert snapshot.saved[0].error == "" and "georeferenced" in snapshot.saved[1].error


def test_a_save_that_waits_does_not_show_how_far_the_last_one_was(tmp_path: Path) -> None:
    recording = tmp_path / "walk-60.mcap"
    recording.write_bytes(b"something to hash")
    bench, may_go_on = Bench(str(recording)), threading.Event()
    bench.do(Seek(30), Save(tmp_path / "first", ("csv", "ply")))
    while not bench.see().saved:
        bench.do()
    bench.sessions[-1]._saves.submit(may_go_on.wait)
    snapshot = bench.do(Save(tmp_path / "second", ("ply",)))
    assert snapshot.progress is not None and snapshot.progress.fraction == 0.0
    may_go_on.set()


def test_a_recording_that_has_to_wait_for_a_save_says_so_and_can_still_be_another(tmp_path: Path) -> None:
    bench, may_go_on = Bench(), threading.Event()
    bench.do(Seek(30))
    bench.sessions[-1]._saves.submit(may_go_on.wait, 5.0)
    waiting = bench.do(Save(tmp_path / "first", ("ply",)), OpenRecording(Path("walk-30.mcap")))
    assert waiting.progress is not None and waiting.progress.title == "Saving, then opening walk-30.mcap"
    waiting = bench.do(OpenRecording(Path("walk-20.mcap")))
    assert waiting.progress is not None and waiting.progress.title == "Saving, then opening walk-20.mcap"
    assert waiting.recording is not None and waiting.recording.path == Path("walk-60.mcap")
    may_go_on.set()
    while bench.controller.work() != 0:
        pass
    saved = bench.see()
    assert saved.saved[0].error == "" and saved.progress == Progress.opening(Path("walk-20.mcap"))
    opened = bench.settle()
    assert opened.recording is not None and opened.recording.path == Path("walk-20.mcap") and opened.progress is None
    assert len(bench.sessions) == 2


@pytest.mark.parametrize(("name", "why"), [("file", "File exists"), ("n" * 300, "File name too long")])
def test_a_folder_that_can_not_be_written_is_named(tmp_path: Path, name: str, why: str) -> None:
    (tmp_path / "file").write_text("in the way")
    bench = Bench()
    bench.controller.handle(Save(tmp_path / name))
    while not bench.see().saved:
        bench.controller.work()
    assert f"The folder {tmp_path / name} cannot be made: {why};" in bench.see().saved[0].error
    assert str(tmp_path / name) in last_notice(bench.see())


def test_a_walk_is_compared_with_another_trajectory_without_being_walked_again(tmp_path: Path) -> None:
    bench, truth = Bench(), truth_file(tmp_path, 60, wobble=0.01)
    before = bench.do(Seek(59), Seek(40))
    assert np.isnan(before.series["error_m"]).all()
    compared = bench.do(CompareWith(truth))
    assert len(compared.series["error_m"]) == 41 and compared.transport.frame == 40
    assert compared.series["error_m"] == pytest.approx(0.01, rel=0.2), "of frames that were walked before, too"
    np.testing.assert_array_equal(compared.series["stamp_s"], before.series["stamp_s"])
    np.testing.assert_array_equal(compared.trajectory, before.trajectory)
    assert compared.recording is not None and compared.recording.truth == truth
    assert compared.T_map_truth is not None
    later = bench.do(Seek(59), StepFrame(-1))
    assert later.series["error_m"] == pytest.approx(0.01, rel=0.2), "of those gone back over, and when stepping back"
    nothing = bench.do(CompareWith(None))
    assert np.isnan(nothing.series["error_m"]).all() and nothing.T_map_truth is None


def test_a_trajectory_of_another_time_is_refused_and_the_one_before_stays(tmp_path: Path) -> None:
    truth = truth_file(tmp_path, 60)
    bench = Bench(truth=truth)
    bench.do(Seek(20))
    elsewhere = tmp_path / "later.tum"
    write_tum(elsewhere, Trajectory.from_poses(10**18 + np.arange(9) * fakes.FRAME_NS, np.tile(np.eye(4), (9, 1, 1))))
    snapshot = bench.do(CompareWith(elsewhere))
    assert "later.tum covers 1000000000.0 s to" in last_notice(snapshot)
    assert snapshot.recording is not None and snapshot.recording.truth == truth
    assert np.isfinite(snapshot.series["error_m"][-1])
    opened = Bench(truth=elsewhere).see()
    assert "later.tum covers" in last_notice(opened), "also when it is opened with the recording"


def test_a_session_remembers_what_it_was_compared_with_and_opens_without_it_if_that_is_gone(tmp_path: Path) -> None:
    recording, truth = tmp_path / "walk-60.mcap", truth_file(tmp_path, 60, wobble=0.01)
    recording.write_bytes(b"something to hash")
    bench = Bench(str(recording), session_folder=tmp_path / "sessions")
    snapshot = bench.do(Seek(30), CompareWith(truth))
    assert snapshot.session_file is not None
    bench.controller.close()
    again = Bench(str(snapshot.session_file)).see()
    assert again.series["error_m"][-1] == pytest.approx(0.01, rel=0.2)
    truth.unlink()
    without = Bench(str(snapshot.session_file)).see()
    assert without.transport.frame == 30 and np.isnan(without.series["error_m"]).all()
    assert "truth.tum, which no longer exists" in last_notice(without)


# --- on the way back to where a session was -------------------------------------------------------
@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """A session file at frame 50, with a note there."""
    bench = Bench(session_folder=tmp_path)
    bench.do(Seek(50))
    file = bench.do(AddNote("there")).session_file
    bench.controller.close()
    assert file is not None
    return file


def reopened(file: Path, at: int) -> Bench:
    """The session, opened again and on its way, at this frame."""
    bench = Bench(None, session_folder=file.parent)
    bench.controller.open(file, None)
    while bench.see().transport.frame < at:
        bench.controller.work()
    return bench


def test_a_session_closed_on_its_way_is_kept_as_it_was(kept: Path) -> None:
    bench = reopened(kept, 20)
    bench.controller.close()
    file = bench.see().session_file
    assert file is not None and file != kept
    assert read_session(file) == read_session(kept)


def test_a_note_made_where_one_stopped_on_the_way_is_of_that_frame(kept: Path) -> None:
    bench = reopened(kept, 20)
    bench.do(Pause())
    stopped = bench.do(AddNote("here"))
    assert 20 <= stopped.transport.frame < 50
    assert stopped.notes == (Note(50, "there"), Note(stopped.transport.frame, "here"))
    bench.do(Seek(10))
    assert bench.do(AddNote("back")).notes[-1] == Note(10, "back")


def test_a_file_that_cannot_be_opened_loses_nothing_that_waits_for_the_way_to_end(kept: Path) -> None:
    bench = reopened(kept, 20)
    bench.controller.handle(AddNote("once there"))
    bench.controller.handle(OpenRecording(Path("notes.txt")))
    assert bench.settle().notes == (Note(50, "there"), Note(50, "once there"))


def test_what_waited_for_a_session_that_was_left_is_not_done_in_the_next(kept: Path, tmp_path: Path) -> None:
    bench = reopened(kept, 20)
    bench.controller.handle(Save(tmp_path / "results"))
    bench.controller.handle(AddNote("once there"))
    bench.controller.handle(OpenRecording(Path("walk-30.mcap")))
    bench.controller.handle(AddNote("in the next"))
    left = bench.settle()
    assert [note.text for note in left.notes] == ["in the next"]
    assert [(saved.folder, saved.error) for saved in left.saved] == [
        (tmp_path / "results", "Another recording was opened before it was saved.")
    ]


def test_a_session_that_had_gone_back_still_knows_the_frames_ahead(tmp_path: Path) -> None:
    first = Bench(session_folder=tmp_path)
    for sigma, frame in ((0.1, 30), (0.2, 50), (0.05, 10)):
        first.do(SetParams({"ground.sigma": sigma}))
        file = first.do(Seek(frame)).session_file
    assert file is not None
    again = reopened(file, 10)
    ahead, as_it_was = again.do(Seek(50)), first.do(Seek(50))
    assert ahead.transport.frame == as_it_was.transport.frame == 50
    np.testing.assert_array_equal(ahead.series["speed"], as_it_was.series["speed"])


class Filling(io.StringIO):
    """A file whose disk is full once `last` is to be written."""

    def __init__(self, last: str) -> None:
        super().__init__()
        self.last = last

    def write(self, text: str) -> int:
        if self.last in text:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(text)


def test_a_disk_that_fills_up_is_reported_once_and_playing_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "open", lambda *_, **__: Filling('"frame": 20'))
    bench = Bench(session_folder=tmp_path)
    told = [notice.text for notice in bench.do(Seek(40)).notices if "are not saved" in notice.text]
    assert len(told) == 1 and "No space left on device" in told[0]
    assert bench.see().transport.frame == 40
    with pytest.raises(HemislamError, match="cannot be forked"):
        forked(bench.see(), {})  # it would repeat another session


def test_a_disk_that_is_full_when_a_session_is_reopened_is_reported(
    kept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(None, session_folder=kept.parent)
    opened = Path.open
    monkeypatch.setattr(
        Path, "open", lambda path, mode="r", **how: Filling('"state"') if mode == "x" else opened(path, mode, **how)
    )
    told = [notice.text for notice in bench.do(OpenRecording(kept)).notices if "are not saved" in notice.text]
    assert len(told) == 1 and bench.see().session_file is None
