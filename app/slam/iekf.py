"""Iterated error-state Kalman filter on manifolds: the update (paper 2.3, eq. 5-7).

State on SO(3) x R3 x R3 x R3 x R3 x S² x SO(3) x R3, 23 error dimensions in the order of
`app.slam.imu`. The gain is in the information form (Xu & Zhang 2021), so its cost is set by the
state's size and not by the number of points; each iteration is one Gauss-Newton step of eq. 7.
"""

import contextlib
from dataclasses import replace

import numpy as np

from app.slam.imu import DIM, POS, POSE, ROT, Belief
from app.slam.kernels import manifold
from app.slam.kernels import registration as kernels
from app.slam.local_map import LocalMap, Planes
from app.slam.sections import FilterParams
from app.slam.types import F32, F64, Matches, NavState, Registration

RESEARCH_ROTATION = 1e-3
RESEARCH_TRANSLATION = 1e-2
"""rad, m: planes are searched again once the state has moved by more than this."""
CONVERGED_ROTATION = 1e-5
CONVERGED_TRANSLATION = 1e-4
"""rad, m: an increment below these ends the iteration."""
MIN_INLIERS = 30
"""Least number of planes for an update; with fewer the prediction stands."""
OPEN_SIGMA = 0.03
"""m (rotation: as below): if good planes leave a direction less certain than this, poor ones are used too, weighted by
their certainty. In a park all good planes lie on the ground, and only trunks constrain the position along it. A few
points could then decide about that direction, so the weight of each is limited (`LARGEST_SHARE`)."""
MANY_PLANES = 0.45
"""If at least this share of a scan's points has a plane, the scan is trusted where it contradicts the IMU."""
SURPRISING = 4.0
"""Surprise of a frame (`Registration`) above which the scan and the IMU contradict each other. Clean sensors stay below
0.3, imperfect ones below 3.5; where scans show little but people and false points, it reaches 5 to 89."""
DEGENERATE_SIGMA = 0.1
"""m (rotation: rad times the RMS range of the points): a direction that one scan alone leaves more
uncertain than this is degenerate."""

NO_LIMIT = np.zeros((6, 6))
"""Passed as the posterior covariance where the weights of points are not limited."""
NAVIGATION = 17
"""Error dimensions without the extrinsics, which come last and are fixed unless estimated."""


def boxplus(x: NavState, d: F64) -> NavState:
    """x [+] d for an error d (23,)."""
    out = np.empty(manifold.SIZE)
    manifold.boxplus(_packed(x), d, out)
    return _unpacked(out, x.stamp_ns)


def boxminus(a: NavState, b: NavState) -> F64:
    """a [-] b: the error d (23,) with b [+] d = a."""
    d = np.empty(DIM)
    manifold.boxminus(_packed(a), _packed(b), d)
    return d


def _packed(x: NavState) -> F64:
    rotation, extrinsic = x.R_odom_imu.ravel(), x.R_imu_lidar.ravel()
    return np.concatenate(
        [rotation, x.p_odom_imu, x.v_odom_imu, x.b_gyro, x.b_accel, x.g_odom, extrinsic, x.p_imu_lidar]
    )


def _unpacked(x: F64, stamp_ns: int) -> NavState:
    R, p, v, bg, ba, g, R_il, p_il = np.split(x, [9, 12, 15, 18, 21, 24, 33])
    return NavState(stamp_ns, R.reshape(3, 3), p, v, bg, ba, g, R_il.reshape(3, 3), p_il)


def update(prior: Belief, points: F32, local_map: LocalMap, params: FilterParams) -> tuple[Belief, Registration]:
    """Fuse one scan: minimise eq. 7 from the predicted belief.

    Args:
        prior: belief at the scan's end, from propagation.
        points: (n, 3) float32 m, LiDAR frame, deskewed to the scan's end.

    Returns:
        The posterior belief, or the unchanged prior if too few points found a plane; and how the update went.
    """
    n = len(points)
    free = DIM if params.estimate_extrinsics else NAVIGATION
    information = np.asarray(np.linalg.inv(prior.covariance[:free, :free]))
    world, residuals = np.empty((n, 3)), np.empty(n)
    H, raw, b, stats = np.empty((6, 6)), np.empty((6, 6)), np.empty(6), np.zeros(2)
    begin = x = _packed(prior.state)
    covariance, step = np.empty((free, free)), np.empty(DIM)
    planes: Planes | None = None
    since_search = np.zeros(DIM)
    converged, iteration, sure = False, 0, True

    def accumulate(planes: Planes, posterior: F64 = NO_LIMIT) -> None:
        kernels.normal_equations(
            points, R, p, R_il, p_il, planes.normals, planes.centers, planes.variances,
            planes.deviations, params.gate, posterior, raw, H, b, stats, residuals,
        )  # fmt: skip

    for iteration in range(1, params.max_iterations + 1):
        R, p, R_il, p_il = x[0:9].reshape(3, 3), x[9:12], x[24:33].reshape(3, 3), x[33:36]
        if planes is None or _over(since_search, RESEARCH_ROTATION, RESEARCH_TRANSLATION):
            kernels.to_world(points, R, p, R_il, p_il, world)
            good, poor = local_map.planes(world, R @ p_il + p, params)
            planes = good if sure else poor
            accumulate(planes)
            if sure and (stats[0] < MIN_INLIERS or is_open(points, H)):
                sure, planes = False, poor
                accumulate(planes)
            since_search[:] = 0.0
        else:
            accumulate(planes)
        if not sure:
            accumulate(planes, _pose_covariance(prior, raw))
        if stats[0] < MIN_INLIERS:
            return prior, too_few(iteration, n, int(stats[0]), matches(points, residuals, planes))
        H, b = _nonnegative(H, b)
        here, x = x, np.empty(manifold.SIZE)
        manifold.gauss_newton(here, begin, information, H, b, covariance, step, x)
        since_search += step
        if not _over(step, CONVERGED_ROTATION, CONVERGED_TRANSLATION):
            converged = True
            break

    assert planes is not None
    correction = np.empty(DIM)
    manifold.boxminus(x, begin, correction)
    correction = correction[:free]
    surprise = correction @ information @ correction / (free - np.trace(information @ covariance))
    found = outcome(points, H, converged, iteration, stats, matches(points, residuals, planes))
    posterior = schmidt(prior.covariance, information, covariance)
    return Belief(_unpacked(x, prior.state.stamp_ns), posterior), replace(found, surprise=float(surprise))


