"""The rotation of the LiDAR on the IMU, the offset of their clocks, and the gyroscope's bias, from how both turn."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from app.calibration.inertial import Inertial
from app.calibration.odometry import Track
from app.slam import lie
from app.slam.types import F64, I64

LATEST_S, STEP_S = 0.5, 0.01
"""Clock offsets that are tried."""
FAR = np.radians(1.5)
"""If the turns between two scans differ by more, this is taken as an error of the odometry."""
WIDEST = np.array([3.0, 3.0, 3.0, 1.0, 1.0, 1.0, 1.0])
"""Standard deviations of rotation (rad), offset (s) and bias (rad/s) if nothing determines them."""
STEPS, SLIPPED = 20, 3.0
"""Most steps of the fit; windows whose differences exceed this many times the usual ones are errors of the odometry."""
CLEARLY = 0.5
"""A sensor's sign counts as wrong if the other one reduces the difference from the LiDAR's motion to less than this
share."""
WINDOW = 10
"""Scans over which attitudes are compared: a second. The gyroscope's noise grows with it, the odometry's does not."""


@dataclass(frozen=True, slots=True)
class Turned:
    """How the IMU turns with the LiDAR.

    Attributes:
        R_imu_lidar: (3, 3). late: s, to be added to the IMU's stamps. bias: (3,) rad/s of the gyroscope.
        covariance: (7, 7) of rotation (rad, LiDAR frame), `late`, and bias.
        before, after: (n, 3) rad, differences between the LiDAR's turns and the IMU's as given, and as
            fitted; attitudes within windows of a second.
    """

    R_imu_lidar: F64
    late: float
    bias: F64
    covariance: F64
    before: F64
    after: F64


def find_offset(track: Track, inertial: Inertial) -> float:
    """s, to be added to the IMU's stamps so that both turn by the same angles; their axes do not matter."""
    angles = np.linalg.norm(lie.log(_turns(track)), axis=1)

    def cost(late: float) -> float:
        there = np.linalg.norm(lie.log(inertial.turns(track.times, late, np.zeros(3))), axis=1)
        return float(np.mean(np.minimum(np.abs(there - angles), FAR)))

    offsets = np.arange(-LATEST_S, LATEST_S + STEP_S / 2, STEP_S)
    costs = np.array([cost(late) for late in offsets])
    best = int(np.clip(np.argmin(costs), 1, len(offsets) - 2))
    left, here, right = costs[best - 1 : best + 2]
    bend = left - 2 * here + right
    return float(offsets[best] + (STEP_S * 0.5 * (left - right) / bend if bend > 0 else 0.0))


def first_rotation(track: Track, inertial: Inertial, late: float) -> F64:
    """R_imu_lidar (3, 3) that turns the LiDAR's rotation vectors onto the IMU's (Wahba 1965), without a guess."""
    return _aligned(*_vectors(track, inertial, late))


def is_mirrored(track: Track, inertial: Inertial, late: float) -> bool:
    """Whether the IMU's turns are the mirror image of the LiDAR's, which no mounting explains."""
    ours, theirs = _vectors(track, inertial, late)
    right, mirrored = (
        np.median(np.linalg.norm(signed - ours @ _aligned(ours, signed).T, axis=1)) for signed in (theirs, -theirs)
    )
    return bool(mirrored < CLEARLY * right)


def _vectors(track: Track, inertial: Inertial, late: float) -> tuple[F64, F64]:
    """(n, 3) rotation vectors from scan to scan, of the LiDAR and of the IMU."""
    return lie.log(_turns(track)), lie.log(inertial.turns(track.times, late, np.zeros(3)))


def _aligned(ours: F64, theirs: F64) -> F64:
    fits = np.abs(np.linalg.norm(ours, axis=1) - np.linalg.norm(theirs, axis=1)) < FAR
    weights = fits.astype(np.float64)
    R = np.eye(3)
    for _ in range(20):
        u, _, vt = np.linalg.svd((theirs * weights[:, None]).T @ ours)
        R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        off = np.linalg.norm(theirs - ours @ R.T, axis=1)
        scale = max(1.5 * float(np.median(off[fits])) if fits.any() else 0.0, 1e-4)
        weights = fits / (1.0 + (off / scale) ** 2)
    return R


