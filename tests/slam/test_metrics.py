"""Trajectory errors compared with evo, and properties that hold for any trajectories.

Tests app/slam/trajectory.py.
"""

from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.slam.errors import HemislamError
from app.slam.metrics import GroundScore, ate, drift, interpolate, rpe
from app.slam.trajectory import Trajectory, read_tum, write_tum

EXACT = 1e-9


def walk(seed: int, poses: int = 60, step_s: float = 0.1) -> Trajectory:
    """A random walk with random turns, starting in November 2023."""
    rng = np.random.default_rng(seed)
    stamps = 1_700_000_000_000_000_000 + (np.arange(poses) * step_s * 1e9).astype(np.int64)
    positions = np.cumsum(rng.normal(scale=0.1, size=(poses, 3)), axis=0)
    rotations = [Rotation.random(random_state=rng)]
    for turn in rng.normal(scale=0.1, size=(poses - 1, 3)):
        rotations.append(rotations[-1] * Rotation.from_rotvec(turn))
    return Trajectory(stamps, positions, np.array([rotation.as_quat() for rotation in rotations]))


def disturbed(trajectory: Trajectory, seed: int, metres: float = 0.005, radians: float = 0.02) -> Trajectory:
    rng = np.random.default_rng(seed)
    n = len(trajectory)
    turned = trajectory.rotations * Rotation.from_rotvec(rng.normal(scale=radians, size=(n, 3)))
    return Trajectory(
        trajectory.stamps_ns, trajectory.positions + rng.normal(scale=metres, size=(n, 3)), turned.as_quat()
    )


def moved(trajectory: Trajectory, seed: int) -> Trajectory:
    """The same trajectory seen from another world frame."""
    rng = np.random.default_rng(seed)
    turn = Rotation.random(random_state=rng)
    return Trajectory(
        trajectory.stamps_ns,
        turn.apply(trajectory.positions) + rng.normal(scale=50, size=3),
        (turn * trajectory.rotations).as_quat(),
    )


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        positions_xyz=trajectory.positions.copy(),
        orientations_quat_wxyz=np.roll(trajectory.quaternions, 1, axis=1),
        timestamps=trajectory.stamps_ns * 1e-9,
    )


def evo_ate(estimate: Trajectory, truth: Trajectory, relation: evo_metrics.PoseRelation) -> dict[str, float]:
    ours, theirs = as_evo(estimate), as_evo(truth)
    ours.align(theirs, correct_scale=False)
    metric = evo_metrics.APE(relation)
    metric.process_data((theirs, ours))
    return metric.get_all_statistics()


def evo_rpe(
    estimate: Trajectory, truth: Trajectory, relation: evo_metrics.PoseRelation, delta: float, unit: evo_metrics.Unit
) -> dict[str, float]:
    metric = evo_metrics.RPE(relation, delta, unit, all_pairs=False, pairs_from_reference=True)
    metric.process_data((as_evo(truth), as_evo(estimate)))
    return metric.get_all_statistics()


@pytest.mark.parametrize("seed", range(5))
def test_ate_equals_that_of_evo(seed: int) -> None:
    truth = walk(seed)
    estimate = moved(disturbed(truth, seed + 100), seed + 200)
    ours = ate(estimate, truth)
    assert ours.rotation is not None
    position = evo_ate(estimate, truth, evo_metrics.PoseRelation.translation_part)
    rotation = evo_ate(estimate, truth, evo_metrics.PoseRelation.rotation_angle_deg)
    assert (ours.position.rmse, ours.position.mean, ours.position.max) == pytest.approx(
        (position["rmse"], position["mean"], position["max"]), abs=EXACT
    )
    assert (ours.rotation.rmse, ours.rotation.mean, ours.rotation.max) == pytest.approx(
        (rotation["rmse"], rotation["mean"], rotation["max"]), abs=EXACT
    )
    assert ours.poses == len(truth)


