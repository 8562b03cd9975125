"""The hashed voxel map: lookup, insertion, eviction, and planes through nearest neighbours."""

import math

import numpy as np
from numba import njit, prange

from app.slam.kernels.small import CHUNKS, plane_of
from app.slam.kernels.voxels import PRIME_X, PRIME_Y, PRIME_Z


@njit(cache=True, inline="always")
def _find(table, cells, a, b, c):
    """Slot of voxel (a, b, c), or -1."""
    mask = len(table) - 1
    h = ((a * PRIME_X) ^ (b * PRIME_Y) ^ (c * PRIME_Z)) & mask
    while True:
        k = table[h]
        if k < 0:
            return -1
        if cells[k, 0] == a and cells[k, 1] == b and cells[k, 2] == c:
            return k
        h = (h + 1) & mask


@njit(cache=True)
def insert(points, voxel, spacing, table, cells, counts, store, used):
    """Add points (n, 3) f32 that are not within `spacing` of one in their own voxel. Returns (used, refused).

    A full voxel takes no more; a full store takes no new voxel (`refused` counts those points).
    """
    mask = len(table) - 1
    inverse, near2 = 1.0 / voxel, spacing * spacing
    capacity, room = store.shape[0], store.shape[1]
    refused = 0
    for j in range(len(points)):
        x, y, z = points[j, 0], points[j, 1], points[j, 2]
        a, b, c = math.floor(x * inverse), math.floor(y * inverse), math.floor(z * inverse)
        h = ((a * PRIME_X) ^ (b * PRIME_Y) ^ (c * PRIME_Z)) & mask
        while True:
            k = table[h]
            if k < 0:
                if used >= capacity:
                    refused += 1
                    break
                k = used
                used += 1
                table[h] = k
                cells[k, 0], cells[k, 1], cells[k, 2] = a, b, c
                store[k, 0, 0], store[k, 0, 1], store[k, 0, 2] = x, y, z
                counts[k] = 1
                break
            if cells[k, 0] == a and cells[k, 1] == b and cells[k, 2] == c:
                n = counts[k]
                if n >= room:
                    break
                free = True
                for i in range(n):
                    dx, dy, dz = store[k, i, 0] - x, store[k, i, 1] - y, store[k, i, 2] - z
                    if dx * dx + dy * dy + dz * dz < near2:
                        free = False
                        break
                if free:
                    store[k, n, 0], store[k, n, 1], store[k, n, 2] = x, y, z
                    counts[k] = n + 1
                break
            h = (h + 1) & mask
    return used, refused


@njit(cache=True)
def evict(center, radius, voxel, table, cells, counts, store, used):
    """Drop voxels whose centre is farther than `radius` from `center` and rebuild the table. Returns used."""
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
                store[kept, i, 0], store[kept, i, 1], store[kept, i, 2] = store[k, i, 0], store[k, i, 1], store[k, i, 2]
        kept += 1
    table[:] = -1
    for k in range(kept):
        h = ((cells[k, 0] * PRIME_X) ^ (cells[k, 1] * PRIME_Y) ^ (cells[k, 2] * PRIME_Z)) & mask
        while table[h] >= 0:
            h = (h + 1) & mask
        table[h] = k
    return kept


NEAREST = 20
"""Most neighbours that one patch may take."""


@njit(cache=True, inline="always")
def _outside(u, cell):
    """Distance from coordinate `u` (in voxels) to the voxel [cell, cell + 1]."""
    return max(0.0, max(cell - u, u - (cell + 1)))


