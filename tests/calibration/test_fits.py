"""Tests app/calibration/inertial.py, app/calibration/rotation.py, app/calibration/translation.py and
app/calibration/guide.py: the fits, on exact motions of a hand with the noise of both sensors. The motion is a spline
with exact derivatives, so nothing is integrated numerically."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.calibration.calibrate import NOT_TURNED
from app.calibration.guide import Guide
from app.calibration.inertial import Inertial, Noise
from app.calibration.odometry import Track
from app.calibration.rotation import Turned, find_offset, first_rotation, fit_rotation, is_mirrored
from app.calibration.translation import fit_translation
from app.sensors.simulator.trajectory import SmoothTrajectory
from app.slam.types import F64

GYRO_BIAS, ACCEL_BIAS = np.array([0.006, -0.004, 0.003]), np.array([0.03, -0.02, 0.04])
PLACE = np.array([0.02, -0.05, 0.11])


def hand(seconds: float, turning: tuple[float, float, float] = (0.4, 0.3, 0.3), seed: int = 0) -> SmoothTrajectory:
    """A walk; `turning`: rad, how far it sways in yaw, pitch and roll."""
    rng = np.random.default_rng(seed)
    t = np.arange(-1.0, seconds + 1.0, 0.02)
    sways = [np.sin(2 * np.pi * f * t + phase) for f, phase in zip((0.4, 0.9, 0.7), rng.uniform(0, 6, 3), strict=True)]
    fast = [np.sin(2 * np.pi * f * t + phase) for f, phase in zip((1.3, 1.7, 1.1), rng.uniform(0, 6, 3), strict=True)]
    angles = [size * (a + 0.3 * b) for size, a, b in zip(turning, sways, fast, strict=True)]
    places = [t * 0.8, 0.3 * np.sin(0.8 * t), 0.03 * np.sin(2 * np.pi * 1.8 * t)]
    return SmoothTrajectory(t, np.column_stack([*places, *angles]))


def sensed(
    way: SmoothTrajectory, R: F64, late: float, seconds: float = 30.0, noise: float = 1.0, seed: int = 0
) -> tuple[Track, Inertial]:
    """What odometry and IMU make of a motion, with the LiDAR turned by R (3, 3) at PLACE; the IMU's stamps are early by
    `late`."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, seconds, 0.1)
    p, R_world_imu = way.poses(times)
    rotations = R_world_imu @ R @ Rotation.from_rotvec(rng.normal(0, noise * 5e-4, (len(times), 3))).as_matrix()
    positions = p + R_world_imu @ PLACE + rng.normal(0, noise * 5e-3, (len(times), 3))
    samples = np.arange(-0.9, seconds + 0.9, 0.005)
    gyro, accel = way.motion(samples)
    gyro = gyro + GYRO_BIAS + rng.normal(0, noise * 1.2e-3, gyro.shape)
    accel = accel + ACCEL_BIAS + rng.normal(0, noise * 1.3e-2, accel.shape)
    return Track(times, rotations, positions, np.zeros(len(times))), Inertial(samples - late, gyro, accel)


def turned_by(track: Track, inertial: Inertial) -> Turned:
    late = find_offset(track, inertial)
    return fit_rotation(track, inertial, first_rotation(track, inertial, late), late, np.eye(3))


def apart(a: F64, b: F64) -> float:
    return float(np.degrees(Rotation.from_matrix(a.T @ b).magnitude()))


@pytest.mark.parametrize("late", [-0.05, -0.013, 0.0, 0.004, 0.05])
def test_clocks_that_are_apart_are_found_to_a_millisecond(late: float) -> None:
    track, inertial = sensed(hand(30.0), Rotation.random(random_state=1).as_matrix(), late)
    found = turned_by(track, inertial)
    assert abs(found.late - late) < 1e-3
    assert abs(found.late - late) < 4 * np.sqrt(found.covariance[3, 3])


@pytest.mark.parametrize("seed", range(6))
def test_a_lidar_turned_in_any_way_on_the_imu_is_found_without_a_guess(seed: int) -> None:
    R = Rotation.random(random_state=seed).as_matrix()
    track, inertial = sensed(hand(30.0, seed=seed), R, 0.01, seed=seed)
    found = turned_by(track, inertial)
    assert apart(R, found.R_imu_lidar) < 0.1
    off = Rotation.from_matrix(found.R_imu_lidar.T @ R).as_rotvec()
    assert (np.abs(off) < 4.5 * np.sqrt(np.diag(found.covariance)[:3])).all()
    assert np.abs(found.bias - GYRO_BIAS).max() < 1e-3
    assert np.sqrt(np.mean(found.after**2)) < 0.2 * np.sqrt(np.mean(found.before**2))


@pytest.mark.parametrize("seed", range(4))
def test_a_mirrored_gyroscope_is_told_from_any_mounting(seed: int) -> None:
    track, inertial = sensed(hand(30.0), Rotation.random(random_state=seed).as_matrix(), 0.01, seed=seed)
    assert not is_mirrored(track, inertial, 0.01)
    for change in (np.diag([-1, 1, 1]), np.diag([1, 1, -1]), np.eye(3)[[1, 0, 2]], -np.eye(3)):
        assert is_mirrored(track, replace(inertial, gyro=inertial.gyro @ change), 0.01)


@pytest.mark.parametrize("turning", [(0.4, 0.0, 0.0), (0.0, 0.0, 0.0)])
def test_turning_about_one_axis_does_not_show_a_mirror(turning: tuple[float, float, float]) -> None:
    track, inertial = sensed(hand(30.0, turning), np.eye(3), 0.0)
    assert not is_mirrored(track, inertial, 0.0)
    assert not is_mirrored(track, replace(inertial, gyro=inertial.gyro @ np.diag([1, 1, -1])), 0.0)


