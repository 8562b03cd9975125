"""The update where the prediction does not tell the motion during a scan: there is no IMU, it has a gap, or the speed
is not known yet.

Each point is compared with the map where the device was at the point's own time, so a scan determines rates and not
only a pose (continuous-time ICP, Dellenbach et al. 2022, "CT-ICP").

Without an IMU the device turns and moves on between two scans as fast as it did. The state then holds the rate of turn
as the bias of a gyroscope that reads zero, and gravity is the normal of the floor where one is seen.
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
"""rad/s and m/s²: change of the rate of turn from a scan to the next, and acceleration, of a walking person's hand."""
FIRST_SPEED, FIRST_RATE = 1.5, 1.0
"""m/s, rad/s: standard deviations before the first two scans are compared."""
ADRIFT = 0.6
"""m/s: standard deviation of the speed along a direction that four scans in a row have left open. A scan that holds all
directions leaves half of that."""
KNOT_S, LONGEST_S = 0.0025, 1.0
"""How far poses in between are apart, and how long a scan lasts at most: a gap before it needs none."""
GATES = (4.0, 2.0, 1.0, 1.0, 1.0)
"""Of the residuals in each iteration, times the filter's gate; wide at first, since nothing measures the motion."""
CONVERGED_ROTATION, CONVERGED_TRANSLATION = 1e-4, 1e-3
"""rad, m: an increment below these ends the iteration."""
ENOUGH_PLANES, ENOUGH_SHARE, WALKING = 50, 0.45, 0.3
"""Fewer good planes than ENOUGH_PLANES, or above WALKING m/s than ENOUGH_SHARE of the points, are too few; then poor
ones are used too. Where good ones leave a direction open, as in a bare corridor, poor ones must not hold the scan."""
UNSURE = 0.2
"""m/s: standard deviation of the speed from which it is better found from the scan's own distortion than taken from the
prediction: points are then off by over 1 cm."""
UPRIGHT = np.array([[0.0, 0.0, 1.0]])
FORWARD = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
"""What may be up in the LiDAR frame: of a scanner held upright, and of a hemispherical one that looks forward."""
BELOW_DEG = -3.0
"""A LiDAR that sees lower than this is one that is held upright."""


@dataclass(frozen=True, slots=True)
class Course:
    """How the device came to its pose at the end of a scan, seen from there, beside a motion at constant rates.

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
        """Nothing beside the constant rates: no turn, no sway, at times KNOT_S apart.

        Args:
            begin_ns, end_ns: of the motion; of one longer than LONGEST_S, the first time is followed by a gap.
        """
        dt = max((end_ns - begin_ns) * 1e-9, 1e-6)
        scan = min(dt, LONGEST_S)
        times = np.linspace(-scan, 0.0, int(np.ceil(scan / KNOT_S)) + 1)
        times = np.append(-dt, times) if scan < dt else times
        nothing = np.zeros((len(times), 3))
        return cls(times, np.tile(np.eye(3), (len(times), 1, 1)), nothing, nothing)

    @classmethod
    def measured(cls, path: Path, predicted: NavState) -> "Course":
        """What the IMU measured along the path, which led to the predicted state."""
        R, t = predicted.R_odom_imu, path.times[:, None]
        turned = R.T @ path.poses[:, :, :3] @ lie.exp(predicted.b_gyro * t)
        swayed = (path.poses[:, :, 3] - predicted.p_odom_imu - predicted.v_odom_imu * t) @ R
        return cls(path.times, turned, swayed, np.zeros_like(swayed))


def begin(scan: Scan, params: Params) -> Belief:
    """Belief at the first scan's begin; odom's z is the normal of the floor that the scan shows, if it shows one."""
    up = lie.from_rpy_degrees(params.sensor.rotation) @ _up(scan, params)
    return standing(scan.stamp_ns, lie.between(up, np.array([0.0, 0.0, 1.0])), params)


def standing(stamp_ns: int, R_odom_imu: F64, params: Params) -> Belief:
    """Belief of a device that rests at odom's origin, as far as is known: speed and rate of turn are wide open.

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
    """The belief where the rate of turn is unknown and gravity is known, as at the begin."""
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
    """Up in the LiDAR frame: as such a scanner is usually held, made exact by the floor. The nearer plane is the floor,
    the farther one a ceiling."""
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
