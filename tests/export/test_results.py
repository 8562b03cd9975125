"""The files of a run: complete, readable by other programs, and never written over older results by accident.

Tests app/export/exports.py, app/export/folder.py, app/export/map_file.py, app/export/points.py, app/slam/ply.py,
app/slam/run_log.py.
"""

import csv
import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.export.box import Box
from app.export.exports import BY_RUN, EXPORTS, of_formats, save_results
from app.export.folder import read_results
from app.export.map_file import KEYFRAME, VERTEX, MapFile, write
from app.export.points import Choice, blocks
from app.export.results import Results
from app.georeference import reference
from app.slam.errors import HemislamError
from app.slam.frames import Frame
from app.slam.loops.files import LoopResults
from app.slam.map_frame import MapFrame
from app.slam.params import Params
from app.slam.report import summarise
from app.slam.run_log import RunInfo, RunLog
from app.slam.trajectory import Trajectory, read_tum
from app.slam.types import (
    GROUND,
    NON_GROUND,
    SEED,
    TIMINGS,
    Cloud,
    FrameStatus,
    GroundResult,
    Keyframe,
    NavState,
    Registration,
    StepResult,
)

START_NS = 1_700_000_000_150_000_000
QUARTER_TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


def cloud(points: list[list[float]], labels: list[int]) -> Cloud:
    n = len(points)
    return Cloud(
        points=np.array(points, dtype=np.float32).reshape(-1, 3),
        labels=np.array(labels, dtype=np.uint8),
        intensity=np.arange(n, dtype=np.float32),
        ring=np.zeros(n, dtype=np.uint16),
        offsets_ns=np.zeros(n, dtype=np.int32),
    )


def frame(index: int, *, status: FrameStatus = FrameStatus.TRACKING, truth: list[int] | None = None) -> StepResult:
    """A frame that stands at x = index, y = index² / 10, turned by 90° about z."""
    labels = np.array([GROUND, SEED, NON_GROUND, NON_GROUND], dtype=np.uint8)
    state = NavState(
        stamp_ns=START_NS + index * 100_000_000,
        R_odom_imu=QUARTER_TURN,
        p_odom_imu=np.array([float(index), index**2 / 10, 0]),
        v_odom_imu=np.zeros(3),
        b_gyro=np.zeros(3),
        b_accel=np.zeros(3),
        g_odom=np.array([0, 0, -9.81]),
        R_imu_lidar=np.eye(3),
        p_imu_lidar=np.zeros(3),
    )
    return StepResult(
        index=index,
        stamp_ns=state.stamp_ns,
        status=status,
        state=state,
        T_map_odom=np.eye(4),
        cloud=cloud([[1, 0, 0]] * 4, labels.tolist()),
        ground=GroundResult(labels, True, "", np.eye(3)[2], np.zeros(3), -np.eye(3)[2], 0.01, 1, 0.5),
        registration=Registration(True, 2, 4, 4, 0.01, np.ones(6), False),
        points_in=4,
        points_reduced=4,
        points_filter=4,
        timings_ms=dict.fromkeys(TIMINGS, 1.0) | {"total": 7.0 + index},
        truth_ground=None if truth is None else np.array(truth, dtype=np.uint8),
    )


def keyframe(index: int, points: list[list[float]], labels: list[int]) -> Keyframe:
    T_odom_imu = np.eye(4)
    T_odom_imu[:3, :3] = QUARTER_TURN
    T_odom_imu[0, 3] = 10.0 * index
    T_imu_lidar = np.eye(4)
    T_imu_lidar[2, 3] = 0.5
    return Keyframe(index, index, START_NS, T_odom_imu, T_imu_lidar, np.eye(6), cloud(points, labels))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "walk.mcap"
    path.write_bytes(b"a recording")
    return path


def logged(frames: int = 6) -> RunLog:
    results = [frame(0, status=FrameStatus.INITIALISING), *(frame(k, truth=[1, 0, 1, 0]) for k in range(1, frames))]
    return RunLog([Frame.of(result) for result in results], ("no IMU", "no IMU"))


