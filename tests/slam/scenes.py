"""Small worlds with exactly known rays, poses and IMU samples. Nothing here uses the code under test.

A `Walk` is a smooth path with explicit derivatives; a `Scene` is a set of axis-aligned boxes and planes,
which rays intersect in closed form. `measurements` combines the two into the measurements of a 32-ring
hemispherical LiDAR and its IMU, where each ray is fired at its own time from the sensor's pose at that time.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import reduce

import numpy as np
from scipy.spatial.transform import Rotation

from app.slam.params import Params
from app.slam.types import ImuSamples, Measurement, Scan

START_NS = 1_700_000_000_000_000_000
GRAVITY = 9.81
PERIOD_S = 0.1
IMU_RATE = 200
ELEVATIONS = np.radians(2.3125 + 2.8125 * np.arange(32))
"""Of the RS-Bpearl's scan lines, outermost first: the rank is the ring."""

UPRIGHT = np.eye(3)
"""R_world_imu of a device whose z axis points up."""
FORWARD = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])
"""R_world_imu of a handheld one: z looks along the world's x, x points up (the paper's mounting)."""


# --- scenes --------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Scene:
    """What rays may hit.

    Attributes:
        room: (2, 3) lower and upper corner of the box whose inside is seen; None outdoors.
        boxes: (2, 3) corners of solid boxes.
        ground: (normal, distance) of an endless plane n . x = d, for outdoors.
    """

    room: np.ndarray | None = None
    boxes: tuple[np.ndarray, ...] = ()
    ground: tuple[np.ndarray, float] | None = None

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ranges (n,), inf where nothing is hit, and whether floor was hit (n,)."""
        ranges, floor = np.full(len(origins), np.inf), np.zeros(len(origins), dtype=bool)
        with np.errstate(divide="ignore", invalid="ignore"):
            rays = [*zip(origins.T.copy(), directions.T.copy(), strict=True)]
            if self.room is not None:
                x, y, z = (np.maximum(*sides) for sides in _crossed(self.room, rays))
                ranges = np.minimum(np.minimum(x, y), z)
                floor = (z < np.minimum(x, y)) & (directions[:, 2] < 0)
            if self.ground is not None:
                normal, distance = self.ground
                t = (distance - origins @ normal) / (directions @ normal)
                nearer = (t > 0) & (t < ranges)
                ranges, floor = np.where(nearer, t, ranges), floor | nearer
            for corners in self.boxes:
                enters, leaves = zip(
                    *((np.minimum(*sides), np.maximum(*sides)) for sides in _crossed(corners, rays)), strict=True
                )
                enter, leave = reduce(np.maximum, enters), reduce(np.minimum, leaves)
                nearer = (enter > 0) & (enter < leave) & (enter < ranges)
                ranges, floor = np.where(nearer, enter, ranges), floor & ~nearer
        return ranges, floor


def _crossed(corners: np.ndarray, rays: list[tuple[np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of each axis: where along the rays its two sides are. Axis by axis, since rows of three are slow to compare."""
    return [((low - o) / d, (high - o) / d) for low, high, (o, d) in zip(*corners, rays, strict=True)]


def box(x0: float, y0: float, z0: float, x1: float, y1: float, z1: float) -> np.ndarray:
    return np.array([[x0, y0, z0], [x1, y1, z1]])


def furnished_room() -> Scene:
    """8 m by 6 m, 2.7 m high, with a cupboard, a table-high block and a pillar; the sensor at 1.3 m."""
    return Scene(
        box(-3.0, -3.0, -1.3, 5.0, 3.0, 1.4),
        (
            box(3.0, 1.5, -1.3, 4.0, 3.0, 0.7),
            box(1.5, -2.6, -1.3, 2.6, -1.8, -0.5),
            box(4.2, -2.0, -1.3, 4.5, -1.7, 1.4),
        ),
    )


