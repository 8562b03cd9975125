"""The hashed voxel map: lookup, insertion, eviction, and planes through nearest neighbours."""

import math

import numpy as np
from numba import njit

from app.slam.kernels.clouds import PRIME_X, PRIME_Y, PRIME_Z
from app.slam.kernels.small import across, plane_of


@njit(cache=True, inline="always")
def _find(table, cells, a, b, c):
    """Slot of voxel (a, b, c) in cells (v, 3) i32 by linear probing of table (2^k,) i32; -1 if it is not there."""
    mask = len(table) - 1
    h = ((a * PRIME_X) ^ (b * PRIME_Y) ^ (c * PRIME_Z)) & mask
    while True:
        k = table[h]
        if k < 0:
            return -1
        if cells[k, 0] == a and cells[k, 1] == b and cells[k, 2] == c:
            return k
        h = (h + 1) & mask


@njit(cache=True, inline="always")
def _begin(point, x, y, z, now, eye):
    """A row of the store for a first hit at (x, y, z) m; see `insert`."""
    ex, ey, ez = eye[0] - x, eye[1] - y, eye[2] - z
    nearer = 1.0 / max(math.sqrt(ex * ex + ey * ey + ez * ez), 1e-6)
    point[0], point[1], point[2], point[3], point[4] = x, y, z, 1.0, now
    point[5], point[6], point[7] = ex * nearer, ey * nearer, ez * nearer


MOST_HITS = 8
"""Number of hits that are averaged. If a point kept following the scans, the map would drift with them."""


@njit(cache=True, nogil=True)
def insert(points, eye, voxel, spacing, now, old, table, cells, counts, store, used, refused):
    """Add points that are not within `spacing` of a point in their own voxel. Returns used.

    A point within `spacing` is another hit of the nearest map point there, which becomes the mean of its first
    MOST_HITS hits. So noise averages out. If the nearest was last seen before `old`, the new point takes its place: a
    mean of both would mix the surface as it is seen now with where odometry put it then.

    points (n, 3) f32 m, odom; eye (3,) m, the sensor; voxel, spacing m; now, old: drift, m². In and out: table (2^k,)
    i32, slot by hash or -1; cells (v, 3) i32, voxel indices; counts (v,) u8; store (v, m, 8) f32: x, y, z in m, hits,
    drift when last seen, and the unit vector towards the sensor at the first hit. The first `used` slots are taken. A
    full voxel takes no more points, a full store no new voxel. Out: refused (n,) bool, the points that needed one.
    """
    mask = len(table) - 1
    inverse, near2 = 1.0 / voxel, spacing * spacing
    capacity, room = store.shape[0], store.shape[1]
    for j in range(len(points)):
        refused[j] = False
        x, y, z = points[j, 0], points[j, 1], points[j, 2]
        a, b, c = math.floor(x * inverse), math.floor(y * inverse), math.floor(z * inverse)
        h = ((a * PRIME_X) ^ (b * PRIME_Y) ^ (c * PRIME_Z)) & mask
        while True:
            k = table[h]
            if k < 0:
                if used >= capacity:
                    refused[j] = True
                    break
                k = used
                used += 1
                table[h] = k
                cells[k, 0], cells[k, 1], cells[k, 2] = a, b, c
                _begin(store[k, 0], x, y, z, now, eye)
                counts[k] = 1
                break
            if cells[k, 0] == a and cells[k, 1] == b and cells[k, 2] == c:
                n = np.int64(counts[k])
                nearest, at = float(near2), -1
                for i in range(n):
                    dx, dy, dz = store[k, i, 0] - x, store[k, i, 1] - y, store[k, i, 2] - z
                    d2 = dx * dx + dy * dy + dz * dz
                    if d2 < nearest:
                        nearest, at = d2, i
                if at >= 0 and store[k, at, 4] >= old:
                    hits = store[k, at, 3] + np.float32(1.0)
                    if hits <= MOST_HITS:
                        store[k, at, 0] += (x - store[k, at, 0]) / hits
                        store[k, at, 1] += (y - store[k, at, 1]) / hits
                        store[k, at, 2] += (z - store[k, at, 2]) / hits
                        store[k, at, 3] = hits
                    store[k, at, 4] = now
                elif at >= 0 or n < room:
                    place = n if at < 0 else at
                    counts[k] = max(n, place + 1)
                    _begin(store[k, place], x, y, z, now, eye)
                break
            h = (h + 1) & mask
    return used


