"""Propagation compared with an independent integrator, its covariance with statistics, deskewing with the true scene.

Tests app/slam/kernels/motion.py.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from app.slam import imu
from app.slam.iekf import boxminus, boxplus
from app.slam.imu import BG, DIM, POS, ROT, VEL, Belief
from app.slam.sections import ImuParams
from app.slam.types import ImuSamples, NavState

from .scenes import (
    FORWARD,
    GRAVITY,
    PERIOD_S,
    START_NS,
    UPRIGHT,
    Rig,
    Scene,
    Walk,
    box,
    imu_samples,
    mounted,
    pose_error,
    seconds_of,
    sweep,
)
from .updates import state_at

QUIET = ImuParams(gyro_noise=1e-6, accel_noise=1e-6, gyro_bias_walk=0, accel_bias_walk=0)


def integrated(state: NavState, samples: ImuSamples, end_ns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R, p, v at end_ns by a fine Runge-Kutta integration of rates that are linear between samples."""
    at = (samples.stamps_ns - state.stamp_ns) * 1e-9

    def motion(t: float, y: np.ndarray) -> np.ndarray:
        R, v = y[:9].reshape(3, 3), y[12:]
        w = [np.interp(t, at, samples.gyro[:, i]) - state.b_gyro[i] for i in range(3)]
        a = [np.interp(t, at, samples.accel[:, i]) - state.b_accel[i] for i in range(3)]
        turning = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([(R @ turning).ravel(), v, R @ a + state.g_odom])

    begin = np.concatenate([state.R_odom_imu.ravel(), state.p_odom_imu, state.v_odom_imu])
    duration = (end_ns - state.stamp_ns) * 1e-9
    y = solve_ivp(motion, (0, duration), begin, rtol=1e-9, atol=1e-11, max_step=0.002).y[:, -1]
    return y[:9].reshape(3, 3), y[9:12], y[12:]


def random_samples(rng: np.random.Generator, seconds: float, varying: bool) -> ImuSamples:
    stamps = START_NS + np.arange(-1, round(seconds * 200) + 2) * 5_000_000
    k = len(stamps)
    gyro, accel = np.tile(rng.normal(size=3), (k, 1)), np.tile(rng.normal(scale=4, size=3), (k, 1))
    if varying:
        phase = np.linspace(0, 12 * seconds, k)[:, None]
        gyro, accel = gyro + 2 * np.sin(phase + rng.normal(size=3)), accel + 5 * np.cos(phase + rng.normal(size=3))
    return ImuSamples(stamps, gyro, accel)


@pytest.mark.parametrize("varying", [False, True], ids=["constant rates", "varying rates"])
@pytest.mark.parametrize("seed", range(3))
def test_propagation_is_the_integral_of_the_samples(seed: int, varying: bool) -> None:
    rng = np.random.default_rng(seed)
    rig = Rig(b_gyro=(0.02, -0.01, 0.03), b_accel=(0.1, -0.2, 0.05))
    state = replace(
        state_at(Walk(), 0.0, rig),
        R_odom_imu=Rotation.random(random_state=rng).as_matrix(),
        v_odom_imu=rng.normal(size=3),
    )
    samples = random_samples(rng, 0.5, varying)
    end_ns = START_NS + 497_300_000  # between two samples
    predicted, path = imu.propagate(Belief(state, np.eye(DIM) * 1e-6), samples, end_ns, QUIET)
    R, p, v = integrated(state, samples, end_ns)
    assert (
        np.degrees((Rotation.from_matrix(R).inv() * Rotation.from_matrix(predicted.state.R_odom_imu)).magnitude())
        < 1e-3
    )
    np.testing.assert_allclose(predicted.state.p_odom_imu, p, atol=2e-5)
    np.testing.assert_allclose(predicted.state.v_odom_imu, v, atol=1e-4)
    np.testing.assert_allclose(predicted.state.R_odom_imu @ predicted.state.R_odom_imu.T, np.eye(3), atol=1e-12)
    assert predicted.state.stamp_ns == end_ns
    np.testing.assert_allclose(path.poses[-1], np.column_stack([R, p]), atol=5e-5)


