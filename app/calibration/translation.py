"""The position of the LiDAR on the IMU, gravity and the accelerometer's bias, from how both move.

In windows of a few scans, the IMU's accelerations, integrated twice, must give the LiDAR's positions, except for an
initial position, a velocity and gravity in each window. All unknowns are linear, since the attitudes are already known.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from app.calibration.inertial import SUBSTEPS, Inertial
from app.calibration.odometry import Track
from app.calibration.rotation import CLEARLY, Turned, chained, clustered, windows_of
from app.slam import lie
from app.slam.types import F64, I64

WINDOW = 15
"""Scans of a window."""
BIAS, TILT = 0.3, 0.02
"""m/s²: how large an accelerometer's bias may be, and how much gravity may seem to change from one window to the next
as the odometry drifts."""
WIDEST = np.array([10.0, 10.0, 10.0, BIAS, BIAS, BIAS])
"""Standard deviations of position (m) and bias (m/s²) if nothing determines them."""
HUBER = 1.5
"""Windows whose residuals exceed this many times the usual ones count for less."""


@dataclass(frozen=True, slots=True)
class Moved:
    """How the IMU moves with the LiDAR.

    Attributes:
        p_imu_lidar: (3,) m. bias: (3,) m/s² of the accelerometer. gravity: (3,) m/s² in the world, at the start.
        covariance: (6, 6) of position and bias.
        before, after: (n, 3) m, differences of the LiDAR's positions from those of the IMU: as given, and as fitted.
    """

    p_imu_lidar: F64
    bias: F64
    gravity: F64
    covariance: F64
    before: F64
    after: F64


def fit_translation(track: Track, inertial: Inertial, turned: Turned, given: F64) -> Moved:
    """Least squares over windows, robust against those in which the odometry slipped.

    Args:
        given: (3,) m, the position in use; `before` holds its residuals.
    """
    windows = windows_of(track, WINDOW)
    tau, attitudes, fallen, lever = _integrated(track, inertial, turned, windows)
    w, n = windows.shape
    # rows of each window (w, 3 n, 6): position of the LiDAR, bias; and (w, 3 n, 3): gravity
    design = np.concatenate([attitudes, -lever], axis=3).reshape(w, 3 * n, 6)
    falls = (0.5 * tau[:, :, None, None] ** 2 * np.eye(3)).reshape(w, 3 * n, 3)
    target = (track.positions[windows] - fallen).reshape(w, 3 * n)
    free = np.einsum("wnk,ij->wnikj", np.stack([np.ones_like(tau), tau], axis=2), np.eye(3)).reshape(w, 3 * n, 6)
    q, _ = np.linalg.qr(free)

    def rest(a: F64) -> F64:
        """The part that an initial position and a velocity cannot explain."""
        return np.asarray(a - q @ (np.swapaxes(q, 1, 2) @ a))

    design, falls, target = rest(design), rest(falls), rest(target[:, :, None])[:, :, 0]
    weights, sigma = np.ones(w), 0.01
    for _ in range(10):
        x, g = _solved(design, falls, target, weights / sigma)
        off = target - design @ x - np.einsum("wmj,wj->wm", falls, g)
        size = np.sqrt(np.mean(off**2, axis=1))
        sigma = float(np.median(size)) + 1e-6
        weights = np.minimum(1.0, HUBER * sigma / np.maximum(size, 1e-9))
    p, _ = np.linalg.qr(falls)
    alone = (design - p @ (np.swapaxes(p, 1, 2) @ design)) * weights[:, None, None]
    covariance = clustered(alone, off * weights[:, None], WIDEST)
    target = target - design[:, :, :3] @ given
    bias, falling = _solved(design[:, :, 3:], falls, target, weights / sigma)
    before = target - design[:, :, 3:] @ bias - np.einsum("wmj,wj->wm", falls, falling)
    return Moved(x[:3], x[3:], g[0], covariance, before.reshape(-1, 3), off.reshape(-1, 3))


def is_opposed(track: Track, inertial: Inertial, turned: Turned, moved: Moved) -> bool:
    """Whether the accelerations fit the LiDAR's motion far better with the opposite sign.

    Some drivers send gravity, which points down. An accelerometer measures the opposite.
    """
    opposite = fit_translation(track, replace(inertial, accel=-inertial.accel), turned, np.zeros(3))
    off, right = (np.median(np.linalg.norm(fit.after, axis=1)) for fit in (opposite, moved))
    return bool(off < CLEARLY * right)


def _solved(design: F64, falls: F64, target: F64, weights: F64) -> tuple[F64, F64]:
    """Common unknowns, and gravity (w, 3) of each window, which changes little from one to the next."""
    w, m, k = design.shape
    each = weights[:, None, None]
    rows = np.vstack(
        [
            np.hstack([(design * each).reshape(w * m, k), block_diag(*(falls * each))]),
            np.hstack([np.zeros((3 * (w - 1), k)), np.kron(np.diff(np.eye(w), axis=0), np.eye(3)) / TILT]),
            np.eye(3, k + 3 * w, k - 3) / BIAS,
        ]
    )
    values = np.append(target * weights[:, None], np.zeros(3 * w))
    x = np.linalg.lstsq(rows, values, rcond=None)[0]
    return np.asarray(x[:k]), np.asarray(x[k:].reshape(w, 3))


def _integrated(track: Track, inertial: Inertial, turned: Turned, windows: I64) -> tuple[F64, F64, F64, F64]:
    """For each scan of each window: s since its start (w, n), attitude of the IMU (w, n, 3, 3), displacement by its
    forces (w, n, 3) m, and the change of this per bias (w, n, 3, 3)."""
    w, n = windows.shape
    times = track.times[windows]
    seen = track.rotations[windows] @ turned.R_imu_lidar.T
    attitudes = chained(seen[:, 0], inertial.turns(track.times, turned.late, turned.bias), windows)
    off = lie.log(seen @ np.swapaxes(attitudes, 2, 3)).mean(axis=1)
    attitudes = lie.exp(off)[:, None] @ attitudes

    way, speed = np.zeros((w, 3)), np.zeros((w, 3))
    lever, leverage = np.zeros((w, 3, 3)), np.zeros((w, 3, 3))
    ways, levers = np.zeros((w, n, 3)), np.zeros((w, n, 3, 3))
    for k in range(1, n):
        h = ((times[:, k] - times[:, k - 1]) / SUBSTEPS)[:, None]
        R = attitudes[:, k - 1]
        for step in range(SUBSTEPS):
            at = times[:, k - 1] + (step + 0.5) * h[:, 0] - turned.late
            half = lie.exp((inertial.rates(at) - turned.bias) * h / 2)
            R = R @ half
            force = (R @ inertial.forces(at)[:, :, None])[:, :, 0]
            way = way + speed * h + 0.5 * force * h**2
            speed = speed + force * h
            lever = lever + leverage * h[:, :, None] + 0.5 * R * h[:, :, None] ** 2
            leverage = leverage + R * h[:, :, None]
            R = R @ half
        ways[:, k], levers[:, k] = way, lever
    return times - times[:, :1], attitudes, ways, levers
