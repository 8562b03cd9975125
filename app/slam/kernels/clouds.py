"""Whole-cloud passes."""

from numba import njit, prange

from app.slam.kernels.small import CHUNKS


@njit(cache=True, parallel=True)
def in_range(points, nearest, farthest, keep):
    """keep (n,) bool, out: nearest <= |p| <= farthest, for points (n, 3) f32 in m. Returns the number kept."""
    n = len(points)
    low, high = nearest * nearest, farthest * farthest
    count = 0
    for chunk in prange(CHUNKS):
        inside = 0
        for j in range(chunk * n // CHUNKS, (chunk + 1) * n // CHUNKS):
            x, y, z = points[j, 0], points[j, 1], points[j, 2]
            r2 = x * x + y * y + z * z
            keep[j] = low <= r2 <= high
            inside += keep[j]
        count += inside
    return count
