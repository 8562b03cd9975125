"""Iterated error-state Kalman filter on manifolds: the update (paper 2.3, eq. 5-7).

State on SO(3) x R3 x R3 x R3 x R3 x S² x SO(3) x R3, 23 error dimensions in the order of
`app.slam.imu`. The gain is in the information form (Xu & Zhang 2021), so its cost is set by the
state's size and not by the number of points; each iteration is one Gauss-Newton step of eq. 7.
"""

import numpy as np

from app.slam.imu import BA, BG, DIM, EXT_POS, EXT_ROT, GRAV, POS, ROT, VEL, Belief
from app.slam.kernels import manifold
from app.slam.kernels import registration as kernels
from app.slam.local_map import LocalMap, Planes
from app.slam.params import Filter
from app.slam.types import F32, F64, NavState, Registration

RESEARCH_ROTATION = 1e-3
RESEARCH_TRANSLATION = 1e-2
"""rad, m: planes are searched again only where the state moved by more than this since."""
CONVERGED_ROTATION = 1e-5
CONVERGED_TRANSLATION = 1e-4
"""rad, m: an increment below these ends the iteration."""
MIN_INLIERS = 30
"""Fewer planes than this do not make an update; the prediction stands."""
DEGENERATE_SIGMA = 0.05
"""m (rotation: rad times the points' typical range): a direction that one scan alone leaves
more uncertain than this is called degenerate."""

_MEASURED = np.r_[0:6, 17:23]
"""Error dimensions that a point-to-plane distance depends on."""


def boxplus(x: NavState, d: F64) -> NavState:
    """x [+] d for an error d (23,)."""
    B = manifold.tangent_basis(x.g_odom)
    return NavState(
        stamp_ns=x.stamp_ns,
        R_odom_imu=x.R_odom_imu @ manifold.exp(d[ROT]),
        p_odom_imu=x.p_odom_imu + d[POS],
        v_odom_imu=x.v_odom_imu + d[VEL],
        b_gyro=x.b_gyro + d[BG],
        b_accel=x.b_accel + d[BA],
        g_odom=manifold.exp(B @ d[GRAV]) @ x.g_odom,
        R_imu_lidar=x.R_imu_lidar @ manifold.exp(d[EXT_ROT]),
        p_imu_lidar=x.p_imu_lidar + d[EXT_POS],
    )


def boxminus(a: NavState, b: NavState) -> F64:
    """a [-] b: the error d (23,) with b [+] d = a."""
    d = np.empty(DIM)
    d[ROT] = manifold.log(b.R_odom_imu.T @ a.R_odom_imu)
    d[POS] = a.p_odom_imu - b.p_odom_imu
    d[VEL] = a.v_odom_imu - b.v_odom_imu
    d[BG] = a.b_gyro - b.b_gyro
    d[BA] = a.b_accel - b.b_accel
    d[GRAV] = manifold.tangent_basis(b.g_odom).T @ manifold.turn(b.g_odom, a.g_odom)
    d[EXT_ROT] = manifold.log(b.R_imu_lidar.T @ a.R_imu_lidar)
    d[EXT_POS] = a.p_imu_lidar - b.p_imu_lidar
    return d


def _boxminus_jacobian(d: F64, x: NavState, prior: NavState) -> F64:
    """d(x [+] e [-] prior)/de at e = 0, where d = x [-] prior."""
    J = np.eye(DIM)
    J[ROT, ROT] = manifold.right_jacobian_inverse(d[ROT])
    J[EXT_ROT, EXT_ROT] = manifold.right_jacobian_inverse(d[EXT_ROT])
    J[GRAV, GRAV] = manifold.tangent_basis(prior.g_odom).T @ manifold.tangent_basis(x.g_odom)
    return J


