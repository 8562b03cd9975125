"""Cells around a scanner that sees no ground below itself: what scans show in them, and which are the floor."""

import math

import numpy as np
from numba import njit

from app.slam.kernels.small import copy, cross

CELLS, EDGE_M = 128, 0.5
"""Cells along each side of the square, and the length of a cell's edge."""
COUNT, MEAN, LOWEST, HIGHEST = range(4)
"""Statistics of the heights (m, odometry's frame) in a cell. Count and mean are of points on the lowest lines only."""
NOTHING = np.array([0.0, 0.0, np.inf, -np.inf], np.float32)
"""The statistics of a cell that no scan shows."""
NONE, BESIDE, FLOOR, PLANE = range(4)
"""What a cell is: nothing, beside the floor, floor, or floor on its plane."""
_HEAD_M = 0.5
"""Points up to this height above the scanner are used to detect walls: the part of a near wall below the scanner is low
and looks flat."""
_FLAT_M = 0.15
"""Heights within one cell of the floor differ by less."""
_RISE_M = 0.1
"""Heights of neighbouring cells of the floor differ by less: a slope of 11 degrees, a low kerb."""
_FOOT_M = 0.05
"""At a wall, a floor cell differs in height from the floor beside it by less than this."""
_LEAST_POINTS, _MOST_SCANS = 3, 50.0
"""Least number of points for a cell's height, and most scans that it is averaged over."""
_LEAST_CELLS, _TRIALS, _JUDGES = 8, 200, 400
"""Least number of cells of a floor, number of planes that are tried, and about how many cells each is tried on."""


@njit(cache=True, nogil=True)
def see(points, ring, last, R, p, corner, seen):
    """Add one scan to the cells that it shows.

    points (n, 3) f32 m, LiDAR frame; ring (n,) u16, of which those below `last` are the lowest; R (3, 3) and p (3,) m:
    LiDAR in odometry's frame; corner (2,) index of the first cell. In and out: seen (CELLS, CELLS, 4) f32.
    """
    for k in range(len(points)):
        i, j, height, _ = _cell(points[k], R, p, corner)
        if height >= p[2] + _HEAD_M or not (0 <= i < CELLS and 0 <= j < CELLS):
            continue
        cell = seen[i, j]
        cell[LOWEST], cell[HIGHEST] = min(cell[LOWEST], height), max(cell[HIGHEST], height)
        if height < p[2] and ring[k] < last:
            cell[COUNT] += 1
            cell[MEAN] += (height - cell[MEAN]) / cell[COUNT]


@njit(cache=True, nogil=True)
def carry(seen, found, known, by, full, now_seen, now_known):
    """Carry the contents of cells over to the square around the next scan.

    Heights of cells that were found to be floor are kept, and heights that scans contradict are forgotten.

    seen (2, CELLS, CELLS, 4) f32; found (CELLS, CELLS) f32 m, nan where there is no floor; known (CELLS, CELLS, 2) f32:
    m, and the number of scans that it is the mean of, 0 where it is not known; by (2,): cells to the next square;
    full: whether the newer half of `seen` is full, becomes the older one, and a new one begins. Out: now_seen,
    now_known: of the next square.
    """
    for i in range(CELLS):
        for j in range(CELLS):
            u, v, cell = i + by[0], j + by[1], now_known[i, j]
            inside = 0 <= u < CELLS and 0 <= v < CELLS
            for c in range(4):
                now_seen[0, i, j, c] = seen[0, u, v, c] if inside and not full else NOTHING[c]
                now_seen[1, i, j, c] = seen[0 if full else 1, u, v, c] if inside else NOTHING[c]
            cell[0], cell[1] = (known[u, v, 0], known[u, v, 1]) if inside else (0.0, 0.0)
            if not inside or (cell[1] == 0 and np.isnan(found[u, v])):
                continue
            count, mean, lowest, highest = _both(seen, u, v)
            flat = count >= _LEAST_POINTS and highest - lowest < _FLAT_M
            if cell[1] and (lowest < cell[0] - _RISE_M or (flat and abs(mean - cell[0]) > _RISE_M)):
                cell[1] = 0
            elif flat and abs(mean - found[u, v]) < _RISE_M:
                cell[1] = min(cell[1] + 1, _MOST_SCANS)
                cell[0] = mean if cell[1] == 1 else cell[0] + (mean - cell[0]) / cell[1]


