"""The simulated walk and its IMU measurements.

Tests app/sensors/simulator/trajectory.py.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.sensors.simulator.trajectory import IMU_RATE_HZ, ImuNoise, SmoothTrajectory, Walker, measured, walk
from app.slam.types import F64

PERFECT = ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
PATH = np.array([(0.0, 0.0), (8.0, 0.0), (8.0, 5.0), (0.0, 5.0)])
DURATION_S = 20.0


@pytest.fixture(scope="module")
def trajectory() -> SmoothTrajectory:
    return walk(PATH, DURATION_S, np.random.default_rng(3), walker=Walker(), height=lambda xy: 0.1 * xy[:, 0])


def velocities(trajectory: SmoothTrajectory, t: F64) -> F64:
    """(n, 3) m/s, by central differences."""
    return (trajectory.poses(t + 1e-4)[0] - trajectory.poses(t - 1e-4)[0]) / 2e-4


def test_a_perfect_imu_integrates_back_to_the_true_walk(trajectory: SmoothTrajectory) -> None:
    stamps = np.arange(0, 20_000_000_000 + 1, 1_000_000_000 // IMU_RATE_HZ)
    imu = measured(trajectory, stamps, 0, PERFECT, np.random.default_rng(0))
    dt = 1.0 / IMU_RATE_HZ
    positions, rotations = trajectory.poses(stamps * 1e-9)
    R = Rotation.from_matrix(rotations[0])
    p, v = positions[0].copy(), velocities(trajectory, np.array([0.0]))[0]
    gravity = np.array([0.0, 0.0, -9.81])
    for k in range(len(stamps) - 1):  # trapezoids, and the coning term between two neighbouring rates
        turn = (imu.gyro[k] + imu.gyro[k + 1]) / 2 * dt + np.cross(imu.gyro[k], imu.gyro[k + 1]) * dt**2 / 12
        R_next = R * Rotation.from_rotvec(turn)
        a0, a1 = R.apply(imu.accel[k]) + gravity, R_next.apply(imu.accel[k + 1]) + gravity
        p = p + v * dt + (2 * a0 + a1) * dt**2 / 6
        v = v + (a0 + a1) * dt / 2
        R = R_next
    walked = np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()
    assert walked > 15.0
    assert np.linalg.norm(p - positions[-1]) < 0.01
    assert (R.inv() * Rotation.from_matrix(rotations[-1])).magnitude() < 1e-4


def test_rates_and_forces_are_the_derivatives_of_the_poses(trajectory: SmoothTrajectory) -> None:
    t = np.linspace(0.5, DURATION_S - 0.5, 300)
    h = 1e-3
    rate, force = trajectory.motion(t)
    (p0, R0), (p1, R1), (p2, R2) = (trajectory.poses(t + s) for s in (-h, 0.0, h))
    turned = (Rotation.from_matrix(R0).inv() * Rotation.from_matrix(R2)).as_rotvec() / (2 * h)
    felt = np.einsum("nji,nj->ni", R1, (p2 - 2 * p1 + p0) / h**2 + [0.0, 0.0, 9.81])
    np.testing.assert_allclose(rate, turned, atol=1e-4)
    np.testing.assert_allclose(force, felt, atol=1e-3)


def test_at_rest_the_specific_force_is_g_upwards_which_is_the_imus_minus_x(trajectory: SmoothTrajectory) -> None:
    t = np.linspace(0.0, 2.4, 50)
    rate, force = trajectory.motion(t)
    _, R_world_imu = trajectory.poses(t)
    np.testing.assert_allclose(np.einsum("nij,nj->ni", R_world_imu, force), np.tile([0, 0, 9.81], (50, 1)), atol=1e-3)
    np.testing.assert_allclose(rate, 0.0, atol=1e-4)
    assert (force[:, 0] < -9.7).all()


def test_the_walker_stands_still_then_walks_at_the_height_and_speed_asked_for(trajectory: SmoothTrajectory) -> None:
    still, _ = trajectory.poses(np.linspace(0.0, 2.4, 20))
    assert np.ptp(still, axis=0).max() < 1e-3
    t = np.linspace(5.0, DURATION_S, 400)
    positions, rotations = trajectory.poses(t)
    speed = np.linalg.norm(velocities(trajectory, t)[:, :2], axis=1)
    assert abs(speed.mean() - Walker().speed) < 0.15
    assert np.abs(positions[:, 2] - 0.1 * positions[:, 0] - Walker().height).max() < 0.06
    forward = rotations[:, :2, 2]  # the sensor's +z looks where one walks
    course = velocities(trajectory, t)[:, :2] / speed[:, None]
    assert np.degrees(np.arccos(np.clip((forward * course).sum(axis=1), -1, 1))).mean() < 25.0


def test_hand_and_steps_move_the_sensor(trajectory: SmoothTrajectory) -> None:
    t = np.linspace(6.0, DURATION_S, 2000)
    rate, _ = trajectory.motion(t)
    assert 0.1 < rate.std() < 1.0
    z = trajectory.poses(t)[0][:, 2] - 0.1 * trajectory.poses(t)[0][:, 0]
    spectrum = np.abs(np.fft.rfft(z - z.mean()))
    peak = np.fft.rfftfreq(len(z), t[1] - t[0])[spectrum.argmax()]
    assert 1.4 < peak < 2.2, "a person takes about 1.8 steps a second"


def test_an_open_path_is_walked_to_its_end_and_no_further() -> None:
    trajectory = walk(PATH[:2], 20.0, np.random.default_rng(0), walker=Walker(wander=0.0), closed=False)
    positions, _ = trajectory.poses(np.array([18.0, 19.9]))
    assert positions[:, 0].max() < 8.0
    assert np.linalg.norm(positions[1] - positions[0]) < 0.1


def test_noise_and_biases_have_the_size_they_are_said_to_have(trajectory: SmoothTrajectory) -> None:
    stamps = np.arange(0, 20_000_000_000, 5_000_000)
    truth = measured(trajectory, stamps, 0, PERFECT, np.random.default_rng(0))
    noise = ImuNoise()
    errors = []
    for seed in range(60):
        read = measured(trajectory, stamps, 0, noise, np.random.default_rng(seed))
        errors.append(np.stack([read.gyro - truth.gyro, read.accel - truth.accel]))
    bias = np.mean(errors, axis=2)  # (seeds, 2, 3)
    np.testing.assert_allclose(bias.std(axis=(0, 2)), [noise.gyro_bias, noise.accel_bias], rtol=0.2)
    np.testing.assert_allclose(np.std(errors, axis=2).mean(axis=(0, 2)), [noise.gyro, noise.accel], rtol=0.05)