@njit(cache=True, nogil=True)
def evict(center, radius, voxel, table, cells, counts, store, used):
    """Drop voxels whose centre is farther than `radius` m from `center` (3,), and rebuild the table. Returns used."""
    mask = len(table) - 1
    r2 = radius * radius
    kept = 0
    for k in range(used):
        dx = (cells[k, 0] + 0.5) * voxel - center[0]
        dy = (cells[k, 1] + 0.5) * voxel - center[1]
        dz = (cells[k, 2] + 0.5) * voxel - center[2]
        if dx * dx + dy * dy + dz * dz > r2:
            continue
        if kept != k:
            n = counts[k]
            counts[kept] = n
            for i in range(3):
                cells[kept, i] = cells[k, i]
            for i in range(n):
                for c in range(8):
                    store[kept, i, c] = store[k, i, c]
        kept += 1
    table[:] = -1
    for k in range(kept):
        h = ((cells[k, 0] * PRIME_X) ^ (cells[k, 1] * PRIME_Y) ^ (cells[k, 2] * PRIME_Z)) & mask
        while table[h] >= 0:
            h = (h + 1) & mask
        table[h] = k
    return kept


MOST = 40
"""Most neighbours of a patch; a patch that is still uncertain with this many is not used."""
BINS = 64
"""Steps of squared distance by which neighbours are ranked. Exact sorting takes three times as long."""
SURE_TILT = math.radians(1.5)
"""A plane whose normal is less certain than this counts for less, in proportion to the variance of its normal."""
PLANE_FREEDOM = 3
"""Degrees of freedom of a plane. The squared distances of k points from it are averaged over k - 3, since a
few points lie flat by chance."""
LEAST_SCATTER = 1.5
"""Least scatter assumed for a plane's points, in standard deviations of a map point: points of one scan share errors,
and after the first scan there are no others."""
BEHIND = 0.15
"""Least cosine between a plane's normal and the direction in which a point was seen from behind. A thin wall has two
faces some centimetres apart, and a scan of one must not be fitted to the other. Closer to edge-on, the side is
uncertain."""
SHARED = 4.0
"""Weight of a plane's own variance: points on the same patch share its error, which does not average out."""
OLD = 4.0
"""Weight of an old plane's variance: odometry has drifted since, and the pose should return to it smoothly."""


@njit(cache=True, inline="always")
def _outside(u, cell):
    """Distance from coordinate `u` (in voxels) to the voxel [cell, cell + 1]."""
    return max(0.0, max(cell - u, u - (cell + 1)))


@njit(cache=True, error_model="numpy")
def _nearest(x, y, z, voxel, reach2, old, table, cells, counts, places, room, spots, bins, begin, order):
    """Map points within reach of (x, y, z) m, ranked by distance to within a bin's width, those not old first.

    reach2 m²; places (v * room, 8): the store, flat; old: drift, before which a point was last seen if it is old.
    Returns the numbers of present points and of all. Out: order (m,) i32, their rows in `places`, ranked. Scratch:
    spots, bins (m,) i32, begin (2 BINS + 1,) i32. The inner loop has no branch: the next point overwrites one that is
    out of reach.
    """
    ux, uy, uz = x / voxel, y / voxel, z / voxel
    a0, b0, c0 = math.floor(ux), math.floor(uy), math.floor(uz)
    scale = BINS / reach2
    begin[:] = 0
    m = np.uint64(0)  # unsigned indices are not checked for counting from the end
    for a in range(a0 - 1, a0 + 2):
        ox = _outside(ux, a) * voxel
        for b in range(b0 - 1, b0 + 2):
            oy = _outside(uy, b) * voxel
            for c in range(c0 - 1, c0 + 2):
                oz = _outside(uz, c) * voxel
                if ox * ox + oy * oy + oz * oz >= reach2:
                    continue
                k = _find(table, cells, a, b, c)
                if k < 0:
                    continue
                row = np.uint64(k * room)
                for i in range(row, row + np.uint64(counts[k])):
                    ex, ey, ez = places[i, 0] - x, places[i, 1] - y, places[i, 2] - z
                    at = int((ex * ex + ey * ey + ez * ez) * scale)
                    spots[m] = i
                    bins[m] = at + (BINS if places[i, 4] < old else 0)
                    m += np.uint64(at < BINS)
    for i in range(m):
        begin[bins[i] + 1] += 1
    for i in range(2 * BINS):
        begin[i + 1] += begin[i]
    present = begin[BINS]
    for i in range(m):
        at = bins[i]
        order[begin[at]] = spots[i]
        begin[at] += 1
    return present, np.int64(m)