@pytest.mark.parametrize(
    ("frames", "metres", "delta", "unit"),
    [
        (1, None, 1, evo_metrics.Unit.frames),
        (7, None, 7, evo_metrics.Unit.frames),
        (1, 1.0, 1.0, evo_metrics.Unit.meters),
        (1, 2.5, 2.5, evo_metrics.Unit.meters),
    ],
)
def test_rpe_equals_that_of_evo(frames: int, metres: float | None, delta: float, unit: evo_metrics.Unit) -> None:
    truth = walk(1)
    estimate = moved(disturbed(truth, 2), 3)
    ours = rpe(estimate, truth, frames=frames, metres=metres)
    assert ours is not None
    position = evo_rpe(estimate, truth, evo_metrics.PoseRelation.translation_part, delta, unit)
    rotation = evo_rpe(estimate, truth, evo_metrics.PoseRelation.rotation_angle_deg, delta, unit)
    assert (ours.position.rmse, ours.position.max) == pytest.approx((position["rmse"], position["max"]), abs=EXACT)
    assert (ours.rotation.rmse, ours.rotation.mean) == pytest.approx((rotation["rmse"], rotation["mean"]), abs=EXACT)


@pytest.mark.parametrize("name", ["hall_bpearl_truth.tum", "outdoor_bpearl_truth.tum", "garage_hdl32e_reference.tum"])
def test_real_truth_files_read_and_score_as_with_evo(shared_data: Path, name: str) -> None:
    truth = read_tum(shared_data / name)
    by_evo = file_interface.read_tum_trajectory_file(shared_data / name)
    np.testing.assert_allclose(truth.positions, by_evo.positions_xyz, atol=0)
    np.testing.assert_allclose(truth.stamps_ns * 1e-9, by_evo.timestamps, atol=1e-6)
    assert truth.distance == pytest.approx(by_evo.path_length, abs=EXACT)
    estimate = moved(disturbed(truth, 4), 5)
    position = evo_ate(estimate, truth, evo_metrics.PoseRelation.translation_part)
    rotation = evo_ate(estimate, truth, evo_metrics.PoseRelation.rotation_angle_deg)
    ours = ate(estimate, truth)
    assert ours.position.rmse == pytest.approx(position["rmse"], abs=EXACT)
    if name.startswith("garage"):  # 4.5 s straight ahead
        assert ours.rotation is None
    else:
        assert ours.rotation is not None and ours.rotation.rmse == pytest.approx(rotation["rmse"], abs=EXACT)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), other=st.integers(0, 10_000))
def test_ate_does_not_depend_on_the_world_frame_of_the_estimate(seed: int, other: int) -> None:
    truth = walk(seed, poses=20)
    estimate = disturbed(truth, other)
    here, there = ate(estimate, truth), ate(moved(estimate, other + 1), truth)
    assert there.position.rmse == pytest.approx(here.position.rmse, abs=EXACT)
    assert here.rotation is not None and there.rotation is not None
    assert there.rotation.rmse == pytest.approx(here.rotation.rmse, abs=1e-7)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_a_trajectory_that_was_only_moved_has_no_error(seed: int) -> None:
    truth = walk(seed, poses=20)
    found = ate(moved(truth, seed), truth)
    assert found.position.max < EXACT
    assert found.rotation is not None and found.rotation.max < 1e-6


def test_a_constant_velocity_truth_is_exact_between_its_poses() -> None:
    stamps = np.arange(0, 11) * 200_000_000
    turn = Rotation.from_rotvec(np.outer(np.arange(11), [0.0, 0.0, 0.1]))
    truth = Trajectory(stamps, np.outer(np.arange(11), [1.0, 2.0, 3.0]), turn.as_quat())
    asked = np.array([50_000_000, 1_950_000_000])
    there, usable = interpolate(truth, asked)
    assert usable.all()
    np.testing.assert_allclose(there.positions, np.outer([0.25, 9.75], [1.0, 2.0, 3.0]), atol=1e-12)
    np.testing.assert_allclose(there.rotations.as_rotvec(), [[0, 0, 0.025], [0, 0, 0.975]], atol=1e-12)