def test_a_log_adds_up_what_its_frames_hold() -> None:
    first, second = Frame.of(frame(0), ("too far", "no IMU")), Frame.of(frame(1, truth=[1, 0, 1, 0]), ("no IMU",))
    log = RunLog([first, second], ("no IMU",))
    assert log.dropped == {"no IMU": 3, "too far": 1}
    assert log.ground_share == 0.5 and RunLog([]).ground_share is None
    assert log.ground_score == second.ground_score is not None
    assert RunLog([first]).ground_score is None and not RunLog([]).dropped
    assert log.stamps_ns.tolist() == [first.stamp_ns, second.stamp_ns] and not log.stamps_ns.flags.writeable


def read_ply(path: Path) -> np.ndarray:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    keyframes = next(int(line.split()[2]) for line in lines if line.startswith("element keyframe"))
    assert len(body) == count * VERTEX.itemsize + keyframes * KEYFRAME.itemsize
    return np.frombuffer(body, dtype=VERTEX, count=count)


def test_a_run_writes_its_four_files(tmp_path: Path, recording: Path) -> None:
    folder = tmp_path / "out"
    report = save_results(folder, Results(logged(), [keyframe(0, [[1, 0, 0]], [GROUND])], RunInfo(recording, Params())))
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        export.name for export in BY_RUN if not export.of_loops
    )
    assert json.loads((folder / "report.json").read_text()) == report


def test_the_trajectory_has_a_pose_at_every_scans_end(tmp_path: Path, recording: Path) -> None:
    save_results(tmp_path / "out", Results(logged(), [], RunInfo(recording, Params())))
    lines = (tmp_path / "out" / "trajectory.tum").read_text().splitlines()
    assert lines[0] == (
        "1700000000.150000000 0.000000000 0.000000000 0.000000000 0.000000000 0.000000000 0.707106781 0.707106781"
    )
    assert len(read_tum(tmp_path / "out" / "trajectory.tum")) == 6


def test_timings_hold_every_processed_frame(tmp_path: Path, recording: Path) -> None:
    save_results(tmp_path / "out", Results(logged(), [], RunInfo(recording, Params())))
    rows = list(csv.DictReader((tmp_path / "out" / "timings.csv").open()))
    assert [float(row["total_ms"]) for row in rows] == [7, 8, 9, 10, 11, 12]
    assert [row["frame"] for row in rows] == ["0", "1", "2", "3", "4", "5"]
    assert rows[0]["stamp_s"] == "1700000000.150000000"


def test_the_report_counts_frames_ground_and_the_input(tmp_path: Path, recording: Path) -> None:
    report = save_results(tmp_path / "out", Results(logged(), [], RunInfo(recording, Params())))
    assert report["recording"]["sha256"] == hashlib.sha256(b"a recording").hexdigest()
    assert report["frames"] == {
        "processed": 6,
        "initialising": 1,
        "tracking": 5,
        "lost": 0,
        "dropped": 2,
        "dropped_reasons": {"no IMU": 2},
    }
    assert report["ground"] == {"share": 0.5, "precision": 0.5, "recall": 0.5, "f1": 0.5}
    assert report["timings_ms"]["total"]["median"] == 9.5
    assert report["parameters"]["ground"]["alpha"] == Params().ground.alpha
    assert report["accuracy"] is None
    assert report["peak_memory_mb"] > 10


def test_the_report_measures_against_truth(tmp_path: Path, recording: Path) -> None:
    log = logged(8)
    ours = log.odometry
    shifted = Trajectory(ours.stamps_ns, ours.positions + np.array([5.0, 0, 0]), ours.quaternions)
    report = save_results(tmp_path / "out", Results(log, [], RunInfo(recording, Params(), truth=shifted)))
    assert report["accuracy"]["ate_m"]["rmse"] < 1e-9
    assert report["accuracy"]["poses"] == 8
    assert report["accuracy"]["rpe"]["50 m"] is None