def test_a_second_of_walking_is_followed_within_a_millimetre() -> None:
    walk = Walk(still=0.0, speed=(1.2, 0.0, 0.0))
    samples = imu_samples(walk, Rig(), np.arange(200, 402) / 200)
    belief = Belief(state_at(walk, 1.0), np.eye(DIM) * 1e-6)
    predicted, _ = imu.propagate(belief, samples, START_NS + 2_000_000_000, QUIET)
    metres, degrees = pose_error(predicted.state.T_odom_imu, walk.pose(2.0))
    assert metres < 1e-3
    assert degrees < 1e-2


def test_the_path_holds_the_poses_in_between() -> None:
    walk = Walk(still=0.0)
    samples = imu_samples(walk, Rig(), np.arange(300, 322) / 200)
    predicted, path = imu.propagate(Belief(state_at(walk, 1.5), np.eye(DIM)), samples, START_NS + 1_600_000_000, QUIET)
    assert path.times[0] == pytest.approx(-0.1)
    assert path.times[-1] == 0.0
    assert np.all(np.diff(path.times) > 0)
    assert np.diff(path.times).max() <= imu.MAX_KNOT_STEP + 1e-9
    for t, pose in zip(path.times[::7], path.poses[::7], strict=True):
        np.testing.assert_allclose(pose, walk.pose(1.6 + t)[:3], atol=1e-5)
    np.testing.assert_allclose(path.poses[-1], predicted.state.T_odom_imu[:3], atol=1e-12)


def test_resting_moves_nothing() -> None:
    walk = Walk(R_world_device=Rotation.from_euler("xyz", [0.3, 2.0, -1.0]).as_matrix(), still=100)
    samples = imu_samples(walk, Rig(), np.arange(0, 202) / 200)
    predicted, _ = imu.propagate(Belief(state_at(walk, 0.0), np.eye(DIM)), samples, START_NS + 1_000_000_000, QUIET)
    metres, degrees = pose_error(predicted.state.T_odom_imu, walk.pose(0.0))
    assert metres < 1e-9
    assert degrees < 1e-9


# --- covariance ----------------------------------------------------------------------------------
def test_the_covariance_is_carried_by_the_motions_true_jacobian() -> None:
    """Finite differences through the whole propagation, in every one of the 23 directions."""
    rng = np.random.default_rng(5)
    rig = Rig(T_imu_lidar=mounted((90, 10, -30), (0.1, 0.2, -0.3)), b_gyro=(0.02, 0, 0), b_accel=(0, 0.1, 0))
    walk = Walk(still=0.0)
    state, samples = state_at(walk, 1.0, rig), imu_samples(walk, rig, np.arange(200, 222) / 200)
    end_ns = START_NS + 1_100_000_000
    root = rng.normal(size=(DIM, DIM)) * 1e-2
    prior = Belief(state, root @ root.T)
    predicted, _ = imu.propagate(prior, samples, end_ns, QUIET)

    jacobian, h = np.empty((DIM, DIM)), 1e-5
    for i, e in enumerate(np.eye(DIM) * h):
        ahead = imu.propagate(replace(prior, state=boxplus(state, e)), samples, end_ns, QUIET)[0].state
        behind = imu.propagate(replace(prior, state=boxplus(state, -e)), samples, end_ns, QUIET)[0].state
        jacobian[:, i] = (boxminus(ahead, predicted.state) - boxminus(behind, predicted.state)) / (2 * h)
    expected = jacobian @ prior.covariance @ jacobian.T
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        predicted.covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.01
    )


