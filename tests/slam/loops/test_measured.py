"""What was measured of a loop comes out of its bytes as it went in."""

import math
import pickle
import tracemalloc
from dataclasses import astuple, fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.slam.loops.measured import Evidence, Measured, covariances, poses
from app.slam.loops.types import SUMMARY, LoopEdge, Verdict
from app.slam.types import F64

NUMBER = st.floats(allow_nan=True, allow_infinity=True)
SHORT = st.floats(allow_nan=True, allow_infinity=True, width=32)
COUNT = st.integers(0, 2**31 - 1)
EVIDENCE = st.builds(Evidence, **{each.name: SHORT for each in fields(Evidence)} | {"support": COUNT})


def pose_and_covariance(seed: int) -> tuple[F64, F64]:
    rng = np.random.default_rng(seed)
    T, half = np.eye(4), rng.normal(size=(6, 6))
    T[:3, :3], T[:3, 3] = Rotation.random(random_state=seed).as_matrix(), rng.normal(0, 100, 3)
    return T, half + half.T


def exactly(evidence: Evidence) -> list[object]:
    """To compare with ==, to the last bit."""
    return ["nan" if isinstance(value, float) and math.isnan(value) else value for value in astuple(evidence)]


@given(st.integers(0, 2**32 - 1), EVIDENCE, EVIDENCE)
def test_it_is_what_it_was_made_of_to_the_last_bit(seed: int, evidence: Evidence, other: Evidence) -> None:
    T, covariance = pose_and_covariance(seed)
    measured = Measured.of(T, covariance, evidence)
    for one, expected in ((measured, evidence), (measured.by(other), other)):
        assert one.covariance.tobytes() == covariance.tobytes()
        for there in (one, pickle.loads(pickle.dumps(one))):
            assert there.T_older_newer.tobytes() == T.tobytes()
            assert exactly(there.evidence) == exactly(expected)


@pytest.mark.parametrize("count", [1, 38])
def test_pickling_leaves_the_covariance_behind_and_nobody_takes_anything_else_for_it(count: int) -> None:
    """38 without are as many bytes as 17 with one."""
    made = [Measured.of(*pose_and_covariance(seed), Evidence(0.5)) for seed in range(count)]
    told = pickle.loads(pickle.dumps(made))
    assert len(told[0]) < 0.5 * len(made[0])
    np.testing.assert_array_equal(poses(told), poses(made))
    for one in (told[0], told[0].by(Evidence(0.25)), pickle.loads(pickle.dumps(told[0]))):
        with pytest.raises(ValueError, match="left behind"):
            _ = one.covariance
    with pytest.raises(ValueError, match="left behind"):
        covariances(told)
    with pytest.raises(ValueError, match="left behind"):
        covariances([*made, told[0]])


@given(NUMBER)
def test_evidence_is_kept_to_seven_digits(number: float) -> None:
    kept = Measured.of(np.eye(4), np.eye(6), Evidence(rival_m=number)).evidence.rival_m
    with np.errstate(over="ignore"):
        assert exactly(Evidence(kept)) == exactly(Evidence(float(np.float32(number))))


def test_many_at_once_are_the_same_as_one_by_one() -> None:
    made = [Measured.of(*pose_and_covariance(seed), Evidence()) for seed in range(5)]
    np.testing.assert_array_equal(poses(made), [each.T_older_newer for each in made])
    np.testing.assert_array_equal(covariances(made), [each.covariance for each in made])
    assert poses([]).shape == (0, 4, 4)
    assert covariances([]).shape == (0, 6, 6)


def test_nobody_changes_what_others_hold() -> None:
    measured = Measured.of(np.eye(4), np.eye(6), Evidence())
    with pytest.raises(ValueError, match="read-only"):
        measured.T_older_newer[0, 3] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        measured.covariance[0, 0] = 2.0


def test_a_loop_takes_little_memory_after_a_way_through_a_pipe() -> None:
    """As the processes that show loops hold them: with arrays and floats of its own each took 1.6 kB."""
    measured = Measured.of(np.eye(4), np.eye(6), Evidence(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 26))
    words, tie = f"{SUMMARY}; 26 others agree", (1000, 3000)
    sent = [
        pickle.dumps(LoopEdge(1000 + k, 3000 + k, 3001 + k, measured, Verdict.ACCEPTED, words, represented_by=tie))
        for k in range(1000)
    ]
    tracemalloc.start()
    held = [pickle.loads(one) for one in sent]
    taken, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held[-1].pair == (1999, 3999)
    assert held[-1].reason == "overlap 0.30, residual 400 mm, slide 600 mm, 0.8 σ from odometry; 26 others agree"
    assert taken < 450 * len(held)
