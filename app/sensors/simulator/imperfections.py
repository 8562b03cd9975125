"""Imperfections of a real scanner, hand and surroundings for a simulated walk. All are off by default.

Each term is one field of `Imperfections` that holds its size; 0 is off. `IMPERFECT` has the sizes of real devices.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.sensors.robosense import CHANNELS
from app.sensors.simulator.raycast import Hits, Mover, Raycaster, SimulatedScene
from app.sensors.simulator.scenes.props import person_mesh
from app.sensors.simulator.trajectory import SmoothTrajectory, Walker, seconds
from app.slam.errors import HemislamError
from app.slam.lie import exp, transform
from app.slam.types import F64, ImuSamples
from app.slam.user_text import read_numbers

GLASS_REFLECTIVITY = 0.05
"""A surface with a lower reflectivity is glass."""
PANE_M = 0.1
JUMP_M = 0.15
VIBRATION_HZ = (25.0, 70.0)
MOST_LATE_S = 3600.0


@dataclass(frozen=True, slots=True)
class Imperfections:
    """The size of each term; a spread is a standard deviation. Sources are in brackets.

    Attributes:
        elevation: deg, spread of the channels' elevations [a unit's calibration table has 0.01 deg steps and ages].
        range_bias: m, spread of the channels' range biases [data sheet: +-3 cm].
        incidence_bias: m, excess range at grazing incidence [the echo is stretched; reports of calibrations].
        range_noise: m, total spread of a range; 0: 5 mm, as for a clean scanner [data sheet: +-3 cm].
        mixed: share of firings beside a range jump of over JUMP_M that return from in between [the beam's footprint].
        glass: share of beams that pass through glass and return from behind it.
        mount_rotation, mount_translation: deg, m, difference of the true from the written mounting, in a random
            direction [drawings and hand-eye calibrations].
        gyro_scale, accel_scale: relative; misalignment: deg. Spreads per axis [data sheets of MEMS IMUs].
        gyro_vibration, accel_vibration: rad/s, m/s², amplitude at VIBRATION_HZ [the LiDAR's motor].
        lost: share of IMU samples that are missing. jitter: s, spread of their stamps. late: s, delay of the IMU's
            stamps [USB and serial links].
        companions: number of people who walk ahead of, behind and across the operator, 1-3 m away; at most 3.
        hand: factor on the usual motion of the hand; 0 counts as 1.
    """

    elevation: float = 0.0
    range_bias: float = 0.0
    incidence_bias: float = 0.0
    range_noise: float = 0.0
    mixed: float = 0.0
    glass: float = 0.0
    mount_rotation: float = 0.0
    mount_translation: float = 0.0
    gyro_scale: float = 0.0
    accel_scale: float = 0.0
    misalignment: float = 0.0
    gyro_vibration: float = 0.0
    accel_vibration: float = 0.0
    lost: float = 0.0
    jitter: float = 0.0
    late: float = 0.0
    companions: float = 0.0
    hand: float = 0.0

    def with_sizes(self, assignments: Sequence[str]) -> "Imperfections":
        """Imperfections with other sizes, each given as `name=size`. Raises HemislamError, which names the terms."""
        made = replace(self, **read_numbers(assignments, self.__slots__, least=0.0))
        if max(made.late, made.jitter) > MOST_LATE_S:
            raise HemislamError("A simulated IMU's stamps cannot be late, or vary, by more than an hour (3600 s).")
        return made


NONE = Imperfections()
IMPERFECT = Imperfections(
    elevation=0.12,
    range_bias=0.01,
    incidence_bias=0.012,
    range_noise=0.017,
    mixed=0.3,
    glass=0.5,
    mount_rotation=0.7,
    mount_translation=0.01,
    gyro_scale=0.004,
    accel_scale=0.008,
    misalignment=0.2,
    gyro_vibration=0.02,
    accel_vibration=0.4,
    lost=0.004,
    jitter=2e-4,
    late=6e-3,
    companions=3,
    hand=3.0,
)


class Unit:
    """A scanner with its own errors, which are the same in every scan; its firings cycle through `channels`."""

    def __init__(self, sizes: Imperfections, rng: np.random.Generator, channels: int = CHANNELS) -> None:
        self.sizes, self._channels = sizes, channels
        self._elevation = np.deg2rad(sizes.elevation) * rng.normal(size=channels)
        self._range_bias = sizes.range_bias * rng.normal(size=channels)
        self._turn = exp(np.deg2rad(sizes.mount_rotation) * _direction(rng))
        self._shift = sizes.mount_translation * _direction(rng)
        skew = np.deg2rad(sizes.misalignment)
        self._gyro = _matrix(sizes.gyro_scale, skew, rng)
        self._accel = _matrix(sizes.accel_scale, skew, rng)
        self._hum = rng.uniform(*VIBRATION_HZ, (2, 3)), rng.uniform(0, 2 * np.pi, (2, 3))

    @property
    def mounting(self) -> F64:
        """(4, 4) T_nominal_lidar: the scanner's true pose in the frame of its nominal mounting."""
        return transform(self._turn, self._shift)

    def fired(self, directions: F64, levers: F64) -> tuple[F64, F64]:
        """The true directions and levers of the firings in the frame of the written mounting, (n, 3) each."""
        level = directions[:, :2]
        flat = np.linalg.norm(level, axis=1)
        elevation = np.arctan2(directions[:, 2], flat) + np.resize(self._elevation, len(flat))
        bent = np.column_stack([level * (np.cos(elevation) / flat)[:, None], np.sin(elevation)])
        return bent @ self._turn.T, levers @ self._turn.T + self._shift

    def see_through(
        self, hits: Hits, scene: Raycaster, origins: F64, directions: F64, times: F64, rng: np.random.Generator
    ) -> None:
        """Let beams pass through glass and return from behind it. `hits` is changed in place."""
        pane = (hits.reflectivity < GLASS_REFLECTIVITY) & np.isfinite(hits.distance)
        through = np.flatnonzero(pane & (rng.random(len(pane)) < self.sizes.glass))
        if not len(through):
            return
        reach = hits.distance[through] + PANE_M
        behind = scene.cast(
            origins[through] + reach[:, None] * directions[through], directions[through], times[through]
        )
        hits.distance[through] = reach + behind.distance
        for name in ("incidence", "reflectivity", "ground"):
            getattr(hits, name)[through] = getattr(behind, name)

    def ranges(self, hits: Hits, rng: np.random.Generator) -> F64:
        """(n,) m, ranges with systematic errors and mixed pixels, without noise; n firings as in the pattern."""
        distance = hits.distance + self.sizes.incidence_bias * (1.0 - hits.incidence)
        turns = distance.reshape(-1, self._channels) + self._range_bias
        mixed = turns.copy()
        for shift in (1, -1):  # the neighbours on the same cone
            with np.errstate(invalid="ignore"):
                jump = np.roll(turns, shift, axis=0) - turns
            chosen = np.isfinite(jump) & (np.abs(jump) > JUMP_M) & (rng.random(turns.shape) < self.sizes.mixed)
            mixed[chosen] = turns[chosen] + rng.random(np.count_nonzero(chosen)) * jump[chosen]
        return mixed.ravel()

    def felt(self, imu: ImuSamples, start_ns: int, rng: np.random.Generator) -> ImuSamples:
        """The samples of this IMU, from those of a perfect IMU."""
        sizes, t = self.sizes, seconds(imu.stamps_ns - start_ns)
        frequencies, phases = self._hum
        hum = np.sin(2 * np.pi * t[:, None, None] * frequencies + phases)
        gyro = imu.gyro @ self._gyro.T + sizes.gyro_vibration * hum[:, 0]
        accel = imu.accel @ self._accel.T + sizes.accel_vibration * hum[:, 1]
        stamps_ns = imu.stamps_ns + np.rint(1e9 * (sizes.late + sizes.jitter * rng.normal(size=len(t)))).astype(
            np.int64
        )
        kept = rng.random(len(t)) >= sizes.lost
        return ImuSamples(stamps_ns[kept], gyro[kept], accel[kept])


def livelier(walker: Walker, times: float) -> Walker:
    """The same walker with a hand that moves `times` as much; 0 counts as 1."""
    moved = {name: getattr(walker, name) * (times or 1.0) for name in ("bob", "sway", "pitch", "roll", "yaw")}
    return replace(walker, **moved)


def companions(
    number: float, trajectory: SmoothTrajectory, place: SimulatedScene, rng: np.random.Generator
) -> tuple[Mover, ...]:
    """People who walk with the operator: one ahead, one behind, one who crosses in front, 1-3 m away."""
    climbs = place.path.shape[1] == 3
    swing, phase = rng.uniform(0.3, 0.7, (3, 2)), rng.uniform(0, 2 * np.pi, (3, 2))

    def company(who: int) -> Mover:
        def pose(t: F64) -> tuple[F64, F64]:
            places, R_world_imu = trajectory.poses(t)
            forward = R_world_imu @ trajectory.R_body_imu[0]
            heading = np.arctan2(forward[:, 1], forward[:, 0])
            u, v = np.sin(swing[who] * t[:, None] + phase[who]).T
            along, left = ((1.9 + 0.6 * u, 0.5 * v), (-1.7 + 0.5 * u, 0.6 * v), (1.8 + 0.4 * u, 2.2 * v))[who]
            c, s = np.cos(heading), np.sin(heading)
            xy = places[:, :2] + np.column_stack([c * along - s * left, s * along + c * left])
            level = places[:, 2] - Walker().height if climbs else np.zeros(len(t))
            z = level if place.height is None else place.height(xy)
            return np.column_stack([xy, z]), heading + (np.pi / 2 if who == 2 else 0.0)

        return Mover(person_mesh(1.65 + 0.1 * who), pose)

    return tuple(company(who) for who in range(min(3, int(number))))


def _direction(rng: np.random.Generator) -> F64:
    v = rng.normal(size=3)
    return np.asarray(v / np.linalg.norm(v))


def _matrix(scale: float, skew: float, rng: np.random.Generator) -> F64:
    """Matrix that maps a true vector to an IMU's axes: scale errors on the diagonal, misalignment off the diagonal."""
    return np.asarray(np.eye(3) + np.where(np.eye(3) > 0, scale, skew) * rng.normal(size=(3, 3)))
