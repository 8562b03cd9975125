"""Compiled single-element operations compared with their readable forms, SciPy and numpy.

Tests app/slam/kernels/manifold.py, app/slam/kernels/small.py.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage
from scipy.spatial.transform import Rotation

from app.slam import lie
from app.slam.kernels import manifold, submaps
from app.slam.kernels.small import plane_of

from .test_lie import directions, rotvecs

NEAR_PI = 1e-7


@given(rotvecs(largest=6.0))
def test_exp_equals_the_readable_form(v: np.ndarray) -> None:
    np.testing.assert_allclose(manifold.exp(v), lie.exp(v), atol=1e-14)


@given(rotvecs())
def test_log_equals_the_readable_form(v: np.ndarray) -> None:
    R = Rotation.from_rotvec(v).as_matrix()
    np.testing.assert_allclose(manifold.log(R), lie.log(R), rtol=1e-7, atol=1e-14)


@given(directions(), st.floats(-12, -3).map(lambda e: 10.0**e))
def test_log_next_to_half_a_turn(axis: np.ndarray, missing: float) -> None:
    R = Rotation.from_rotvec(axis * (np.pi - missing)).as_matrix()
    v = manifold.log(R)
    assert np.linalg.norm(v) == pytest.approx(np.pi - missing, abs=NEAR_PI)
    np.testing.assert_allclose(Rotation.from_rotvec(v).as_matrix(), R, atol=NEAR_PI)


@given(rotvecs(largest=3.0))
def test_the_inverse_right_jacobian_inverts_the_derivative_of_exp(v: np.ndarray) -> None:
    h = 1e-6
    derivative = np.empty((3, 3))
    for i, e in enumerate(np.eye(3) * h):
        ahead, behind = Rotation.from_rotvec(v + e), Rotation.from_rotvec(v - e)
        derivative[:, i] = (Rotation.from_rotvec(v).inv() * ahead).as_rotvec() / (2 * h)
        derivative[:, i] -= (Rotation.from_rotvec(v).inv() * behind).as_rotvec() / (2 * h)
    np.testing.assert_allclose(manifold.right_jacobian_inverse(v) @ derivative, np.eye(3), atol=1e-7)


@given(directions(), st.floats(0.01, 100))
def test_the_tangent_basis_is_orthonormal_and_right_handed(u: np.ndarray, length: float) -> None:
    B = manifold.tangent_basis(length * u)
    np.testing.assert_allclose(np.column_stack([B, u]).T @ np.column_stack([B, u]), np.eye(3), atol=1e-12)


@given(st.floats(0.0, 2 * np.pi), st.floats(0.0, 0.1), st.floats(0.0, 2 * np.pi))
def test_a_little_tilt_of_gravity_turns_its_tangent_basis_as_little(at: float, tilt: float, to: float) -> None:
    """The covariance of gravity is expressed in this basis from frame to frame: it may not jump where gravity is."""
    before = -np.array([1e-3 * np.cos(at), 1e-3 * np.sin(at), 1.0])
    after = -np.array([tilt * np.cos(to), tilt * np.sin(to), 1.0])
    apart = np.linalg.norm(after / np.linalg.norm(after) - before / np.linalg.norm(before))
    change = manifold.tangent_basis(9.81 * after) - manifold.tangent_basis(9.81 * before)
    assert np.linalg.norm(change) <= 2.0 * apart + 1e-12


@given(directions(), rotvecs(largest=3.0))
def test_the_turn_between_two_directions_is_the_smallest(u: np.ndarray, v: np.ndarray) -> None:
    w = Rotation.from_rotvec(v).apply(u)
    turn = manifold.turn(9.81 * u, 9.81 * w)
    np.testing.assert_allclose(Rotation.from_rotvec(turn).apply(u), w, atol=1e-9)
    assert np.linalg.norm(turn) <= np.linalg.norm(v) + 1e-9
    assert abs(turn @ u) < 1e-9


@given(rotvecs(), st.lists(st.floats(-6, 1), min_size=3, max_size=3), st.floats(-3, 3))
def test_principal_axes_of_a_patch_equal_numpys(orientation: np.ndarray, exponents: list[float], scale: float) -> None:
    """Patches of every shape from a needle to a ball, of millimetres and of kilometres."""
    values = np.sort(10.0 ** np.array(exponents)) * 10.0**scale
    R = Rotation.from_rotvec(orientation).as_matrix()
    A = R @ np.diag(values) @ R.T
    normal = np.empty(3)
    l1, l2, l3 = plane_of(A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2], normal)

    expected, vectors = np.linalg.eigh(0.5 * (A + A.T))
    np.testing.assert_allclose([l3, l2, l1], expected, atol=1e-7 * expected[2])
    assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
    if expected[1] - expected[0] > 1e-3 * expected[2]:  # else the normal is not determined
        assert abs(normal @ vectors[:, 0]) == pytest.approx(1.0, abs=1e-6)


def test_a_perfect_plane_has_no_thickness() -> None:
    normal = np.empty(3)
    _, _, l3 = plane_of(4.0, 0.0, 0.0, 1.0, 0.0, 0.0, normal)
    assert 0.0 <= l3 < 1e-14
    np.testing.assert_allclose(np.abs(normal), [0, 0, 1])


def test_points_all_in_one_place_have_a_unit_normal_anyway() -> None:
    normal = np.full(3, np.nan)
    assert plane_of(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, normal) == (0.0, 0.0, 0.0)
    assert np.linalg.norm(normal) == pytest.approx(1.0)


@given(st.integers(0, 99), st.integers(1, 3))
def test_peaks_are_those_of_scipys_maximum_filter(seed: int, reach: int) -> None:
    values = np.random.default_rng(seed).integers(1, 20, (6, 9, 12)).astype(np.float32)
    places = np.argwhere(values > 4)
    peaks = values == ndimage.maximum_filter(values, 2 * reach + 1, mode="constant")
    np.testing.assert_array_equal(submaps.highest(values, places, reach), peaks[tuple(places.T)])
