"""Normal equations of the errors of scan lines, from the distances of their points to planes."""

import math

from numba import njit

from app.slam.kernels.registration import EDGE_ON, RESIDUAL_HUBER


@njit(cache=True, nogil=True, error_model="numpy")
def observe(points, rings, world, R, normals, centers, variances, gate, errors, information, moment):
    """Add the distances of points to planes to the normal equations of their lines' errors.

    points (n, 3) f32 m, LiDAR frame, already corrected by `errors` (lines, 2); rings (n,) u16; world (n, 3) m, odom;
    R (3, 3): R_odom_lidar; planes as from `kernels.map.planes`; gate m/√m. In and out: information (lines, 2, 2) and
    moment (lines, 2), weighted sums; the range in m comes before the elevation in rad.
    """
    for j in range(len(points)):
        line = rings[j]
        if variances[j] < 0.0 or line >= len(errors):
            continue
        x, y, z = float(points[j, 0]), float(points[j, 1]), float(points[j, 2])
        nx, ny, nz = normals[j, 0], normals[j, 1], normals[j, 2]
        d = nx * (world[j, 0] - centers[j, 0]) + ny * (world[j, 1] - centers[j, 1]) + nz * (world[j, 2] - centers[j, 2])
        flat = math.sqrt(x * x + y * y)
        reach = math.sqrt(flat * flat + z * z)
        lx = R[0, 0] * nx + R[1, 0] * ny + R[2, 0] * nz
        ly = R[0, 1] * nx + R[1, 1] * ny + R[2, 1] * nz
        lz = R[0, 2] * nx + R[1, 2] * ny + R[2, 2] * nz
        level = lx * x + ly * y
        longer = (level + lz * z) / reach
        if abs(d) > gate * math.sqrt(reach) or abs(longer) < EDGE_ON or flat == 0.0:
            continue
        higher = lz * flat - level * z / flat
        w = 1.0 / max(variances[j], abs(d) * math.sqrt(variances[j]) / RESIDUAL_HUBER)
        d += longer * errors[line, 0] + higher * errors[line, 1]
        information[line, 0, 0] += w * longer * longer
        information[line, 0, 1] += w * longer * higher
        information[line, 1, 0] += w * longer * higher
        information[line, 1, 1] += w * higher * higher
        moment[line, 0] += w * longer * d
        moment[line, 1] += w * higher * d
