"""Seeds, their moments, and labels of ground segmentation."""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def steep_seeds(points, ring, lines, down, cos_alpha, labels):
    """Mark the paper's seeds: label 2 for points on the outermost `lines` present and within the angle alpha of down.

    points (n, 3) f32 m, LiDAR frame; ring (n,) u16, line of each point, 0 the outermost; down (3,) unit. Out: labels
    (n,) u8. Returns the number of seeds, and of points on any line within alpha of down.
    """
    last = last_line(ring, lines)
    count = steep = 0
    for j in range(len(points)):
        labels[j] = 0
        x, y, z = float(points[j, 0]), float(points[j, 1]), float(points[j, 2])
        along = x * down[0] + y * down[1] + z * down[2]
        if along <= cos_alpha * math.sqrt(x * x + y * y + z * z):
            continue
        steep += 1
        if ring[j] < last:
            labels[j] = 2
            count += 1
    return count, steep


@njit(cache=True, nogil=True)
def moments(points, labels, sums):
    """Add up the first and second moments of the seeds (label 2) about the first of them.

    Out: sums (12,) f64: origin (the first seed, m), sum of offsets from it (m), and of their products
    xx xy xz yy yz zz (m²).
    """
    first = True
    for j in range(len(points)):
        if labels[j] != 2:
            continue
        x, y, z = float(points[j, 0]), float(points[j, 1]), float(points[j, 2])
        if first:
            sums[0], sums[1], sums[2] = x, y, z
            first = False
        x, y, z = x - sums[0], y - sums[1], z - sums[2]
        sums[3] += x
        sums[4] += y
        sums[5] += z
        sums[6] += x * x
        sums[7] += x * y
        sums[8] += x * z
        sums[9] += y * y
        sums[10] += y * z
        sums[11] += z * z


@njit(cache=True)
def last_line(ring, lines):
    """The first line after the outermost `lines` of those present. ring (n,) u16, 0 the outermost."""
    present = np.zeros(1 << 16, np.bool_)
    for j in range(len(ring)):
        present[ring[j]] = True
    last = found = 0
    while found < lines and last < len(present):
        found += present[last]
        last += 1
    return last


@njit(cache=True, nogil=True)
def label(points, centroid, normal, sigma, labels):
    """Paper eq. 2-3: a point p is ground if |(mu - p) . n| < sigma |p|. Seeds that are ground stay seeds.

    points (n, 3) f32 m; centroid mu (3,) m; normal n (3,) unit; sigma m/m; labels (n,) u8, in and out. Returns the
    number of ground points.
    """
    count = 0
    for j in range(len(points)):
        x, y, z = float(points[j, 0]), float(points[j, 1]), float(points[j, 2])
        d = (centroid[0] - x) * normal[0] + (centroid[1] - y) * normal[1] + (centroid[2] - z) * normal[2]
        ground = abs(d) < sigma * math.sqrt(x * x + y * y + z * z)
        if not ground:
            labels[j] = 0
        elif labels[j] == 0:
            labels[j] = 1
        count += ground
    return count