@njit(cache=True, error_model="numpy")
def _fit(x, y, z, eye, places, order, n, first, flat, tilts, noise, normal, j, normals, centers, variances, deviations):
    """Planes through the nearest of n ranked points around (x, y, z), one for each of `tilts` (see `planes`).

    Out, in row j of each tilt: normals, unit; centers, m; variances, m² or -1; deviations, rad.
    Scratch: normal.
    """
    variances[:, j] = -1.0
    sx = sy = sz = xx = xy = xz = yy = yz = zz = inverse_hits = 0.0
    done, take, level = 0, first, 0
    while take <= n:
        for i in range(done, take):
            k = order[i]
            ex, ey, ez = places[k, 0] - x, places[k, 1] - y, places[k, 2] - z
            sx += ex
            sy += ey
            sz += ez
            xx += ex * ex
            xy += ex * ey
            xz += ex * ez
            yy += ey * ey
            yz += ey * ez
            zz += ez * ez
            inverse_hits += 1.0 / places[k, 3]
        done = take
        s = 1.0 / take
        mx, my, mz = sx * s, sy * s, sz * s
        _, l2, l3 = plane_of(
            xx * s - mx * mx, xy * s - mx * my, xz * s - mx * mz,
            yy * s - my * my, yz * s - my * mz, zz * s - mz * mz, normal,
        )  # fmt: skip
        l3 *= take / (take - PLANE_FREEDOM)
        # the mean of h hits has a variance of noise² / h
        least = LEAST_SCATTER * LEAST_SCATTER * noise * noise * s * inverse_hits
        scatter = max(l3, least)
        begin = level
        while level < len(tilts) and scatter < tilts[level] * tilts[level] * take * l2:
            level += 1
        if level > begin and _is_one_side(x, y, z, eye, places, order, take, mx, my, mz, normal, flat):
            doubt = max(1.0, scatter / (SURE_TILT * SURE_TILT * take * l2))
            for i in range(begin, level):
                normals[i, j, 0], normals[i, j, 1], normals[i, j, 2] = normal[0], normal[1], normal[2]
                centers[i, j, 0], centers[i, j, 1], centers[i, j, 2] = mx + x, my + y, mz + z
                variances[i, j] = (noise * noise + SHARED * l3) * doubt
                _deviate(
                    xx * s - mx * mx, xy * s - mx * my, xz * s - mx * mz, yy * s - my * my, yz * s - my * mz,
                    zz * s - mz * mz, scatter * s, normal, deviations[i, j],
                )  # fmt: skip
        if level == len(tilts) or take == n:
            break
        take = min(2 * take, n)