def schmidt(prior: F64, information: F64, covariance: F64) -> F64:
    """The covariance (23, 23) after an update of the first states only; the others keep their variance, and their
    correlations shrink (Schmidt 1966).

    Args:
        information, covariance: (k, k) of these states, before and after the update.
    """
    free, posterior = len(covariance), prior.copy()
    posterior[:free, :free] = covariance
    posterior[:free, free:] = covariance @ information @ prior[:free, free:]
    posterior[free:, :free] = posterior[:free, free:].T
    return posterior


def is_open(points: F32, H: F64) -> bool:
    """Whether a direction is less certain than OPEN_SIGMA, by the information H (6, 6) that (n, 3) points give."""
    return bool(_eigenvalues(points, H)[0] < 1.0 / OPEN_SIGMA**2)


def is_imu_to_blame(registration: Registration) -> bool:
    """Whether a scan contradicts the IMU and shows so many planes that the IMU is the likelier culprit."""
    enough = registration.inliers >= MANY_PLANES * registration.used
    return registration.surprise > SURPRISING and enough


def _nonnegative(H: F64, b: F64) -> tuple[F64, F64]:
    """The normal equations without directions in which the normals' errors outweigh the information of the points."""
    with contextlib.suppress(np.linalg.LinAlgError):
        np.linalg.cholesky(H)  # raises if there is one; faster than the eigenvalues
        return H, b
    eigenvalues, axes = np.linalg.eigh(H)
    told = axes[:, eigenvalues > 0.0]
    kept = told @ told.T
    return kept @ H @ kept, kept @ b


def _pose_covariance(prior: Belief, H: F64) -> F64:
    """The covariance (6, 6) of the prior's pose once the positive semidefinite information H (6, 6) is added."""
    before = prior.covariance[POSE, POSE]
    return np.asarray(np.linalg.solve(np.eye(6) + before @ H, before))


def too_few(iterations: int, used: int, inliers: int, matches: Matches) -> Registration:
    """The result of an update that found too few planes to change the state.

    Args:
        iterations: begun so far. used: points compared with the map. inliers: those that found a plane.
    """
    reason = f"only {inliers} of {used} points found a plane in the map; an update needs {MIN_INLIERS}"
    return Registration(False, iterations, used, inliers, float("nan"), np.zeros(6), True, reason, matches)


def outcome(points: F32, H: F64, converged: bool, iterations: int, stats: F64, matches: Matches) -> Registration:
    """The result of an update.

    Args:
        points: (n, 3) m, LiDAR frame. H: (6, 6) information of the scan alone on rotation (rad) and position (m).
        stats: (2,) number of inliers, and the sum of their squared residuals in m².
    """
    eigenvalues = _eigenvalues(points, H)
    degenerate = bool(eigenvalues[0] < 1.0 / DEGENERATE_SIGMA**2)
    reason = "this scan leaves one direction unobserved" if degenerate else ""
    rms = float(np.sqrt(stats[1] / stats[0]))
    return Registration(
        converged, iterations, len(points), int(stats[0]), rms, eigenvalues, degenerate, reason, matches
    )


def _eigenvalues(points: F32, H: F64) -> F64:
    """(6,) ascending, 1/m²: of H, as in `outcome`, with rotation scaled to metres by the RMS range of the points."""
    reach = float(np.sqrt(np.square(points, dtype=np.float64).sum() / len(points)))
    scale = np.r_[np.full(3, 1.0 / reach), np.ones(3)]
    return np.linalg.eigvalsh(H * np.outer(scale, scale))


def matches(points: F32, residuals: F64, planes: Planes) -> Matches:
    """The points that were looked up, with the residual and plane of each."""
    found_at = Matches(points.copy(), *(a.astype(np.float32) for a in (residuals, planes.normals, planes.centers)))
    for array in (found_at.points, found_at.residuals, found_at.normals, found_at.centers):
        array.setflags(write=False)
    return found_at


def _over(step: F64, rotation: float, translation: float) -> bool:
    """Whether the pose part of an error exceeds either bound (rad, m)."""
    return bool(step[ROT] @ step[ROT] > rotation**2 or step[POS] @ step[POS] > translation**2)