def test_truth_is_not_made_up_outside_its_time_or_in_a_gap() -> None:
    stamps = np.array([0, 1, 2, 5, 6]) * 1_000_000_000
    truth = Trajectory(stamps, np.zeros((5, 3)), np.tile([0.0, 0, 0, 1], (5, 1)))
    _, usable = interpolate(truth, np.array([-1, 500, 2000, 3500, 5000, 5500, 6001]) * 1_000_000)
    assert usable.tolist() == [False, True, True, False, True, True, False]


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_a_written_trajectory_is_read_back(seed: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("tum") / "t.tum"
    written = walk(seed, poses=10)
    write_tum(path, written)
    read = read_tum(path)
    np.testing.assert_array_equal(read.stamps_ns, written.stamps_ns)
    np.testing.assert_allclose(read.positions, written.positions, atol=0.5e-9)
    assert (read.rotations.inv() * written.rotations).magnitude().max() < 1e-8


def test_stamps_keep_every_nanosecond(tmp_path: Path) -> None:
    path = tmp_path / "t.tum"
    trajectory = walk(0, poses=3)
    stamps = trajectory.stamps_ns + np.array([1, 123_456_789, 999_999_999])
    write_tum(path, Trajectory(stamps, trajectory.positions, trajectory.quaternions))
    assert read_tum(path).stamps_ns.tolist() == stamps.tolist()


POSE = "0 0 0 0 0 0 1"
GOOD = f"1.0 {POSE}\n1.1 {POSE}\n1.2 {POSE}\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (GOOD + "1.3 0 0 0 0 0 0\n", "line 4 has 7 columns"),
        (GOOD + f"1.3 nan {POSE[2:]}\n", "line 4 holds NaN"),
        (GOOD + f"nan {POSE}\n", "line 4 holds NaN"),
        (GOOD + f"x {POSE}\n", "not a number"),
        (GOOD + f"1.2 {POSE}\n", "line 4: the time does not increase"),
        (GOOD + "1.3 1 0 0 0 0 0 0\n", "unit quaternion"),
        (f"1700000000400100000 {POSE}\n" * 3, "not in seconds"),
        (f"1.0 {POSE}\n1.1 {POSE}\n", "2 poses, but at least 3"),
        ("# only a comment\n", "no pose"),
    ],
)
def test_a_bad_truth_file_is_refused_in_one_sentence(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "truth.tum"
    path.write_text(text)
    with pytest.raises(HemislamError, match=says) as error:
        read_tum(path)
    assert "truth.tum" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_or_binary_truth_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(HemislamError, match=r"none\.tum cannot be read"):
        read_tum(tmp_path / "none.tum")
    (tmp_path / "cloud.pcd").write_bytes(b"\xff\xfe\x00\x81" * 10)
    with pytest.raises(HemislamError, match="not a text file"):
        read_tum(tmp_path / "cloud.pcd")


def test_a_truth_of_another_day_is_refused() -> None:
    truth, estimate = walk(1), walk(1)
    later = Trajectory(truth.stamps_ns + 86_400_000_000_000, truth.positions, truth.quaternions)
    with pytest.raises(HemislamError, match="same clock"):
        ate(estimate, later)


def test_a_walk_that_never_moved_cannot_be_aligned() -> None:
    truth = walk(1)
    still = Trajectory(truth.stamps_ns, np.tile([1.0, 2, 3], (len(truth), 1)), truth.quaternions)
    with pytest.raises(HemislamError, match="longer walk"):
        ate(truth, still)


def along(corners: list[tuple[float, float]], poses: int = 200) -> Trajectory:
    """A walk at a constant speed from corner to corner, looking one way."""
    there = np.array([(*corner, 0.0) for corner in corners])
    way = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(there, axis=0), axis=1))))
    at = np.linspace(0, way[-1], poses)
    positions = np.column_stack([np.interp(at, way, there[:, k]) for k in range(3)])
    return Trajectory(np.arange(poses) * 100_000_000, positions, np.tile([0.0, 0.0, 0.0, 1.0], (poses, 1)))