@njit(cache=True, error_model="numpy")
def _deviate(xx, xy, xz, yy, yz, zz, scatter, normal, out):
    """Fill out (2, 3) with two vectors across the normal whose outer products sum to the normal's covariance.

    That covariance is scatter / T, where T is the covariance of the points (xx ... zz) within the plane. The two
    vectors are its Cholesky factor.
    """
    ax, ay, az, bx, by, bz = across(normal[0], normal[1], normal[2])
    aa = ax * ax * xx + ay * ay * yy + az * az * zz + 2.0 * (ax * ay * xy + ax * az * xz + ay * az * yz)
    bb = bx * bx * xx + by * by * yy + bz * bz * zz + 2.0 * (bx * by * xy + bx * bz * xz + by * bz * yz)
    ab = ax * (bx * xx + by * xy + bz * xz) + ay * (bx * xy + by * yy + bz * yz) + az * (bx * xz + by * yz + bz * zz)
    scale = scatter / (aa * bb - ab * ab)
    p = math.sqrt(scale * bb)
    q = -scale * ab / p
    r = math.sqrt(max(scale * aa - q * q, 0.0))
    out[0, 0], out[0, 1], out[0, 2] = p * ax + q * bx, p * ay + q * by, p * az + q * bz
    out[1, 0], out[1, 1], out[1, 2] = r * bx, r * by, r * bz


@njit(cache=True, inline="always")
def _is_one_side(x, y, z, eye, places, order, n, mx, my, mz, normal, flat):
    """Whether the nearest n points are the side of a surface that `eye` sees: they lie within `flat` m of the plane at
    (mx, my, mz) from (x, y, z), and none was seen from behind it."""
    nx, ny, nz = normal[0], normal[1], normal[2]
    if nx * (eye[0] - x) + ny * (eye[1] - y) + nz * (eye[2] - z) < 0.0:
        nx, ny, nz = -nx, -ny, -nz
    for i in range(n):
        k = order[i]
        if nx * places[k, 5] + ny * places[k, 6] + nz * places[k, 7] < -BEHIND:
            return False
        ex, ey, ez = places[k, 0] - x - mx, places[k, 1] - y - my, places[k, 2] - z - mz
        if abs(ex * normal[0] + ey * normal[1] + ez * normal[2]) > flat:
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def planes(
    begin, end, queries, eye, voxel, reach, first, flat, tilts, noise, old, table, cells, counts, store,
    normals, centers, variances, deviations,
):  # fmt: skip
    """Planes through the nearest map points of queries [begin, end), one for each of `tilts` (k,) rad, descending.

    The `first` nearest points within `reach` m are tried first. The normal of a plane through k points of scatter s is
    uncertain by s / sqrt(k l2) rad. While that exceeds the tilt (neighbours on one scan line do not determine the
    surface across it), the patch is widened to twice as many points, up to MOST. The plane is accepted once it is
    certain enough, every neighbour lies within `flat` m of it, and none was seen from its other side.

    Points last seen before drift was `old` m² are used only if newer ones give no plane, and never together with these.

    queries (n, 3) f64 m, odom; eye (3,) m, the sensor; noise: of a point, m; the map as in `insert`. Out: normals
    (k, n, 3) unit, centers (k, n, 3) m, variances (k, n): of a point's distance from its plane in m², negative where
    there is no plane; deviations (k, n, 2, 3) rad: the outer products of the two sum to the normal's covariance.
    """
    room = store.shape[1]
    places = store.reshape(-1, 8)
    spots, bins, order = np.empty(27 * room, np.int32), np.empty(27 * room, np.int32), np.empty(27 * room, np.int32)
    starts = np.empty(2 * BINS + 1, np.int32)
    normal = np.empty(3)
    for j in range(begin, end):
        x, y, z = queries[j, 0], queries[j, 1], queries[j, 2]
        present, n = _nearest(
            x, y, z, voxel, reach * reach, old, table, cells, counts, places, room, spots, bins, starts, order
        )
        _fit(
            x, y, z, eye, places, order, min(present, MOST), first, flat, tilts, noise, normal, j,
            normals, centers, variances, deviations,
        )  # fmt: skip
        if variances[0, j] < 0.0 and n > present:
            _fit(
                x, y, z, eye, places, order[present:], min(n - present, MOST), first, flat, tilts, noise, normal, j,
                normals, centers, variances, deviations,
            )  # fmt: skip
            for i in range(len(tilts)):
                variances[i, j] *= OLD
