"""Points in a cone. Points sorted by cubes: how many are around a point, and how far two clouds are apart there."""

import math

import numpy as np
from numba import njit

from app.slam.kernels.small import plane_of

HALF = 1 << 20
"""Cubes are counted from -HALF to HALF along each axis, so that three numbers fit into one key."""
MOST = 4096
"""Most points of a cloud that a mean is computed from."""


@njit(cache=True, nogil=True)
def in_cone(points, origin, direction, width, hits, along, off):
    """The points (n, 3) f32 in a cone around a ray from origin (3,) f64, m, along the unit direction (3,) f64.

    width: tangent of its half angle. Out, (n,) each: hits i32, indices of the points; along f32, m along the ray;
    off f32, tangent of the angle to it. Returns how many.
    """
    count = 0
    for j in range(len(points)):
        x, y, z = points[j, 0] - origin[0], points[j, 1] - origin[1], points[j, 2] - origin[2]
        d = x * direction[0] + y * direction[1] + z * direction[2]
        aside = x * x + y * y + z * z - d * d
        if d > 0 and aside < (width * d) ** 2:
            hits[count], along[count], off[count] = j, d, math.sqrt(max(aside, 0.0)) / d
            count += 1
    return count


@njit(cache=True)
def key_of(a, b, c):
    """The key of a cube, from its three numbers."""
    return ((a + HALF) << 42) | ((b + HALF) << 21) | (c + HALF)


@njit(cache=True, nogil=True)
def keys_of(points, edge, out):
    """out (n,) i64: the keys of the cubes of this edge (m) that points (n, 3) f32 lie in."""
    for j in range(len(points)):
        a, b, c = math.floor(points[j, 0] / edge), math.floor(points[j, 1] / edge), math.floor(points[j, 2] / edge)
        out[j] = key_of(a, b, c)


