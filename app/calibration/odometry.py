"""The path of the LiDAR from its scans alone: each scan is registered to the map of the earlier ones.

Between two scans the LiDAR turns and moves at a constant rate, up to unknown accelerations. Each point is compared with
the map where the LiDAR was at its own time, so a scan determines its rates and not only its pose (continuous-time ICP,
Dellenbach et al. 2022, "CT-ICP").
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from app.calibration.excerpt import Excerpt
from app.calibration.guide import Guide
from app.slam import lie
from app.slam.iekf import enough_planes
from app.slam.kernels import motion
from app.slam.kernels.registration import EDGE_ON, REPEATED, RESIDUAL_HUBER
from app.slam.local_map import LocalMap
from app.slam.sections import FilterParams, MapParams
from app.slam.types import F32, F64, Scan

MATCHED = 1000
"""Most points of a scan that are looked up in the map."""
GATES = (4.0, 2.0, 1.0, 1.0, 1.0)
GUIDED_GATES = (2.0, 1.0, 1.0)
"""Of the residuals in each iteration, times the filter's gate; wide at first, since nothing predicts the motion."""
LEAST_PLANES = 30
KNOTS = 11
"""Poses of the LiDAR within a scan; linear in between."""
GYRO = 0.05
"""rad/√s, noise of the turning by gyroscope."""
AROUND_S = 0.15
"""How far the clocks of the sensors may be apart."""
LEAST_CHANGES = (0.05, 0.2)
"""rad/s and m/s²: change of the rate, and acceleration, that is always possible."""
ROT, POS, RATE, VEL = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)


@dataclass(frozen=True, slots=True)
class Track:
    """Poses of the LiDAR at the ends of n scans.

    Attributes:
        times: (n,) s after the end of the first scan. rotations: (n, 3, 3) and positions (n, 3) m, in the world.
        residuals: (n,) m, RMS of point to plane; nan where the scan could not be registered to the map.
        points: of each scan (k, 3) m, in the LiDAR frame at the scan's end.
    """

    times: F64
    rotations: F64
    positions: F64
    residuals: F64
    points: tuple[F32, ...] = ()

    @property
    def residual(self) -> float:
        """m, the median over the scans."""
        return float(np.nanmedian(self.residuals)) if np.isfinite(self.residuals).any() else float("nan")


@dataclass(slots=True)
class _Motion:
    """Pose and rates of the LiDAR: R (3, 3), p (3,) m, rate (3,) rad/s in its own frame, velocity (3,) m/s; and the
    covariance (12, 12) of their errors, rotations on the right."""

    R: F64
    p: F64
    rate: F64
    velocity: F64
    P: F64

    def plus(self, d: F64) -> "_Motion":
        return _Motion(self.R @ lie.exp(d[ROT]), self.p + d[POS], self.rate + d[RATE], self.velocity + d[VEL], self.P)

    def minus(self, other: "_Motion") -> F64:
        return np.concatenate(
            [lie.log(other.R.T @ self.R), self.p - other.p, self.rate - other.rate, self.velocity - other.velocity]
        )


def track(
    excerpt: Excerpt, guide: Guide | None = None, progress: Callable[[float], None] = lambda fraction: None
) -> Track:
    """Register each scan to the local map of the earlier ones.

    Args:
        guide: how the LiDAR turns and sways between two scans; None: at constant rates, up to what the scans show.
    """
    params, mapping = FilterParams(), MapParams()
    local_map = LocalMap(mapping)
    times = excerpt.seconds(excerpt.ends_ns)
    here = _Motion(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), np.diag(np.repeat([1e-8, 1e-8, 1.0, 1.0], 3)))
    rotations, positions, residuals, deskewed = [here.R], [here.p], [float("nan")], [excerpt.scans[0].points]
    local_map.insert(excerpt.scans[0].points, here.p, mapping)
    for k, scan in enumerate(excerpt.scans[1:], 1):
        here = _predicted(here, float(times[k - 1]), float(times[k]), guide, _changes(excerpt, scan.end_ns))
        path = _Path.of(scan, float(times[k]), here.R, guide)
        here, residual = _fitted(scan, here, path, local_map, params)
        if not (np.isfinite(here.p).all() and np.isfinite(here.R).all()):
            raise np.linalg.LinAlgError("the odometry gave no finite pose")
        points = path.deskewed(scan, here)
        world = points @ here.R.T.astype(np.float32) + here.p.astype(np.float32)
        local_map.insert(np.ascontiguousarray(world), here.p, mapping)
        rotations.append(here.R)
        positions.append(here.p)
        residuals.append(residual)
        deskewed.append(points)
        progress(k / (len(excerpt.scans) - 1))
    return Track(times, np.stack(rotations), np.stack(positions), np.array(residuals), tuple(deskewed))


@dataclass(frozen=True, slots=True)
class _Path:
    """Where the LiDAR was within a scan, seen from its pose at the scan's end.

    Attributes:
        back: (KNOTS,) s before the end, <= 0. turned: (KNOTS, 3, 3) R_end_then; None: by the rate. swayed: (KNOTS, 3)
            m beside the motion at constant velocity.
    """

    back: F64
    turned: F64 | None
    swayed: F64

    @classmethod
    def of(cls, scan: Scan, end: float, R: F64, guide: Guide | None) -> "_Path":
        back = np.linspace(-max(scan.offsets_ns.max() * 1e-9, 1e-3), 0.0, KNOTS)
        if guide is None:
            return cls(back, None, np.zeros((KNOTS, 3)))
        return cls(back, guide.turned(end, back), guide.swayed(end, back, R)[0])

    def deskewed(self, scan: Scan, here: _Motion) -> F32:
        """(n, 3) float32 m, all points in the LiDAR frame at the scan's end."""
        rotations = lie.exp(here.rate * self.back[:, None]) if self.turned is None else self.turned
        moved = (here.R.T @ here.velocity) * self.back[:, None] + self.swayed
        knots = np.concatenate([rotations, moved[:, :, None]], axis=2)
        out = np.empty_like(scan.points)
        motion.deskew(scan.points, scan.offsets_ns, self.back[0], self.back, np.ascontiguousarray(knots), out)
        return out


