"""Operations on the filter's state (SO(3), R3, S²), one element at a time, and its Gauss-Newton step.

`app.slam.lie` has the batched form of the same formulas. A state is packed into one vector of SIZE
numbers: R (9, by rows), p, v, b_gyro, b_accel, g (3 each), R_imu_lidar (9), p_imu_lidar (3).
"""

import math

import numpy as np
from numba import njit

from app.slam.kernels.small import across, copy, cross, rotation


@njit(cache=True)
def exp(v):
    """Exponential map so(3) -> SO(3): (3,) rad to (3, 3) f64."""
    R = np.empty((3, 3))
    rotation(v[0], v[1], v[2], R)
    return R


@njit(cache=True)
def log(R):
    """Logarithm SO(3) -> so(3): (3, 3) to (3,) rad, for angles up to pi (near pi to 1e-8, from R + R^T)."""
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
        axis[k] = 0.5 * (R[i, k] + R[k, i]) + (1.0 if k == i else 0.0)
    n = math.sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2])
    sign = 1.0 if axis[0] * v[0] + axis[1] * v[1] + axis[2] * v[2] >= 0.0 else -1.0
    return (sign * angle / n) * axis


@njit(cache=True)
def right_jacobian_inverse(v):
    """Inverse right Jacobian of SO(3): (3,) rad to (3, 3), for angles below 2 pi."""
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
    """(3, 2) orthonormal basis of the plane across g (3,), by `across`.

    It must not jump near the vertical, where gravity is: the covariance is expressed in it.
    """
    n = math.sqrt(g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    B = np.empty((3, 2))
    B[0, 0], B[1, 0], B[2, 0], B[0, 1], B[1, 1], B[2, 1] = across(g[0] / n, g[1] / n, g[2] / n)
    return B


@njit(cache=True)
def turn(a, b):
    """Rotation vector (3,) of the smallest rotation from direction a to direction b."""
    axis = np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
    s = math.sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2])
    if s == 0.0:
        return axis
    return (math.atan2(s, a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) / s) * axis


SIZE = 36


@njit(cache=True)
def boxplus(x, d, out):
    """out = x [+] d, for packed states (SIZE,) and an error d (23,)."""
    np.dot(x[0:9].reshape(3, 3), exp(d[0:3]), out[0:9].reshape(3, 3))
    np.add(x[9:21], d[3:15], out[9:21])
    g = x[21:24]
    np.dot(exp(tangent_basis(g) @ d[15:17]), g, out[21:24])
    np.dot(x[24:33].reshape(3, 3), exp(d[17:20]), out[24:33].reshape(3, 3))
    np.add(x[33:36], d[20:23], out[33:36])


@njit(cache=True)
def boxminus(a, b, d):
    """d (23,) with b [+] d = a, for packed states (SIZE,)."""
    copy(log(b[0:9].reshape(3, 3).T @ a[0:9].reshape(3, 3)), d[0:3])
    np.subtract(a[9:21], b[9:21], d[3:15])
    np.dot(tangent_basis(b[21:24]).T, turn(b[21:24], a[21:24]), d[15:17])
    copy(log(b[24:33].reshape(3, 3).T @ a[24:33].reshape(3, 3)), d[17:20])
    np.subtract(a[33:36], b[33:36], d[20:23])


@njit(cache=True)
def gauss_newton(x, prior, information, H, b, covariance, step, out):
    """One step of eq. 7: minimise |x [-] prior|²_P + sum |z + H d|²_R, linearised at x.

    x, prior (SIZE,) f64: packed states. information (n, n): inverse prior covariance of the first n error
    dimensions (17 without the extrinsics, 23 with them). H (6, 6), b (6,): normal equations of the points over
    rotation and position, from which those over the extrinsics follow. Out: covariance (n, n), step (23,), the new
    state out (SIZE,).
    """
    n = len(information)
    d = np.empty(23)
    boxminus(x, prior, d)
    J = np.eye(n)
    copy(right_jacobian_inverse(d[0:3]), J[0:3, 0:3])
    copy(tangent_basis(prior[21:24]).T @ tangent_basis(x[21:24]), J[15:17, 15:17])
    if n > 17:
        copy(right_jacobian_inverse(d[17:20]), J[17:20, 17:20])
    to_pose = np.eye(6, n)
    if n > 17:  # an error of the extrinsics moves the points as an error of the pose does
        R, R_il = x[0:9].reshape(3, 3), x[24:33].reshape(3, 3)
        copy(R_il, to_pose[0:3, 17:20])
        copy(R, to_pose[3:6, 20:23])
        lever = np.empty(3)
        for i in range(3):
            cross(x[33:36], R_il[:, i], lever)
            copy(R @ lever, to_pose[3:6, 17 + i])
    A = J.T @ information @ J + to_pose.T @ H @ to_pose
    r = J.T @ (information @ d[:n]) + to_pose.T @ b
    inverse = np.linalg.inv(A)
    np.multiply(0.5, inverse + inverse.T, covariance)
    step[n:] = 0.0
    np.negative(covariance @ r, step[:n])
    boxplus(x, step, out)