@njit(cache=True)
def _find(keys, key):
    """The place of a key in ascending keys (m,) i64; -1 if it is not there."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) >> 1
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low if low < len(keys) and keys[low] == key else -1


@njit(cache=True, nogil=True)
def count_around(points, keys, starts, edge, out):
    """out (n,) i32: how many points are in the 2 x 2 x 2 cubes nearest to each of points (n, 3) f32.

    keys (m,) i64 ascending; starts (m + 1,) i64: where each cube's points begin; edge: of the cubes, m.
    """
    for j in range(len(points)):
        a = math.floor(points[j, 0] / edge - 0.5)
        b = math.floor(points[j, 1] / edge - 0.5)
        c = math.floor(points[j, 2] / edge - 0.5)
        count = 0
        for i in range(8):
            k = _find(keys, key_of(a + (i & 1), b + ((i >> 1) & 1), c + (i >> 2)))
            if k >= 0:
                count += starts[k + 1] - starts[k]
        out[j] = count


@njit(cache=True)
def _plane(points, keys, starts, edge, x, y, z, radius, normal):
    """The plane through the points within radius of (x, y, z): their number, and the eigenvalues l2 >= l3 (m^2)."""
    n, sx, sy, sz = 0, 0.0, 0.0, 0.0
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(math.floor((x - radius) / edge), math.floor((x + radius) / edge) + 1):
        for b in range(math.floor((y - radius) / edge), math.floor((y + radius) / edge) + 1):
            for c in range(math.floor((z - radius) / edge), math.floor((z + radius) / edge) + 1):
                k = _find(keys, key_of(a, b, c))
                if k < 0:
                    continue
                for j in range(starts[k], starts[k + 1]):
                    u, v, w = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                    if u * u + v * v + w * w <= radius * radius:
                        n += 1
                        sx += u
                        sy += v
                        sz += w
                        xx += u * u
                        xy += u * v
                        xz += u * w
                        yy += v * v
                        yz += v * w
                        zz += w * w
    if n < 3:
        return n, 0.0, 0.0
    s = 1.0 / n
    sx, sy, sz = sx * s, sy * s, sz * s
    _, l2, l3 = plane_of(
        xx * s - sx * sx,
        xy * s - sx * sy,
        xz * s - sx * sz,
        yy * s - sy * sy,
        yz * s - sy * sz,
        zz * s - sz * sz,
        normal,
    )
    return n, l2, l3


@njit(cache=True)
def _heights(points, keys, starts, edge, x, y, z, normal, radius, reach, out):
    """Heights over (x, y, z), along the unit normal, of the points in a cylinder around it. Returns how many.

    out (k,) f32: further ones are left out.
    """
    n = 0
    u, v, w = normal[0], normal[1], normal[2]
    du = reach * abs(u) + radius * math.sqrt(max(1.0 - u * u, 0.0))
    dv = reach * abs(v) + radius * math.sqrt(max(1.0 - v * v, 0.0))
    dw = reach * abs(w) + radius * math.sqrt(max(1.0 - w * w, 0.0))
    far = (radius + 0.8661 * edge) ** 2
    for a in range(math.floor((x - du) / edge), math.floor((x + du) / edge) + 1):
        for b in range(math.floor((y - dv) / edge), math.floor((y + dv) / edge) + 1):
            for c in range(math.floor((z - dw) / edge), math.floor((z + dw) / edge) + 1):
                p, q, r = (a + 0.5) * edge - x, (b + 0.5) * edge - y, (c + 0.5) * edge - z
                h = p * u + q * v + r * w
                if p * p + q * q + r * r - h * h > far:
                    continue
                k = _find(keys, key_of(a, b, c))
                if k < 0:
                    continue
                for j in range(starts[k], starts[k + 1]):
                    p, q, r = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                    h = p * u + q * v + r * w
                    if abs(h) <= reach and p * p + q * q + r * r - h * h <= radius * radius and n < len(out):
                        out[n] = h
                        n += 1
    return n


@njit(cache=True)
def _layer(heights, n, at, window):
    """Number, mean and variance of the heights around `at`; a few steps move `at` to the middle of its layer."""
    count, mean, var = 0, at, 0.0
    for _ in range(4):
        count, s, ss = 0, 0.0, 0.0
        for j in range(n):
            d = heights[j] - at
            if abs(d) <= window:
                count += 1
                s += d
                ss += d * d
        if count == 0:
            return 0, at, 0.0
        mean = at + s / count
        var = max(ss / count - (s / count) ** 2, 0.0) * count / max(count - 1, 1)
        at = mean
    return count, mean, var


@njit(cache=True, nogil=True)
def distances(
    cores, sensors, own, own_keys, own_starts, other, other_keys, other_starts, edge, radii, reach, least, out
):
    """How far our own cloud lies in front of the other one at the cores (n, 3) f32, m.

    sensors (n, 3) f32: the sides from which the surface is seen. own, other (k, 3) f32, sorted into cubes as in
    `count_around`. radii (r,): scales, ascending; the first at which the own cloud is a plane is taken, else the last.
    reach: of the search, m. least: points that a mean needs. Out: out (n, 2) f32, the distance and the
    level of detection at 95 %; nan where a cloud has too few points.
    """
    normal = np.zeros(3)
    own_heights, other_heights = np.empty(MOST, np.float32), np.empty(MOST, np.float32)
    for i in range(len(cores)):
        out[i, 0], out[i, 1] = math.nan, math.nan
        x, y, z = float(cores[i, 0]), float(cores[i, 1]), float(cores[i, 2])
        radius = 0.0
        for radius in radii:
            n, l2, l3 = _plane(own, own_keys, own_starts, edge, x, y, z, radius, normal)
            if n >= 2 * least and l3 < 0.1 * l2:
                break
        u, v, w = sensors[i, 0] - x, sensors[i, 1] - y, sensors[i, 2] - z
        if u * normal[0] + v * normal[1] + w * normal[2] < 0:
            for k in range(3):
                normal[k] = -normal[k]
        n = _heights(own, own_keys, own_starts, edge, x, y, z, normal, radius, radius, own_heights)
        na, a, var_a = _layer(own_heights, n, 0.0, 0.5 * radius)
        n = _heights(other, other_keys, other_starts, edge, x, y, z, normal, radius, reach, other_heights)
        if na < least or n < least:
            continue
        nearest = other_heights[0]
        for j in range(n):
            if abs(other_heights[j] - a) < abs(nearest - a):
                nearest = other_heights[j]
        nb, b, var_b = _layer(other_heights, n, nearest, 0.5 * radius)
        if nb >= least:
            out[i, 0] = a - b
            out[i, 1] = 1.96 * math.sqrt(var_a / na + var_b / nb)
