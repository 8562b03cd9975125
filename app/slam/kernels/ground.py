"""Seeds, their moments, and labels of ground segmentation."""

import math

import numpy as np
from numba import njit

SECTORS, REACH, STEP = 72, 40, 1.0
"""Polar cells of 5 degrees and 1 m, out to 40 m."""
_STEP_M = 0.2
"""Heights in one cell of the ground differ by less."""
_HEAD_M = 0.5
"""Points up to this height above the scanner show a wall too: what a near one has below it is low and looks flat."""
_FOOT_M, _FOOT_SIGMA, _ROUGH_SIGMA = 0.05, 0.25, 2.0
"""At a wall, ground is lower than this above the lowest point there, and nearer to the plane than so many sigma. A flat
cell is ground up to so many sigma from it: far from the scanner, real ground is no plane."""
_LEAST_POINTS, _LEAST_CELLS, _TRIALS = 3, 8, 200
"""Points that make a cell, cells that make a floor, and planes that are tried."""


@njit(cache=True, nogil=True)
def steep_seeds(points, ring, lines, down, cos_alpha, labels):
    """Mark the seeds of the paper: label 2 for points on the outermost `lines` present, within the angle alpha of down.

    points (n, 3) f32 m, LiDAR frame; ring (n,) u16, line of each point, 0 the outermost; down (3,) unit. Out: labels
    (n,) u8. Returns the number of seeds, and of points on any line within alpha of down.
    """
    last = _last_line(ring, lines)
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
def flat_seeds(points, ring, lines, down, sigma, cos_slope, labels):
    """Mark seeds where nothing is seen near straight down: points of flat polar cells that share the lowest plane.

    A cell is flat if its heights differ by less than a step, which a wall's do not. Of planes through three flat
    cells, less steep than the slope, the one counts that most cells lie on and fewest below. Points that cannot be
    ground, such as those on a wall, get label 3; other points of flat cells near the plane are ground and get label 4.

    Arguments as `steep_seeds`; sigma m/m; cos_slope of the steepest plane. Returns the number of seeds.
    """
    last = _last_line(ring, lines)
    ahead = np.zeros(3)
    ahead[np.argmin(np.abs(down))] = 1.0
    across = np.cross(down, ahead)
    across /= np.linalg.norm(across)
    ahead = np.cross(across, down)
    cell = np.full(len(points), -1, np.int32)
    count = np.zeros(SECTORS * REACH)
    mean = np.zeros((SECTORS * REACH, 3))
    lowest, highest = np.full(SECTORS * REACH, np.inf), np.full(SECTORS * REACH, -np.inf)
    low = np.zeros(SECTORS * REACH)
    for j in range(len(points)):
        p = points[j].astype(np.float64)
        height = -(p @ down)
        if height >= _HEAD_M:
            continue
        u, v = p @ ahead, p @ across
        reach = int(math.hypot(u, v) / STEP)
        if reach >= REACH:
            continue
        sector = int((math.atan2(v, u) + math.pi) * (SECTORS / (2 * math.pi))) % SECTORS
        c = sector * REACH + reach
        highest[c] = max(highest[c], height)
        if height >= 0.0:
            continue
        cell[j] = c
        count[c] += 1
        low[c] += ring[j] < last
        mean[c] += p
        lowest[c] = min(lowest[c], height)
    flat = np.empty(SECTORS * REACH, np.int64)
    wall = np.zeros(SECTORS * REACH, np.bool_)
    cells = 0
    for c in range(SECTORS * REACH):
        if count[c]:
            mean[c] /= count[c]
            if highest[c] - lowest[c] > _STEP_M:
                wall[c] = True
            elif low[c] >= _LEAST_POINTS:
                flat[cells] = c
                cells += 1
    if cells < _LEAST_CELLS:
        return 0
    best, chosen, plane = -np.inf, np.zeros(3), np.zeros(3)
    state = np.uint64(1)
    for _ in range(_TRIALS):
        corner = np.empty((3, 3))
        for k in range(3):
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            corner[k] = mean[flat[int(state >> np.uint64(33)) % cells]]
        normal = np.cross(corner[1] - corner[0], corner[2] - corner[0])
        size = np.linalg.norm(normal)
        if size < 1e-6 or abs(normal @ down) < cos_slope * size:
            continue
        normal *= -np.sign(normal @ down) / size
        score = 0.0
        for k in range(cells):
            p = mean[flat[k]]
            above = (p - corner[0]) @ normal
            limit = sigma * np.linalg.norm(p)
            score += 1.0 - abs(above) / limit if abs(above) < limit else -2.0 if above < 0 else 0.0
        if score > best:
            best, chosen, plane = score, corner[0].copy(), normal
    if best < 0.5 * _LEAST_CELLS:
        return 0
    seeding = np.zeros(SECTORS * REACH, np.bool_)
    seeding[flat[:cells]] = True
    seeds = 0
    for j in range(len(points)):
        c = cell[j]
        if c < 0:
            labels[j] = 3
            continue
        p = points[j].astype(np.float64) if wall[c] else mean[c]
        off = abs((p - chosen) @ plane) / (sigma * np.linalg.norm(p))
        if wall[c]:
            if off > _FOOT_SIGMA or -(p @ down) > lowest[c] + _FOOT_M:
                labels[j] = 3
        elif seeding[c] and off < 1.0:
            labels[j] = 2
            seeds += 1
        elif off < _ROUGH_SIGMA:
            labels[j] = 4
    return seeds


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
def _last_line(ring, lines):
    """The first line after the outermost `lines` of those present."""
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

    points (n, 3) f32 m; centroid mu (3,) m; normal n (3,) unit; sigma m/m; labels (n,) u8, in and out: label 3 is no
    ground, label 4 is ground. Returns the number of ground points.
    """
    count = 0
    for j in range(len(points)):
        x, y, z = float(points[j, 0]), float(points[j, 1]), float(points[j, 2])
        d = (centroid[0] - x) * normal[0] + (centroid[1] - y) * normal[1] + (centroid[2] - z) * normal[2]
        ground = abs(d) < sigma * math.sqrt(x * x + y * y + z * z)
        if labels[j] == 4:
            ground = True
            labels[j] = 1
        elif not ground or labels[j] == 3:
            ground = False
            labels[j] = 0
        elif labels[j] == 0:
            labels[j] = 1
        count += ground
    return count