def _changes(excerpt: Excerpt, end_ns: int) -> tuple[float, float]:
    """How fast a scan's rates may change by the IMU (rad/s and m/s², norms, so that its mounting does not matter)."""
    around = np.searchsorted(excerpt.imu.stamps_ns, end_ns + np.array([-AROUND_S - 0.1, AROUND_S]) * 1e9)
    gyro, accel = excerpt.imu.gyro[slice(*around)], excerpt.imu.accel[slice(*around)]
    if len(gyro) < 3:
        return 1.0, 3.0
    turning = float(np.linalg.norm(gyro - gyro.mean(axis=0), axis=1).max())
    moving = float(np.linalg.norm(accel.std(axis=0)))
    return max(turning, LEAST_CHANGES[0]), max(moving, LEAST_CHANGES[1])


def _predicted(last: _Motion, begin: float, end: float, guide: Guide | None, changes: tuple[float, float]) -> _Motion:
    """The motion at `end` s after that at `begin` s, at constant rates or as the guide says.

    Args:
        changes: of the rates, as by `_changes`.
    """
    dt = end - begin
    F, Q = np.eye(12), np.zeros((12, 12))
    F[POS, VEL] = np.eye(3) * dt
    for pose, rate, density in ((ROT, RATE, changes[0] / np.sqrt(dt)), (POS, VEL, changes[1] * np.sqrt(dt))):
        Q[pose, pose], Q[rate, rate] = (np.eye(3) * density**2 * power for power in (dt**3 / 3, dt))
        Q[pose, rate] = Q[rate, pose] = np.eye(3) * density**2 * dt**2 / 2
    velocity, shift = last.velocity, np.zeros(3)
    if guide is None:
        R = last.R @ lie.exp(last.rate * dt)
        F[ROT, RATE] = np.eye(3) * dt
    else:
        back = np.linspace(-dt, 0.0, KNOTS)
        R = last.R @ guide.turned(end, back)[0].T
        ways, speeds = guide.swayed(end, back, R)
        velocity = last.velocity - R @ speeds[0]
        shift = (velocity - last.velocity) * dt - R @ ways[0]
        Q[ROT, :] = Q[:, ROT] = 0.0
        Q[ROT, ROT] = np.eye(3) * GYRO**2 * dt
    F[ROT, ROT] = R.T @ last.R
    return _Motion(R, last.p + last.velocity * dt + shift, last.rate, velocity, F @ last.P @ F.T + Q)


def _fitted(
    scan: Scan, prior: _Motion, path: _Path, local_map: LocalMap, params: FilterParams
) -> tuple[_Motion, float]:
    """The motion given the scan, and its residual: iterated least squares from the prior; nan without planes."""
    here, information = prior, np.linalg.inv(prior.P)
    chosen = slice(None, None, -(-len(scan) // MATCHED))
    ago = (scan.offsets_ns[chosen] * 1e-9 + path.back[0])[:, None]  # <= 0
    residual = float("nan")
    speed = float(np.linalg.norm(prior.velocity))
    for gate in GATES if path.turned is None else GUIDED_GATES:
        points = path.deskewed(scan, here)[chosen].astype(np.float64)
        world = points @ here.R.T + here.p
        good, poor = local_map.planes(np.ascontiguousarray(world), params)
        enough = np.count_nonzero(good.variances >= 0) >= enough_planes(len(points), speed)
        planes = good if enough else poor
        found = np.flatnonzero(planes.variances >= 0)  # nothing was written elsewhere
        at, spread = planes.normals[found], np.sqrt(planes.variances[found])
        off = np.sum(at * (world[found] - planes.centers[found]), axis=1)
        points, normals = points[found], at @ here.R  # in the LiDAR frame
        reach = np.linalg.norm(points, axis=1)
        fits = np.abs(off) < gate * params.gate * np.sqrt(reach)
        fits &= np.abs(np.sum(normals * points, axis=1)) > EDGE_ON * reach
        if np.count_nonzero(fits) < LEAST_PLANES:
            return prior, float("nan")
        rotation = np.cross(points, normals)
        then = ago[found]
        rows = np.hstack([rotation, at, then * rotation, then * at])[fits]
        if path.turned is not None:
            rows[:, RATE] = 0.0
        off, spread = off[fits], spread[fits]
        weight = np.minimum(1.0, RESIDUAL_HUBER * spread / np.maximum(np.abs(off), 1e-9)) / spread**2 / REPEATED
        H = information + rows.T @ (weight[:, None] * rows)
        b = rows.T @ (weight * off) + information @ here.minus(prior)
        step = -np.linalg.solve(H, b)
        here = here.plus(step)
        here.P = np.linalg.inv(H)
        residual = float(np.sqrt(np.mean(off**2)))
        if gate == 1.0 and np.linalg.norm(step[ROT]) < 1e-4 and np.linalg.norm(step[POS]) < 1e-3:
            break
    return here, residual