def test_noise_grows_as_random_walks_do() -> None:
    """At rest: angle and velocity as sqrt(t), position as t^1.5 / sqrt(3), from the noise densities."""
    params = ImuParams(gyro_noise=2e-3, accel_noise=1e-2, gyro_bias_walk=0, accel_bias_walk=0)
    samples = imu_samples(Walk(still=100), Rig(), np.arange(0, 102) / 200)
    start = Belief(state_at(Walk(still=100), 0.0), np.eye(DIM) * 1e-20)
    predicted, _ = imu.propagate(start, samples, START_NS + 500_000_000, params)
    sigma = np.sqrt(np.diag(predicted.covariance))
    np.testing.assert_allclose(sigma[ROT], 2e-3 * np.sqrt(0.5), rtol=0.01)
    # upwards; across, what tilts the device lets gravity in as well
    assert sigma[VEL][2] == pytest.approx(1e-2 * np.sqrt(0.5), rel=0.01)
    assert sigma[POS][2] == pytest.approx(1e-2 * np.sqrt(0.5**3 / 3), rel=0.01)
    assert np.all(sigma[VEL][:2] > 1.05 * sigma[VEL][2])
    np.testing.assert_allclose(np.sqrt(np.diag(predicted.covariance))[9:15], 1e-10, rtol=1e-3)


def test_simulated_noise_scatters_as_the_covariance_says() -> None:
    """Monte Carlo over noisy IMUs on the same walk: normalised errors squared average to the dimension."""
    density_gyro, density_accel, rate = 5e-3, 5e-2, 200
    params = ImuParams(gyro_noise=density_gyro, accel_noise=density_accel, gyro_bias_walk=0, accel_bias_walk=0)
    rig = Rig(gyro_noise=density_gyro * np.sqrt(rate), accel_noise=density_accel * np.sqrt(rate))
    walk, seconds = Walk(still=0.0), np.arange(200, 282) / rate
    start, end_ns = Belief(state_at(walk, 1.0), np.eye(DIM) * 1e-16), START_NS + 1_400_000_000
    clean = imu.propagate(start, imu_samples(walk, Rig(), seconds), end_ns, params)[0]
    errors = np.array(
        [
            boxminus(imu.propagate(start, imu_samples(walk, rig, seconds, seed), end_ns, params)[0].state, clean.state)[
                :9
            ]
            for seed in range(300)
        ]
    )
    information = np.linalg.inv(clean.covariance[:9, :9])
    nees = np.einsum("ni,ij,nj->n", errors, information, errors)
    assert nees.mean() == pytest.approx(9, rel=0.15)  # standard error of the mean: sqrt(18 / 300) = 0.25


def test_the_covariance_stays_symmetric_and_positive() -> None:
    walk, belief = Walk(still=0.0), Belief(state_at(Walk(still=0.0), 0.0), np.diag(np.geomspace(1e-8, 1, DIM)))
    for k in range(30):
        samples = imu_samples(walk, Rig(), np.arange(20 * k, 20 * k + 22) / 200)
        belief, _ = imu.propagate(belief, samples, START_NS + (k + 1) * 100_000_000, ImuParams())
    np.testing.assert_array_equal(belief.covariance, belief.covariance.T)
    assert np.linalg.eigvalsh(belief.covariance)[0] > 0


# --- gaps ----------------------------------------------------------------------------------------
def with_gap(begin_s: float, end_s: float) -> ImuSamples:
    seconds = np.arange(0, 102) / 200
    return imu_samples(Walk(still=100), Rig(), seconds[(seconds <= begin_s) | (seconds >= end_s)])


def sigma_after(samples: ImuSamples, ends_s: tuple[float, ...]) -> np.ndarray:
    """Standard deviations after propagating to each of the ends in turn, as the engine does."""
    belief = Belief(state_at(Walk(still=100), 0.0), np.eye(DIM) * 1e-10)
    for end in ends_s:
        end_ns = START_NS + round(end * 1e9)
        gap = imu.longest_gap(samples, end_ns) > ImuParams().max_gap
        moved, _ = imu.propagate(imu.before_gap(belief) if gap else belief, samples, end_ns, ImuParams())
        belief = imu.after_gap(moved, belief) if gap else moved
    return np.asarray(np.sqrt(np.diag(belief.covariance)))


def test_a_gap_in_the_imu_widens_the_covariance() -> None:
    whole, gap = sigma_after(with_gap(0, 0), (0.5,)), sigma_after(with_gap(0.1, 0.4), (0.5,))
    assert np.all(gap[ROT] > 20 * whole[ROT])
    assert np.all(gap[POS] > 20 * whole[POS])


