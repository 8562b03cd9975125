"""The update for a scan whose motion cannot be predicted: there is no IMU, its samples have a gap, or the speed is not
known yet.

Each point is compared with the map from the device's pose at the point's own time, so a scan determines rates and not
only a pose (continuous-time ICP, Dellenbach et al. 2022, "CT-ICP").

Without an IMU, the speed and the rate of turn are assumed to stay the same between two scans. The state then holds the
rate of turn as the bias of a gyroscope that reads zero, and gravity follows from the floor's normal if a floor is seen.
"""

from dataclasses import dataclass, replace

import numpy as np

from app.slam import ground, iekf, lie
from app.slam.imu import BA, BG, DIM, EXT_POS, EXT_ROT, GRAV, KNOWN, POS, ROT, VEL, Belief, Path, at_origin
from app.slam.kernels import motion
from app.slam.kernels.registration import EDGE_ON, REPEATED, RESIDUAL_HUBER
from app.slam.local_map import LocalMap
from app.slam.params import Params
from app.slam.sections import FilterParams
from app.slam.types import F32, F64, NavState, Registration, Scan

CHANGES = (1.0, 3.0)
"""rad/s and m/s², of a walking person's hand: change of the rate of turn between two scans, and acceleration."""
FIRST_SPEED, FIRST_RATE = 1.5, 1.0
"""m/s, rad/s: standard deviations before the first two scans are compared."""
ADRIFT = 0.6
"""m/s: standard deviation of the speed along a direction that four scans in a row have left open. A scan that
constrains all directions leaves half of that."""
KNOT_S, LONGEST_S = 0.0025, 1.0
"""s: time between two intermediate poses, and longest duration of a scan. A gap before the scan needs no such poses."""
GATES = (4.0, 2.0, 1.0, 1.0, 1.0)
"""Gate of the residuals in each iteration, in multiples of the filter's; wide at first, as the motion is unknown."""
CONVERGED_ROTATION, CONVERGED_TRANSLATION = 1e-4, 1e-3
"""rad, m: an increment below these ends the iteration."""
ENOUGH_PLANES, ENOUGH_SHARE, WALKING = 50, 0.45, 0.3
"""Good planes are too few if there are fewer than ENOUGH_PLANES or, above WALKING m/s, fewer than ENOUGH_SHARE of the
points. Then poor planes are used too. If good planes are enough but leave a direction open, as in a bare corridor, poor
planes must not constrain it."""
UNSURE = 0.2
"""m/s: above this standard deviation of the speed, the scan's own distortion shows the speed better than the prediction
does: deskewed by the prediction, points would be off by over 1 cm."""
UPRIGHT = np.array([[0.0, 0.0, 1.0]])
FORWARD = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
"""Possible up directions in the LiDAR frame: if held upright, and if a hemispherical scanner looks forward."""
BELOW_DEG = -3.0
"""A LiDAR that sees below this elevation is assumed to be held upright."""


@dataclass(frozen=True, slots=True)
class Course:
    """Motion of the device during a scan, in addition to constant rates, relative to its pose at the end.

    Attributes:
        times: (k,) s before the end, ascending to 0. turned: (k, 3, 3) R_end_then. swayed: (k, 3) m.
        speeds: (k, 3) m/s, the change of `swayed`.
    """

    times: F64
    turned: F64
    swayed: F64
    speeds: F64

    @classmethod
    def steady(cls, begin_ns: int, end_ns: int) -> "Course":
        """Constant rates only: no additional turn or sway, at times KNOT_S apart.

        Args:
            begin_ns, end_ns: of the motion. If it is longer than LONGEST_S, the first interval is a gap.
        """
        dt = max((end_ns - begin_ns) * 1e-9, 1e-6)
        scan = min(dt, LONGEST_S)
        times = np.linspace(-scan, 0.0, int(np.ceil(scan / KNOT_S)) + 1)
        times = np.append(-dt, times) if scan < dt else times
        nothing = np.zeros((len(times), 3))
        return cls(times, np.tile(np.eye(3), (len(times), 1, 1)), nothing, nothing)

    @classmethod
    def measured(cls, path: Path, predicted: NavState) -> "Course":
        """As the IMU measured it along the path that led to the predicted state."""
        R, t = predicted.R_odom_imu, path.times[:, None]
        turned = R.T @ path.poses[:, :, :3] @ lie.exp(predicted.b_gyro * t)
        swayed = (path.poses[:, :, 3] - predicted.p_odom_imu - predicted.v_odom_imu * t) @ R
        return cls(path.times, turned, swayed, np.zeros_like(swayed))


