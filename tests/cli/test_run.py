"""`hemislam run` from the outside: correct results, the same bytes every time, and nothing lost after a failure."""

import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from app.__main__ import cli, main
from app.export.exports import BY_RUN
from app.mapping.session import Session
from app.mapping.session_file import Opened, SavedSession, State, new_path, size_of, write_session
from app.sensors.presets import resolve_params
from app.slam.errors import HemislamError
from app.slam.metrics import ate
from app.slam.params import Params
from app.slam.trajectory import Trajectory, read_tum, truth_beside, write_tum

Call = Callable[..., Any]
RESULTS = sorted(export.name for export in BY_RUN)


def test_help_lists_every_result_file_with_its_meaning(hemislam: Call) -> None:
    lines = [" ".join(line.split()) for line in hemislam("run", "--help").out.splitlines()]
    assert [line for line in lines if any(line.startswith(f"{export.name} ") for export in BY_RUN)] == [
        f"{export.name} {export.meaning}" for export in BY_RUN
    ]


@pytest.fixture(scope="module")
def first(hemislam_alone: Call, walk: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Path]:
    folder = tmp_path_factory.mktemp("results") / "first"
    return hemislam_alone("run", walk, "--out", folder), folder


def test_a_walk_in_a_room_is_followed_to_a_centimetre(first: tuple[Any, Path], walk: Path) -> None:
    outcome, folder = first
    assert outcome.code == 0, outcome.err
    error = ate(read_tum(folder / "trajectory.tum"), read_tum(walk.with_name("walk_truth.tum")))
    assert error.position.rmse < 0.01
    assert error.rotation.rmse < 1.0
    report = json.loads((folder / "report.json").read_text())
    assert report["accuracy"]["ate_m"]["rmse"] == pytest.approx(error.position.rmse, abs=1e-7)
    assert report["frames"]["processed"] == 39
    assert report["ground"]["f1"] > 0.9


def test_the_map_is_turned_as_far_as_the_report_says_and_its_heading_stays(first: tuple[Any, Path]) -> None:
    level, odometry = (read_tum(first[1] / name).rotations for name in ("trajectory.tum", "trajectory_odometry.tum"))
    turn = (level * odometry.inv()).mean().as_rotvec(degrees=True)
    reported = json.loads((first[1] / "report.json").read_text())["levelled_deg"]
    assert np.linalg.norm(turn) == pytest.approx(reported, abs=0.001)
    assert 0.001 < reported < 1 and abs(turn[2]) < 0.001


def test_truth_beside_the_recording_is_used_and_named(first: tuple[Any, Path]) -> None:
    assert "walk_truth.tum" in first[0].out
    assert "ATE" in first[0].out


@pytest.mark.parametrize("here", [".", "..", "inside/.."])
def test_a_recording_named_by_dots_has_the_files_beside_it_too(
    hemislam: Call, walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, here: str
) -> None:
    folder = tmp_path / "walk"
    (folder / "inside").mkdir(parents=True)
    (folder / "walk.mcap").symlink_to(walk)
    truth = walk.with_name("walk_truth.tum").read_bytes()
    (tmp_path / "walk_truth.tum").write_bytes(truth)
    (tmp_path / "walk.params.yaml").write_text("ground: {alpha: 31}")
    monkeypatch.chdir(at := folder / "inside" if here == ".." else folder)
    run = hemislam("run", here, "--no-calibrate", "--duration", "2", "--out", tmp_path / "out", folder=at)
    assert run.code == 0 and "walk_truth.tum" in run.out
    assert json.loads((tmp_path / "out" / "report.json").read_text())["parameters"]["ground"]["alpha"] == 31
    assert new_path(tmp_path, Path(here)).name.startswith("walk-")


def test_without_a_terminal_only_the_summary_is_printed(first: tuple[Any, Path]) -> None:
    assert first[0].err == ""
    assert str(first[1]) in first[0].out


def test_the_same_run_twice_gives_the_same_bytes(
    first: tuple[Any, Path], hemislam: Call, walk: Path, tmp_path: Path
) -> None:
    assert hemislam("run", walk, "--out", tmp_path / "second").code == 0
    for name in ("trajectory.tum", "map.ply"):
        assert (tmp_path / "second" / name).read_bytes() == (first[1] / name).read_bytes()