def test_a_gap_counts_as_one_however_many_scans_end_inside_it() -> None:
    at_once = sigma_after(with_gap(0.1, 0.4), (0.5,))
    in_parts = sigma_after(with_gap(0.1, 0.4), (0.15, 0.2, 0.25, 0.3, 0.35, 0.5))
    np.testing.assert_allclose(in_parts[[5, 8]], at_once[[5, 8]], rtol=0.1)  # vertically, where turns do not matter
    assert np.all(in_parts[ROT] > 0.1)  # within each scan it may turn at a rate of its own


def test_a_missing_sample_is_not_a_gap() -> None:
    np.testing.assert_allclose(sigma_after(with_gap(0.1, 0.11), (0.5,)), sigma_after(with_gap(0, 0), (0.5,)), rtol=0.05)


@pytest.mark.parametrize(("gap_s", "coasts"), [(0.3, False), (2.0, True)])
def test_through_a_long_gap_one_walks_on_as_one_walked(gap_s: float, coasts: bool) -> None:
    """A foot that lands at both its ends brakes with 3 m/s^2, and no one brakes for seconds."""
    end_ns = START_NS + round(gap_s * 1e9)
    braking = np.tile([-3.0, 0.0, GRAVITY], (2, 1))
    samples = ImuSamples(np.array([START_NS, end_ns]), np.zeros((2, 3)), braking)
    state = replace(
        state_at(Walk(still=100), 0.0),
        R_odom_imu=np.eye(3),
        v_odom_imu=np.array([1.3, 0.0, 0.0]),
        b_gyro=np.zeros(3),
        b_accel=np.zeros(3),
    )
    predicted, _ = imu.propagate(Belief(state, np.eye(DIM) * 1e-10), samples, end_ns, ImuParams())
    v = 1.3 - (0.0 if coasts else 3.0 * gap_s)
    np.testing.assert_allclose(predicted.state.v_odom_imu, [v, 0, 0], atol=1e-6)
    np.testing.assert_allclose(predicted.state.p_odom_imu - state.p_odom_imu, [(1.3 + v) / 2 * gap_s, 0, 0], atol=1e-6)


def test_a_gap_does_not_touch_the_bias_of_the_gyroscope() -> None:
    """What a scan finds out about the rate of turn in a gap is no bias."""
    known = Belief(state_at(Walk(still=100), 0.0), np.eye(DIM) * 1e-6)
    in_gap = replace(imu.before_gap(known), state=replace(known.state, b_gyro=np.array([0.4, -0.2, 0.9])))
    assert np.all(np.diag(in_gap.covariance)[BG] > 0.9)
    after = imu.after_gap(in_gap, known)
    np.testing.assert_array_equal(after.state.b_gyro, known.state.b_gyro)
    np.testing.assert_array_equal(after.covariance, known.covariance)


def test_who_turned_when_the_samples_ended_does_not_turn_for_ever() -> None:
    """A second after the last sample, with a rate of 2 rad/s and a bias of 0.1 rad/s about z."""
    stamps = START_NS + np.array([-1_005_000_000, -1_000_000_000])
    samples = ImuSamples(stamps, np.tile([0.0, 0.0, 2.1], (2, 1)), np.tile([0.0, 0.0, GRAVITY], (2, 1)))
    state = replace(state_at(Walk(still=100), 0.0), R_odom_imu=np.eye(3), b_gyro=np.array([0.0, 0.0, 0.1]))
    predicted, _ = imu.propagate(Belief(state, np.eye(DIM) * 1e-10), samples, START_NS + 100_000_000, ImuParams())
    np.testing.assert_allclose(predicted.state.R_odom_imu, np.eye(3), atol=1e-12)