def test_degrees_that_positions_do_not_fix_are_withheld_with_the_reason(tmp_path: Path, recording: Path) -> None:
    log = logged(8)
    ours = log.odometry
    bent = Trajectory(ours.stamps_ns, ours.positions, ours.quaternions)
    nearly_straight = Trajectory(ours.stamps_ns, ours.positions * [1.0, 0.001, 1.0], ours.quaternions)
    told, withheld = (
        save_results(tmp_path / name, Results(log, [], RunInfo(recording, Params(), truth=truth)))
        for name, truth in (("told", bent), ("withheld", nearly_straight))
    )
    assert told["accuracy"]["ate_deg"]["rmse"] < 1e-4 and told["accuracy"]["ate_deg_withheld"] is None
    assert "0.000° over 8 poses" in summarise(told, tmp_path)
    assert withheld["accuracy"]["ate_deg"] is None
    assert withheld["accuracy"]["ate_m"]["rmse"] > 0.1
    assert "one straight line" in withheld["accuracy"]["ate_deg_withheld"]
    assert "no rotation error: The truth lies within" in summarise(withheld, tmp_path)


def test_the_summary_says_for_how_long_the_imu_was_missing(tmp_path: Path, recording: Path) -> None:
    gaps = [0.005, 0.3, 0.3, 0.005, 0.14, 0.24, 0.34, 0.44]  # the last one is still going on
    frames = [Frame.of(replace(frame(k), imu_gap_s=gap)) for k, gap in enumerate(gaps)]
    report = save_results(tmp_path / "out", Results(RunLog(frames), [], RunInfo(recording, Params())))
    assert report["imu_gaps_s"] == [0.3, 0.44]
    assert "missing for 0.7 s, at most 0.4 s at a time" in summarise(report, tmp_path)
    assert "missing for" not in summarise(report | {"imu_gaps_s": []}, tmp_path)


def test_a_truth_that_does_not_fit_is_reported_in_the_report(tmp_path: Path, recording: Path) -> None:
    log = logged(8)
    other_day = Trajectory(log.odometry.stamps_ns + 10**14, log.odometry.positions, log.odometry.quaternions)
    report = save_results(tmp_path / "out", Results(log, [], RunInfo(recording, Params(), truth=other_day)))
    assert "same clock" in report["accuracy"]["error"]


def test_a_run_without_a_single_frame_still_has_a_report(tmp_path: Path, recording: Path) -> None:
    report = save_results(
        tmp_path / "out", Results(RunLog([]), [], RunInfo(recording, Params(), stopped="It was cut."))
    )
    assert report["stopped_early"] == "It was cut."
    assert report["ground"]["share"] is None
    assert (tmp_path / "out" / "trajectory.tum").read_text() == ""


def test_the_map_holds_every_keyframe_where_loops_place_it(tmp_path: Path) -> None:
    keyframes = [keyframe(0, [[1, 0, 0], [0, 2, 0]], [GROUND, NON_GROUND]), keyframe(1, [[1, 0, 0]], [SEED])]
    T_map_odom = np.tile(np.eye(4), (2, 1, 1))
    T_map_odom[:, 1, 3] = 100.0, 200.0
    count, moving = write(tmp_path / "map.ply", blocks(keyframes, MapFrame(np.array([0, 1]), T_map_odom), Choice()))
    points = read_ply(tmp_path / "map.ply")
    assert count == len(points) == 3 and moving == 0
    np.testing.assert_allclose(
        np.stack([points["x"], points["y"], points["z"]], axis=1), [[0, 101, 0.5], [-2, 100, 0.5], [10, 201, 0.5]]
    )
    assert points["ground"].tolist() == [1, 0, 1]
    assert points["intensity"].tolist() == [0, 1, 0]