def test_odometry_that_slips_for_seconds_hardly_moves_the_rotation() -> None:
    R = Rotation.random(random_state=8).as_matrix()
    track, inertial = sensed(hand(40.0), R, 0.0, 40.0)
    slipped = track.rotations.copy()
    slipped[50:90] = Rotation.random(40, random_state=2).as_matrix()
    found = turned_by(Track(track.times, slipped, track.positions, track.residuals), inertial)
    assert apart(R, found.R_imu_lidar) < 0.3


def test_turning_about_one_axis_leaves_the_rotation_about_it_unknown() -> None:
    track, inertial = sensed(hand(30.0, (0.5, 0.0, 0.0)), np.eye(3), 0.0)
    found = turned_by(track, inertial)
    assert np.degrees(np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1])) > 1.0


@pytest.mark.parametrize("seed", range(6))
def test_without_turning_the_bias_of_the_gyroscope_is_known_all_the_same(seed: int) -> None:
    R = Rotation.random(random_state=seed).as_matrix()
    found = turned_by(*sensed(hand(8.0, (0.0, 0.0, 0.0), seed), R, 0.0, seconds=8.0, seed=seed))
    assert np.abs(found.bias - GYRO_BIAS).max() < 0.01 and abs(found.late) < 0.6
    assert (np.sqrt(np.diag(found.covariance)[:3]) > NOT_TURNED).all()


def test_a_lively_motion_shows_the_place_of_the_lidar_to_a_centimetre() -> None:
    R = Rotation.random(random_state=3).as_matrix()
    track, inertial = sensed(hand(40.0), R, 0.0, 40.0)
    turned = turned_by(track, inertial)
    moved = fit_translation(track, inertial, turned, np.zeros(3))
    assert np.linalg.norm(moved.p_imu_lidar - PLACE) < 0.01
    assert (np.abs(moved.p_imu_lidar - PLACE) < 4.5 * np.sqrt(np.diag(moved.covariance)[:3])).all()
    assert np.linalg.norm(moved.gravity - [0.0, 0.0, -9.81]) < 0.1
    assert np.sqrt(np.mean(moved.after**2)) < 0.8 * np.sqrt(np.mean(moved.before**2))


def test_without_turning_the_place_is_unknown() -> None:
    track, inertial = sensed(hand(30.0, (0.0, 0.0, 0.0)), np.eye(3), 0.0)
    known = Turned(np.eye(3), 0.0, GYRO_BIAS, np.eye(7) * 1e-9, np.zeros((1, 3)), np.zeros((1, 3)))
    moved = fit_translation(track, inertial, known, np.zeros(3))
    assert np.sqrt(np.linalg.eigvalsh(moved.covariance[:3, :3])[0]) > 0.05


def test_turns_between_scans_are_those_of_the_motion() -> None:
    way = hand(5.0)
    times = np.arange(0.0, 5.0, 0.1)
    _, inertial = sensed(way, np.eye(3), 0.02, 5.0, noise=0.0)
    true = way.poses(times)[1]
    turns = inertial.turns(times, 0.02, GYRO_BIAS)
    assert (
        np.abs(turns - np.swapaxes(true[:-1], 1, 2) @ true[1:]).max() < 1e-4
    )  # of linear interpolation between samples
    assert np.abs(inertial.attitudes(times, 0.02, GYRO_BIAS) - true[0].T @ true).max() < 2e-4


def test_within_a_scan_the_lidar_is_where_its_motion_had_it() -> None:
    way, R = hand(5.0), Rotation.random(random_state=5).as_matrix()
    _, inertial = sensed(way, R, 0.0, 5.0, noise=0.0)
    guide = Guide.of(inertial, R, 0.0, GYRO_BIAS, PLACE, ACCEL_BIAS, np.array([0.0, 0.0, -9.81]))
    back = np.linspace(-0.1, 0.0, 11)
    p, R_world_imu = way.poses(3.0 + np.append(back, [-1e-4, 1e-4]))
    lidar = p + R_world_imu @ PLACE
    velocity = (lidar[-1] - lidar[-2]) / 2e-4
    R_end = R_world_imu[10] @ R
    true = (lidar[:11] - lidar[10] - velocity * back[:, None]) @ R_end
    course = guide.course(3.0, back, R_world_imu[0] @ R)
    assert np.abs(true).max() > 1e-3
    assert np.abs(course.swayed - true).max() < 2e-4
    assert np.abs(course.turned - R_end.T @ R_world_imu[:11] @ R).max() < 1e-4


@pytest.mark.parametrize("rate", [100, 200, 400])
def test_an_imus_noise_is_distinguished_from_a_hands_motion(rate: int) -> None:
    """White noise of a known density on a lively walk, with a stretch in which the hand knocks against something."""
    rng = np.random.default_rng(1)
    times = np.arange(0.0, 30.0, 1.0 / rate)
    motion = np.column_stack([np.sin(2 * np.pi * f * times) for f in (0.7, 1.8, 3.0)])
    knocks = ((times > 10) & (times < 15))[:, None] * np.sin(2 * np.pi * 30.0 * times)[:, None]
    for density, swing in ((1.2e-3, 1.5), (1.3e-2, 4.0)):
        noise = rng.normal(scale=density * np.sqrt(rate), size=(len(times), 3))
        found = Noise.of(times, swing * (motion + knocks) + noise)
        assert abs(found.density - density) < 0.1 * density
        assert 0.0 < found.sigma < 0.1 * density
    assert np.isnan(Noise.of(times[:100], np.zeros((100, 3))).density)