def update(prior: Belief, points: F32, local_map: LocalMap, params: Filter) -> tuple[Belief, Registration]:
    """Fuse one scan: minimise eq. 7 from the predicted belief.

    Args:
        prior: belief at the scan's end, from propagation.
        points: (n, 3) float32 m, LiDAR frame, deskewed to the scan's end.

    Returns:
        The posterior belief, or the prior as it was where too few points found a plane; and how
        the update went.
    """
    n = len(points)
    free = np.arange(DIM) if params.estimate_extrinsics else np.arange(17)
    information = np.linalg.inv(prior.covariance[np.ix_(free, free)])
    world, residuals = np.empty((n, 3)), np.full(n, np.nan)
    H, b, stats = np.empty((12, 12)), np.empty(12), np.zeros(2)
    x = prior.state
    planes: Planes | None = None
    searched_R, searched_p = x.R_odom_imu, x.p_odom_imu
    converged, iteration = False, 0
    posterior = prior.covariance

    for iteration in range(1, params.max_iterations + 1):
        if planes is None or _moved(x, searched_R, searched_p):
            kernels.to_world(points, x.R_odom_imu, x.p_odom_imu, x.R_imu_lidar, x.p_imu_lidar, world)
            planes = local_map.planes(
                world,
                params.neighbour_distance,
                params.plane_threshold,
                params.neighbours,
                np.radians(params.plane_tilt),
                params.point_noise,
            )
            searched_R, searched_p = x.R_odom_imu, x.p_odom_imu
        kernels.normal_equations(
            points, x.R_odom_imu, x.p_odom_imu, x.R_imu_lidar, x.p_imu_lidar,
            planes.normals, planes.centers, planes.variances,
            params.point_noise, params.gate, params.estimate_extrinsics, H, b, stats, residuals,
        )  # fmt: skip
        if stats[0] < MIN_INLIERS:
            reason = f"only {int(stats[0])} of {n} points found a plane in the map; an update takes {MIN_INLIERS}"
            nothing = Registration(False, iteration, n, int(stats[0]), float("nan"), np.zeros(6), True, reason)
            return prior, nothing

        # Gauss-Newton on |x [-] prior|²_P + sum |z + H d|²_R
        d = boxminus(x, prior.state)
        J = _boxminus_jacobian(d, x, prior.state)[np.ix_(free, free)]
        A = J.T @ information @ J
        rhs = J.T @ (information @ d[free])
        full_H, full_b = np.zeros((DIM, DIM)), np.zeros(DIM)
        full_H[np.ix_(_MEASURED, _MEASURED)] = H
        full_b[_MEASURED] = b
        A += full_H[np.ix_(free, free)]
        rhs += full_b[free]
        posterior_free = np.linalg.inv(A)
        step = np.zeros(DIM)
        step[free] = -posterior_free @ rhs
        x = boxplus(x, step)
        posterior = prior.covariance.copy()
        posterior[np.ix_(free, free)] = 0.5 * (posterior_free + posterior_free.T)
        if np.linalg.norm(step[ROT]) < CONVERGED_ROTATION and np.linalg.norm(step[POS]) < CONVERGED_TRANSLATION:
            converged = True
            break

    reach = float(np.sqrt(np.mean(np.sum(points.astype(np.float64) ** 2, axis=1))))
    scale = np.r_[np.full(3, 1.0 / reach), np.ones(3)]
    eigenvalues = np.linalg.eigvalsh(H[:6, :6] * np.outer(scale, scale))
    degenerate = bool(eigenvalues[0] < 1.0 / DEGENERATE_SIGMA**2)
    registration = Registration(
        converged=converged,
        iterations=iteration,
        used=n,
        inliers=int(stats[0]),
        residual_rms=float(np.sqrt(stats[1] / stats[0])),
        eigenvalues=eigenvalues,
        degenerate=degenerate,
        reason="one direction is not held by this scan" if degenerate else "",
    )
    return Belief(x, posterior), registration


def _moved(x: NavState, R: F64, p: F64) -> bool:
    angle = np.linalg.norm(manifold.log(R.T @ x.R_odom_imu))
    return bool(angle > RESEARCH_ROTATION or np.linalg.norm(x.p_odom_imu - p) > RESEARCH_TRANSLATION)