def corridor(length: float, *, pillars: bool) -> Scene:
    """2.4 m wide, 2.5 m high, along x; with pillars on its walls, or with nothing along it at all."""
    walls = box(-4.0, -1.2, -1.3, length, 1.2, 1.2)
    if not pillars:
        return Scene(walls)
    at = np.arange(-3.0, length, 2.5)
    return Scene(
        walls,
        tuple(box(x, 0.95 if i % 2 else -1.2, -1.3, x + 0.3, 1.2 if i % 2 else -0.95, 1.2) for i, x in enumerate(at)),
    )


# --- the walk ------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Walk:
    """A smooth handheld motion: at rest for `still` seconds, then swinging, and walking along x.

    position_i(t) = speed_i u + sum of amplitude sin(frequency u + phase) - its value at u = 0, the
    same for the angles yaw, pitch, roll; u runs from 0, without a jerk, once the rest is over.

    Attributes:
        R_world_device: orientation of the IMU at rest. still: s.
        speed: (3,) m/s. sway: rows of (amplitude, frequency, phase) for x, y, z in m, rad/s, rad.
        turn: the same for yaw, pitch, roll in rad. yaw_rate: rad/s.
    """

    R_world_device: np.ndarray = field(default_factory=lambda: FORWARD.copy())
    still: float = 1.2
    speed: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sway: tuple[tuple[float, float, float], ...] = ((0.5, 0.8, 0.0), (0.3, 1.1, 0.4), (0.05, 3.0, 0.9))
    turn: tuple[tuple[float, float, float], ...] = ((0.4, 0.7, 0.0), (0.10, 1.9, 0.3), (0.08, 1.4, 1.0))
    yaw_rate: float = 0.0

    def _u(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """u = tau - tanh(tau) and its two derivatives: at tau = 0 all of them vanish."""
        tau = np.clip(np.asarray(t, dtype=np.float64) - self.still, 0.0, None)
        s = np.tanh(tau)
        return tau - s, s**2, 2 * s * (1 - s**2)

    @staticmethod
    def _series(
        rows: tuple[tuple[float, float, float], ...], slopes: tuple[float, ...], u: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values (n, 3), first and second derivatives with respect to u."""
        a, f, c = np.array(rows).T
        k = np.array(slopes)
        angle = u[:, None] * f + c
        return (
            k * u[:, None] + a * (np.sin(angle) - np.sin(c)),
            k + a * f * np.cos(angle),
            -a * f * f * np.sin(angle),
        )

    def positions(self, t: np.ndarray) -> np.ndarray:
        """(n, 3) m, world."""
        return self._series(self.sway, self.speed, self._u(t)[0])[0]

    def velocities(self, t: np.ndarray) -> np.ndarray:
        u, du, _ = self._u(t)
        return self._series(self.sway, self.speed, u)[1] * du[:, None]

    def accelerations(self, t: np.ndarray) -> np.ndarray:
        u, du, ddu = self._u(t)
        _, first, second = self._series(self.sway, self.speed, u)
        return second * du[:, None] ** 2 + first * ddu[:, None]

    def rotations(self, t: np.ndarray) -> Rotation:
        """R_world_imu."""
        angles = self._series(self.turn, (self.yaw_rate, 0.0, 0.0), self._u(t)[0])[0]
        return Rotation.from_euler("ZYX", angles) * Rotation.from_matrix(self.R_world_device)

    def rates(self, t: np.ndarray) -> np.ndarray:
        """(n, 3) rad/s in the IMU frame, from the angles' derivatives (Diebel 2006, eq. 78)."""
        u, du, _ = self._u(t)
        angles, slopes, _ = self._series(self.turn, (self.yaw_rate, 0.0, 0.0), u)
        yaw, pitch, roll = (slopes * du[:, None]).T
        p, r = angles[:, 1], angles[:, 2]
        body = np.stack(
            [
                roll - yaw * np.sin(p),
                pitch * np.cos(r) + yaw * np.sin(r) * np.cos(p),
                yaw * np.cos(r) * np.cos(p) - pitch * np.sin(r),
            ],
            axis=1,
        )
        return body @ self.R_world_device

    def specific_force(self, t: np.ndarray) -> np.ndarray:
        """(n, 3) m/s², IMU frame: what an ideal accelerometer reads."""
        return self.rotations(t).inv().apply(self.accelerations(t) + np.array([0.0, 0.0, GRAVITY]))

    def pose(self, t: float) -> np.ndarray:
        """T_world_imu (4, 4)."""
        T = np.eye(4)
        T[:3, :3] = self.rotations(np.array([t])).as_matrix()[0]
        T[:3, 3] = self.positions(np.array([t]))[0]
        return T

    def relative(self, t: float) -> np.ndarray:
        """Pose with respect to where the device stood at the start, gravity-aligned as `odom` is.

        The engine chooses the heading of `odom` by the smallest turn that sets the device upright.
        """
        begin = self.pose(0.0)
        up = begin[:3, :3].T @ np.array([0.0, 0.0, 1.0])
        axis = np.cross(up, [0.0, 0.0, 1.0])
        angle = np.arctan2(np.linalg.norm(axis), up[2])
        unit = axis / np.linalg.norm(axis) if np.linalg.norm(axis) > 1e-12 else np.array([1.0, 0.0, 0.0])
        T_odom_begin = np.eye(4)
        T_odom_begin[:3, :3] = Rotation.from_rotvec(angle * unit).as_matrix()
        return T_odom_begin @ np.linalg.inv(begin) @ self.pose(t)


# --- the sensors ---------------------------------------------------------------------------------
@dataclass(frozen=True)
class Rig:
    """The device: how many columns a revolution has, its noises, biases, and where the LiDAR sits.

    Attributes:
        T_imu_lidar: (4, 4). range_noise: m. gyro_noise, accel_noise: standard deviation a sample.
        b_gyro, b_accel: constant biases, IMU frame.
    """

    columns: int = 60
    T_imu_lidar: np.ndarray = field(default_factory=lambda: np.eye(4))
    range_noise: float = 0.003
    gyro_noise: float = 0.0
    accel_noise: float = 0.0
    b_gyro: tuple[float, float, float] = (0.0, 0.0, 0.0)
    b_accel: tuple[float, float, float] = (0.0, 0.0, 0.0)


def mounted(rpy_degrees: tuple[float, float, float], translation: tuple[float, float, float]) -> np.ndarray:
    """T_imu_lidar for the parameters sensor.rotation and sensor.translation."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("ZYX", rpy_degrees[::-1], degrees=True).as_matrix()
    T[:3, 3] = translation
    return T


def pattern(columns: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One revolution: directions (n, 3) in the LiDAR frame, seconds after its start (n,), ring (n,)."""
    azimuth = np.repeat(2 * np.pi * np.arange(columns) / columns, 32)
    ring = np.tile(np.arange(32, dtype=np.uint16), columns)
    e = ELEVATIONS[ring]
    directions = np.stack([np.cos(e) * np.cos(azimuth), -np.cos(e) * np.sin(azimuth), np.sin(e)], axis=1)
    seconds = np.arange(len(ring)) * (PERIOD_S / len(ring))
    return directions, np.round(seconds * 1e9) * 1e-9, ring


def sweep(scene: Scene, walk: Walk, rig: Rig, begin_s: float, seed: int) -> Scan:
    """One scan, each point measured from the sensor's pose at its own time."""
    directions, seconds, ring = pattern(rig.columns)
    R_world_imu, p_world_imu = walk.rotations(begin_s + seconds), walk.positions(begin_s + seconds)
    origins = p_world_imu + R_world_imu.apply(rig.T_imu_lidar[:3, 3])
    rays = R_world_imu.apply(directions @ rig.T_imu_lidar[:3, :3].T)
    ranges, floor = scene.cast(origins, rays)
    ranges = ranges + np.random.default_rng(seed).normal(scale=rig.range_noise, size=len(ranges))
    hit = np.isfinite(ranges) & (ranges < 100.0)
    return Scan(
        stamp_ns=START_NS + round(begin_s * 1e9),
        points=(directions * np.where(hit, ranges, 0.0)[:, None])[hit].astype(np.float32),
        offsets_ns=np.round(seconds[hit] * 1e9).astype(np.int32),
        intensity=(10.0 + ring[hit]).astype(np.float32),
        ring=ring[hit],
        truth_ground=floor[hit].astype(np.uint8),
    )


def imu_samples(walk: Walk, rig: Rig, seconds: np.ndarray, seed: int = 0) -> ImuSamples:
    """IMU samples at times `seconds` (k,); the noise of a sample depends on its time and `seed` only."""
    number = np.round(seconds * IMU_RATE).astype(int)
    noise = np.random.default_rng(seed).normal(size=(number.max() + 1, 6))[number] if len(number) else np.empty((0, 6))
    return ImuSamples(
        stamps_ns=START_NS + np.round(seconds * 1e9).astype(np.int64),
        gyro=walk.rates(seconds) + rig.b_gyro + rig.gyro_noise * noise[:, :3],
        accel=walk.specific_force(seconds) + rig.b_accel + rig.accel_noise * noise[:, 3:],
    )


def measurements(scene: Scene, walk: Walk, rig: Rig, frames: int, *, begin_s: float = 0.05) -> Iterator[Measurement]:
    """Scans back to back from `begin_s` on, each with the samples that cover it."""
    last_end_s = 0.0
    for k in range(frames):
        scan = sweep(scene, walk, rig, begin_s + k * PERIOD_S, seed=k)
        end_s = (scan.end_ns - START_NS) * 1e-9
        first, last = np.floor(last_end_s * IMU_RATE + 1e-6), np.ceil(end_s * IMU_RATE - 1e-6)
        yield Measurement(scan, imu_samples(walk, rig, np.arange(first, last + 1) / IMU_RATE))
        last_end_s = end_s


def params_for(rig: Rig, values: dict[str, object] | None = None) -> Params:
    """Parameters that tell the engine where the LiDAR sits; the rest are defaults or `values`."""
    rpy = Rotation.from_matrix(rig.T_imu_lidar[:3, :3]).as_euler("ZYX", degrees=True)[::-1]
    sensor = {"translation": rig.T_imu_lidar[:3, 3].tolist(), "rotation": rpy.tolist()}
    return Params().merged({"sensor": sensor}).with_values(values or {})


def seconds_of(stamp_ns: int) -> float:
    return (stamp_ns - START_NS) * 1e-9


def pose_error(estimate: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Distance in m and angle in degrees between two (4, 4) poses."""
    difference = np.linalg.inv(truth) @ estimate
    angle = Rotation.from_matrix(difference[:3, :3]).magnitude()
    return float(np.linalg.norm(difference[:3, 3])), float(np.degrees(angle))


YARD = Scene(
    box(-30.0, -25.0, -1.3, 35.0, 20.0, 12.0),
    (box(8.0, 5.0, -1.3, 14.0, 9.0, 2.0), box(-15.0, -12.0, -1.3, -9.0, -8.0, -0.2)),
)
"""A yard between walls, with a shed and a low block."""


def upright(scene: Scene, position: tuple[float, float] = (0.0, 0.0), tilt: float = 0.0, seed: int = 5) -> Scan:
    """Seen by a scanner without scan lines, -7 to 52 degrees, held upright; its rings are steps of 2 degrees.

    position: x and y, m. tilt: degrees about y.
    """
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform([-np.pi, np.radians(-7)], [np.pi, np.radians(52)], (20_000, 2)).T
    level = np.cos(elevation)
    directions = np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    R = Rotation.from_euler("y", tilt, degrees=True).as_matrix()
    ranges, floor = scene.cast(np.tile([*position, 0.0], (20_000, 1)), directions @ R.T)
    hit = np.isfinite(ranges) & (ranges < 70.0)
    ranges = ranges[hit] + rng.normal(scale=0.01, size=np.count_nonzero(hit))
    return Scan(
        stamp_ns=0,
        points=(directions[hit] * ranges[:, None]).astype(np.float32),
        offsets_ns=np.zeros(len(ranges), np.int32),
        intensity=np.zeros(len(ranges), np.float32),
        ring=((np.degrees(elevation[hit]) + 7) // 2).astype(np.uint16),
        truth_ground=floor[hit].astype(np.uint8),
    )