@njit(cache=True, nogil=True)
def find(seen, known, corner, p, sigma, cos_slope, heights, kinds, seeds):
    """Find the floor: the lowest plane that most cells share, then extended cell by cell.

    A cell is flat if its heights differ little; the cell of a wall is not. Planes are tried through three cells that
    are flat or known, if they are less steep than the limit. The plane with the most cells on it and the fewest below
    is chosen. Cells on it are floor, and so are their neighbours at about the same height, and in turn the neighbours
    of these. A cell beside the floor may be its edge.

    Arguments as `see` and `carry`; sigma m/m; cos_slope of the steepest plane. Out: heights (CELLS, CELLS) f32 m,
    nan where there is no floor; kinds (CELLS, CELLS) u8, NONE to PLANE; seeds (CELLS², 3) f64 m, from the LiDAR,
    odometry's axes: cells on the plane. Returns the number of seeds.
    """
    height, cells = np.full((CELLS, CELLS), np.nan), np.empty((CELLS * CELLS, 3))
    index = np.empty((CELLS * CELLS, 2), np.int64)
    count = 0
    for i in range(CELLS):
        for j in range(CELLS):
            heights[i, j], kinds[i, j] = np.nan, NONE
            points, mean, lowest, highest = _both(seen, i, j)
            if known[i, j, 1] and lowest >= known[i, j, 0] - _RISE_M:
                height[i, j] = known[i, j, 0]
            elif points and highest - lowest < _FLAT_M:
                height[i, j] = mean
                if points < _LEAST_POINTS:
                    continue
            else:
                continue
            cells[count, 0] = (i + corner[0] + 0.5) * EDGE_M - p[0]
            cells[count, 1] = (j + corner[1] + 0.5) * EDGE_M - p[1]
            cells[count, 2] = height[i, j] - p[2]
            index[count, 0], index[count, 1] = i, j
            count += 1
    chosen, plane = _lowest_plane(cells[:count], sigma, cos_slope)
    if not plane.any():
        return 0

    queue = np.empty((CELLS * CELLS, 2), np.int64)
    found = 0
    for k in range(count):
        if abs((cells[k] - chosen) @ plane) < sigma * np.linalg.norm(cells[k]):
            copy(cells[k], seeds[found])
            copy(index[k], queue[found])
            i, j = index[k]
            heights[i, j], kinds[i, j] = height[i, j], PLANE
            found += 1
    reached, nearest, k = found, np.full((CELLS, CELLS), 3), 0
    while k < reached:
        i, j = queue[k]
        for u in range(max(i - 1, 0), min(i + 2, CELLS)):
            for v in range(max(j - 1, 0), min(j + 2, CELLS)):
                if np.isnan(heights[u, v]) and abs(height[u, v] - heights[i, j]) < _RISE_M:
                    heights[u, v], kinds[u, v] = height[u, v], FLOOR
                    queue[reached, 0], queue[reached, 1] = u, v
                    reached += 1
        k += 1
    for k in range(reached):
        i, j = queue[k]
        for u in range(max(i - 1, 0), min(i + 2, CELLS)):
            for v in range(max(j - 1, 0), min(j + 2, CELLS)):
                distance = abs(u - i) + abs(v - j)
                if kinds[u, v] <= BESIDE and distance < nearest[u, v]:
                    nearest[u, v], kinds[u, v], heights[u, v] = distance, BESIDE, heights[i, j]
    return found


@njit(cache=True, nogil=True)
def label(points, ring, last, R, p, corner, heights, kinds, sigma, labels):
    """Label points: 1 on the floor, 2 on the floor, the lowest lines and a cell of the plane, 0 elsewhere.

    Arguments as `see` and `find`.

    Out: labels (n,) u8. Returns the number of points on the floor.
    """
    count = 0
    for k in range(len(points)):
        labels[k] = 0
        i, j, height, distance = _cell(points[k], R, p, corner)
        if not (0 <= i < CELLS and 0 <= j < CELLS) or kinds[i, j] == NONE:
            continue
        most = _FOOT_M if kinds[i, j] == BESIDE else _RISE_M
        if abs(height - heights[i, j]) < min(most, sigma * distance):
            labels[k] = 2 if kinds[i, j] == PLANE and ring[k] < last else 1
            count += 1
    return count


@njit(cache=True)
def _cell(point, R, p, corner):
    """Cell (i, j) of a point of the LiDAR's frame, its height in odometry's frame and its range in m."""
    x, y, z = float(point[0]), float(point[1]), float(point[2])
    i = math.floor((R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + p[0]) / EDGE_M) - corner[0]
    j = math.floor((R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + p[1]) / EDGE_M) - corner[1]
    return i, j, R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + p[2], math.sqrt(x * x + y * y + z * z)


@njit(cache=True)
def _both(seen, i, j):
    """Count, mean, lowest and highest of both halves of `seen` together."""
    new, old = seen[0, i, j], seen[1, i, j]
    count = new[COUNT] + old[COUNT]
    mean = (new[COUNT] * new[MEAN] + old[COUNT] * old[MEAN]) / max(count, 1.0)
    return count, mean, min(new[LOWEST], old[LOWEST]), max(new[HIGHEST], old[HIGHEST])


@njit(cache=True)
def _lowest_plane(cells, sigma, cos_slope):
    """A point and the normal of the plane with the most cells on it and the fewest below; zeros if there is none."""
    best, chosen, plane = 0.5 * _LEAST_CELLS, np.zeros(3), np.zeros(3)
    if len(cells) < _LEAST_CELLS:
        return chosen, plane
    cells = cells[:: 1 + len(cells) // _JUDGES].copy()
    limits = np.empty(len(cells))
    for k in range(len(cells)):
        limits[k] = sigma * np.linalg.norm(cells[k])
    state = np.uint64(1)
    corners = np.empty((3, 3))
    for _ in range(_TRIALS):
        for k in range(3):
            state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
            copy(cells[int(state >> np.uint64(33)) % len(cells)], corners[k])
        normal = np.empty(3)
        cross(corners[1] - corners[0], corners[2] - corners[0], normal)
        size = np.linalg.norm(normal)
        if size < 1e-6 or abs(normal[2]) < cos_slope * size:
            continue
        normal *= np.sign(normal[2]) / size
        x, y, z = normal
        through = corners[0, 0] * x + corners[0, 1] * y + corners[0, 2] * z
        score = 0.0
        for k in range(len(cells)):
            above = cells[k, 0] * x + cells[k, 1] * y + cells[k, 2] * z - through
            score += 1.0 - abs(above) / limits[k] if abs(above) < limits[k] else -2.0 if above < 0 else 0.0
        if score > best:
            best, chosen, plane = score, corners[0].copy(), normal
    return chosen, plane
