"""A simulated LiDAR: each firing has its own time, direction, origin and pose."""

from dataclasses import dataclass, field, replace

import numpy as np

from app.sensors.robosense import (
    BPEARL,
    MAX_RANGE_M,
    MIN_RANGE_M,
    RATED_RANGE_M,
    RATED_REFLECTIVITY,
    Model,
    levers,
    rays,
)
from app.sensors.simulator.imperfections import Unit
from app.sensors.simulator.raycast import Raycaster
from app.sensors.simulator.trajectory import SmoothTrajectory, seconds
from app.slam.types import F32, F64, I64, U16, Scan

P_IMU_LIDAR: F64 = np.array([0.0175, 0.0276, -0.1083])
"""m, position of the LiDAR on H2LID's IMU; their axes are parallel."""

STRAY_LOSS = 0.005
"""Share of firings without a return, independent of the surface."""


@dataclass(frozen=True, slots=True)
class Pattern:
    """The firings of one scan, block by block; all b blocks have equally many firings, n in total.

    Attributes:
        offsets_ns: (n,) time after the scan's start.
        directions, levers: (n, 3) in the LiDAR frame: a point is lever + distance * direction.
        ring: (n,). blocks_ns: (b,) time of each block. block_ns: duration of a block.
        channels: number of lasers, which fire one after another.
    """

    offsets_ns: I64
    directions: F64
    levers: F64
    ring: U16
    blocks_ns: I64
    block_ns: int
    channels: int


def firing_pattern(model: Model = BPEARL, rate_hz: int = 10, every_block: int = 1) -> Pattern:
    """The pattern of an RS-Bpearl, whose levers have the azimuth of their block; only every k-th block fires."""
    elevation, still = np.deg2rad(model.elevations_deg), np.zeros(model.channels)
    pattern = turning(elevation, still, model.firing_offsets_ns, model.block_ns, rate_hz, every_block)
    azimuth = np.repeat(2 * np.pi * rate_hz * 1e-9 * pattern.blocks_ns, model.channels)
    return replace(pattern, levers=levers(azimuth, model.rx, model.rz))


