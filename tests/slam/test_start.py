"""The start: biases and gravity from a rest, and the messages if there is no rest."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.slam import rest, start
from app.slam.imu import BG, EXT_ROT, GRAV, POS, ROT, VEL, Belief
from app.slam.params import Params
from app.slam.types import Scan

from .scenes import GRAVITY, START_NS, Rig, Walk, imu_samples

NOISY = Rig(gyro_noise=2e-3, accel_noise=0.05, b_gyro=(0.02, -0.015, 0.01))
RESTING = Walk(still=100)
MOVING = Walk(still=-3.0, turn=((0.6, 3.0, 0.5), (0.4, 4.0, 0.3), (0.3, 5.0, 1.0)))


def scan_at(begin_s: float, end_s: float) -> Scan:
    return Scan(
        START_NS + round(begin_s * 1e9),
        np.ones((2, 3), np.float32),
        np.array([0, round((end_s - begin_s) * 1e9)], np.int32),
        np.zeros(2, np.float32),
        np.zeros(2, np.uint16),
    )


def samples(walk: Walk, begin_s: float, end_s: float, rig: Rig = NOISY) -> start.ImuSamples:
    return imu_samples(walk, rig, np.arange(round(begin_s * 200), round(end_s * 200) + 1) / 200)


def run(walk: Walk, params: Params, scans: int, rig: Rig = NOISY) -> list[start.Started]:
    """Scans of 0.1 s until the start is over, at most `scans`."""
    outcomes: list[start.Started] = []
    for k in range(scans):
        still = outcomes[-1].still if outcomes else None
        cover = samples(walk, 0.1 * k, 0.1 * k + 0.1, rig)
        outcomes.append(start.proceed(still, scan_at(0.1 * k, 0.1 * k + 0.099), cover, params))
        if not outcomes[-1].waiting:
            break
    return outcomes


@given(st.integers(0, 2**32))
def test_at_rest_down_is_found_for_any_mounting(seed: int) -> None:
    R = Rotation.random(random_state=np.random.default_rng(seed)).as_matrix()
    rest = samples(Walk(R, still=100), 0, 1)
    state = start.standing(rest, START_NS + 10**9, Params()).state
    down_true, down = R.T @ [0, 0, -1], state.R_odom_imu.T @ state.g_odom / GRAVITY
    assert np.degrees(np.arccos(np.clip(down @ down_true, -1, 1))) < 0.1
    assert np.linalg.norm(state.g_odom) == pytest.approx(GRAVITY)
    np.testing.assert_allclose(state.R_odom_imu.T @ state.R_odom_imu, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("R", [np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, 1.0, -1.0]), np.eye(3)])
def test_exactly_upside_down_is_a_mounting_too(R: np.ndarray) -> None:
    state = start.standing(samples(Walk(R, still=100), 0, 1, Rig()), START_NS, Params()).state
    np.testing.assert_allclose(state.R_odom_imu.T @ state.g_odom, R.T @ [0, 0, -GRAVITY], atol=1e-9)


def test_the_gyroscopes_bias_is_its_mean_at_rest_and_known_as_well_as_claimed() -> None:
    belief = start.standing(samples(RESTING, 0, 1), START_NS, Params())
    error = belief.state.b_gyro - NOISY.b_gyro
    claimed = np.sqrt(np.diag(belief.covariance))[BG]
    assert np.all(np.abs(error) < 4 * 2e-3 / np.sqrt(200))
    assert np.all(np.abs(error) < 3 * claimed)
    assert np.all(claimed < 1e-3)


def test_the_start_waits_for_a_rest_as_long_as_asked_for() -> None:
    for seconds in (0.5, 1.0, 2.0):
        outcomes = run(RESTING, Params().with_values({"imu.start_duration": seconds}), 30)
        assert [o.waiting for o in outcomes] == [True] * (len(outcomes) - 1) + [False]
        assert len(outcomes) == round(seconds * 10)
        assert not any(o.notice for o in outcomes)
        assert outcomes[-1].belief.state.stamp_ns == START_NS + round((0.1 * len(outcomes) - 0.001) * 1e9)


def test_samples_that_two_scans_share_count_once() -> None:
    outcomes = run(RESTING, Params(), 30)
    stamps = outcomes[-1].still.stamps_ns
    assert np.all(np.diff(stamps) == 5_000_000)


def test_where_the_device_lay_before_the_first_scan_does_not_count() -> None:
    """Three seconds on its side, then picked up; only then does the LiDAR send."""
    cover = samples(RESTING, 0.0, 3.6)
    on_its_side = cover.accel.copy()
    on_its_side[:600] = on_its_side[:600, [2, 1, 0]]
    cover = replace(cover, accel=on_its_side)
    outcome = start.proceed(None, scan_at(3.5, 3.6), cover, Params())
    down = outcome.belief.state.R_odom_imu.T @ [0, 0, -1]
    assert outcome.waiting and np.degrees(np.arccos(down @ RESTING.pose(3.5)[:3, :3].T @ [0, 0, -1])) < 1.0


def test_a_moving_start_says_so_and_claims_little() -> None:
    outcome = run(MOVING, Params(), 1)[0]
    assert not outcome.waiting
    assert "moving" in outcome.notice
    moving, standing = outcome.belief.covariance, run(RESTING, Params(), 30)[-1].belief.covariance
    for part in (VEL, BG, GRAV):
        assert np.all(np.diag(moving)[part] > 10 * np.diag(standing)[part])
    fixed = run(MOVING, Params().with_values({"filter.estimate_extrinsics": False}), 1)[0].belief.covariance
    assert np.all(np.diag(fixed)[ROT] < 1e-6)  # odom is defined by this pose, moving or not
    assert np.allclose(np.diag(moving)[ROT] - np.diag(fixed)[ROT], np.diag(moving)[EXT_ROT])  # or by the LiDAR's
    assert outcome.belief.state.stamp_ns == START_NS  # the path reaches back over the whole scan


def test_a_moving_starts_gravity_is_within_what_it_claims() -> None:
    belief, walk = run(MOVING, Params(), 1)[0].belief, MOVING
    down = belief.state.R_odom_imu.T @ belief.state.g_odom / GRAVITY
    true = walk.pose(0.0)[:3, :3].T @ [0, 0, -1]
    angle = np.arccos(np.clip(down @ true, -1, 1))
    assert angle < 3 * np.sqrt(belief.covariance[15, 15])


def test_a_rest_cut_short_is_used_as_far_as_it_goes() -> None:
    walk = Walk(still=0.6, sway=((1.0, 5.0, 0.0), (0.5, 6.0, 0.4), (0.3, 7.0, 0.9)))
    outcome = run(walk, Params().with_values({"imu.start_duration": 3.0}), 40)[-1]
    assert not outcome.waiting
    assert "only" in outcome.notice
    np.testing.assert_allclose(outcome.belief.state.b_gyro, NOISY.b_gyro, atol=2e-3)
    rest = (outcome.belief.state.stamp_ns - START_NS) * 1e-9
    assert 0.3 <= rest <= 1.4  # the belief is of the rest's end, before the first swing was felt


def test_a_knock_right_at_the_start_is_not_taken_for_a_rest() -> None:
    walk = Walk(still=0.12, sway=((1.0, 9.0, 0.0), (0.5, 8.0, 0.4), (0.3, 7.0, 0.9)))
    outcome = run(walk, Params(), 30)[-1]
    assert "moving" in outcome.notice or outcome.belief.state.stamp_ns > START_NS + 300_000_000


def test_turning_evenly_is_not_a_rest() -> None:
    """A turntable, or a person turning on the spot: the rates do not scatter, but they are no bias."""
    even = samples(RESTING, 0, 0.1)
    turning = start.ImuSamples(even.stamps_ns, np.add(even.gyro, [0.0, 0.0, 0.6]), even.accel)
    assert rest.is_moving(turning)
    assert not rest.is_moving(even)


@pytest.mark.parametrize(("residual", "rides"), [(0.02, True), (0.09, False)])
def test_scans_that_fit_poorly_do_not_turn_a_rest_into_a_ride(residual: float, rides: bool) -> None:
    """They seem to show a way of 0.25 m, known to 3 cm; scans that miss the map by 9 cm show no such way."""
    still = start.standing(samples(RESTING, 0, 1), START_NS + 10**9, Params())
    covariance = still.covariance.copy()
    covariance[POS, POS] = 0.03**2 * np.eye(3)
    away = Belief(replace(still.state, p_odom_imu=np.array([0.0, 0.0, 0.25])), covariance)
    assert start.has_ridden(start.Ride(away, residual), still) == rides


def test_the_mounting_of_the_lidar_is_taken_from_the_parameters() -> None:
    params = Params().merged({"sensor": {"translation": [0.1, 0.2, 0.3], "rotation": [10, 20, 30]}})
    state = start.standing(samples(RESTING, 0, 1), START_NS, params).state
    np.testing.assert_allclose(state.p_imu_lidar, [0.1, 0.2, 0.3])
    expected = Rotation.from_euler("ZYX", [30, 20, 10], degrees=True).as_matrix()
    np.testing.assert_allclose(state.R_imu_lidar, expected, atol=1e-12)