def begin(scan: Scan, params: Params) -> Belief:
    """Belief at the beginning of the first scan. If the scan shows a floor, its normal is odom's z axis."""
    up = lie.from_rpy_degrees(params.sensor.rotation) @ _up(scan, params)
    return standing(scan.stamp_ns, lie.between(up, np.array([0.0, 0.0, 1.0])), params)


def standing(stamp_ns: int, R_odom_imu: F64, params: Params) -> Belief:
    """Belief of a device at rest at odom's origin, but with very uncertain speed and rate of turn.

    Args:
        R_odom_imu: (3, 3), odom's z up; known to 1e-4 rad.

    Returns:
        The state, with gravity along -z of odom (m/s²), and its (DIM, DIM) covariance in rad, m, m/s, rad/s.
    """
    sigma = np.zeros(DIM)
    sigma[ROT] = sigma[POS] = KNOWN
    sigma[VEL], sigma[BG], sigma[BA], sigma[GRAV] = FIRST_SPEED, FIRST_RATE, 1e-3, 1e-3
    sigma[EXT_ROT] = sigma[EXT_POS] = 1e-6
    return at_origin(stamp_ns, R_odom_imu, np.zeros(3), sigma, params)


def without_imu(belief: Belief) -> Belief:
    """The belief with the rate of turn unknown and gravity known, as at the start."""
    covariance = belief.covariance.copy()
    for part, sigma in ((BG, FIRST_RATE), (GRAV, 1e-3)):
        covariance[part] = covariance[:, part] = 0.0
        covariance[part, part] = sigma**2 * np.eye(part.stop - part.start)
    return Belief(replace(belief.state, b_gyro=np.zeros(3)), covariance)


def propagate(belief: Belief, end_ns: int, course: Course, changes: tuple[float, float] = CHANGES) -> Belief:
    """Carry the belief forward to `end_ns` along the course.

    Args:
        changes: standard deviations, as CHANGES.
    """
    state, dt = belief.state, -float(course.times[0])
    R = state.R_odom_imu @ course.turned[0].T @ lie.exp(-state.b_gyro * dt)
    v = state.v_odom_imu - R @ course.speeds[0]
    F, Q = np.eye(DIM), np.zeros((DIM, DIM))
    F[ROT, ROT], F[ROT, BG], F[POS, VEL] = R.T @ state.R_odom_imu, -dt * np.eye(3), dt * np.eye(3)
    for pose, rate, change, sign in ((ROT, BG, changes[0], -1.0), (POS, VEL, changes[1] * dt, 1.0)):
        Q[pose, pose], Q[rate, rate] = change**2 * dt**2 / 3 * np.eye(3), change**2 * np.eye(3)
        Q[pose, rate] = Q[rate, pose] = sign * change**2 * dt / 2 * np.eye(3)
    p = state.p_odom_imu + v * dt - R @ course.swayed[0]
    moved = replace(state, stamp_ns=end_ns, R_odom_imu=R, p_odom_imu=p, v_odom_imu=v)
    return Belief(moved, F @ belief.covariance @ F.T + Q)


def is_unsure(belief: Belief) -> bool:
    """Whether the speed is too uncertain to deskew a scan by it."""
    return bool(np.linalg.eigvalsh(belief.covariance[VEL, VEL])[-1] > UNSURE**2)


def is_adrift(belief: Belief) -> bool:
    """Whether nothing measures the speed in some direction any more, so that the position along it is a guess."""
    return bool(np.linalg.eigvalsh(belief.covariance[VEL, VEL])[-1] > ADRIFT**2)


def deskew(scan: Scan, state: NavState, course: Course) -> F32:
    """(n, 3) float32 m, all points in the LiDAR frame at the time of `state`, at its rates."""
    knots = np.tile(np.eye(4), (len(course.times), 1, 1))
    knots[:, :3, :3] = course.turned @ lie.exp(-state.b_gyro * course.times[:, None])
    knots[:, :3, 3] = (state.R_odom_imu.T @ state.v_odom_imu) * course.times[:, None] + course.swayed
    seen = (lie.inverse(state.T_imu_lidar) @ knots @ state.T_imu_lidar)[:, :3]
    shift = (scan.stamp_ns - state.stamp_ns) * 1e-9
    out = np.empty_like(scan.points)
    motion.deskew(scan.points, scan.offsets_ns, shift, course.times, np.ascontiguousarray(seen), out)
    return out