def test_the_graph_lies_where_the_trajectory_and_the_map_lie(tmp_path: Path, recording: Path) -> None:
    """Oracle: SciPy, of the levelled trajectory."""
    log, keyframes = logged(), [keyframe(k, [[1, 0, 0]], [GROUND]) for k in (0, 5)]
    level = MapFrame.levelling(np.array([0.1, 0.2, -9.8]))
    rows = zip((0, 5), log.odometry.positions[[0, 5]], log.odometry.quaternions[[0, 5]], strict=True)
    vertices = [f"VERTEX_SE3:QUAT {k // 5} " + " ".join(map(str, (*p, *q))) for k, p, q in rows]
    edge = "EDGE_SE3:QUAT 0 1 5 0 0 0 0 0 1 " + " ".join(["1"] * 21)
    graph = LoopResults(MapFrame(), np.array([0, 1]), (), "\n".join([*vertices, edge, ""]))
    save_results(tmp_path, Results(log, keyframes, RunInfo(recording, Params()), graph, level))
    *lines, last = (tmp_path / "graph.g2o").read_text().splitlines()
    written, trajectory = np.array([line.split()[2:] for line in lines], float), read_tum(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(written[:, :3], trajectory.positions[[0, 5]], atol=1e-6)
    turns = Rotation.from_quat(written[:, 3:]).inv() * trajectory.rotations[[0, 5]]
    assert turns.magnitude().max() < 1e-6 and last == edge
    assert abs(written[1, 2] - log.odometry.positions[5, 2]) > 0.05


def test_results_are_not_overwritten_unless_asked(tmp_path: Path, recording: Path) -> None:
    info = RunInfo(recording, Params())
    save_results(tmp_path / "out", Results(logged(4), [], info))
    before = (tmp_path / "out" / "trajectory.tum").read_bytes()
    with pytest.raises(HemislamError, match="already holds results"):
        save_results(tmp_path / "out", Results(logged(9), [], info))
    assert (tmp_path / "out" / "trajectory.tum").read_bytes() == before
    save_results(tmp_path / "out", Results(logged(9), [], info), replace=True)
    assert len(read_tum(tmp_path / "out" / "trajectory.tum")) == 9


def test_a_new_map_does_not_lie_where_the_older_one_lay(tmp_path: Path, recording: Path) -> None:
    results = Results(logged(4), [], RunInfo(recording, Params()))
    save_results(tmp_path, results)
    of_older = [tmp_path / name for name in (reference.FILE, reference.RESIDUALS, reference.PLOT)]
    for path in of_older:
        path.write_text("of the older map")
    csv_only = [export for export in EXPORTS if export.name == "trajectory.csv"]
    save_results(tmp_path, results, csv_only, replace=True)
    assert all(path.exists() for path in of_older), "the map is the same"
    save_results(tmp_path, results, replace=True)
    assert not any(path.exists() for path in of_older)


def test_older_results_survive_a_write_that_fails(tmp_path: Path, recording: Path) -> None:
    class BrokenDisk:
        def __len__(self) -> int:
            return 1

        def __getitem__(self, index: int) -> Keyframe:
            raise OSError(28, "No space left on device")

    info = RunInfo(recording, Params())
    folder = tmp_path / "out"
    save_results(folder, Results(logged(4), [], info))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(HemislamError, match="No space left"):
        save_results(folder, Results(logged(9), BrokenDisk(), info), replace=True)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize("format", ["section", "gpx", "g2o"])
def test_what_cannot_be_written_leaves_no_empty_folder(tmp_path: Path, recording: Path, format: str) -> None:
    results, mine = Results(logged(), [], RunInfo(recording, Params())), tmp_path / "mine"
    mine.mkdir()
    for folder in (tmp_path / "out", mine):
        with pytest.raises(HemislamError):
            save_results(folder, results, of_formats([format]))
    assert list(tmp_path.glob("*/")) == [mine], "it was there before"


def test_a_file_in_the_place_of_the_folder_is_named(tmp_path: Path, recording: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(HemislamError, match="out cannot be made"):
        save_results(tmp_path / "out", Results(logged(), [], RunInfo(recording, Params())))
    assert (tmp_path / "out").read_text() == "mine"


def test_a_map_read_again_is_the_map_that_was_written(tmp_path: Path, recording: Path) -> None:
    keyframes = [keyframe(0, [[1, 0, 0], [0, 2, 0]], [GROUND, NON_GROUND]), keyframe(1, [[1, 0, 0]], [NON_GROUND])]
    keyframes[0].cloud.offsets_ns[:] = 0, 50_000_000
    keyframes[0].cloud.ring[:] = 3, 7
    save_results(tmp_path, Results(logged(), keyframes, RunInfo(recording, Params())))
    before = list(blocks(keyframes, MapFrame(), Choice()))
    results = read_results(tmp_path)
    assert results.info.recording == recording and len(results.trajectory) == 6
    for one, other in zip(before, results.blocks(), strict=True):
        np.testing.assert_allclose(other.points, one.points, atol=1e-5)
        np.testing.assert_allclose(other.T_map_lidar, one.T_map_lidar, atol=1e-12)
        np.testing.assert_allclose(other.stamps_ns, one.stamps_ns, atol=300)
        for name in ("keyframe", "stamp_ns", "ring", "intensity", "labels"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_points_of_a_thinned_map_keep_their_times(tmp_path: Path, recording: Path) -> None:
    points = [[0.01 * (k // 2), 0, 0] for k in range(10)]  # the last one is not the first in its voxel
    one = keyframe(0, points, [NON_GROUND] * 10)
    one.cloud.offsets_ns[:] = np.arange(10) * 10_000_000
    written = list(blocks([one], MapFrame(), Choice(0.01)))
    save_results(tmp_path, Results(logged(), [one], RunInfo(recording, Params()), choice=Choice(0.01)))
    (read,) = read_results(tmp_path).blocks()
    assert 0 < len(read) < 10 and written[0].stamps_ns[-1] < START_NS
    np.testing.assert_allclose(read.stamps_ns - START_NS, written[0].stamps_ns - START_NS, atol=300)


def test_a_report_that_cannot_be_read_costs_no_loops(tmp_path: Path, recording: Path) -> None:
    save_results(tmp_path, Results(logged(), [], RunInfo(recording, Params())))
    (tmp_path / "report.json").write_text("{")
    (tmp_path / "graph.g2o").write_text("EDGE_SE3:QUAT 0 5")
    results = read_results(tmp_path)
    assert results.info.recording == tmp_path and results.loops is not None
    assert results.loops.g2o == "EDGE_SE3:QUAT 0 5"


def test_only_the_first_point_in_a_voxel_and_in_the_box_is_taken() -> None:
    rng = np.random.default_rng(3)
    points = [rng.uniform(-2, 2, (3000, 3)).tolist() for _ in range(30)]
    keyframes = [keyframe(0, one, [NON_GROUND] * 3000) for one in points]
    everything = np.concatenate([block.points for block in blocks(keyframes, MapFrame(), Choice())])
    box = (-1.0, -1.5, 0.0, 1.0, 1.5, 2.0)
    choice = Choice(0.05, Box(box[:3], box[3:]))
    taken = np.concatenate([block.points for block in blocks(keyframes, MapFrame(), choice)])
    inside = everything[((everything >= box[:3]) & (everything <= box[3:])).all(axis=1)]
    _, first = np.unique(np.floor(inside / 0.05), axis=0, return_index=True)
    np.testing.assert_array_equal(taken, inside[np.sort(first)])
    assert 1000 < len(taken) < len(inside)


@pytest.mark.parametrize(("thin", "box"), [(-1.0, None), (1e-6, None), (0.0, (0.0, 0, 0, 1, 1, 0))])
def test_a_choice_without_sense_is_refused(thin: float, box: tuple[float, float, float, float, float, float]) -> None:
    with pytest.raises(HemislamError, match=r"Voxels|empty"):
        Choice(thin, box and Box(box[:3], box[3:]))


def test_a_file_that_is_no_map_is_refused(tmp_path: Path) -> None:
    (tmp_path / "map.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\nend_header\n")
    with pytest.raises(HemislamError, match="not a map of this version"):
        MapFile(tmp_path / "map.ply")


def test_the_summary_lists_notices_that_differ_in_numbers_alone_as_one(tmp_path: Path, recording: Path) -> None:
    told = ["no IMU sample for 0.31 s", "Lost.", "no IMU sample for 12.000 s"]
    frames = [Frame.of(replace(frame(k), notices=(text,))) for k, text in enumerate(told)]
    report = save_results(tmp_path / "out", Results(RunLog(frames), [], RunInfo(recording, Params())))
    assert set(report["notices"]) == set(told)
    noted = [line for line in summarise(report, tmp_path).splitlines() if line.startswith("noted")]
    assert [line.split(maxsplit=1)[1] for line in noted] == [
        "2 x no IMU sample for 0.31 s and similar",
        "1 x Lost.",
    ]