def test_only_the_part_asked_for_is_processed(hemislam: Call, walk: Path, tmp_path: Path) -> None:
    outcome = hemislam(
        "run", walk, "--start", "0.5", "--duration", "2", "--set", "imu.start_duration=0.5", folder=tmp_path
    )
    assert outcome.code == 0, outcome.err
    stamps = read_tum(tmp_path / "runs" / "walk-1" / "trajectory.tum").stamps_ns
    assert stamps[-1] - stamps[0] <= 2e9
    report = json.loads((tmp_path / "runs" / "walk-1" / "report.json").read_text())
    assert report["frames"]["processed"] == 20
    assert report["parameters"]["imu"]["start_duration"] == 0.5


# --- refused at once -------------------------------------------------------------------------------
def missing(walk: Path, path: Path) -> None:
    pass


def empty(walk: Path, path: Path) -> None:
    path.write_bytes(b"")


def foreign(walk: Path, path: Path) -> None:
    path.write_text("This is not a recording.\n" * 100)


def empty_folder(walk: Path, path: Path) -> None:
    path.mkdir()


def cut_in_the_header(walk: Path, path: Path) -> None:
    path.write_bytes(walk.read_bytes()[:20])


@pytest.mark.parametrize(
    ("command", "spoil"),
    [
        ("run", missing),
        ("run", empty),
        ("run", foreign),
        ("run", empty_folder),
        ("run", cut_in_the_header),
        ("info", missing),
        ("info", cut_in_the_header),
        ("serve", missing),
        ("serve", empty),
    ],
)
def test_a_file_that_is_no_recording_is_refused_by_name(
    hemislam: Call, walk: Path, tmp_path: Path, command: str, spoil: Callable[[Path, Path], None]
) -> None:
    path = tmp_path / "spoilt.mcap"
    spoil(walk, path)
    assert "spoilt.mcap" in hemislam(command, path, folder=tmp_path).refused()
    assert not (tmp_path / "runs").exists()


def test_a_session_is_repeated_though_what_it_was_compared_with_is_gone(
    hemislam: Call, walk: Path, tmp_path: Path
) -> None:
    session = tmp_path / "short.hemislam"
    opened = Opened(walk, nbytes=size_of(walk))
    write_session(
        session, SavedSession(opened, State(resolve_params(walk, None, None, []), truth=tmp_path / "gone.tum"), 5)
    )
    outcome = hemislam("replay", session, "--out", tmp_path / "out")
    assert outcome.code == 0, outcome.err
    assert "gone.tum, which no longer exists" in outcome.out
    assert len((tmp_path / "out" / "trajectory.tum").read_text().splitlines()) == 6


@pytest.mark.parametrize("option", ["--start=1", "--duration=2", "--truth=gone.tum"])
def test_serve_refuses_an_option_that_a_session_would_ignore(
    hemislam: Call, walk: Path, tmp_path: Path, option: str
) -> None:
    session = tmp_path / "short.hemislam"
    write_session(session, SavedSession(Opened(walk, nbytes=size_of(walk)), State(Params()), 3))
    assert "belong to a recording" in hemislam("serve", session, option).refused()