@njit(cache=True)
def _nearest(x, y, z, voxel, reach2, table, cells, counts, store, near):
    """Offsets of the up to NEAREST map points within reach, ascending in distance.

    near (NEAREST, 4) f64 out: squared distance and offset from (x, y, z). Looks through the 27
    voxels around, the own one first, and passes over voxels that can not hold a nearer point.
    """
    ux, uy, uz = x / voxel, y / voxel, z / voxel
    a0, b0, c0 = math.floor(ux), math.floor(uy), math.floor(uz)
    worst, n = reach2, 0
    for v in range(27):
        w = 13 if v == 0 else (v - 1 if v <= 13 else v)  # voxel 13 is the own one
        a, b, c = a0 + w // 9 - 1, b0 + (w // 3) % 3 - 1, c0 + w % 3 - 1
        ox, oy, oz = _outside(ux, a) * voxel, _outside(uy, b) * voxel, _outside(uz, c) * voxel
        if ox * ox + oy * oy + oz * oz >= worst:
            continue
        k = _find(table, cells, a, b, c)
        if k < 0:
            continue
        for i in range(counts[k]):
            ex, ey, ez = store[k, i, 0] - x, store[k, i, 1] - y, store[k, i, 2] - z
            e2 = ex * ex + ey * ey + ez * ez
            if e2 >= worst:
                continue
            at = n if n < NEAREST else NEAREST - 1
            while at > 0 and near[at - 1, 0] > e2:
                near[at, 0], near[at, 1] = near[at - 1, 0], near[at - 1, 1]
                near[at, 2], near[at, 3] = near[at - 1, 2], near[at - 1, 3]
                at -= 1
            near[at, 0], near[at, 1], near[at, 2], near[at, 3] = e2, ex, ey, ez
            if n < NEAREST:
                n += 1
            if n == NEAREST:
                worst = near[NEAREST - 1, 0]
    return n


@njit(cache=True, parallel=True)
def planes(queries, voxel, reach, first, flat, tilt, noise, table, cells, counts, store, normals, centers, variances):
    """A plane through the nearest map points of each query.

    The `first` nearest within `reach` m are tried. A plane through k points of scatter s has a normal
    that is uncertain by s / sqrt(k l2): where that is over `tilt` rad (neighbours from one scan line
    say nothing about the surface across it) the patch widens, up to NEAREST points. Accepted when
    it becomes certain enough and every neighbour lies within `flat` m of it.

    queries (n, 3) f64, map frame; noise: least scatter of the points, m. Out: normals (n, 3), centers
    (n, 3), variances (n,): l3 of the patch in m², or -1 where there is no plane.
    """
    total = len(queries)
    for chunk in prange(CHUNKS):
        near = np.empty((NEAREST, 4))
        normal = np.empty(3)
        for j in range(chunk * total // CHUNKS, (chunk + 1) * total // CHUNKS):
            x, y, z = queries[j, 0], queries[j, 1], queries[j, 2]
            variances[j] = -1.0
            n = _nearest(x, y, z, voxel, reach * reach, table, cells, counts, store, near)
            sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
            done, take = 0, first
            while take <= n:
                for i in range(done, take):
                    ex, ey, ez = near[i, 1], near[i, 2], near[i, 3]
                    sx += ex
                    sy += ey
                    sz += ez
                    xx += ex * ex
                    xy += ex * ey
                    xz += ex * ez
                    yy += ey * ey
                    yz += ey * ez
                    zz += ez * ez
                done = take
                s = 1.0 / take
                mx, my, mz = sx * s, sy * s, sz * s
                _, l2, l3 = plane_of(
                    xx * s - mx * mx, xy * s - mx * my, xz * s - mx * mz,
                    yy * s - my * my, yz * s - my * mz, zz * s - mz * mz, normal,
                )  # fmt: skip
                if max(l3, noise * noise) < tilt * tilt * take * l2:
                    good = True
                    for i in range(take):
                        off = (
                            (near[i, 1] - mx) * normal[0]
                            + (near[i, 2] - my) * normal[1]
                            + (near[i, 3] - mz) * normal[2]
                        )
                        if abs(off) > flat:
                            good = False
                            break
                    if good:
                        variances[j] = l3
                        for i in range(3):
                            normals[j, i] = normal[i]
                        centers[j, 0], centers[j, 1], centers[j, 2] = x + mx, y + my, z + mz
                    break
                if take == n:
                    break
                take = min(2 * take, n)
