"""The errors in the tables compared with evo, on random and on real trajectories."""

from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.filters import FilterException
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.evaluation.measured import Outcome, measure
from app.evaluation.truth import TruePoses
from app.slam.trajectory import Trajectory, read_tum
from tests.evaluation import walks

EXACT = 1e-9
POSITION, ROTATION = evo_metrics.PoseRelation.translation_part, evo_metrics.PoseRelation.rotation_angle_deg


def drifting(walk: Trajectory, seed: int) -> Trajectory:
    """Another world, noise on every pose, and a slow drift."""
    rng = np.random.default_rng(seed)
    n = len(walk)
    turn = Rotation.from_rotvec(rng.normal(size=3))
    off = np.cumsum(rng.normal(scale=0.005, size=(n, 3)), axis=0) + rng.normal(scale=0.01, size=(n, 3))
    rotations = turn * walk.rotations * Rotation.from_rotvec(rng.normal(scale=0.01, size=(n, 3)))
    return Trajectory(walk.stamps_ns, turn.apply(walk.positions + off) + rng.normal(size=3), rotations.as_quat())


def as_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        positions_xyz=trajectory.positions.copy(),
        orientations_quat_wxyz=np.roll(trajectory.quaternions, 1, axis=1),
        timestamps=trajectory.stamps_ns * 1e-9,
    )


def check_against_evo(estimate: Trajectory, truth: Trajectory) -> bool:
    """Whether there is a rotation error after the alignment."""
    given_truth = TruePoses("The truth", "TUM", truth.stamps_ns, truth.positions, truth.quaternions)
    columns, _, path = measure([Outcome("ours", trajectory=estimate)], given_truth)
    assert path is not None and columns[0].unmeasured == "" and columns[0].accuracy is not None
    errors = columns[0].accuracy.errors
    aligned = as_evo(estimate)
    aligned.align(as_evo(truth), correct_scale=False)
    for relation, ours in ((POSITION, errors["ate_m"]), (ROTATION, errors["ate_deg"])):
        by_evo = evo_metrics.APE(relation)
        by_evo.process_data((as_evo(truth), aligned))
        theirs = by_evo.get_all_statistics()
        if ours is None:  # not fixed by positions along one line
            assert relation is ROTATION and "one straight line" in errors["ate_deg_withheld"]
            continue
        assert [ours[name] for name in ("rmse", "mean", "max")] == pytest.approx(
            [theirs[name] for name in ("rmse", "mean", "max")], abs=EXACT
        )
    deltas = {"1 frame": (1, evo_metrics.Unit.frames)}
    deltas |= {f"{metres} m": (metres, evo_metrics.Unit.meters) for metres in (1, 10, 50)}
    for over, (delta, unit) in deltas.items():
        for relation, name in ((POSITION, "m"), (ROTATION, "deg")):
            by_evo = evo_metrics.RPE(relation, delta, unit, all_pairs=False, pairs_from_reference=True)
            ours = errors["rpe"][over]
            if ours is None:  # the path is too short for one pair; evo says so too
                with pytest.raises(FilterException):
                    by_evo.process_data((as_evo(truth), as_evo(estimate)))
                continue
            by_evo.process_data((as_evo(truth), as_evo(estimate)))
            theirs = by_evo.get_all_statistics()
            assert [ours[name][kind] for kind in ("rmse", "mean", "max")] == pytest.approx(
                [theirs[kind] for kind in ("rmse", "mean", "max")], abs=EXACT
            )
    assert errors["distance_m"] == pytest.approx(as_evo(truth).path_length, abs=EXACT)
    return errors["ate_deg"] is not None


def test_a_slip_at_the_start_is_distinguished_from_the_errors_after_it() -> None:
    truth = walks.wandering(walks.frames(), 1)
    slipped = truth.positions + np.where(np.arange(len(truth)) < 30, 0.05, 0.0)[:, None] * [1.0, 0.0, 0.0]
    estimate = Trajectory(truth.stamps_ns, slipped, truth.quaternions)
    given_truth = TruePoses("The truth", "TUM", truth.stamps_ns, truth.positions, truth.quaternions)
    (column,), _, _ = measure([Outcome("ours", trajectory=estimate)], given_truth)
    assert column.value("accuracy/ate_m/rmse") > 0.005
    assert column.value("accuracy/ate_after_start_m") < 1e-9


@settings(max_examples=3, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_errors_equal_those_of_evo_on_random_walks(seed: int) -> None:
    truth = walks.wandering(walks.frames(), seed)
    assert check_against_evo(drifting(truth, seed + 1), truth)


@pytest.mark.parametrize("name", ["hall_bpearl_truth.tum", "outdoor_bpearl_truth.tum", "garage_hdl32e_reference.tum"])
def test_errors_equal_those_of_evo_on_real_trajectories(shared_data: Path, name: str) -> None:
    truth = read_tum(shared_data / name)
    assert check_against_evo(drifting(truth, 3), truth) is not name.startswith("garage")  # 4.5 s straight ahead
