"""From a recording to the pose of the LiDAR on the IMU and the corrections of its scan lines: first by odometry from
scans alone, then with the help of the IMU."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from app.calibration.excerpt import LONGEST_S, Excerpt, read_excerpt
from app.calibration.guide import Guide
from app.calibration.inertial import Inertial, Noise
from app.calibration.lines import Lines, fit_lines
from app.calibration.odometry import track
from app.calibration.rotation import Turned, find_offset, first_rotation, fit_rotation, is_mirrored
from app.calibration.translation import Moved, fit_translation, is_opposed
from app.sensors.imu_units import axes_name, named_axes
from app.sensors.presets import built_in_mounting
from app.sensors.recording import open_recording
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.start import DRAWN
from app.slam.types import F64

ROUNDS = 3
"""Rounds in which the scans are registered again with the help of the IMU; each improves the fit, and so the help."""
READING, ROUND = 0.1, 0.9 / (ROUNDS + 1)
LARGEST_ROTATION, LARGEST_PLACE, LARGEST_OFFSET = np.radians(1.0), 0.05, 0.002
"""rad, m, s: values with a larger standard deviation count as not observable."""
NOT_TURNED = np.radians(20.0)
"""rad: an axis of the rotation that scans alone leave this uncertain is not observed. If none is observed, the help of
the IMU would mislead. Its accelerations can be compared only if all are."""
SURE = 3.0
"""Standard deviations by which two values must differ to count as different."""
APART_ROTATION, APART_PLACE = np.radians(3.0), 0.1
"""rad, m: a mounting that is off by more than this spoils a map."""
POSED = "sensor.rotation", "sensor.translation", "recording.imu_time_offset"
"""Parameters that say where the LiDAR is on the IMU, and when."""

Report = Callable[[float], None]
"""A function that is called with the fraction done, 0-1."""


class AxesError(HemislamError):
    """The axes of a sensor are not those of any IMU, however it is mounted."""


def is_mounting_unknown(params: Params) -> bool:
    return not any(params.sensor.translation + params.sensor.rotation)


@dataclass(frozen=True, slots=True)
class Calibration:
    """What a recording shows about its sensors.

    Attributes:
        recording: the file. params: those that it was opened with. lasted_s: the part that was used.
        preset: the source of the mounting in `params`, if none was given; "" if one was.
        turned, moved: the fits. down: (3,) unit direction of gravity in the LiDAR frame at the start.
        residuals: m, RMS of the scans to the map without the IMU, and with it.
        gyro_noise, accel_noise: of the IMU in most seconds, vibrations included.
        lines: corrections of the scan lines.
    """

    recording: Path
    params: Params
    preset: str
    lasted_s: float
    turned: Turned
    moved: Moved
    down: F64
    residuals: tuple[float, float]
    gyro_noise: Noise
    accel_noise: Noise
    lines: Lines

    @property
    def rotation(self) -> tuple[float, float, float]:
        """Roll, pitch, yaw in degrees, as `sensor.rotation`."""
        return lie.rpy_degrees(self.turned.R_imu_lidar)

    @property
    def sigmas(self) -> dict[str, F64]:
        """Standard deviations (3,) or (1,) of rotation (rad, about the LiDAR's axes), offset (s), gyroscope's bias
        (rad/s), translation (m) and accelerometer's bias (m/s²)."""
        turned, moved = np.sqrt(np.diag(self.turned.covariance)), np.sqrt(np.diag(self.moved.covariance))
        return {
            "rotation": turned[:3], "offset": turned[3:4], "gyro_bias": turned[4:],
            "translation": moved[:3], "accel_bias": moved[3:],
        }  # fmt: skip

    @property
    def observed(self) -> dict[str, bool]:
        """Whether the motion determined rotation, translation and offset."""
        s = self.sigmas
        rotation = bool((s["rotation"] < LARGEST_ROTATION).all())
        return {
            "rotation": rotation,
            "translation": rotation and bool((s["translation"] < LARGEST_PLACE).all()),
            "offset": bool((s["offset"] < LARGEST_OFFSET).all()),
        }

    @property
    def mounting(self) -> tuple[F64, F64]:
        """R_imu_lidar (3, 3) and p_imu_lidar (3,) to use from now on: the mean of the given and the fitted values,
        weighted by their variances; the fitted ones alone if none were given, or if the given ones are surely wrong."""
        sensor, parts = self.params.sensor, []
        R, p = lie.from_rpy_degrees(sensor.rotation), np.array(sensor.translation)
        off = lie.log(R.T @ self.turned.R_imu_lidar), self.moved.p_imu_lidar - p
        for name, apart, drawn in zip(("rotation", "translation"), off, DRAWN, strict=True):
            variance = self.sigmas[name] ** 2
            wrong = (np.abs(apart) > SURE * np.sqrt(variance + drawn**2)).any()
            alone = wrong or is_mounting_unknown(self.params)
            parts.append(apart if alone else apart * drawn**2 / (variance + drawn**2))
        return R @ lie.exp(parts[0]), p + parts[1]

    def found(self) -> dict[str, Any]:
        """Parameters to use from now on, by dotted name: those that the recording determines, and the given values of
        the rest of mounting and clock, so that a file of them is complete. {} if it determines nothing."""
        (R, p), observed = self.mounting, self.observed
        values: dict[str, Any] = {}
        if observed["rotation"]:
            values["sensor.rotation"] = [round(angle, 3) for angle in lie.rpy_degrees(R)]
        if observed["translation"]:
            values["sensor.translation"] = [round(float(x), 4) for x in p]
        if observed["offset"] and abs(self.turned.late) > max(0.001, SURE * float(self.sigmas["offset"][0])):
            late = self.params.recording.imu_time_offset + self.turned.late
            values["recording.imu_time_offset"] = round(late, 4)
        values |= self.lines.found()
        given = Params().changed(self.params)
        posed = {path: given[path] for path in POSED if path in given}
        return posed | values if values or self.preset else {}

    def contradiction(self) -> str:
        """What is wrong with the mounting or the clock used so far, in a sentence; "" if nothing is, or if this
        cannot be determined. If no mounting was given, it names the preset that has it."""
        (R, p), sensor, observed, parts = self.mounting, self.params.sensor, self.observed, []
        turned = np.linalg.norm(lie.log(lie.from_rpy_degrees(sensor.rotation).T @ R))
        if observed["rotation"] and turned > APART_ROTATION:
            angles = ", ".join(f"{round(angle)}°" for angle in self.rotation)
            parts.append(f"the LiDAR seems to be rotated by {angles} on the IMU")
        if observed["translation"] and np.linalg.norm(p - sensor.translation) > APART_PLACE:
            place = ", ".join(f"{x:.2f}" for x in self.moved.p_imu_lidar)
            parts.append(f"{'it' if parts else 'the LiDAR'} seems to be at {place} m on the IMU")
        if observed["offset"] and abs(self.turned.late) > 5 * LARGEST_OFFSET:
            late = -self.turned.late * 1e3
            parts.append(f"the IMU's clock seems to be {abs(late):.0f} ms {'late' if late > 0 else 'early'}")
        if self.preset and not parts:
            parts.append(f"the clouds and the IMU are those of preset {self.preset}, which has the mounting")
        text = ", and ".join(parts)
        return text[:1].upper() + text[1:]


def calibrate(
    path: Path, params: Params, duration_s: float = LONGEST_S, progress: Report = lambda fraction: None
) -> Calibration:
    """Find the mounting, the clock offset and the biases from the recording alone.

    Args:
        duration_s: how much of it to use. progress: called with the fraction done, 0-1.

    Raises:
        HemislamError: the recording cannot be read, has no IMU, or is too short; AxesError.
    """
    with open_recording(path, params) as recording:
        if not recording.imu_topic:
            raise HemislamError(f"{path} has no usable IMU, so there is nothing to calibrate.")
        preset, mounting = "", built_in_mounting(recording.preset, recording.imu_topic)
        if mounting and is_mounting_unknown(params):
            preset, params = recording.preset, params.merged({"sensor": mounting})
        excerpt = read_excerpt(recording, params, duration_s, lambda done: progress(READING * done))
    try:
        return calibrate_excerpt(path, params, excerpt, progress, preset)
    except np.linalg.LinAlgError as error:
        raise HemislamError(
            f"{path} cannot be calibrated ({error}); record again, walking slowly near walls."
        ) from None


def calibrate_excerpt(
    path: Path, params: Params, excerpt: Excerpt, progress: Report = lambda fraction: None, preset: str = ""
) -> Calibration:
    """As `calibrate`, from a part that was already read. preset: the source of the mounting in `params`."""
    inertial = Inertial(excerpt.seconds(excerpt.imu.stamps_ns), excerpt.imu.gyro, excerpt.imu.accel)
    given = lie.from_rpy_degrees(params.sensor.rotation), np.array(params.sensor.translation, np.float64)

    def report(number: int) -> Report:
        return lambda done: progress(READING + ROUND * (number + done))

    way = track(excerpt, None, report(0))
    alone = way.residual
    late = find_offset(way, inertial)
    if is_mirrored(way, inertial, late):
        raise AxesError(
            f"The gyroscope in {path} turns as the LiDAR does in a mirror: one of its axes has the wrong sign, or two "
            "are exchanged; correct the driver, or set recording.gyroscope_axes to -xyz, x-yz or xy-z."
        )
    turned = fit_rotation(way, inertial, first_rotation(way, inertial, late), late, given[0])
    guide = Guide.of(inertial, turned.R_imu_lidar, turned.late, turned.bias)
    moved = fit_translation(way, inertial, turned, given[1])
    observed = np.diag(turned.covariance)[:3] < NOT_TURNED**2
    if observed.all() and is_opposed(way, inertial, turned, moved):
        axes = axes_name(tuple((axis, -sign) for axis, sign in named_axes(params.recording.accelerometer_axes)))
        raise AxesError(
            f"The accelerometer in {path} reads the opposite of how the LiDAR moves: correct the driver, or set "
            f"recording.accelerometer_axes to {axes}."
        )
    lines, seen = Lines.none(excerpt.lines), excerpt
    for number in range(ROUNDS if observed.any() else 0):
        way = track(seen, guide, report(number + 1))
        turned = fit_rotation(way, inertial, turned.R_imu_lidar, turned.late, given[0])
        moved = fit_translation(way, inertial, turned, given[1])
        guide = Guide.of(
            inertial, turned.R_imu_lidar, turned.late, turned.bias, moved.p_imu_lidar, moved.bias, moved.gravity
        )
        if excerpt.lines:
            lines = fit_lines(seen, way, lines)
            seen = lines.applied(excerpt)
    down = moved.gravity / np.linalg.norm(moved.gravity)
    gyro_noise, accel_noise = (Noise.of(inertial.times, values) for values in (inertial.gyro, inertial.accel))
    residuals = alone, way.residual
    return Calibration(
        path, params, preset, excerpt.duration_s, turned, moved, down, residuals, gyro_noise, accel_noise, lines
    )
