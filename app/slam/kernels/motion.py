"""Propagation through IMU samples and deskew by backward propagation."""

import math

import numpy as np
from numba import njit

from app.slam.kernels.small import copy, cross, rotation


@njit(cache=True)
def propagate(times, gyro, accel, bridged, coasting, max_step, R, p, v, bg, ba, g, B, P, noise, knot_t, knot_T):
    """Integrate the kinematics from times[0] to times[-1]; R, p, v and P are updated in place.

    times (k,) s ascending; gyro (k, 3) rad/s and accel (k, 3) m/s² at those times, linear in between; bg, ba, g (3,):
    biases and gravity; B (3, 2): tangent basis of gravity. noise (5,): densities of gyro, accel, gyro bias, accel bias,
    and of accel in intervals that are `bridged` (k - 1,) bool. In intervals that are `coasting` (k - 1,) bool the
    velocity is constant. In and out: R (3, 3), p (3,) m, v (3,) m/s, P (23, 23) in the order of `app.slam.imu`.
    Out: knots, times knot_t (m,) s and poses knot_T (m, 3, 4), at most `max_step` s apart. Returns their number.
    """
    d = P.shape[0]
    F = np.zeros((9, d))  # rows of rotation, position and velocity; the other states stay
    dR = np.empty((3, 3))
    Rm = np.empty((3, 3))
    Rn = np.empty((3, 3))
    w = np.empty(3)
    a = np.empty(3)
    aw = np.empty(3)
    n = 0
    knot_t[0] = times[0]
    for i in range(3):
        for j in range(3):
            knot_T[0, i, j] = R[i, j]
        knot_T[0, i, 3] = p[i]
    n = 1
    for s in range(len(times) - 1):
        dt = times[s + 1] - times[s]
        if dt <= 0.0:
            continue
        # covariance: one step per sample interval, linearised at its start with its mean rates
        for i in range(3):
            w[i] = 0.5 * (gyro[s, i] + gyro[s + 1, i]) - bg[i]
            a[i] = 0.5 * (accel[s, i] + accel[s + 1, i]) - ba[i]
        F[:] = 0.0
        rotation(-w[0] * dt, -w[1] * dt, -w[2] * dt, dR)
        rotation(0.5 * w[0] * dt, 0.5 * w[1] * dt, 0.5 * w[2] * dt, Rm)
        np.dot(R, Rm, Rn)
        for i in range(3):
            for j in range(3):
                F[i, j] = dR[i, j]
                F[6 + i, 12 + j] = -Rn[i, j] * dt
            F[i, 9 + i] = -dt
            F[3 + i, 3 + i] = F[6 + i, 6 + i] = 1.0
            F[3 + i, 6 + i] = dt
            # -R [a]x dt, columns
            F[6 + i, 0] = -(Rn[i, 1] * a[2] - Rn[i, 2] * a[1]) * dt
            F[6 + i, 1] = -(Rn[i, 2] * a[0] - Rn[i, 0] * a[2]) * dt
            F[6 + i, 2] = -(Rn[i, 0] * a[1] - Rn[i, 1] * a[0]) * dt
        for j in range(2):
            cross(B[:, j], g, aw)  # -[g]x b = b x g
            for i in range(3):
                F[6 + i, 15 + j] = aw[i] * dt
        copy(F @ P, P[:9])
        copy(P @ F.T, P[:, :9])
        ng, na = noise[0], noise[4] if bridged[s] else noise[1]
        for i in range(3):
            P[i, i] += ng * ng * dt
            P[6 + i, 6 + i] += na * na * dt
            P[3 + i, 3 + i] += na * na * dt * dt * dt / 3.0
            P[3 + i, 6 + i] += na * na * dt * dt / 2.0
            P[6 + i, 3 + i] += na * na * dt * dt / 2.0
            P[9 + i, 9 + i] += noise[2] * noise[2] * dt
            P[12 + i, 12 + i] += noise[3] * noise[3] * dt
        # mean: midpoint rule on sub-steps, so that knots are close enough to interpolate linearly
        steps = max(1, math.ceil(dt / max_step - 1e-9))
        h = dt / steps
        for k in range(steps):
            u = (k + 0.5) / steps
            for i in range(3):
                w[i] = (1.0 - u) * gyro[s, i] + u * gyro[s + 1, i] - bg[i]
                a[i] = (1.0 - u) * accel[s, i] + u * accel[s + 1, i] - ba[i]
            if coasting[s]:  # the specific force that keeps the velocity
                for i in range(3):
                    a[i] = -(R[0, i] * g[0] + R[1, i] * g[1] + R[2, i] * g[2])
            rotation(0.5 * w[0] * h, 0.5 * w[1] * h, 0.5 * w[2] * h, dR)
            np.dot(R, dR, Rm)
            np.dot(Rm, dR, R)
            for i in range(3):
                aw[i] = Rm[i, 0] * a[0] + Rm[i, 1] * a[1] + Rm[i, 2] * a[2] + g[i]
                p[i] += v[i] * h + 0.5 * aw[i] * h * h
                v[i] += aw[i] * h
            if n < len(knot_t):
                knot_t[n] = times[s] + (k + 1) * h
                for i in range(3):
                    for j in range(3):
                        knot_T[n, i, j] = R[i, j]
                    knot_T[n, i, 3] = p[i]
                n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def deskew(points, offsets_ns, shift, knot_t, knot_T, out):
    """Move each point by the pose at its time: out_j = knot(offsets_ns_j * 1e-9 + shift) points_j.

    points (n, 3) f32; offsets_ns (n,) i32; knot_t (m,) f64 s ascending, m >= 2; knot_T (m, 3, 4) f64
    relative poses, interpolated linearly (under 3 ms apart: error under 1e-5 rad at 2 rad/s).
    """
    last = len(knot_t) - 2
    k = 0
    for j in range(len(points)):
        t = offsets_ns[j] * 1e-9 + shift
        while k < last and knot_t[k + 1] <= t:  # neighbours in the scan are neighbours in time
            k += 1
        while k > 0 and knot_t[k] > t:
            k -= 1
        u = (t - knot_t[k]) / (knot_t[k + 1] - knot_t[k])
        x, y, z = points[j, 0], points[j, 1], points[j, 2]
        for i in range(3):
            a = knot_T[k, i, 0] * x + knot_T[k, i, 1] * y + knot_T[k, i, 2] * z + knot_T[k, i, 3]
            b = knot_T[k + 1, i, 0] * x + knot_T[k + 1, i, 1] * y + knot_T[k + 1, i, 2] * z + knot_T[k + 1, i, 3]
            out[j, i] = a + u * (b - a)
