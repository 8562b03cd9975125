"""SO(3) and SE(3) helpers on plain arrays.

Rotations are (..., 3, 3) matrices; tangent vectors are (..., 3), in radians. Perturbations act on
the right: `R = R_hat @ exp(d)`, so that `d` is expressed in the body frame (Solà et al. 2018,
"A micro Lie theory"). Near zero the Taylor expansions are written out.
"""

from typing import Any

import numpy as np

from app.slam.arrays import F64
from app.slam.kernels import small

_SMALL = 1e-8
"""Squared angle below which series replace the closed forms (their error is under 1e-16 there)."""


def hat(v: F64) -> F64:
    """(..., 3) vector to the (..., 3, 3) skew matrix with hat(v) @ u = v x u."""
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def exp(v: F64) -> F64:
    """Exponential map so(3) -> SO(3) (Rodrigues). v: (..., 3) rad; returns (..., 3, 3)."""
    v = np.asarray(v, dtype=np.float64)
    t2 = np.sum(v * v, axis=-1)[..., None, None]
    small = t2 < _SMALL
    safe = np.where(small, 1.0, t2)
    t = np.sqrt(safe)
    a = np.where(small, 1.0 - t2 / 6.0, np.sin(t) / t)
    b = np.where(small, 0.5 - t2 / 24.0, (1.0 - np.cos(t)) / safe)
    K = hat(v)
    return np.eye(3) + a * K + b * (K @ K)


def log(R: F64) -> F64:
    """Logarithm SO(3) -> so(3), angle in [0, pi]. R: (..., 3, 3); returns (..., 3) rad."""
    R = np.asarray(R, dtype=np.float64)
    q = quaternion(R)
    n = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(n, q[..., 3:])
    scale = np.where(
        n < 1e-9, 2.0 / np.where(np.abs(q[..., 3:]) < 0.5, 1.0, q[..., 3:]), angle / np.where(n < 1e-9, 1.0, n)
    )
    return np.asarray(q[..., :3] * scale)


def quaternion(R: F64) -> F64:
    """(..., 3, 3) rotations to (..., 4) unit quaternions x, y, z, w with w >= 0 (Shepperd's method)."""
    matrices = np.array(R, dtype=np.float64).reshape(-1, 3, 3)  # a copy, so that all callers share one kernel
    out = np.empty((len(matrices), 4))
    small.quaternions(matrices, out)
    return out.reshape(*np.shape(R)[:-2], 4)


def matrix(q: F64) -> F64:
    """(..., 4) quaternions x, y, z, w (of any length but zero) to (..., 3, 3) rotations."""
    q = np.asarray(q, dtype=np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def between(a: F64, b: F64) -> F64:
    """The smallest rotation that turns the direction of `a` (3,) into that of `b` (3,)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-12:  # parallel or opposite: any axis across `a` will do
        axis = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
    axis -= (axis @ a) * a  # remove what rounding left along `a`
    return exp(np.arctan2(sine, cosine) * axis / np.linalg.norm(axis))


def from_rpy_degrees(rpy: tuple[float, float, float]) -> F64:
    """Roll, pitch, yaw in degrees to R = Rz(yaw) Ry(pitch) Rx(roll)."""
    r, p, y = np.radians(rpy)
    return exp(np.array([0.0, 0.0, y])) @ exp(np.array([0.0, p, 0.0])) @ exp(np.array([r, 0.0, 0.0]))


def rpy_degrees(R: F64) -> tuple[float, float, float]:
    """Roll, pitch, yaw in degrees of a rotation (3, 3); the inverse of `from_rpy_degrees`."""
    pitch = np.arcsin(np.clip(-R[2, 0], -1.0, 1.0))
    angles = np.degrees([np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])])
    return float(angles[0]), float(angles[1]), float(angles[2])


def transform(R: F64, p: F64) -> F64:
    """(3, 3) and (3,) to the (4, 4) homogeneous matrix."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = p
    return T


def moved(T: F64, points: Any) -> Any:
    """(3,) or (n, 3) points of one frame in another, by the (3 or 4, 4) transform between them."""
    return points @ T[:3, :3].T + T[:3, 3]


def inverse(T: F64) -> F64:
    """Inverse of (..., 4, 4) rigid transforms, without a general solve."""
    out = np.zeros_like(T)
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = R
    out[..., :3, 3] = -(R @ T[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def exp_se3(v: F64) -> F64:
    """Exponential map of SE(3), rotation vector then translation. v: (..., 6) rad and m; returns (..., 4, 4)."""
    v = np.asarray(v, dtype=np.float64)
    t2 = np.sum(v[..., :3] ** 2, axis=-1)[..., None, None]
    small = t2 < _SMALL
    safe = np.where(small, 1.0, t2)
    t = np.sqrt(safe)
    b = np.where(small, 0.5 - t2 / 24.0, (1.0 - np.cos(t)) / safe)
    c = np.where(small, 1.0 / 6.0 - t2 / 120.0, (t - np.sin(t)) / (safe * t))
    K = hat(v[..., :3])
    V = np.eye(3) + b * K + c * (K @ K)
    out = np.zeros((*v.shape[:-1], 4, 4))
    out[..., :3, :3] = exp(v[..., :3])
    out[..., :3, 3] = (V @ v[..., 3:, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def log_se3(T: F64) -> F64:
    """Logarithm of SE(3), angle in [0, pi]. T: (..., 4, 4); returns (..., 6) rad and m, rotation first."""
    w = log(T[..., :3, :3])
    t2 = np.sum(w**2, axis=-1)[..., None, None]
    small = t2 < _SMALL
    safe = np.where(small, 1.0, t2)
    t = np.sqrt(safe)
    a = np.where(small, 1.0 / 12.0 + t2 / 720.0, 1.0 / safe - 0.5 / (t * np.tan(t / 2)))
    K = hat(w)
    V_inverse = np.eye(3) - 0.5 * K + a * (K @ K)
    return np.concatenate([w, (V_inverse @ T[..., :3, 3:])[..., 0]], axis=-1)


def adjoint(T: F64) -> F64:
    """(..., 4, 4) to (..., 6, 6): exp_se3(adjoint(T) @ v) @ T is T @ exp_se3(v) (Barfoot 2017)."""
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., 3:, :3] = hat(T[..., :3, 3]) @ R
    return out
