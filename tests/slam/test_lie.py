"""SO(3) and SE(3): the axioms for all angles, especially near the identity, with SciPy as the oracle."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.slam import lie

TIGHT = 1e-12


def directions() -> st.SearchStrategy[np.ndarray]:
    def unit(seed: int) -> np.ndarray:
        v = np.random.default_rng(seed).normal(size=3)
        return np.asarray(v / np.linalg.norm(v))

    axes = [np.array(a, dtype=float) for a in ((1, 0, 0), (0, -1, 0), (0, 0, 1))]
    return st.one_of(st.integers(0, 2**32).map(unit), st.sampled_from(axes))


def angles(largest: float) -> st.SearchStrategy[float]:
    """Ordinary angles, near-identity ones of every order, and those around the switch to series."""
    return st.one_of(
        st.floats(0.0, largest),
        st.floats(-16.0, -2.0).map(lambda e: float(10.0**e)),
        st.floats(0.9e-4, 1.1e-4),
        st.just(0.0),
    )


def rotvecs(largest: float = np.pi - 1e-6) -> st.SearchStrategy[np.ndarray]:
    return st.tuples(directions(), angles(largest)).map(lambda pair: pair[0] * pair[1])


@given(rotvecs(largest=10.0))
def test_exp_is_scipys_rotation(v: np.ndarray) -> None:
    np.testing.assert_allclose(lie.exp(v), Rotation.from_rotvec(v).as_matrix(), atol=TIGHT)


@given(rotvecs())
def test_log_undoes_exp_to_the_last_digits(v: np.ndarray) -> None:
    np.testing.assert_allclose(lie.log(lie.exp(v)), v, rtol=1e-7, atol=1e-15)


@given(directions(), st.floats(-9, -4).map(lambda e: 10.0**e))
def test_log_is_right_next_to_half_a_turn(axis: np.ndarray, missing: float) -> None:
    v = axis * (np.pi - missing)
    np.testing.assert_allclose(lie.log(lie.exp(v)), v, atol=1e-7)


def test_half_a_turn_itself_has_a_logarithm() -> None:
    R = np.diag([-1.0, 1.0, -1.0])
    np.testing.assert_allclose(np.abs(lie.log(R)), [0, np.pi, 0], atol=TIGHT)


@given(rotvecs(), rotvecs(), rotvecs())
def test_rotations_form_a_group(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    A, B, C = lie.exp(a), lie.exp(b), lie.exp(c)
    np.testing.assert_allclose(A @ lie.exp(-a), np.eye(3), atol=TIGHT)
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=TIGHT)
    np.testing.assert_allclose(A.T @ A, np.eye(3), atol=TIGHT)
    assert np.linalg.det(A @ B) == pytest.approx(1.0, abs=TIGHT)


@given(rotvecs(), rotvecs())
def test_a_turn_seen_from_another_frame_is_the_turned_turn(a: np.ndarray, b: np.ndarray) -> None:
    """The adjoint: R exp(v) R^T = exp(R v)."""
    R = lie.exp(a)
    np.testing.assert_allclose(R @ lie.exp(b) @ R.T, lie.exp(R @ b), atol=TIGHT)


@given(rotvecs(), st.integers(0, 2**32))
def test_transforms_invert(v: np.ndarray, seed: int) -> None:
    T = lie.transform(lie.exp(v), np.random.default_rng(seed).normal(scale=100, size=3))
    np.testing.assert_allclose(lie.inverse(T) @ T, np.eye(4), atol=1e-10)
    np.testing.assert_allclose(lie.inverse(T), np.linalg.inv(T), atol=1e-10)


@given(rotvecs())
def test_quaternions_are_scipys_with_w_not_negative(v: np.ndarray) -> None:
    q = lie.quaternion(lie.exp(v))
    expected = Rotation.from_rotvec(v).as_quat(canonical=True)
    assert q[3] >= 0
    np.testing.assert_allclose(q * (1 if q @ expected > 0 else -1), expected, atol=1e-9)
    np.testing.assert_allclose(lie.matrix(q), lie.exp(v), atol=1e-12)


@given(rotvecs(), st.floats(0.1, 10))
def test_a_quaternions_length_does_not_matter(v: np.ndarray, length: float) -> None:
    q = Rotation.from_rotvec(v).as_quat()
    np.testing.assert_allclose(lie.matrix(-length * q), Rotation.from_quat(q).as_matrix(), atol=TIGHT)


def test_batches_equal_one_at_a_time() -> None:
    v = np.random.default_rng(1).normal(size=(4, 5, 3)) * np.geomspace(1e-9, 2, 5)[:, None]
    R = lie.exp(v)
    for index in np.ndindex(4, 5):
        np.testing.assert_array_equal(R[index], lie.exp(v[index]))
        np.testing.assert_array_equal(lie.log(R)[index], lie.log(R[index]))
        np.testing.assert_array_equal(lie.quaternion(R)[index], lie.quaternion(R[index]))
        np.testing.assert_allclose(lie.matrix(lie.quaternion(R))[index], R[index], atol=TIGHT)


@given(rotvecs(), st.integers(0, 2**32))
def test_hat_is_the_cross_product(v: np.ndarray, seed: int) -> None:
    u = np.random.default_rng(seed).normal(size=3)
    np.testing.assert_allclose(lie.hat(v) @ u, np.cross(v, u), atol=TIGHT)


@given(directions(), directions(), st.floats(0.01, 100), st.floats(0.01, 100))
def test_between_turns_one_direction_into_the_other_by_the_smallest_angle(
    a: np.ndarray, b: np.ndarray, la: float, lb: float
) -> None:
    R = lie.between(la * a, lb * b)
    np.testing.assert_allclose(R @ a, b, atol=1e-9)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-9)
    angle = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
    assert Rotation.from_matrix(R).magnitude() == pytest.approx(angle, abs=1e-6)


@given(directions(), st.floats(-12, -5).map(lambda e: 10.0**e))
def test_between_almost_opposite_directions_is_still_a_rotation(a: np.ndarray, off: float) -> None:
    """An IMU mounted upside down, out by a hair."""
    aside = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
    b = -a * np.cos(off) + aside / np.linalg.norm(aside) * np.sin(off)
    R = lie.between(a, b)
    np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R @ a, b, atol=1e-10)


@given(st.tuples(*[st.floats(-180, 180)] * 3))
def test_roll_pitch_yaw_compose_as_documented(rpy: tuple[float, float, float]) -> None:
    expected = Rotation.from_euler("ZYX", rpy[::-1], degrees=True).as_matrix()
    np.testing.assert_allclose(lie.from_rpy_degrees(rpy), expected, atol=TIGHT)


@given(rotvecs(), st.integers(0, 2**32))
def test_points_are_moved_as_scipy_turns_them_then_by_the_translation(v: np.ndarray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, shift = rng.normal(size=(5, 3)), rng.normal(size=3)
    expected = Rotation.from_rotvec(v).apply(points) + shift
    T = lie.transform(lie.exp(v), shift)
    np.testing.assert_allclose(lie.moved(T, points), expected, atol=TIGHT)
    np.testing.assert_allclose(lie.moved(T, points[0]), expected[0], atol=TIGHT)
    np.testing.assert_allclose(lie.moved(lie.inverse(T), lie.moved(T, points)), points, atol=TIGHT)