def test_samples_that_end_early_are_held() -> None:
    """A path is there for every point, even if the last sample is from before the scan's end."""
    samples = imu_samples(Walk(still=100), Rig(), np.arange(0, 18) / 200)
    predicted, path = imu.propagate(
        Belief(state_at(Walk(still=100), 0.0), np.eye(DIM) * 1e-10), samples, START_NS + 100_000_000, ImuParams()
    )
    assert path.times[0] == pytest.approx(-0.1)
    np.testing.assert_allclose(predicted.state.p_odom_imu, 0, atol=1e-9)


def test_time_that_stands_still_changes_nothing() -> None:
    belief = Belief(state_at(Walk(still=100), 0.0), np.eye(DIM) * 1e-4)
    samples = imu_samples(Walk(still=100), Rig(), np.arange(0, 3) / 200)
    predicted, path = imu.propagate(belief, samples, START_NS, ImuParams())
    np.testing.assert_allclose(predicted.covariance, belief.covariance, atol=1e-12)
    np.testing.assert_array_equal(predicted.state.p_odom_imu, belief.state.p_odom_imu)
    np.testing.assert_allclose(path.poses, np.tile(belief.state.T_odom_imu[:3], (len(path.poses), 1, 1)))
    assert path.times[-1] == 0.0


# --- deskew --------------------------------------------------------------------------------------
MOUNTS = {
    "as the IMU": mounted((0, 0, 0), (0, 0, 0)),
    "before the IMU": mounted((0, 0, 0), (0.3, -0.2, 0.4)),
    "sideways": mounted((90, 0, 45), (0.2, 0.1, -0.3)),
    "upside down": mounted((180, 0, 0), (0, 0, 0.5)),
}


@pytest.mark.parametrize("mount", MOUNTS, ids=str)
@pytest.mark.parametrize("device", [FORWARD, UPRIGHT], ids=["forward", "upright"])
def test_a_wall_seen_while_moving_fast_is_flat_again(mount: str, device: np.ndarray) -> None:
    """A device swung at 2 rad/s and 2 m/s bends a wall by decimetres; deskewed, it lies where it is."""
    walk = Walk(device, still=0.0, speed=(2.0, 0.5, 0.0), yaw_rate=1.5)
    rig = Rig(T_imu_lidar=MOUNTS[mount], range_noise=0.0)
    wall = Scene(boxes=(box(12.0, -30, -30, 13.0, 30, 30), box(-30, -30, -6, 30, 30, -5), box(-30, -30, 5, 30, 30, 6)))
    begin = 2.0
    scan = sweep(wall, walk, rig, begin, seed=0)
    end = seconds_of(scan.end_ns)
    samples = imu_samples(walk, rig, np.arange(np.floor(begin * 200), np.ceil(end * 200) + 1) / 200)
    predicted, path = imu.propagate(Belief(state_at(walk, begin, rig), np.eye(DIM)), samples, scan.end_ns, ImuParams())
    points = imu.deskew(scan, path, predicted.state)

    T = walk.pose(end) @ rig.T_imu_lidar
    world, raw = (p.astype(float) @ T[:3, :3].T + T[:3, 3] for p in (points, scan.points))

    def off(p: np.ndarray) -> np.ndarray:
        return np.abs(np.stack([p[:, 0] - 12, p[:, 2] + 5, p[:, 2] - 5])).min(axis=0)

    assert len(points) > 300
    assert off(world).max() < 1e-3
    assert off(raw).max() > 0.1
    assert points.dtype == np.float32


def test_a_scan_at_rest_is_returned_as_it_is() -> None:
    walk = Walk(still=100)
    scan = sweep(Scene(box(-3, -3, -1, 4, 3, 2)), walk, Rig(T_imu_lidar=MOUNTS["sideways"]), 0.0, seed=1)
    rig = Rig(T_imu_lidar=MOUNTS["sideways"])
    samples = imu_samples(walk, rig, np.arange(0, 22) / 200)
    predicted, path = imu.propagate(Belief(state_at(walk, 0.0, rig), np.eye(DIM)), samples, scan.end_ns, ImuParams())
    np.testing.assert_allclose(imu.deskew(scan, path, predicted.state), scan.points, atol=1e-5)


