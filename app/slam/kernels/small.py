"""Copies, 3-vectors and 3x3 matrices, for the other kernels."""

import math

import numpy as np
from numba import njit


@njit(cache=True)
def copy(values, out):
    """out[:] = values, of the same shape. (That assignment itself takes numba two seconds to compile.)"""
    np.positive(values, out)


@njit(cache=True, inline="always")
def cross(a, b, out):
    """out (3,) = a x b."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True, inline="always")
def across(x, y, z):
    """Two unit vectors across a unit vector, a and b = (x, y, z) x a: ax, ay, az, bx, by, bz.

    They depend smoothly on it, except where |x| crosses 0.8.
    """
    if abs(x) < 0.8:  # its cross product with an axis well across it
        ax, ay, az = 0.0, z, -y
    else:
        ax, ay, az = -z, 0.0, x
    s = 1.0 / math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax * s, ay * s, az * s
    return ax, ay, az, y * az - z * ay, z * ax - x * az, x * ay - y * ax


@njit(cache=True)
def rotation(wx, wy, wz, out):
    """Rodrigues: rotation vector (rad) to the (3, 3) array `out`."""
    t2 = wx * wx + wy * wy + wz * wz
    if t2 < 1e-8:
        a, b = 1.0 - t2 / 6.0, 0.5 - t2 / 24.0
    else:
        t = math.sqrt(t2)
        a, b = math.sin(t) / t, (1.0 - math.cos(t)) / t2
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - b * (wy * wy + wz * wz), b * wx * wy - a * wz, b * wx * wz + a * wy
    out[1, 0], out[1, 1], out[1, 2] = b * wx * wy + a * wz, 1.0 - b * (wx * wx + wz * wz), b * wy * wz - a * wx
    out[2, 0], out[2, 1], out[2, 2] = b * wx * wz - a * wy, b * wy * wz + a * wx, 1.0 - b * (wx * wx + wy * wy)


@njit(cache=True)
def quaternions(R, out):
    """Rotations R (n, 3, 3) f64 to out (n, 4) f64: x, y, z, w, with w >= 0.

    Shepperd's method: it divides by the largest component, so no precision is lost.
    """
    row = np.empty(4)
    for n in range(len(R)):
        m = R[n]
        trace = m[0, 0] + m[1, 1] + m[2, 2]
        largest, square = 3, 1 + trace  # 4 q² of it
        for i in range(2, -1, -1):
            if 1 + 2 * m[i, i] - trace >= square:
                largest, square = i, 1 + 2 * m[i, i] - trace
        row[largest] = square
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            if largest == 3:
                row[i] = m[k, j] - m[j, k]
            elif largest == i:
                row[j], row[k] = m[i, j] + m[j, i], m[i, k] + m[k, i]
                row[3] = m[k, j] - m[j, k]
        size = math.sqrt(row[0] * row[0] + row[1] * row[1] + row[2] * row[2] + row[3] * row[3])
        sign = -1.0 if row[3] < 0 else 1.0
        for i in range(4):
            out[n, i] = sign * (row[i] / size)


@njit(cache=True)
def plane_of(xx, xy, xz, yy, yz, zz, normal):
    """Eigenvalues l1 >= l2 >= l3 of a symmetric 3x3 matrix; `normal` becomes the eigenvector of l3.

    Trigonometric solution (Smith 1961). The eigenvector is the best-conditioned cross product of two rows of A - l3 I.
    If l2 = l3 the normal is arbitrary; callers refuse such patches.
    """
    off = xy * xy + xz * xz + yz * yz
    m = (xx + yy + zz) / 3.0
    a, b, c = xx - m, yy - m, zz - m
    p2 = (a * a + b * b + c * c + 2.0 * off) / 6.0
    if p2 <= 1e-30:
        normal[0], normal[1], normal[2] = 0.0, 0.0, 1.0
        return m, m, m
    p = math.sqrt(p2)
    det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    r = min(1.0, max(-1.0, det / (2.0 * p2 * p)))
    phi = math.acos(r) / 3.0
    l1 = m + 2.0 * p * math.cos(phi)
    l3 = m + 2.0 * p * math.cos(phi + 2.0943951023931953)
    l2 = 3.0 * m - l1 - l3

    d0, d1, d2 = xx - l3, yy - l3, zz - l3
    best, bx, by, bz = -1.0, 0.0, 0.0, 1.0
    for k in range(3):
        if k == 0:  # rows 0 and 1
            x, y, z = xy * yz - xz * d1, xz * xy - d0 * yz, d0 * d1 - xy * xy
        elif k == 1:  # rows 0 and 2
            x, y, z = xy * d2 - xz * yz, xz * xz - d0 * d2, d0 * yz - xy * xz
        else:  # rows 1 and 2
            x, y, z = d1 * d2 - yz * yz, yz * xz - xy * d2, xy * yz - d1 * xz
        n2 = x * x + y * y + z * z
        if n2 > best:
            best, bx, by, bz = n2, x, y, z
    if best <= 1e-60:
        normal[0], normal[1], normal[2] = 0.0, 0.0, 1.0
    else:
        s = 1.0 / math.sqrt(best)
        normal[0], normal[1], normal[2] = bx * s, by * s, bz * s
    return l1, l2, max(l3, 0.0)
