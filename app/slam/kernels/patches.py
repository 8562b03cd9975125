"""Planes through the neighbourhoods of a cloud's points."""

import numpy as np
from numba import njit

from app.slam.kernels.small import plane_of


@njit(cache=True)
def planes(points, neighbours, eyes, thickness, normals, flat):
    """Fit a plane to the neighbours of each point.

    points (n, 3) f64 m; neighbours (n, k) i64, indices into points; eyes (n, 3) f32 m, from where each point was seen;
    thickness m: largest standard deviation of a flat patch along its normal. Out: normals (n, 3) f64, unit, towards the
    eye; flat (n,) bool: whether the patch is thin and not a line.
    """
    k = neighbours.shape[1]
    for i in range(len(points)):
        mx = my = mz = 0.0
        for j in neighbours[i]:
            mx += points[j, 0]
            my += points[j, 1]
            mz += points[j, 2]
        mx, my, mz = mx / k, my / k, mz / k
        xx = xy = xz = yy = yz = zz = 0.0
        for j in neighbours[i]:
            x, y, z = points[j, 0] - mx, points[j, 1] - my, points[j, 2] - mz
            xx += x * x
            xy += x * y
            xz += x * z
            yy += y * y
            yz += y * z
            zz += z * z
        normal = normals[i]
        _, l2, l3 = plane_of(xx / k, xy / k, xz / k, yy / k, yz / k, zz / k, normal)
        flat[i] = l3 < thickness * thickness and l2 > 4.0 * l3
        towards = 0.0
        for c in range(3):
            towards += normal[c] * (eyes[i, c] - points[i, c])
        if towards < 0.0:
            np.negative(normal, normal)
