"""Without an IMU: constant velocity between scans, gravity from the floor.

Tests app/slam/coast.py.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.slam import coast, imu
from app.slam.engine import Engine
from app.slam.iekf import boxminus, boxplus
from app.slam.imu import DIM, VEL, Belief
from app.slam.sections import FilterParams, ImuParams
from app.slam.types import FrameStatus, ImuSamples, NavState, Scan
from tests.slam.engine_runs import ALONG, run, worst
from tests.slam.scenes import (
    FORWARD,
    UPRIGHT,
    Rig,
    Walk,
    corridor,
    furnished_room,
    imu_samples,
    measurements,
    params_for,
    seconds_of,
    sweep,
)
from tests.slam.updates import state_at, surveyed

NOTHING = ImuSamples(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))


def moving() -> Belief:
    """A device on the move, uncertain in everything and with correlations."""
    rng = np.random.default_rng(2)
    state = NavState(
        stamp_ns=1_000,
        R_odom_imu=Rotation.from_rotvec(rng.normal(size=3)).as_matrix(),
        p_odom_imu=rng.normal(size=3),
        v_odom_imu=rng.normal(size=3),
        b_gyro=0.5 * rng.normal(size=3),
        b_accel=np.zeros(3),
        g_odom=np.array([0.0, 0.0, -9.81]),
        R_imu_lidar=np.eye(3),
        p_imu_lidar=np.zeros(3),
    )
    spread = 1e-3 * rng.normal(size=(DIM, DIM))
    return Belief(state, spread @ spread.T + 1e-8 * np.eye(DIM))


END_NS = 1_000 + 100_000_000
STEADY = coast.Course.steady(1_000, END_NS)


def test_the_device_goes_on_in_a_straight_line_and_turns_on_at_its_rate() -> None:
    belief = moving()
    before, after = belief.state, coast.propagate(belief, END_NS, STEADY).state
    np.testing.assert_allclose(after.p_odom_imu, before.p_odom_imu + 0.1 * before.v_odom_imu, rtol=0, atol=1e-12)
    turn = Rotation.from_matrix(before.R_odom_imu.T @ after.R_odom_imu).as_rotvec()
    np.testing.assert_allclose(turn, -0.1 * before.b_gyro, rtol=0, atol=1e-9)


def test_points_are_put_back_to_where_the_device_was_when_it_measured_them() -> None:
    """Its LiDAR is off the IMU, and turned on it; the points are one place in odom, seen at three times."""
    there = moving().state
    arm = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    state = replace(there, stamp_ns=END_NS, R_imu_lidar=arm, p_imu_lidar=np.array([0.1, -0.2, 0.05]))
    place, seen = np.array([4.0, -3.0, 2.0]), []
    for ago in (-0.1, -0.03, 0.0):
        R = state.R_odom_imu @ Rotation.from_rotvec(-state.b_gyro * ago).as_matrix()
        in_imu = R.T @ (place - state.p_odom_imu - state.v_odom_imu * ago)
        seen.append(arm.T @ (in_imu - state.p_imu_lidar))
    offsets = np.array([0, 70_000_000, 100_000_000], np.int32)
    scan = Scan(1_000, np.array(seen, np.float32), offsets, np.zeros(3, np.float32), np.zeros(3, np.uint16))
    np.testing.assert_allclose(coast.deskew(scan, state, STEADY), np.tile(seen[-1], (3, 1)), rtol=0, atol=1e-4)


def test_along_what_the_imu_measured_points_lie_where_its_own_deskewing_puts_them() -> None:
    walk, rig = Walk(still=0.0, speed=(2.0, 0.5, 0.0), yaw_rate=1.5), Rig()
    scan = sweep(furnished_room(), walk, rig, 2.0, seed=0)
    samples = imu_samples(walk, rig, np.arange(398, 424) / 200)
    state = replace(state_at(walk, 2.0, rig), b_gyro=np.array([0.02, -0.01, 0.03]))
    predicted, path = imu.propagate(Belief(state, np.eye(DIM)), samples, scan.end_ns, ImuParams())
    along = coast.deskew(scan, predicted.state, coast.Course.measured(path, predicted.state))
    np.testing.assert_allclose(along, imu.deskew(scan, path, predicted.state), rtol=0, atol=1e-5)


def test_a_speed_that_is_not_known_is_found_from_one_scan() -> None:
    """1.3 m/s are taken for a rest; scan and map show the speed, although the prediction bends the scan by 13 cm."""
    walk, rig = Walk(still=0.0, speed=(1.3, 0.0, 0.0)), Rig(range_noise=0.0)
    scan = sweep(furnished_room(), walk, rig, 2.0, seed=0)
    samples = imu_samples(walk, rig, np.arange(398, 424) / 200)
    true = state_at(walk, 2.0, rig)
    sigma = np.full(DIM, 1e-4)
    sigma[VEL] = 1.5
    wrong = Belief(replace(true, v_odom_imu=np.zeros(3)), np.diag(sigma**2))
    predicted, path = imu.propagate(wrong, samples, scan.end_ns, ImuParams())
    assert coast.is_unsure(predicted)
    course = coast.Course.measured(path, predicted.state)
    found, registration = coast.update(predicted, scan, course, surveyed(furnished_room()), FilterParams())
    end = state_at(walk, seconds_of(scan.end_ns), rig)
    assert registration.inliers > 100
    assert np.linalg.norm(true.v_odom_imu) > 1.0
    np.testing.assert_allclose(found.state.v_odom_imu, end.v_odom_imu, atol=0.1)
    np.testing.assert_allclose(found.state.p_odom_imu, end.p_odom_imu, atol=0.02)
    assert not coast.is_unsure(found)


def test_its_covariance_is_that_of_states_drawn_from_the_belief_beside_the_noise() -> None:
    belief = moving()
    end = coast.propagate(belief, END_NS, STEADY)
    rest = coast.propagate(replace(belief, covariance=np.zeros((DIM, DIM))), END_NS, STEADY)
    rng = np.random.default_rng(3)
    drawn = rng.multivariate_normal(np.zeros(DIM), belief.covariance, size=4000)
    ends = np.array(
        [
            boxminus(coast.propagate(replace(belief, state=boxplus(belief.state, d)), END_NS, STEADY).state, end.state)
            for d in drawn
        ]
    )
    expected = end.covariance - rest.covariance
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(np.cov(ends.T) / np.outer(size, size), expected / np.outer(size, size), atol=0.1)


@pytest.mark.parametrize("device", [FORWARD, UPRIGHT], ids=["forward", "upright"])
def test_a_walk_in_a_room_is_followed_by_the_lidar_alone(device: np.ndarray) -> None:
    walk, rig = Walk(device), Rig()
    room = [replace(entry, imu=NOTHING) for entry in measurements(furnished_room(), walk, rig, 60)]
    results = run(Engine(params_for(rig)), iter(room))
    metres, degrees = worst(results, walk)
    assert metres < 0.02
    assert degrees < 0.5
    assert results[-1].status is FrameStatus.TRACKING
    assert "no IMU" in results[0].notices[0]


def test_in_a_bare_corridor_the_lidar_alone_is_lost_and_says_so() -> None:
    """Nothing there measures the way along it."""
    bare = [replace(e, imu=NOTHING) for e in measurements(corridor(150.0, pillars=False), ALONG, Rig(), 40)]
    results = run(Engine(params_for(Rig())), iter(bare))
    assert {result.status for result in results[20:]} == {FrameStatus.LOST}
    assert any("one direction unobserved, and there is no IMU" in notice for r in results for notice in r.notices)


def test_going_back_without_an_imu_repeats_the_walk_to_the_last_bit() -> None:
    walk, rig = Walk(FORWARD), Rig()
    room = [replace(entry, imu=NOTHING) for entry in measurements(furnished_room(), walk, rig, 40)]
    engine = Engine(params_for(rig))
    run(engine, iter(room[:30]))
    there = engine.checkpoint()
    first = run(engine, iter(room[30:]))
    engine.restore(there)
    second = run(engine, iter(room[30:]))
    for one, other in zip(first, second, strict=True):
        assert one.state.T_odom_imu.tobytes() == other.state.T_odom_imu.tobytes()
        assert one.cloud.points.tobytes() == other.cloud.points.tobytes()


def test_a_scan_without_points_and_a_day_without_scans_are_survived() -> None:
    room = [replace(e, imu=NOTHING) for e in measurements(furnished_room(), Walk(FORWARD), Rig(), 12)]
    engine = Engine(params_for(Rig()))
    run(engine, iter(room[:10]))
    empty = engine.step(room[10].scan.part(np.arange(0)), NOTHING)
    later = replace(room[11].scan, stamp_ns=room[11].scan.stamp_ns + 86_400_000_000_000)
    for result in (empty, engine.step(later, NOTHING)):
        assert np.isfinite(result.state.T_odom_imu).all()
    assert empty.status is FrameStatus.LOST


@pytest.mark.parametrize("tilt", [-10.0, 5.0])
def test_up_is_the_normal_of_the_floor(tilt: float) -> None:
    R_world_lidar = FORWARD @ Rotation.from_euler("y", tilt, degrees=True).as_matrix()
    scan = sweep(furnished_room(), Walk(R_world_lidar, still=100), Rig(columns=120), 0.0, seed=3)
    begun = coast.begin(scan, params_for(Rig())).state
    up = begun.R_imu_lidar.T @ begun.R_odom_imu.T @ [0.0, 0.0, 1.0]
    assert np.degrees(np.arccos(up @ (R_world_lidar.T @ [0.0, 0.0, 1.0]))) < 1.0
