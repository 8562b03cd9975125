"""The units and axes of an IMU, settled from its first samples, and what is wrong with them.

Gravity gives the accelerometer's unit. While the device sways, the direction of gravity turns in the IMU frame. This
matches the gyroscope only if its unit is rad/s and both sensors have the same axes, so it tests both.
"""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from app.sensors.findings import Finding
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.sections import RecordingParams
from app.slam.types import F64, I64, Mask, Vector

STANDARD_GRAVITY = 9.80665
ABSURD = 1e6
"""No IMU reads more than this, in any unit."""
ACCELERATION_UNITS = {"m/s2": 1.0, "g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY / 1000}
GYROSCOPE_UNITS = {"rad/s": 1.0, "deg/s": np.pi / 180}
_GYROSCOPE_OPTION = "--set recording.gyroscope_unit="

PARTS, LEAST_SHARE = 5, 0.5
"""The first samples are averaged in this many parts of about 4 s. With gravity, an average has at least this share of
the samples' norm: on walks 0.96 to 1.01, and 0.07 without gravity."""
LEAST_NORM = 0.5
"""Gravity is larger than this in every unit that an IMU uses."""
MOST_ACCEL = 200.0
"""m/s^2; a larger value is not a walking motion."""
WINDOW_S, STRIDE_S, SPAN_S, STEPS = 0.5, 0.25, 1.0, 50
"""s: accelerations are averaged over a window, about a walking step, and compared with those one span later."""
GAP_NS = 1_000_000_000
DOUBTFUL, TOO_FAST = 3.0, 10.0
"""rad/s: a gyroscope that reads more than the first may be in deg/s; no hand turns faster than the second."""
CLEARLY = 0.5
"""Another unit or other axes are proposed if they reduce the error to less than this share."""
LEAST_ERROR = 0.3
"""m/s^2; axes with a smaller error are not questioned."""


@dataclass(frozen=True, slots=True)
class ImuProbe:
    """The first IMU samples: log times and stamps (k,) int64 ns, gyro and accel (k, 3) as recorded."""

    log_ns: I64
    stamps_ns: I64
    gyro: F64
    accel: F64


def measured(gyro: F64, accel: F64) -> Mask:
    """(k,) which samples (k, 3), as recorded, an IMU can have measured. If only some have no acceleration, these come
    from a driver that has lost its device."""
    usual = (np.abs(accel) < ABSURD).all(axis=1) & (np.abs(gyro) < ABSURD).all(axis=1)
    felt = usual & accel.any(axis=1)
    return np.asarray(felt if felt.any() else usual)


def holds_gravity(probe: ImuProbe) -> bool:
    """Whether the accelerations contain gravity. Those of walking average out over some seconds; gravity does not.

    Some drivers take gravity off, and some send only zeros.
    """
    parts = np.array_split(probe.accel, min(PARTS, len(probe.accel)))
    averaged = float(np.median([np.linalg.norm(part.mean(axis=0)) for part in parts]))
    norm = float(np.median(np.linalg.norm(probe.accel, axis=1)))
    return norm > LEAST_NORM and averaged > LEAST_SHARE * norm


Axes = tuple[tuple[int, float], ...]
"""For x, y and z of the IMU frame: which recorded axis it is, and the factor to SI units, with its sign."""


ALL_AXES: tuple[Axes, ...] = tuple(
    tuple(zip(order, signs, strict=True))
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
)
"""All 48 orders and signs."""
AS_IS = ALL_AXES[0]


@dataclass(frozen=True, slots=True)
class ImuUnits:
    """Converts recorded values to rad/s and m/s^2 in the IMU frame."""

    gyro: Axes
    accel: Axes

    def apply(self, gyro: Vector, accel: Vector) -> tuple[Vector, Vector]:
        return _converted(gyro, self.gyro), _converted(accel, self.accel)


def _converted(values: Vector, axes: Axes) -> Vector:
    (i, a), (j, b), (k, c) = axes
    return a * values[i], b * values[j], c * values[k]


AS_RECORDED = ImuUnits(AS_IS, AS_IS)


def settle_imu(probe: ImuProbe, chosen: RecordingParams) -> tuple[ImuUnits, list[Finding]]:
    """Units and axes as chosen or, where the choice is `auto`, by the first samples; and findings.

    Raises:
        HemislamError: the accelerometer reads nothing at all.
    """
    gyro_axes, accel_axes = named_axes(chosen.gyroscope_axes), named_axes(chosen.accelerometer_axes)
    norm = float(np.median(np.linalg.norm(probe.accel, axis=1)))
    if norm == 0.0:
        raise HemislamError(
            "The accelerometer reads 0 on all axes, which is impossible on Earth; check the IMU's driver, or start "
            "hemislam with --imu-topic and another topic."
        )
    accel_unit, findings = _acceleration_unit(norm, chosen.acceleration_unit)
    accel = _reordered(probe.accel, accel_axes) * accel_unit
    gyro = _reordered(probe.gyro, gyro_axes)
    possible = (np.abs(accel) < MOST_ACCEL).all(axis=1)
    sway = Sway.of(probe.stamps_ns[possible], gyro[possible], accel[possible])
    gyro_unit, more = _gyroscope_unit(gyro, sway, chosen.gyroscope_unit)
    findings += [*more, *_stuck(probe)]
    if sway is not None and not any(finding.verdict == "needs you" for finding in findings):
        findings += _axes_finding(sway, gyro_unit, chosen)
    units = ImuUnits(
        tuple((i, sign * gyro_unit) for i, sign in gyro_axes), tuple((i, sign * accel_unit) for i, sign in accel_axes)
    )
    return units, findings


def named_axes(name: str) -> Axes:
    """`xyz`, `-yxz`: which recorded axes are x, y and z."""
    signs = [
        -1.0 if before == "-" else 1.0 for before, letter in zip(" " + name, name, strict=False) if letter in "xyz"
    ]
    return tuple(zip(map("xyz".index, (letter for letter in name if letter in "xyz")), signs, strict=True))


def axes_name(axes: Axes) -> str:
    return "".join(("-" if sign < 0 else "") + "xyz"[i] for i, sign in axes)


def _reordered(values: F64, axes: Axes) -> F64:
    return np.stack([sign * values[:, i] for i, sign in axes], axis=1)


def _acceleration_unit(norm: float, chosen: str) -> tuple[float, list[Finding]]:
    """The factor to m/s^2, by the norm of the first samples, which is gravity."""
    text, option = f"the acceleration's norm is {norm:.4g} at the start", "--set recording.acceleration_unit="
    fitting = next((unit for unit, scale in ACCELERATION_UNITS.items() if 8.0 < norm * scale < 12.0), None)
    if chosen != "auto":
        text, scale = f"{chosen}, as you set it; {text}", ACCELERATION_UNITS[chosen]
        if fitting == chosen:
            return scale, [Finding("IMU units", "fine", text)]
        return scale, [Finding("IMU units", "needs you", f"{text}, which is not gravity in it", f"{option}auto")]
    if fitting == "m/s2":
        return 1.0, [Finding("IMU units", "fine", f"m/s²: {text}")]
    if fitting is not None:
        text = f"{fitting}: {text}; scaled to m/s²"
        return ACCELERATION_UNITS[fitting], [Finding("IMU units", "corrected", text, f"{option}m/s2")]
    text = f"{text}, which is not gravity in any of {', '.join(ACCELERATION_UNITS)}"
    for unit, scale in ACCELERATION_UNITS.items():
        if 6.5 < norm * scale < 15.0:  # a recording that begins amid walking may show so little or so much
            return scale, [Finding("IMU units", "needs you", f"{text}; taken as {unit}: check the IMU's driver")]
    text += "; taken as m/s²: record the raw acceleration, if the driver takes gravity off it or sends bare counts"
    return 1.0, [Finding("IMU units", "needs you", text)]


def _gyroscope_unit(gyro: F64, sway: "Sway | None", chosen: str) -> tuple[float, list[Finding]]:
    """The factor to rad/s, by how gravity turns, or by how fast a hand can turn."""
    if chosen != "auto":
        return GYROSCOPE_UNITS[chosen], []
    turning = turning_rate(gyro)
    if sway is None:
        return 1.0, [too_fast(turning, " at the start")] if turning > TOO_FAST else []
    errors = {unit: sway.error(scale) for unit, scale in GYROSCOPE_UNITS.items()}
    if turning > DOUBTFUL and errors["deg/s"] < CLEARLY * errors["rad/s"]:
        text = "the gyroscope is in deg/s, by how gravity turns in the IMU's axes; scaled to rad/s"
        return GYROSCOPE_UNITS["deg/s"], [Finding("IMU units", "corrected", text, f"{_GYROSCOPE_OPTION}rad/s")]
    return 1.0, []


def turning_rate(gyro: F64) -> float:
    """The rate that a tenth of the samples (k, 3) exceed, in their unit."""
    return float(np.percentile(np.linalg.norm(gyro, axis=1), 90))


def too_fast(rate: float, when: str = "") -> Finding:
    """The finding that a gyroscope, read as rad/s, exceeds `TOO_FAST`."""
    text = f"the gyroscope reads {rate:.0f}{when}, too fast for a hand in rad/s: it may be in deg/s"
    return Finding("IMU units", "needs you", text, f"{_GYROSCOPE_OPTION}deg/s")


def _axes_finding(sway: "Sway", gyro_unit: float, chosen: RecordingParams) -> list[Finding]:
    """Whether another order or sign of the axes makes gyroscope and accelerometer agree far better."""
    errors = {axes: sway.error(gyro_unit, axes) for axes in ALL_AXES}
    best = min(errors, key=lambda axes: errors[axes])
    if errors[best] > CLEARLY * errors[AS_IS] or errors[AS_IS] < LEAST_ERROR:
        return []
    # Turning the axes of one sensor, or those of the other the opposite way, is equivalent; so is gravity upside down.
    # A mirrored gyroscope is different: no change of the accelerometer's axes corrects it.
    name, given, change = "gyroscope", chosen.gyroscope_axes, _matrix(best)
    if np.linalg.det(change) > 0:
        back = change.T
        change = max((back, -back), key=np.sum)
        name, given = "accelerometer", chosen.accelerometer_axes
    total = change @ _matrix(named_axes(given))
    axes = tuple((int(np.flatnonzero(row)[0]), float(row.sum())) for row in total)
    text = f"gravity does not turn as the gyroscope says; it does with the {name}'s axes taken as {axes_name(axes)}"
    return [Finding("IMU axes", "needs you", text, f"--set recording.{name}_axes={axes_name(axes)}")]


def _stuck(probe: ImuProbe) -> list[Finding]:
    """Axes that read the same number in every sample: they measure nothing."""
    if len(probe.gyro) < 100:
        return []
    names = [
        f"{sensor} {'xyz'[axis]} ({values[0, axis]:g})"
        for sensor, values in (("gyroscope", probe.gyro), ("accelerometer", probe.accel))
        for axis in range(3)
        if np.ptp(values[:, axis]) == 0.0
    ]
    if not names:
        return []
    text = f"{', '.join(names)}: the same number in all of the first {len(probe.gyro)} samples; check the IMU's driver"
    return [Finding("IMU values", "needs you", text, "--imu-topic if there is another IMU")]


@dataclass(frozen=True, slots=True)
class Sway:
    """Spans in which the device swayed: mean accelerations (n, 3) m/s^2 at the start and end of each, and the rotation
    vectors (n, m, 3) of its m samples in turn, rad in the gyroscope's recorded unit."""

    begin: F64
    end: F64
    steps: F64

    @classmethod
    def of(cls, stamps_ns: I64, gyro: F64, accel: F64) -> "Sway | None":
        """From the longest part without a gap, since a wrong stamp can be years off. None without enough samples."""
        edges = np.r_[0, np.flatnonzero(np.abs(np.diff(stamps_ns)) > GAP_NS) + 1, len(stamps_ns)]
        longest = int(np.argmax(np.diff(edges)))
        part = slice(edges[longest], edges[longest + 1])
        stamps_ns, gyro, accel = stamps_ns[part], gyro[part], accel[part]
        rises = np.diff(np.maximum.accumulate(stamps_ns), prepend=stamps_ns[:1] - 1) > 0
        stamps_ns, gyro, accel = stamps_ns[rises], gyro[rises], accel[rises]
        times = (stamps_ns - stamps_ns[:1]) / 1e9
        if len(times) < 100 or times[-1] < SPAN_S + WINDOW_S + STRIDE_S:
            return None
        starts = np.arange(0.0, times[-1] - SPAN_S - WINDOW_S, STRIDE_S)
        means = _window_means(times, accel, np.r_[starts, starts + SPAN_S])
        begin, end = np.split(means, 2)
        middle = starts[:, None] + WINDOW_S / 2 + np.linspace(0.0, SPAN_S, STEPS + 1)[None, :]
        step = SPAN_S / STEPS
        rates = np.stack([np.interp(middle[:, :-1] + step / 2, times, gyro[:, axis]) for axis in range(3)], axis=-1)
        return cls(begin, end, rates * step)

    def error(self, gyro_unit: float, axes: Axes = AS_IS) -> float:
        """m/s^2, RMS: how far gravity at the end of a span is from its direction according to the gyroscope."""
        unit = _matrix(axes) * gyro_unit
        n, m, _ = self.steps.shape
        turns = Rotation.from_rotvec((self.steps @ unit.T).reshape(-1, 3)).as_matrix().reshape(n, m, 3, 3)
        gravity = self.begin[:, None, :]
        for step in range(m):
            gravity = gravity @ turns[:, step]
        return float(np.sqrt(np.mean(np.sum((self.end - gravity[:, 0]) ** 2, axis=1))))


def _matrix(axes: Axes) -> F64:
    matrix = np.zeros((3, 3))
    for row, (column, sign) in enumerate(axes):
        matrix[row, column] = sign
    return matrix


def _window_means(times: F64, values: F64, starts: F64) -> F64:
    first, last = np.searchsorted(times, starts), np.searchsorted(times, starts + WINDOW_S)
    sums = np.vstack([np.zeros(3), np.cumsum(values, axis=0)])
    return np.asarray((sums[last] - sums[first]) / np.maximum(last - first, 1)[:, None])


def gravity_findings(probe: ImuProbe, units: ImuUnits, params: Params, preset: str = "") -> list[Finding]:
    """The direction of down in the LiDAR frame, by the IMU's first samples, and whether the mounting was given.

    Args:
        preset: of the sensor that the clouds look like; "" if unknown.
    """
    first = probe.stamps_ns - probe.stamps_ns[0] <= params.imu.start_duration * 1e9
    accel, gyro = _reordered(probe.accel[first], units.accel), _reordered(probe.gyro[first], units.gyro)
    specific = np.median(accel, axis=0)
    norm = float(np.linalg.norm(specific))
    findings = []
    if norm > 1.0:
        down = -(lie.from_rpy_degrees(params.sensor.rotation).T @ specific) / norm
        axis = int(np.argmax(np.abs(down)))
        name = f"{'+' if down[axis] > 0 else '−'}{'xyz'[axis]}"
        off = np.degrees(np.arccos(min(abs(float(down[axis])), 1.0)))
        values = ", ".join(f"{value:+.2f}" for value in down)
        text = f"down is {off:.0f} deg from the LiDAR's {name} axis ({values})"
        moving = float(np.linalg.norm(gyro.std(axis=0))) > 0.05 or float(np.linalg.norm(accel.std(axis=0))) > 0.5
        if moving:
            text += f"; the device moves during the first {params.imu.start_duration:g} s, so this is rough"
        findings.append(Finding("gravity", "corrected" if moving else "fine", text))
    if any(params.sensor.translation + params.sensor.rotation):
        x, y, z = params.sensor.translation
        roll, pitch, yaw = params.sensor.rotation
        text = f"LiDAR in the IMU frame at {x:g}, {y:g}, {z:g} m, turned by {roll:g}, {pitch:g}, {yaw:g} deg"
        findings.append(Finding("mount", "fine", text))
    else:
        text = "no pose of the LiDAR on the IMU is given; taken as the same axes and origin"
        option = "--set 'sensor.translation=[x, y, z]' --set 'sensor.rotation=[roll, pitch, yaw]'"
        if preset:
            text, option = f"{text}; the clouds look like those of preset {preset}, which has it", f"--preset {preset}"
        findings.append(Finding("mount", "needs you", text, option))
    return findings