def fit_rotation(track: Track, inertial: Inertial, R: F64, late: float, given: F64) -> Turned:
    """Refine a rotation and an offset by least squares over windows, each with an attitude of its own.

    Args:
        given: (3, 3), the rotation in use; `before` holds its residuals.
    """
    windows = windows_of(track, WINDOW)

    def differences(x: F64) -> F64:
        return _differences(track, inertial, R @ lie.exp(x[:3]), late + x[3], x[4:7], windows)

    x, off = np.zeros(7), differences(np.zeros(7))
    kept = np.ones(len(windows), np.bool_)

    def differences_kept(x: F64) -> F64:
        return differences(x)[kept]

    for _ in range(STEPS):
        size = np.sqrt(np.mean(np.sum(off**2, axis=2), axis=1))
        kept = size < SLIPPED * np.median(size) + 1e-9
        spread = 1.48 * np.median(np.abs(off[kept])) + 1e-9
        root = (1.0 + (off[kept].ravel() / spread) ** 2) ** -0.25  # Barron's "soft L1"
        J = _jacobian(differences_kept, x).reshape(-1, 7)
        rows = np.vstack([J * root[:, None], np.diag(spread / WIDEST)])  # else undetermined values would diverge
        step = np.linalg.lstsq(rows, -np.append(off[kept].ravel() * root, spread / WIDEST * x), rcond=None)[0]
        x = x + step
        off = differences(x)
        if np.abs(step).max() < 1e-6:
            break
    J = _jacobian(differences_kept, x)
    covariance = clustered(J, off[kept].reshape(np.count_nonzero(kept), -1), WIDEST)
    before = _differences(track, inertial, given, 0.0, np.zeros(3), windows)
    return Turned(R @ lie.exp(x[:3]), late + float(x[3]), x[4:7], covariance, before.reshape(-1, 3), off.reshape(-1, 3))


def clustered(J: F64, residuals: F64, widest: F64) -> F64:
    """Covariance (p, p) of a least-squares fit whose residuals (w, m) are independent between, not within, w windows.

    J: (w, m, p). widest: (p,) standard deviations of unobserved values. The result is the larger of two estimates: with
    equal noise everywhere, and by how the windows disagree (Liang & Zeger 1986, the sandwich estimator).
    """
    variance = float(np.sum(residuals**2)) / max(residuals.size - J.shape[2], 1) + 1e-18
    plain = np.linalg.inv(np.einsum("wmp,wmq->pq", J, J) / variance + np.diag(widest**-2.0))
    votes = np.einsum("wmp,wm->wp", J, residuals) / variance
    sandwich = plain @ (votes.T @ votes) @ plain
    scale = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(plain), 1.0))
    return np.asarray(plain * np.outer(scale, scale))


def _jacobian(function: Callable[[F64], F64], x: F64) -> F64:
    """(w, m, p) by central differences of a function of (p,) that gives (w, k, 3)."""
    columns = [(function(x + step) - function(x - step)) / 2e-5 for step in 1e-5 * np.eye(len(x))]
    stacked = np.stack(columns, axis=-1)
    return np.asarray(stacked.reshape(stacked.shape[0], -1, len(x)))


def _turns(track: Track) -> F64:
    return np.swapaxes(track.rotations[:-1], 1, 2) @ track.rotations[1:]


def windows_of(track: Track, length: int) -> I64:
    """(w, length) indices of scans; windows with a longer pause between two of them are left out."""
    count = (len(track.times) - 1) // length
    windows = np.arange(count * length).reshape(count, length) + 1
    lasting = track.times[windows[:, -1]] - track.times[windows[:, 0]]
    return windows[lasting < 1.5 * np.median(lasting)]


def chained(first: F64, turns: F64, windows: I64) -> F64:
    """(w, n, 3, 3) attitudes at the scans of each window, from the first (w, 3, 3) on by turns from scan to scan."""
    attitudes = np.empty((*windows.shape, 3, 3))
    attitudes[:, 0] = first
    for k in range(1, windows.shape[1]):
        attitudes[:, k] = attitudes[:, k - 1] @ turns[windows[:, k] - 1]
    return attitudes


def _differences(track: Track, inertial: Inertial, R: F64, late: float, bias: F64, windows: I64) -> F64:
    """(w, WINDOW, 3) rad, world: attitudes by scans against those by gyroscope, less the mean of each window."""
    ours = track.rotations[windows]
    theirs = chained(ours[:, 0], R.T @ inertial.turns(track.times, late, bias) @ R, windows)
    off = lie.log(ours @ np.swapaxes(theirs, 2, 3))
    return np.asarray(off - off.mean(axis=1, keepdims=True))
