"""The state and its errors: adding an error to a state, and the difference of two states.

Tests app/slam/kernels/manifold.py.
"""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.slam.iekf import boxminus, boxplus
from app.slam.imu import BA, BG, DIM, EXT_POS, EXT_ROT, GRAV, POS, ROT, VEL
from app.slam.types import NavState

from .scenes import START_NS


def random_state(seed: int) -> NavState:
    rng = np.random.default_rng(seed)
    g = rng.normal(size=3)
    return NavState(
        START_NS,
        Rotation.random(random_state=rng).as_matrix(),
        rng.normal(scale=100, size=3),
        *rng.normal(size=(3, 3)),
        9.81 * g / np.linalg.norm(g),
        Rotation.random(random_state=rng).as_matrix(),
        rng.normal(size=3),
    )


def errors(scale: float) -> st.SearchStrategy[np.ndarray]:
    return st.integers(0, 2**32).map(lambda s: np.random.default_rng(s).uniform(-scale, scale, DIM))


@given(st.integers(0, 2**32), st.one_of(errors(1.0), errors(1e-3), errors(1e-9), st.just(np.zeros(DIM))))
def test_boxminus_undoes_boxplus(seed: int, d: np.ndarray) -> None:
    x = random_state(seed)
    moved = boxplus(x, d)
    np.testing.assert_allclose(boxminus(moved, x), d, rtol=1e-6, atol=1e-13)
    assert np.linalg.norm(moved.g_odom) == pytest.approx(9.81, abs=1e-9)
    assert moved.stamp_ns == x.stamp_ns


@given(st.integers(0, 2**31), st.integers(0, 2**31))
def test_boxplus_of_boxminus_reaches_any_state(a: int, b: int) -> None:
    x, y = random_state(a), random_state(b + 2**31 + 1)
    reached = boxplus(x, boxminus(y, x))
    for field in fields(NavState):
        np.testing.assert_allclose(getattr(reached, field.name), getattr(y, field.name), atol=1e-6)


def test_each_error_moves_what_its_name_says() -> None:
    x, d = random_state(3), np.zeros(DIM)
    expected = [
        (ROT, "R_odom_imu"), (POS, "p_odom_imu"), (VEL, "v_odom_imu"), (BG, "b_gyro"),
        (BA, "b_accel"), (GRAV, "g_odom"), (EXT_ROT, "R_imu_lidar"), (EXT_POS, "p_imu_lidar"),
    ]  # fmt: skip
    for part, name in expected:
        d[:] = 0
        d[part] = 0.1
        moved = boxplus(x, d)
        changed = {f.name for f in fields(NavState) if not np.allclose(getattr(moved, f.name), getattr(x, f.name))}
        assert changed == {name}
