"""Single-element SO(3) and S² operations, and the Gauss-Newton step of the filter's update.

The same formulas as `app.slam.lie`, which is the batched, readable form that tests hold these to.
"""

import math

import numpy as np
from numba import njit

from app.slam.kernels.small import rotation


@njit(cache=True)
def exp(v):
    """(3,) rad to (3, 3)."""
    R = np.empty((3, 3))
    rotation(v[0], v[1], v[2], R)
    return R


@njit(cache=True)
def log(R):
    """(3, 3) to (3,) rad, for angles up to pi (near pi to 1e-8, as its axis then comes from R + R^T)."""
    v = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    s = 0.5 * math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    c = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    angle = math.atan2(s, c)
    if angle < 1e-4:
        return 0.5 * (1.0 + angle * angle / 6.0) * v
    if s > 1e-6:
        return (0.5 * angle / s) * v
    i = 0
    for k in range(1, 3):
        if R[k, k] > R[i, i]:
            i = k
    axis = np.empty(3)
    for k in range(3):
        axis[k] = R[i, k] + (1.0 if k == i else 0.0)
    n = math.sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2])
    sign = 1.0 if axis[0] * v[0] + axis[1] * v[1] + axis[2] * v[2] >= 0.0 else -1.0
    return (sign * angle / n) * axis


@njit(cache=True)
def right_jacobian_inverse(v):
    """(3,) rad to (3, 3)."""
    t2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if t2 < 1e-8:
        k = 1.0 / 12.0
    else:
        t = math.sqrt(t2)
        k = 1.0 / t2 - (1.0 + math.cos(t)) / (2.0 * t * math.sin(t))
    J = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            J[i, j] = k * v[i] * v[j]
        J[i, i] += 1.0 - k * t2
    J[0, 1] -= 0.5 * v[2]
    J[0, 2] += 0.5 * v[1]
    J[1, 0] += 0.5 * v[2]
    J[1, 2] -= 0.5 * v[0]
    J[2, 0] -= 0.5 * v[1]
    J[2, 1] += 0.5 * v[0]
    return J


@njit(cache=True)
def tangent_basis(g):
    """(3, 2) orthonormal basis of the plane across g (3,)."""
    n = math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    ux, uy, uz = g[0] / n, g[1] / n, g[2] / n
    ax, ay, az = abs(ux), abs(uy), abs(uz)
    if ax <= ay and ax <= az:  # u x e for the axis e that is least along u
        bx, by, bz = 0.0, uz, -uy
    elif ay <= az:
        bx, by, bz = -uz, 0.0, ux
    else:
        bx, by, bz = uy, -ux, 0.0
    s = 1.0 / math.sqrt(bx * bx + by * by + bz * bz)
    bx, by, bz = bx * s, by * s, bz * s
    B = np.empty((3, 2))
    B[0, 0], B[1, 0], B[2, 0] = bx, by, bz
    B[0, 1], B[1, 1], B[2, 1] = uy * bz - uz * by, uz * bx - ux * bz, ux * by - uy * bx
    return B


@njit(cache=True)
def turn(a, b):
    """Rotation vector (3,) of the smallest rotation from direction a to direction b."""
    axis = np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
    s = math.sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2])
    if s == 0.0:
        return axis
    return (math.atan2(s, a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) / s) * axis
