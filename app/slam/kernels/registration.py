"""Point-to-plane residuals and their normal equations."""

import math

import numpy as np
from numba import njit

REPEATED = 2.0
"""Factor on the variance of a distance: errors of the calibration and of a map patch repeat from frame to frame, so
they do not average out over time."""
EDGE_ON = 0.15
"""Least cosine between a beam and the normal of its plane. Points of one scan line at different depths lie on the cone
that the line sweeps. That looks like a surface seen edge-on, and it turns with the scanner."""
RESIDUAL_HUBER = 2.0
"""Standard deviations beyond which a residual has constant influence (Huber 1964). Otherwise, one of 400 points on a
wrong plane could move the pose by millimetres."""
LARGEST_SHARE = 0.1
"""About the largest share of the information on a direction, the prior's included, that one point may give: one wrong
plane must not decide about a direction that nothing else constrains (bounded influence, Krasker & Welsch 1982)."""


@njit(cache=True)
def to_world(points, R, p, R_il, p_il, out):
    """out (n, 3) f64 m, odom = R (R_il points + p_il) + p, for points (n, 3) f32 m, LiDAR frame."""
    A = R @ R_il
    t = R @ p_il + p
    for j in range(len(points)):
        x, y, z = points[j, 0], points[j, 1], points[j, 2]
        for i in range(3):
            out[j, i] = A[i, 0] * x + A[i, 1] * y + A[i, 2] * z + t[i]


@njit(cache=True, inline="always")
def _differentiate(nx, ny, nz, R, ix, iy, iz, row):
    """Fill row (6,) with the derivatives of a point's distance along n (odom); returns n in the IMU frame."""
    ax = R[0, 0] * nx + R[1, 0] * ny + R[2, 0] * nz
    ay = R[0, 1] * nx + R[1, 1] * ny + R[2, 1] * nz
    az = R[0, 2] * nx + R[1, 2] * ny + R[2, 2] * nz
    row[0], row[1], row[2] = iy * az - iz * ay, iz * ax - ix * az, ix * ay - iy * ax
    row[3], row[4], row[5] = nx, ny, nz
    return ax, ay, az


@njit(cache=True, inline="always")
def _add(w, d, row, H, b):
    """Add a distance d of weight w to the upper half of H and to b."""
    for i in range(6):
        wi = w * row[i]
        b[i] += wi * d
        for k in range(i, 6):
            H[i, k] += wi * row[k]


@njit(cache=True, inline="always")
def _quadratic(A, row):
    """row^T A row, for A (6, 6) and row (6,)."""
    total = 0.0
    for i in range(6):
        for k in range(6):
            total += row[i] * A[i, k] * row[k]
    return total


@njit(cache=True)
def normal_equations(
    points, R, p, R_il, p_il, normals, centers, variances, deviations, gate, posterior, raw, H, b, stats, residuals
):  # fmt: skip
    """Accumulate H^T W H and H^T W z of eq. 5-6 over all points with a plane.

    A normal has errors of its own. Their squares would count as information, mostly along a corridor, where there is
    little real information, and would pull each point towards the middle of its patch. Their average contribution is
    subtracted (Fuller 1987, "Measurement Error Models"), so H may have negative eigenvalues.

    Columns: rotation (right perturbation) and position. points (n, 3) f32 m, LiDAR frame; R, p: pose of the IMU in
    odom; R_il, p_il: pose of the LiDAR in the IMU frame; normals, centers (n, 3), variances (n,) m², deviations
    (n, 2, 3) rad: planes as from `kernels.map.planes`; gate m/√m; posterior (6, 6): covariance of the pose once all
    points have full weight, by which LARGEST_SHARE limits the weight of each, or zeros for no limit. Out: raw (6, 6):
    H before the subtraction; H (6, 6), b (6,), stats (2,): inliers and their sum of squared distances in m²;
    residuals (n,) m, signed, nan if not used.
    """
    raw[:], H[:], b[:], stats[:] = 0.0, 0.0, 0.0, 0.0
    row = np.empty(6)
    for j in range(len(points)):
        residuals[j] = np.nan
        if variances[j] < 0.0:
            continue
        x, y, z = float(points[j, 0]), float(points[j, 1]), float(points[j, 2])
        ix = R_il[0, 0] * x + R_il[0, 1] * y + R_il[0, 2] * z + p_il[0]
        iy = R_il[1, 0] * x + R_il[1, 1] * y + R_il[1, 2] * z + p_il[1]
        iz = R_il[2, 0] * x + R_il[2, 1] * y + R_il[2, 2] * z + p_il[2]
        ox = R[0, 0] * ix + R[0, 1] * iy + R[0, 2] * iz + p[0] - centers[j, 0]
        oy = R[1, 0] * ix + R[1, 1] * iy + R[1, 2] * iz + p[1] - centers[j, 1]
        oz = R[2, 0] * ix + R[2, 1] * iy + R[2, 2] * iz + p[2] - centers[j, 2]
        nx, ny, nz = normals[j, 0], normals[j, 1], normals[j, 2]
        d = nx * ox + ny * oy + nz * oz
        # FAST-LIO2's gate: near points must fit better than far ones
        reach = math.sqrt(x * x + y * y + z * z)
        if abs(d) > gate * math.sqrt(reach):
            continue
        ax, ay, az = _differentiate(nx, ny, nz, R, ix, iy, iz, row)
        if abs(ax * (ix - p_il[0]) + ay * (iy - p_il[1]) + az * (iz - p_il[2])) < EDGE_ON * reach:
            continue
        w = 1.0 / (REPEATED * variances[j])
        if d * d > RESIDUAL_HUBER * RESIDUAL_HUBER * variances[j]:
            w *= RESIDUAL_HUBER * math.sqrt(variances[j]) / abs(d)
        uncertainty = _quadratic(posterior, row)
        if w * uncertainty > LARGEST_SHARE:
            w = LARGEST_SHARE / uncertainty
        residuals[j] = d
        stats[0] += 1.0
        stats[1] += d * d
        _add(w, d, row, raw, b)
        for m in range(2):
            nx, ny, nz = deviations[j, m, 0], deviations[j, m, 1], deviations[j, m, 2]
            _differentiate(nx, ny, nz, R, ix, iy, iz, row)
            _add(-w, nx * ox + ny * oy + nz * oz, row, H, b)
    for i in range(6):
        for k in range(i, 6):
            raw[k, i] = raw[i, k]
            H[i, k] += raw[i, k]
            H[k, i] = H[i, k]