def update(
    prior: Belief, scan: Scan, course: Course, local_map: LocalMap, params: FilterParams, extrinsics: bool = False
) -> tuple[Belief, Registration]:
    """Correct pose and rates by one scan: iterated least squares from the prior, as `iekf.update`.

    Args:
        scan: points as measured; at most `max_points` of them are looked up in the map.
        extrinsics: whether to refine the LiDAR's pose on the IMU, too.
    """
    scan = scan.part(np.arange(0, len(scan), -(-len(scan) // params.max_points) or 1))
    ago = ((scan.stamp_ns - prior.state.stamp_ns + scan.offsets_ns.astype(np.int64)) * 1e-9)[:, None]  # <= 0
    free = DIM if extrinsics else iekf.NAVIGATION
    information, here = np.asarray(np.linalg.inv(prior.covariance[:free, :free])), prior.state
    walks = float(np.linalg.norm(here.v_odom_imu)) > WALKING
    enough = max(ENOUGH_PLANES, ENOUGH_SHARE * len(scan)) if walks else ENOUGH_PLANES
    converged, iteration, covariance = False, 0, information
    for iteration, gate in enumerate(GATES, 1):
        points = deskew(scan, here, course)
        arms = points @ here.R_imu_lidar.T + here.p_imu_lidar
        world = arms @ here.R_odom_imu.T + here.p_odom_imu
        good, poor = local_map.planes(world, here.p_odom_lidar, params)
        planes = good if np.count_nonzero(good.variances >= 0) >= enough else poor
        found = np.flatnonzero(planes.variances >= 0)  # nothing was written elsewhere
        at, spread = planes.normals[found], np.sqrt(planes.variances[found])
        off = np.sum(at * (world[found] - planes.centers[found]), axis=1)
        normals, reach = at @ here.R_odom_imu, np.linalg.norm(points[found], axis=1)
        fits = np.abs(off) < gate * params.gate * np.sqrt(reach)
        fits &= np.abs(np.sum(normals @ here.R_imu_lidar * points[found], axis=1)) > EDGE_ON * reach
        used, off, spread = found[fits], off[fits], spread[fits]
        residuals = np.full(len(scan), np.nan)
        residuals[used] = off
        stats = np.array([len(used), np.sum(off**2)])
        if len(used) < iekf.MIN_INLIERS:
            return prior, iekf.too_few(iteration, len(scan), len(used), iekf.matches(points, residuals, planes))
        turn, way = np.cross(arms[used], normals[fits]), at[fits]
        rows = np.zeros((len(used), DIM))
        rows[:, ROT], rows[:, POS], rows[:, VEL], rows[:, BG] = turn, way, ago[used] * way, -ago[used] * turn
        rows[:, EXT_ROT] = np.cross(points[used], normals[fits] @ here.R_imu_lidar)
        rows[:, EXT_POS] = normals[fits]
        rows = rows[:, :free]
        weighted = rows.T * (np.minimum(1.0, RESIDUAL_HUBER * spread / np.maximum(np.abs(off), 1e-9)) / spread**2)
        H = weighted @ rows / REPEATED
        gradient = weighted @ off / REPEATED + information @ iekf.boxminus(here, prior.state)[:free]
        covariance = np.asarray(np.linalg.inv(information + H))
        step = np.zeros(DIM)
        step[:free] = -covariance @ gradient
        here = iekf.boxplus(here, step)
        small = np.linalg.norm(step[ROT]) < CONVERGED_ROTATION and np.linalg.norm(step[POS]) < CONVERGED_TRANSLATION
        if gate == 1.0 and small:
            converged = True
            break
    registration = iekf.outcome(points, H[:6, :6], converged, iteration, stats, iekf.matches(points, residuals, planes))
    return Belief(here, iekf.schmidt(prior.covariance, information, covariance)), registration


def _up(scan: Scan, params: Params) -> F64:
    """Up in the LiDAR frame: the usual direction for such a scanner, made exact by the floor. If two planes are found,
    the nearer one is the floor and the farther one a ceiling."""
    heights = scan.points[:, 2] / np.maximum(np.linalg.norm(scan.points, axis=1), 1e-3)
    lowest = np.degrees(np.arcsin(np.percentile(heights, 0.5))) if len(heights) else 0.0
    guesses = UPRIGHT if lowest < BELOW_DEG else FORWARD
    floors = [ground.segment(scan.points, scan.ring, -up, params.ground) for up in guesses]
    found = [floor for floor in floors if floor.found]
    if not found:
        return np.asarray(guesses[0])
    floor = min(found, key=lambda plane: abs(plane.centroid @ plane.normal))
    again = ground.segment(scan.points, scan.ring, -floor.normal, params.ground)
    return again.normal if again.found else floor.normal