def test_points_from_before_the_path_are_extrapolated() -> None:
    """Scans that overlap a little in time: the first points are older than the last pose."""
    walk, rig = Walk(still=0.0, yaw_rate=1.0), Rig(range_noise=0.0)
    scan = sweep(Scene(box(-6, -6, -6, 6, 6, 6)), walk, rig, 2.0, seed=0)
    late = 2.01
    samples = imu_samples(walk, rig, np.arange(400, 423) / 200)
    predicted, path = imu.propagate(Belief(state_at(walk, late, rig), np.eye(DIM)), samples, scan.end_ns, ImuParams())
    points = imu.deskew(scan, path, predicted.state)
    T = walk.pose(seconds_of(scan.end_ns)) @ rig.T_imu_lidar
    world = points.astype(float) @ T[:3, :3].T + T[:3, 3]
    off = 6 - np.abs(world).max(axis=1)
    assert np.abs(off).max() < 5e-3


def test_no_points_deskew_to_no_points() -> None:
    walk = Walk(still=100)
    scan = sweep(Scene(), walk, Rig(), 0.0, seed=0)
    assert len(scan) == 0
    samples = imu_samples(walk, Rig(), np.arange(0, 3) / 200)
    predicted, path = imu.propagate(Belief(state_at(walk, 0.0), np.eye(DIM)), samples, START_NS + 1, ImuParams())
    assert imu.deskew(scan, path, predicted.state).shape == (0, 3)


def test_the_scenes_samples_are_the_walks_derivatives() -> None:
    """The oracle itself, by finite differences."""
    walk, t, h = Walk(speed=(1.0, 0.2, 0.0), yaw_rate=0.3), np.linspace(0, 5, 40), 1e-5
    np.testing.assert_allclose((walk.positions(t + h) - walk.positions(t - h)) / (2 * h), walk.velocities(t), atol=1e-8)
    np.testing.assert_allclose(
        (walk.velocities(t + h) - walk.velocities(t - h)) / (2 * h), walk.accelerations(t), atol=1e-7
    )
    turn = (walk.rotations(t - h).inv() * walk.rotations(t + h)).as_rotvec() / (2 * h)
    np.testing.assert_allclose(turn, walk.rates(t), atol=1e-7)
    assert PERIOD_S * 200 == 20


@pytest.mark.parametrize(("clock", "mounting"), [(0.004, 0.0), (0.001, 0.01)])
def test_at_rest_the_noise_is_that_of_the_data_sheet_and_motion_adds_what_is_not_known(
    clock: float, mounting: float
) -> None:
    """Growth of the heading's uncertainty over 0.1 s: still, turning steadily, and turning ever faster."""
    P = np.zeros((DIM, DIM))
    P[imu.EXT_ROT, imu.EXT_ROT] = mounting**2 * np.eye(3)
    turn = 0.1 * np.hypot(imu.GYRO_SCALE, np.sqrt(2.0) * mounting)  # rad, of a turn by 0.1
    grown = []
    for first, last in ((0.0, 0.0), (1.0, 1.0), (0.0, 2.0)):
        gyro = np.zeros((21, 3))
        gyro[:, 2] = np.linspace(first, last, 21)
        samples = ImuSamples(np.arange(21, dtype=np.int64) * 5_000_000, gyro, np.tile([0.0, 0.0, 9.81], (21, 1)))
        state = NavState(0, np.eye(3), *np.zeros((4, 3)), np.array([0.0, 0.0, -9.81]), np.eye(3), np.zeros(3))
        after, _ = imu.propagate(Belief(state, P), samples, 100_000_000, ImuParams(), clock)
        grown.append(np.sqrt(after.covariance[2, 2]))
    sheet = ImuParams().gyro_noise * np.sqrt(0.1)
    assert grown[0] == pytest.approx(sheet, rel=0.01)
    assert grown[1] == pytest.approx(np.hypot(sheet, turn), rel=0.01)
    farthest = clock * 1.0  # the rate is at most 1 rad/s from its mean
    assert grown[2] == pytest.approx(np.sqrt(sheet**2 + farthest**2 + turn**2), rel=0.01)