def turning(
    elevation: F64, azimuth: F64, firing_ns: I64, block_ns: int, rate_hz: int, every_block: int,
    radial: float = 0.0, height: float = 0.0,
) -> Pattern:  # fmt: skip
    """The pattern of a head that rotates from azimuth 0 at the scan's start, x towards -y; every k-th block fires.

    elevation, azimuth: (c,) rad by channel; azimuth relative to the head. firing_ns: (c,) time within a block.
    radial, height: m, lever of the lasers.
    """
    blocks_ns = np.arange(0, 1_000_000_000 // rate_hz // block_ns, every_block, dtype=np.int64) * block_ns
    offsets_ns = (blocks_ns[:, None] + firing_ns).ravel()
    head = np.asarray(2 * np.pi * rate_hz * 1e-9 * offsets_ns, np.float64)
    along, up = head + np.tile(azimuth, len(blocks_ns)), np.tile(elevation, len(blocks_ns))
    rings = np.tile(np.argsort(np.argsort(elevation)).astype(np.uint16), len(blocks_ns))
    return Pattern(
        offsets_ns, rays(up, along), levers(head, radial, height), rings, blocks_ns, block_ns, len(elevation)
    )


@dataclass(frozen=True, slots=True)
class Lidar:
    """Attributes:
    R_imu_lidar, p_imu_lidar: its mounting, p in m.
    farthest: m, longest range. rated: (m, reflectivity) at which half of the beams return.
    range_noise: m, spread of a range before rounding to `range_step` (m, 0 = not rounded).
    coordinate_step: m, rounding of x, y, z (0 = none). lossless: whether every beam that hits something returns.
    unit: errors of this scanner; None: no errors.
    """

    R_imu_lidar: F64 = field(default_factory=lambda: np.eye(3))
    p_imu_lidar: F64 = field(default_factory=P_IMU_LIDAR.copy)
    farthest: float = MAX_RANGE_M
    rated: tuple[float, float] = (RATED_RANGE_M, RATED_REFLECTIVITY)
    range_noise: float = 0.005
    range_step: float = BPEARL.range_step
    coordinate_step: float = 0.0
    lossless: bool = False
    unit: Unit | None = None

    def turn(
        self,
        pattern: Pattern,
        scene: Raycaster,
        trajectory: SmoothTrajectory,
        start_s: float,
        epoch_ns: int,
        rng: np.random.Generator,
    ) -> Scan:
        """The firings of one revolution that starts `start_s` after `epoch_ns` (the trajectory's time 0).

        The points are in firing order; intensities are whole numbers, and the true ground labels are included.
        """
        start_ns = round(start_s * 1e9)
        origins, directions = self._rays(pattern, trajectory, start_ns)
        times = seconds(start_ns + pattern.offsets_ns)
        hits = scene.cast(origins, directions, times)

        n = len(directions)
        exact, noise = hits.distance, self.range_noise
        if self.unit is not None:
            self.unit.see_through(hits, scene, origins, directions, times, rng)
            exact, noise = self.unit.ranges(hits, rng), self.unit.sizes.range_noise or noise
        distance = exact + noise * rng.normal(size=n)
        if self.range_step > 0:
            distance = np.rint(distance / self.range_step) * self.range_step
        seen = (distance >= MIN_RANGE_M) & (distance <= self.farthest)
        luck = rng.random(n)
        grain = rng.normal(scale=0.03, size=n)
        if not self.lossless:
            seen &= luck < _detection(hits.distance, hits.incidence, hits.reflectivity, self.rated)
        brightness = 255.0 * hits.reflectivity * (0.35 + 0.65 * hits.incidence) * (1.0 + grain)

        kept = np.flatnonzero(seen)
        points = pattern.levers[kept] + distance[kept, None] * pattern.directions[kept]
        if self.coordinate_step > 0:
            points = np.rint(points / self.coordinate_step) * self.coordinate_step
        offsets_ns = pattern.offsets_ns[kept]
        first_ns = int(offsets_ns.min()) if len(kept) else 0
        return Scan(
            epoch_ns + start_ns + first_ns,
            points.astype(np.float32),
            (offsets_ns - first_ns).astype(np.int32),
            np.clip(np.rint(brightness[kept]), 0, 255).astype(np.float32),
            pattern.ring[kept],
            hits.ground[kept],
        )

    def _rays(self, pattern: Pattern, trajectory: SmoothTrajectory, start_ns: int) -> tuple[F64, F64]:
        """The ray of every firing in the world, from the pose at its own time.

        Poses are computed at both ends of each block and interpolated in between: within 55 us, the motion of a hand
        deviates from a straight line by nanometres.
        """
        if self.unit is not None:
            directions, levers = self.unit.fired(pattern.directions, pattern.levers)
            pattern = replace(pattern, directions=directions, levers=levers)
        begin = start_ns + pattern.blocks_ns
        p0, R0 = trajectory.poses(seconds(begin))
        p1, R1 = trajectory.poses(seconds(begin + pattern.block_ns))
        blocks = len(begin)
        share = ((pattern.offsets_ns.reshape(blocks, -1) - pattern.blocks_ns[:, None]) / pattern.block_ns)[:, :, None]
        directions = (pattern.directions @ self.R_imu_lidar.T).reshape(blocks, -1, 3)
        levers = (pattern.levers @ self.R_imu_lidar.T).reshape(blocks, -1, 3) + self.p_imu_lidar

        # Contiguous, so that numpy multiplies the rows (v^T R^T) by BLAS: seven times as fast.
        first_T = np.ascontiguousarray(R0.transpose(0, 2, 1))
        change_T = np.ascontiguousarray((R1 - R0).transpose(0, 2, 1))

        def at_own_time(vectors: F64) -> F64:
            return np.asarray(vectors @ first_T + share * (vectors @ change_T))

        origins = p0[:, None, :] + share * (p1 - p0)[:, None, :] + at_own_time(levers)
        return origins.reshape(-1, 3), at_own_time(directions).reshape(-1, 3)


def _detection(distance: F64, incidence: F32, reflectivity: F32, rated: tuple[float, float]) -> F64:
    """Probability of a return: the echo, reflectivity * cos(incidence) / distance^2, relative to the rated limit."""
    with np.errstate(divide="ignore"):
        echo = reflectivity * incidence / np.maximum(distance, MIN_RANGE_M) ** 2
        margin = np.log(echo * (rated[0] ** 2 / rated[1]))
    return np.asarray((1.0 - STRAY_LOSS) / (1.0 + np.exp(-np.clip(4.0 * margin, -50.0, 50.0))))
