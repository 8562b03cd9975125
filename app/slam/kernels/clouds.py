"""Passes over whole clouds: the range of points, and voxel-grid downsampling over a reusable hash table."""

import math

import numpy as np
from numba import njit

PRIME_X, PRIME_Y, PRIME_Z = 73856093, 19349669, 83492791
"""Teschner et al. 2003, "Optimized spatial hashing"."""


@njit(cache=True, nogil=True)
def in_range(points, nearest, farthest, keep):
    """keep (n,) bool, out: nearest <= |p| <= farthest, for points (n, 3) f32 in m. Returns the number kept."""
    low, high = nearest * nearest, farthest * farthest
    count = 0
    for j in range(len(points)):
        x, y, z = points[j, 0], points[j, 1], points[j, 2]
        r2 = x * x + y * y + z * z
        keep[j] = low <= r2 <= high
        count += keep[j]
    return count


@njit(cache=True, nogil=True)
def transform(points, T, out):
    """Points (n, 3) f32 m of one frame in another, by T (4, 4) f64 between them. Out: out (n, 3) f64 m."""
    for j in range(len(points)):
        x, y, z = float(points[j, 0]), float(points[j, 1]), float(points[j, 2])
        for i in range(3):
            out[j, i] = T[i, 0] * x + T[i, 1] * y + T[i, 2] * z + T[i, 3]


@njit(cache=True, nogil=True)
def correct(points, ring, elevations, ranges, out):
    """Raise and lengthen each beam as its scan line asks for; lines beyond the tables stay as they are.

    points (n, 3) f32 m, LiDAR frame; ring (n,) u16; elevations (k,) f64 rad and ranges (k,) f64 m, both added. Out: out
    (n, 3) f32 m.
    """
    cosines, sines = np.cos(elevations), np.sin(elevations)
    for j in range(len(points)):
        x, y, z = float(points[j, 0]), float(points[j, 1]), float(points[j, 2])
        line = ring[j]
        flat = math.sqrt(x * x + y * y)
        reach = math.sqrt(flat * flat + z * z)
        if line < len(elevations) and flat > 0.0:
            c, s = cosines[line], sines[line]
            bent = c - s * z / flat
            x, y, z = x * bent, y * bent, c * z + s * flat
        longer = (reach + ranges[line]) / reach if line < len(ranges) and reach > 0.0 else 1.0
        out[j, 0], out[j, 1], out[j, 2] = x * longer, y * longer, z * longer


@njit(cache=True, nogil=True)
def centroids(points, chosen, voxel, table, stamp, generation, cells, sums, order, out):
    """Replace the chosen points of each voxel by their centroid; copy the others unchanged.

    points (n, 3) f32 and voxel in the same unit; chosen (n,) u8, non-zero where a point takes part. Scratch: table
    (2^k,) i32 and stamp (2^k,) i32, where `generation` marks live slots, so that nothing has to be cleared; cells
    (n, 3) i32; sums (n, 4) f64: x y z count. Out, in order of first appearance: out (n, 3) f32; order (n,) i32, the
    first point of each. Returns the number of outputs.
    """
    mask = len(table) - 1
    inverse = 1.0 / voxel
    m = 0
    for j in range(len(points)):
        x, y, z = float(points[j, 0]), float(points[j, 1]), float(points[j, 2])
        if chosen[j] == 0:
            sums[m, 0], sums[m, 1], sums[m, 2], sums[m, 3] = x, y, z, 1.0
            order[m] = j
            m += 1
            continue
        a, b, c = math.floor(x * inverse), math.floor(y * inverse), math.floor(z * inverse)
        h = ((a * PRIME_X) ^ (b * PRIME_Y) ^ (c * PRIME_Z)) & mask
        while True:
            if stamp[h] != generation:
                stamp[h] = generation
                table[h] = m
                cells[m, 0], cells[m, 1], cells[m, 2] = a, b, c
                sums[m, 0], sums[m, 1], sums[m, 2], sums[m, 3] = x, y, z, 1.0
                order[m] = j
                m += 1
                break
            k = table[h]
            if cells[k, 0] == a and cells[k, 1] == b and cells[k, 2] == c:
                sums[k, 0] += x
                sums[k, 1] += y
                sums[k, 2] += z
                sums[k, 3] += 1.0
                break
            h = (h + 1) & mask
    for k in range(m):
        s = 1.0 / sums[k, 3]
        for i in range(3):
            out[k, i] = sums[k, i] * s
    return m


@njit(cache=True)
def first_in_voxels(keys, table, first):
    """Put keys (n,) i64 >= 0 into the hash table (2^k,) i64, where -1 is free; it must have room.

    Out: first (n,) bool, whether the key was not there yet. Returns how many were not.
    """
    mask, count = len(table) - 1, 0
    for j in range(len(keys)):
        key = keys[j]
        slot = ((key * PRIME_X) ^ (key >> 20)) & mask
        while table[slot] >= 0 and table[slot] != key:
            slot = (slot + 1) & mask
        first[j] = table[slot] < 0
        table[slot] = key
        count += first[j]
    return count


@njit(cache=True)
def passages(points, path, half, indices, along, aside):
    """Project points onto a path: once for each passage of the path within `half`, m.

    points (n, 2), path (m >= 2, 2) f64, m, no two of it the same in a row. Out, as far as they reach: indices (k,) i64
    of the points; along (k,) f64, m from the path's begin; aside (k,) f64, m to its left. Points before its begin and
    after its end are left out. Returns how many there are, which may be more than k.
    """
    steps = len(path) - 1
    segments = np.empty((steps, 4))  # direction, length, and how long the path is before it
    total = 0.0
    for i in range(steps):
        u, v = path[i + 1, 0] - path[i, 0], path[i + 1, 1] - path[i, 1]
        length = math.sqrt(u * u + v * v)
        segments[i, 0], segments[i, 1], segments[i, 2], segments[i, 3] = u / length, v / length, length, total
        total += length
    count = 0
    for j in range(len(points)):
        before, nearing, s, left = math.inf, False, 0.0, 1.0
        for i in range(steps + 1):
            d = math.inf  # squared distance; behind the last segment the path is nowhere
            if i < steps:
                x, y = points[j, 0] - path[i, 0], points[j, 1] - path[i, 1]
                u, v = segments[i, 0], segments[i, 1]
                t = min(max(x * u + y * v, 0.0), segments[i, 2])
                d = (x - t * u) ** 2 + (y - t * v) ** 2
            if d > before * (1 + 1e-12):
                if nearing and before <= half * half and 0.0 < s < total:
                    if count < len(indices):
                        indices[count], along[count], aside[count] = j, s, left * math.sqrt(before)
                    count += 1
                nearing = False
            elif d < before * (1 - 1e-12):
                nearing, s = True, segments[i, 3] + t
                left = 1.0 if u * y >= v * x else -1.0
            before = d
    return count
