import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm, logm

from app.slam import lie
from app.slam.map_frame import corrected
from app.slam.types import F64

S = 1_000_000_000
vectors = st.tuples(*[st.floats(-1.5, 1.5)] * 3, *[st.floats(-50, 50)] * 3).map(np.array)


def algebra(v: F64) -> F64:
    """(4, 4) of se(3)."""
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = lie.hat(v[:3]), v[3:]
    return out


@given(vectors, st.sampled_from([1.0, 1e-3, 1e-6, 0.0]))
def test_exponential_and_logarithm_are_those_of_matrices(v: F64, scale: float) -> None:
    v = v * np.array([scale] * 3 + [1.0] * 3)
    T = lie.exp_se3(v)
    np.testing.assert_allclose(T, expm(algebra(v)), atol=1e-9)
    np.testing.assert_allclose(lie.log_se3(T), v, atol=1e-7)
    if scale == 1.0:
        np.testing.assert_allclose(algebra(lie.log_se3(T)), np.real(logm(T)), atol=1e-6)
    np.testing.assert_array_equal(lie.exp_se3(np.stack([v, v]))[1], T)


def poses(*vs: tuple[float, ...]) -> F64:
    return lie.exp_se3(np.array(vs, dtype=np.float64).reshape(-1, 6))


def test_at_keyframes_the_correction_is_theirs_and_outside_that_of_the_nearest() -> None:
    rng = np.random.default_rng(0)
    keyframes = np.array([2, 4, 7]) * S
    corrections = lie.exp_se3(rng.normal(size=(3, 6)))
    stamps = np.array([0, 2, 4, 7, 9]) * S
    odometry = lie.exp_se3(rng.normal(size=(5, 6)) * 5)
    out = corrected(stamps, odometry, keyframes, corrections)
    np.testing.assert_allclose(out, corrections[[0, 0, 1, 2, 2]] @ odometry, atol=1e-9)


def test_halfway_in_time_is_halfway_in_correction() -> None:
    turned, shifted = poses((0, 0, 0.2, 0, 0, 0))[0], poses((0, 0, 0, 1.0, 0, 0))[0]
    stamps = np.array([1, 3]) * S
    there = np.stack([np.eye(4), np.eye(4)])
    out = corrected(stamps, there, np.array([0, 4]) * S, np.stack([np.eye(4), shifted @ turned]))
    np.testing.assert_allclose(np.arctan2(out[:, 1, 0], out[:, 0, 0]), [0.05, 0.15], atol=1e-9)
    assert (np.diff(out[:, 0, 3], prepend=0.0) > 0.2).all()


def test_far_from_the_origin_a_correction_does_not_swing_between_keyframes() -> None:
    """Half a degree about where the walker is, 500 m off, hardly moves it, in between either."""
    here = poses((0, 0, 0, 500.0, 0, 0))[0]
    turn = here @ poses((0, 0, 0.2, 0, 0, 0))[0] @ lie.inverse(here)
    stamps = np.arange(0, 11) * S // 10
    out = corrected(stamps, np.tile(here, (11, 1, 1)), np.array([0, S]), np.stack([np.eye(4), turn]))
    np.testing.assert_allclose(out[:, :3, 3], np.tile(here[:3, 3], (11, 1)), atol=1e-9)


def test_without_keyframes_odometry_stays() -> None:
    odometry = poses((0, 0, 0, 1, 2, 3))
    np.testing.assert_array_equal(
        corrected(np.array([5]), odometry, np.empty(0, np.int64), np.empty((0, 4, 4))), odometry
    )
