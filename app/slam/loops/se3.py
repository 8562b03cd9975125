"""Exponential, logarithm and adjoint of SE(3), many at once (Barfoot 2017): rotation vector, then translation."""

import numpy as np

from app.slam import lie
from app.slam.types import F64

_SMALL = 1e-8
"""Squared angle below which series replace the closed forms."""


def exp(v: F64) -> F64:
    """(..., 6), rad and m, to (..., 4, 4)."""
    v = np.asarray(v, dtype=np.float64)
    t2 = np.sum(v[..., :3] ** 2, axis=-1)[..., None, None]
    small = t2 < _SMALL
    safe = np.where(small, 1.0, t2)
    t = np.sqrt(safe)
    b = np.where(small, 0.5 - t2 / 24.0, (1.0 - np.cos(t)) / safe)
    c = np.where(small, 1.0 / 6.0 - t2 / 120.0, (t - np.sin(t)) / (safe * t))
    K = lie.hat(v[..., :3])
    V = np.eye(3) + b * K + c * (K @ K)
    out = np.zeros((*v.shape[:-1], 4, 4))
    out[..., :3, :3] = lie.exp(v[..., :3])
    out[..., :3, 3] = (V @ v[..., 3:, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def log(T: F64) -> F64:
    """(..., 4, 4) to (..., 6), rad and m; the angle is in [0, pi]."""
    w = lie.log(T[..., :3, :3])
    t2 = np.sum(w**2, axis=-1)[..., None, None]
    small = t2 < _SMALL
    safe = np.where(small, 1.0, t2)
    t = np.sqrt(safe)
    a = np.where(small, 1.0 / 12.0 + t2 / 720.0, 1.0 / safe - 0.5 / (t * np.tan(t / 2)))
    K = lie.hat(w)
    V_inverse = np.eye(3) - 0.5 * K + a * (K @ K)
    return np.concatenate([w, (V_inverse @ T[..., :3, 3:])[..., 0]], axis=-1)


def adjoint(T: F64) -> F64:
    """(..., 4, 4) to (..., 6, 6): exp(adjoint(T) @ v) @ T is T @ exp(v)."""
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., 3:, :3] = lie.hat(T[..., :3, 3]) @ R
    return out
