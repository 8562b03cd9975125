"""Space that a scan saw through: its ranges by direction, and points of other scans looked up in them.

Directions are bins of Lambert's equal-area map around +z, which covers all directions except -z in one square. A bin
near +z is `size` rad wide along both axes.
"""

import math

import numpy as np
from numba import njit

from app.slam.kernels.clouds import PRIME_X, PRIME_Y, PRIME_Z

NEAR, FAR = 0, 1
"""Layers of an image: the least and the greatest range in a bin, m; inf and 0 where nothing returned."""
RING = 2
"""A place is seen through only if nothing is before it in this many bins to each side, as far as lines are apart."""


@njit(cache=True, inline="always")
def _bin(x, y, z, r, size, half):
    """Row and column of a direction; -1, -1 if it is not in the image."""
    c = 1.0 + z / r
    if c < 0.01:
        return -1, -1
    s = math.sqrt(2.0 / c) / (r * size)
    return math.floor(x * s) + half, math.floor(y * s) + half


@njit(cache=True)
def look(points, size, image):
    """Ranges of points (n, 3) f32 m by direction. Out: image (w, w, 2) f32 of NEAR and FAR."""
    half = image.shape[0] // 2
    image[:, :, NEAR] = np.inf
    image[:, :, FAR] = 0.0
    for j in range(len(points)):
        x, y, z = points[j, 0], points[j, 1], points[j, 2]
        r = math.sqrt(x * x + y * y + z * z)
        if r == 0.0:
            continue
        a, b = _bin(x, y, z, r, size, half)
        if 0 <= a < image.shape[0] and 0 <= b < image.shape[1]:
            image[a, b, NEAR] = min(image[a, b, NEAR], r)
            image[a, b, FAR] = max(image[a, b, FAR], r)


@njit(cache=True)
def group(points, labels, edge, reach, table, cells, first, voxel):
    """Put the points that are not ground and lie within `reach` m into voxels.

    points (n, 3) f32 m; labels (n,) u8, not 0 = ground; edge m. Scratch: table (2^k,) i32. Out: cells (n, 3) i32 of
    the m voxels; first (n,) i32, a point of each; voxel (n,) i32 of each point, -1 = none. Returns m.
    """
    mask, inverse, m = len(table) - 1, 1.0 / edge, 0
    table[:] = -1
    for j in range(len(points)):
        x, y, z = points[j, 0], points[j, 1], points[j, 2]
        if labels[j] != 0 or x * x + y * y + z * z > reach * reach:
            voxel[j] = -1
            continue
        a, b, c = math.floor(x * inverse), math.floor(y * inverse), math.floor(z * inverse)
        h = ((a * PRIME_X) ^ (b * PRIME_Y) ^ (c * PRIME_Z)) & mask
        while table[h] >= 0:
            k = table[h]
            if cells[k, 0] == a and cells[k, 1] == b and cells[k, 2] == c:
                break
            h = (h + 1) & mask
        if table[h] < 0:
            table[h] = m
            cells[m, 0], cells[m, 1], cells[m, 2] = a, b, c
            first[m] = j
            m += 1
        voxel[j] = table[h]
    return m


@njit(cache=True, error_model="numpy")
def vote(points, first, T, size, image, margin, slack, most_hits, through, hits):
    """Look places up in an image of another scan: whether it saw through each, or hit something there.

    points (n, 3) f32 m with first (m,) i32 of them; T (3, 4) f64, from their frame to that of the image; size rad;
    image as of `look`. A return within margin m + slack of the range counts as at the place. Places with more than
    `most_hits` hits are settled. In and out: through and hits (m,) i32, counts of images.
    """
    wide = image.shape[0]
    half = wide // 2
    for k in range(len(first)):
        if hits[k] > most_hits:
            continue
        px, py, pz = points[first[k], 0], points[first[k], 1], points[first[k], 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        r = math.sqrt(x * x + y * y + z * z)
        if r < 0.5:
            continue
        a, b = _bin(x, y, z, r, size, half)
        if a < RING or b < RING or a >= wide - RING or b >= wide - RING:
            continue
        low, high = r - margin - slack * r, r + margin + slack * r
        seen = hit = blocked = False
        for i in range(a - 1, a + 2):
            for j in range(b - 1, b + 2):
                near, far = image[i, j, NEAR], image[i, j, FAR]
                # without branches, which would be hard to predict; an empty bin is neither a hit nor blocked
                hit |= ((low < near) & (near < high)) | ((low < far) & (far < high))
                seen |= far > 0.0
                blocked |= near < high
        if hit:
            hits[k] += 1
        elif seen and not blocked:
            for i in range(a - RING, a + RING + 1):
                for j in range(b - RING, b + RING + 1):
                    blocked |= image[i, j, NEAR] < high
            if not blocked:
                through[k] += 1
