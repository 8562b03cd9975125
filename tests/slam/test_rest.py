"""At rest, the velocity is zero: what this constrains, what is learnt from it, and when it is not trusted."""

from dataclasses import replace

import numpy as np
import pytest

from app.slam import imu, rest, start
from app.slam.imu import BA, DIM, GRAV, POS, ROT, VEL, Belief
from app.slam.kernels import manifold
from app.slam.lie import hat
from app.slam.params import Params
from app.slam.types import ImuSamples

from .scenes import GRAVITY, START_NS, Rig, Walk, imu_samples

RIG = Rig(gyro_noise=1e-3, accel_noise=0.05, b_gyro=(0.01, -0.008, 0.005), b_accel=(0.03, -0.02, 0.04))


def samples(walk: Walk, begin_s: float, end_s: float) -> ImuSamples:
    return imu_samples(walk, RIG, np.arange(round(begin_s * 200), round(end_s * 200) + 1) / 200)


def after_a_rest(seconds: float, *, held: bool) -> Belief:
    """The belief after standing still so long, without any scan."""
    walk = Walk(still=100)
    belief = start.standing(samples(walk, 0, 1), START_NS + 10**9, Params())
    for k in range(10, round(10 * seconds)):
        cover = samples(walk, 0.1 * k, 0.1 * k + 0.1)
        belief, _ = imu.propagate(belief, cover, START_NS + (k + 1) * 10**8, Params().imu)
        if held:
            belief = rest.hold(belief, cover)
    return belief


def axes(belief: Belief) -> tuple[np.ndarray, np.ndarray]:
    """Up (3,) and two directions across it (2, 3), IMU frame."""
    up = -belief.state.R_odom_imu.T @ belief.state.g_odom / GRAVITY
    return up, manifold.tangent_basis(up).T


def sigma_of(axis: np.ndarray, belief: Belief) -> float:
    """m/s², how well the accelerometer's bias along an axis is known."""
    return float(np.sqrt(axis @ belief.covariance[BA, BA] @ axis))


def test_a_device_at_rest_stays_where_it_is_without_any_scan() -> None:
    held, drifting = after_a_rest(10, held=True), after_a_rest(10, held=False)
    assert np.linalg.norm(held.state.p_odom_imu) < 0.01
    assert np.linalg.norm(held.state.v_odom_imu) < 0.005
    assert np.linalg.norm(held.state.p_odom_imu) < 0.1 * np.linalg.norm(drifting.state.p_odom_imu)
    assert np.all(np.sqrt(np.diag(held.covariance))[VEL] < rest.TREMOR)
    assert np.linalg.norm(held.state.p_odom_imu) < 4 * np.sqrt(np.diag(held.covariance)[POS].sum())


def test_a_rest_shows_the_bias_along_gravity_but_not_across() -> None:
    """Across, a bias and a tilt of gravity feel the same: their sum is known, each of them is not."""
    belief = start.standing(samples(Walk(still=100), 0, 1), START_NS + 10**9, Params())
    along, across = axes(belief)
    assert sigma_of(along, belief) < 0.012
    assert along @ belief.state.b_accel == pytest.approx(along @ RIG.b_accel, abs=0.012)
    assert all(sigma_of(axis, belief) > 0.03 for axis in across)

    state, H = belief.state, np.zeros((3, DIM))
    H[:, ROT] = hat(-state.R_odom_imu.T @ state.g_odom)
    H[:, BA] = np.eye(3)
    H[:, GRAV] = state.R_odom_imu.T @ hat(state.g_odom) @ manifold.tangent_basis(state.g_odom)
    of_the_sum = np.sqrt(np.diag(H @ belief.covariance @ H.T))
    assert np.all(of_the_sum < 0.012)


def test_standing_longer_does_not_make_a_bias_known_that_a_rest_cannot_determine() -> None:
    """An inconsistent filter would gain certainty from nothing, frame by frame."""
    belief = after_a_rest(10, held=True)
    assert all(sigma_of(axis, belief) > 0.03 for axis in axes(belief)[1])
    assert np.all(np.diag(belief.covariance)[GRAV] > (0.03 / GRAVITY) ** 2)


def test_an_even_ride_is_no_rest() -> None:
    """A lift feels like a rest; but how fast it goes is known."""
    walk = Walk(still=100)
    belief = start.standing(samples(walk, 0, 1), START_NS + 10**9, Params())
    riding = replace(belief.state, v_odom_imu=np.array([0.0, 0.0, 1.0]))
    moving = Belief(riding, belief.covariance)
    assert rest.hold(moving, samples(walk, 1.0, 1.1)) is moving


def test_shaking_is_no_rest() -> None:
    walk = Walk(still=100)
    belief = start.standing(samples(walk, 0, 1), START_NS + 10**9, Params())
    shaken = samples(walk, 1.0, 1.1)
    shaken = ImuSamples(shaken.stamps_ns, shaken.gyro, shaken.accel + 3.0 * np.sin(np.arange(len(shaken)))[:, None])
    assert rest.hold(belief, shaken) is belief
    assert rest.hold(belief, samples(walk, 1.0, 1.1)) is not belief


def test_one_sample_does_not_make_a_rest() -> None:
    belief = start.standing(samples(Walk(still=100), 0, 1), START_NS + 10**9, Params())
    assert rest.hold(belief, samples(Walk(still=100), 1.0, 1.0)) is belief