def test_serve_says_that_a_session_keeps_its_own_parameters(
    hemislam: Call, walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session, served = tmp_path / "short.hemislam", list[Any]()
    write_session(session, SavedSession(Opened(walk, nbytes=size_of(walk)), State(Params()), 3))
    monkeypatch.setattr("app.server.web.run_server", lambda setup, **_: served.append(setup))
    assert "its own parameters" in hemislam("serve", session, "--set", "ground.alpha=40").out
    assert "its own parameters" not in hemislam("serve", session).out
    assert [setup.params for setup in served] == [Params()] * 2
    assert "ground.alfa" in hemislam("serve", session, "--set", "ground.alfa=40").refused()


def test_a_recording_whose_imu_is_silent_is_mapped_by_the_lidar_alone_and_says_so(
    hemislam: Call, walk_without: Callable[[float], Path], tmp_path: Path
) -> None:
    outcome = hemislam("run", walk_without(0.0), "--out", tmp_path / "out")
    assert outcome.code == 0, outcome.err
    assert "no IMU: motion is estimated from the LiDAR alone" in outcome.out
    assert json.loads((tmp_path / "out" / "report.json").read_text())["frames"]["processed"] == 39


def test_scans_after_the_last_imu_sample_are_mapped_by_the_lidar_alone_and_the_time_is_given(
    hemislam: Call, walk_without: Callable[[float], Path], tmp_path: Path
) -> None:
    outcome = hemislam("run", walk_without(3.0), "--out", tmp_path / "out")
    assert outcome.code == 0, outcome.err
    assert "the IMU has fallen silent" in outcome.out and "IMU        missing for" in outcome.out
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert (report["frames"]["processed"], report["frames"]["dropped"]) == (39, 0)
    assert report["imu_gaps_s"] == [pytest.approx(1.0, abs=0.1)]
    assert len((tmp_path / "out" / "timings.csv").read_text().splitlines()) == 40


def test_of_a_recording_that_was_cut_short_the_rest_is_used_and_said_to_be_one(
    hemislam: Call, walk: Path, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(walk.read_bytes()[: walk.stat().st_size * 2 // 3])
    outcome = hemislam("run", cut, "--out", tmp_path / "out")
    assert outcome.code == 2
    assert "the file ends here" in outcome.err
    assert "Traceback" not in outcome.err
    assert 15 <= json.loads((tmp_path / "out" / "report.json").read_text())["frames"]["processed"] < 39


def test_a_truth_of_another_day_or_none_at_all_or_whose_frame_jumps_is_refused(
    hemislam: Call, walk: Path, tmp_path: Path
) -> None:
    assert "none.tum" in hemislam("run", walk, "--truth", tmp_path / "none.tum", folder=tmp_path).refused()
    truth = read_tum(walk.with_name("walk_truth.tum"))
    write_tum(tmp_path / "late.tum", Trajectory(truth.stamps_ns + 86_400 * 10**9, truth.positions, truth.quaternions))
    moved = truth.positions + np.where(np.arange(len(truth)) > len(truth) // 2, 40.0, 0.0)[:, None]
    write_tum(tmp_path / "moved.tum", Trajectory(truth.stamps_ns, moved, truth.quaternions))
    assert "jumps by 69" in hemislam("run", walk, "--truth", tmp_path / "moved.tum", folder=tmp_path).refused()
    late = hemislam("run", walk, "--truth", tmp_path / "late.tum", folder=tmp_path).refused()
    assert "late.tum" in late
    assert "same clock" in late
    assert not (tmp_path / "runs").exists()


def test_results_are_kept_unless_told_otherwise(
    first: tuple[Any, Path], hemislam: Call, walk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {path.name: path.read_bytes() for path in first[1].iterdir()}
    monkeypatch.setattr("app.cli.run.settle_mounting", lambda *_: pytest.fail("it is calibrated first"))
    assert "--force" in hemislam("run", walk, "--out", first[1]).refused()
    assert {path.name: path.read_bytes() for path in first[1].iterdir()} == before


# --- stopped on the way ----------------------------------------------------------------------------
def run_with_trouble(
    monkeypatch: pytest.MonkeyPatch, walk: Path, folder: Path, trouble: BaseException, after: int = 20
) -> Any:
    """Run in this process; `trouble` is raised when the frame number `after` is due."""
    advance = Session.advance

    def trouble_comes(self: Session) -> Any:
        if self.frame + 1 == after:
            raise trouble
        return advance(self)

    monkeypatch.setattr(Session, "advance", trouble_comes)
    return CliRunner().invoke(cli, ["run", str(walk), "--out", str(folder)])


def test_an_interrupted_run_keeps_what_it_has(monkeypatch: pytest.MonkeyPatch, walk: Path, tmp_path: Path) -> None:
    outcome = run_with_trouble(monkeypatch, walk, tmp_path / "out", KeyboardInterrupt())
    assert outcome.exit_code == 130
    assert "20 processed" in outcome.output
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == RESULTS
    assert json.loads((tmp_path / "out" / "report.json").read_text())["stopped_early"] == "KeyboardInterrupt"


def test_ctrl_c_while_the_program_loads_gives_no_traceback(
    hemislam_alone: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def press(**_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("app.__main__.cli", press)
    with pytest.raises(SystemExit, match="130"):
        main()
    (tmp_path / "typer.py").write_text("raise KeyboardInterrupt\n")  # found before the installed one
    done = hemislam_alone("--version", folder=tmp_path)
    assert (done.code, done.out, done.err) == (130, "", "")


def test_ctrl_c_while_results_are_saved_does_not_lose_them(
    monkeypatch: pytest.MonkeyPatch, walk: Path, tmp_path: Path
) -> None:
    save = Session.save

    def press_and_save(*args: Any, **options: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return save(*args, **options)

    monkeypatch.setattr(Session, "save", press_and_save)
    outcome = CliRunner().invoke(cli, ["run", str(walk), "--out", str(tmp_path / "out"), "--duration", "2"])
    assert outcome.exit_code == 0, outcome.output
    assert "Ctrl-C again" in outcome.stderr
    assert (tmp_path / "out" / "report.json").exists()


def test_a_recording_damaged_on_the_way_gives_what_came_before(
    monkeypatch: pytest.MonkeyPatch, walk: Path, tmp_path: Path
) -> None:
    outcome = run_with_trouble(monkeypatch, walk, tmp_path / "out", HemislamError("The file is damaged at 2.1 s."))
    assert outcome.exit_code == 2
    assert "hemislam: The file is damaged at 2.1 s. The frames before that" in outcome.stderr
    assert np.genfromtxt(tmp_path / "out" / "timings.csv", delimiter=",", skip_header=1).shape[0] == 20


def test_a_bug_of_ours_costs_no_frames_and_is_not_hidden(
    monkeypatch: pytest.MonkeyPatch, walk: Path, tmp_path: Path
) -> None:
    outcome = run_with_trouble(monkeypatch, walk, tmp_path / "out", ZeroDivisionError("our bug"))
    assert isinstance(outcome.exception, ZeroDivisionError)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == RESULTS


def test_a_run_that_fails_before_its_first_frame_leaves_no_folder(
    monkeypatch: pytest.MonkeyPatch, walk: Path, tmp_path: Path
) -> None:
    outcome = run_with_trouble(monkeypatch, walk, tmp_path / "out", HemislamError("No."), after=0)
    assert outcome.exit_code == 2
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", ["evaluate", "tune"])
def test_nothing_is_compiled_for_a_recording_that_cannot_be_used(
    hemislam: Call, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: str
) -> None:
    monkeypatch.setattr("app.slam.warmup.compile_kernels", lambda *_: pytest.fail("it compiles first"))
    (tmp_path / "empty.mcap").touch()
    for name in ("gone.mcap", "empty.mcap"):
        assert name in hemislam(command, tmp_path / name, "--out", tmp_path / "out", folder=tmp_path).refused()


@pytest.mark.parametrize("command", ["run", "replay"])
def test_interrupted_while_it_compiles_it_leaves_no_folder(
    monkeypatch: pytest.MonkeyPatch, walk: Path, tmp_path: Path, command: str
) -> None:
    def press(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("app.slam.warmup.compile_kernels", press)
    session = tmp_path / "a.hemislam"
    write_session(session, SavedSession(Opened(walk, nbytes=size_of(walk)), State(Params()), 3))
    outcome = CliRunner().invoke(
        cli, [command, str(session if command == "replay" else walk), "--out", str(tmp_path / "out")]
    )
    assert outcome.exit_code == 130
    assert not (tmp_path / "out").exists()


def test_a_recording_whose_name_leaves_no_room_for_others_beside_it_is_mapped_all_the_same(
    hemislam: Call, walk: Path, tmp_path: Path
) -> None:
    path = tmp_path / f"{'w' * 250}.mcap"
    path.symlink_to(walk)
    assert hemislam("run", path, "--out", tmp_path / "out", "--duration", "2").code == 0
    assert len(new_path(tmp_path, path).name.encode()) < 255 and truth_beside(path) is None