STRAIGHT, BENT = [(0.0, 0.0), (20.0, 0.0)], [(0.0, 0.0), (10.0, 0.0), (10.0, 10.0)]
RESTING = [(0.0, 0.0), (0.002, 0.001)]


def turned_by_a_degree(corners: list[tuple[float, float]], seed: int) -> tuple[Trajectory, Trajectory]:
    """An estimate 1 cm off on each axis whose orientations are all wrong by 1°, and its truth, 1 mm off."""
    walked, rng = along(corners), np.random.default_rng(seed)
    off = [rng.normal(scale=scale, size=walked.positions.shape) for scale in (0.01, 0.001)]
    wrong = (walked.rotations * Rotation.from_rotvec([0, 0, np.radians(1.0)])).as_quat()
    estimate = Trajectory(walked.stamps_ns, walked.positions + off[0], wrong)
    return moved(estimate, seed), Trajectory(walked.stamps_ns, walked.positions + off[1], walked.quaternions)


@pytest.mark.parametrize("corners", [STRAIGHT, RESTING])
def test_a_rotation_that_positions_do_not_fix_is_not_reported(corners: list[tuple[float, float]]) -> None:
    told_by_evo = []
    for seed in range(5):
        estimate, truth = turned_by_a_degree(corners, seed)
        error = ate(estimate, truth)
        assert error.rotation is None and error.doubt.endswith("walk a bend.")
        assert error.position.rmse < 0.03
        told_by_evo.append(evo_ate(estimate, truth, evo_metrics.PoseRelation.rotation_angle_deg)["rmse"])
    assert max(told_by_evo) > 10  # of 1°: what there is to withhold


@pytest.mark.parametrize("seed", range(3))
def test_a_walk_around_a_corner_fixes_the_rotation(seed: int) -> None:
    error = ate(*turned_by_a_degree(BENT, seed))
    assert error.doubt == "" and error.rotation is not None
    assert error.rotation.rmse == pytest.approx(1.0, abs=0.05)


def test_without_any_error_a_straight_line_does_not_fix_the_rotation_either() -> None:
    """Its rounding would: here the truth's file holds micrometres."""
    truth = along(STRAIGHT)
    rounded = Trajectory(
        truth.stamps_ns, truth.positions + 1e-7 * np.sin(np.arange(600).reshape(-1, 3)), truth.quaternions
    )
    assert ate(rounded, rounded).rotation is None


def test_a_short_path_has_no_error_over_many_metres() -> None:
    truth = walk(1, poses=5)
    assert rpe(truth, truth, metres=100.0) is None


def test_a_walk_whose_scale_is_wrong_drifts_by_that_share() -> None:
    stamps = np.arange(500, dtype=np.int64) * 100_000_000
    along = np.arange(500) * 0.1
    still = np.tile([0.0, 0.0, 0.0, 1.0], (500, 1))
    straight = Trajectory(stamps, np.column_stack([along, 0 * along, 0 * along]), still)
    longer = Trajectory(stamps, 1.02 * straight.positions, still)
    np.testing.assert_allclose(drift(longer, straight, 10.0), 2.0, rtol=0.02)
    assert len(drift(longer, straight, 10.0)) == 40  # every tenth pose from which 10 m are left
    np.testing.assert_allclose(drift(straight, straight, 10.0), 0.0, atol=1e-9)
    assert not len(drift(longer, straight, 100.0))


def test_ground_scores_count_seeds_as_ground_and_add_up() -> None:
    labels = np.array([2, 1, 1, 0, 0, 0], dtype=np.uint8)
    truth = np.array([1, 1, 0, 1, 0, 0], dtype=np.uint8)
    score = GroundScore.of(labels, truth)
    assert score == GroundScore(true_positive=2, false_positive=1, false_negative=1)
    assert (score.precision, score.recall, score.f1) == pytest.approx((2 / 3, 2 / 3, 2 / 3))
    assert (score + score).f1 == pytest.approx(score.f1)
    assert np.isnan(GroundScore().f1)
