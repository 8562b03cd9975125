"""Compare submaps: their plans, and the point-to-plane normal equations of registering one to the other."""

import math

import numpy as np
from numba import njit

LAYERS = 64
"""Number of layers of a column; higher layers wrap around to the lowest."""


@njit(cache=True)
def columns(points, level, upright, yaw, position, cell, bare, tallest, plan):
    """Raster of upright structure, of points turned by yaw (rad) about the vertical and then moved.

    points (n, 3) f64 m; level, upright (n,) bool: ground, and neither ground nor ceiling; position (3,) m; cell: edge
    of cells and layers, m. Out: plan (k, k) f32, which wraps around; the origin is in the first cell. Where something
    stands sqrt(layers / 2), counting at most `tallest` occupied layers; `bare` where there is only ground; else 0.
    """
    size = len(plan)
    c, s = math.cos(yaw), math.sin(yaw)
    layers = np.zeros((size, size), np.uint64)
    plan[:] = 0.0
    for k in range(len(points)):
        if not (level[k] or upright[k]):
            continue
        i = math.floor((c * points[k, 0] - s * points[k, 1] + position[0]) / cell) % size
        j = math.floor((s * points[k, 0] + c * points[k, 1] + position[1]) / cell) % size
        if upright[k]:
            layer = math.floor((points[k, 2] + position[2]) / cell) % LAYERS
            layers[i, j] |= np.uint64(1) << np.uint64(layer)
        else:
            plan[i, j] = bare
    for i in range(size):
        for j in range(size):
            left, count = layers[i, j], 0
            while left != np.uint64(0) and count < tallest:
                left &= left - np.uint64(1)
                count += 1
            if count:
                plan[i, j] = math.sqrt(count / 2)


@njit(cache=True)
def highest(values, places, reach):
    """(n,) bool: whether no value up to `reach` steps along each axis from a place is higher than the one there.

    values (a, b, c) f32; places (n, 3) i64: indices into them.
    """
    out = np.ones(len(places), np.bool_)
    for index in range(len(places)):
        i, j, k = places[index, 0], places[index, 1], places[index, 2]
        around = values[max(i - reach, 0) : i + reach + 1, max(j - reach, 0) : j + reach + 1]
        for value in around[:, :, max(k - reach, 0) : k + reach + 1].flat:
            if value > values[i, j, k]:
                out[index] = False
                break
    return out


@njit(cache=True)
def normal_equations(
    moved, normals, R, origin, partner, squared, there, their_normals, flat, reach, facing, scale, H, b, residuals
):
    """Accumulate J^T W J and J^T W r of distances to the planes of partners, with Cauchy weights.

    Columns of J: a rotation about `origin` (3,) and a translation, in the target's axes. moved (n, 3) f64 m: source
    points, placed on the target; normals (n, 3): theirs in their own axes, R (3, 3) turns them to the target's; partner
    (n,) i64, squared (n,) f64 m²: nearest target point, and how far; there, their_normals (m, 3), flat (m,): of the
    target; reach m, facing (cosine): what a partner must meet; scale m: distance that halves the weight.
    Out: H (6, 6), b (6,), residuals (n,) m, nan without a partner. Returns the number with one.
    """
    H[:] = 0.0
    b[:] = 0.0
    row = np.empty(6)
    count = 0
    for k in range(len(moved)):
        residuals[k] = np.nan
        p = partner[k]
        if squared[k] >= reach * reach or not flat[p]:
            continue
        n0, n1, n2 = their_normals[p, 0], their_normals[p, 1], their_normals[p, 2]
        m0, m1, m2 = normals[k, 0], normals[k, 1], normals[k, 2]
        cosine = (
            n0 * (R[0, 0] * m0 + R[0, 1] * m1 + R[0, 2] * m2)
            + n1 * (R[1, 0] * m0 + R[1, 1] * m1 + R[1, 2] * m2)
            + n2 * (R[2, 0] * m0 + R[2, 1] * m1 + R[2, 2] * m2)
        )
        if cosine <= facing:
            continue
        r = n0 * (moved[k, 0] - there[p, 0]) + n1 * (moved[k, 1] - there[p, 1]) + n2 * (moved[k, 2] - there[p, 2])
        x, y, z = moved[k, 0] - origin[0], moved[k, 1] - origin[1], moved[k, 2] - origin[2]
        row[0], row[1], row[2] = y * n2 - z * n1, z * n0 - x * n2, x * n1 - y * n0
        row[3], row[4], row[5] = n0, n1, n2
        weight = 1.0 / (1.0 + (r / scale) ** 2)
        for i in range(6):
            b[i] += weight * row[i] * r
            for j in range(i + 1):
                H[i, j] += weight * row[i] * row[j]
        residuals[k] = r
        count += 1
    for i in range(6):
        for j in range(i):
            H[j, i] = H[i, j]
    return count
