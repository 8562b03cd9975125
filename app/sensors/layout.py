"""How a recording is read: each `auto` is settled from its first messages.

`settle_cloud` does it for the point clouds, `settle_imu` for the IMU. Every decision is a `Finding` that states its
evidence and names the option that changes it.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from app.sensors.azimuth import sense_of_rotation, settle_spin
from app.sensors.cloud_types import POINT_CLOUD_2, CloudMessage, CloudType, Probe
from app.sensors.findings import Finding
from app.sensors.pointcloud import CloudLayout
from app.sensors.rings import settle_rings
from app.sensors.timing import Timing, settle_timing
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.sections import RecordingParams
from app.slam.types import F32, F64, I64, U16

STANDARD_GRAVITY = 9.80665


@dataclass(frozen=True, slots=True)
class ImuProbe:
    """The first IMU samples: log times and stamps (k,) int64 ns, gyro and accel (k, 3) as recorded."""

    log_ns: I64
    stamps_ns: I64
    gyro: F64
    accel: F64


def settle_cloud(
    probes: list[Probe], chosen: RecordingParams, where: str, kind: CloudType = POINT_CLOUD_2
) -> tuple[CloudLayout, list[Finding]]:
    """Decide the layout of topic `where` from its first clouds, each with at least one valid point.

    Raises:
        HemislamError: the clouds have no x, y, z, or not the time field that was asked for.
    """
    fields = probes[0].cloud.fields
    names = {name.lower(): name for name in reversed(fields)}
    if chosen.time_field not in ("auto", "none") and chosen.time_field not in fields:
        raise HemislamError(
            f"The clouds of {where} have no field `{chosen.time_field}` for the time; they have "
            f"{', '.join(fields)}: choose one by --set recording.time_field=NAME, or `none`."
        )
    timing, time_findings = settle_timing(probes, kind, chosen)
    rings, ring_finding = settle_rings(probes, kind, names)
    clouds = [(probe.points, rings.of(probe.cloud, probe.points, probe.index)) for probe in probes]
    spin = None
    if timing.field is None:
        spin = settle_spin(clouds, timing.period_ns / 1e9)
        if spin.start is None:  # then only the cloud's own first or last point can be at the header stamp
            timing = replace(timing, anchor="last" if timing.shift_ns else "first", shift_ns=0)
    else:
        time_findings.append(_rotation_finding(clouds[-1], probes[-1].column(timing.field), timing))
    layout = CloudLayout(
        timing=timing,
        rings=rings,
        spin=spin,
        intensity_field=next((names[name] for name in kind.intensities if name in names), None),
        ground_field=names.get("ground"),
        kind=kind,
        stamped=probes[0].stamped,
    )
    return layout, [_fields_finding(probes[0].cloud), *time_findings, ring_finding]


def settle_imu(probe: ImuProbe, chosen: RecordingParams) -> tuple[float, list[Finding]]:
    """The factor that makes the accelerometer m/s^2, decided from the norm of its first samples."""
    norm = float(np.median(np.linalg.norm(probe.accel, axis=1)))
    text, option = f"the acceleration's norm is {norm:.3f} at the start", "--set recording.acceleration_unit="
    if chosen.acceleration_unit != "auto":
        scale = STANDARD_GRAVITY if chosen.acceleration_unit == "g" else 1.0
        text = f"{chosen.acceleration_unit}, as you set it; {text}"
        if 8.5 < norm * scale < 11.0:
            finding = Finding("IMU units", "fine", text)
        else:
            finding = Finding("IMU units", "needs you", f"{text}, which is not gravity in it", f"{option}auto")
    elif 0.8 < norm < 1.25:
        scale = STANDARD_GRAVITY
        finding = Finding("IMU units", "corrected", f"g: {text}; scaled to m/s²", f"{option}g")
    elif 8.5 < norm < 11.0:
        scale = 1.0
        finding = Finding("IMU units", "fine", f"m/s²: {text}", f"{option}m/s2")
    else:
        scale, taken, other = (STANDARD_GRAVITY, "g", "m/s2") if norm < 3.0 else (1.0, "m/s²", "g")
        text = f"{text}, neither 1 g nor 9.81 m/s²; taken as {taken}"
        finding = Finding("IMU units", "needs you", text, option + other)
    findings = [finding]
    turning = float(np.percentile(np.linalg.norm(probe.gyro, axis=1), 90))
    if turning > 10.0:
        text = f"the gyroscope reads {turning:.0f} at the start, too fast for rad/s; its driver must publish rad/s"
        findings.append(Finding("IMU units", "needs you", text))
    return scale, findings


def gravity_findings(probe: ImuProbe, scale: float, params: Params) -> list[Finding]:
    """The direction of down in the LiDAR frame, by the IMU's first samples, and whether the mount was given."""
    first = probe.stamps_ns - probe.stamps_ns[0] <= params.imu.start_duration * 1e9
    accel, gyro = probe.accel[first] * scale, probe.gyro[first]
    specific = accel.mean(axis=0)
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
        findings.append(Finding("mount", "needs you", text, option))
    return findings


def _rotation_finding(cloud: tuple[F32, U16], time: npt.NDArray[Any], timing: Timing) -> Finding:
    """Whether the azimuth follows the points' times, as it must on a rotating sensor."""
    points, ring = cloud
    order = np.argsort(time, kind="stable")
    clockwise, turns = sense_of_rotation(points[order], ring[order])
    if turns < 2.5:
        period_s = float(time.max() - time.min()) * timing.unit_ns / 1e9 / turns
        sense = "clockwise" if clockwise else "counter-clockwise"
        text = f"the points' times follow their azimuth: one turn in {period_s:.4f} s, {sense} seen from +z"
        return Finding("rotation", "fine", text)
    text = (
        "the points' times do not follow their azimuth: either the sensor does not rotate, or the times are made up "
        "and should be derived from the azimuth"
    )
    return Finding("rotation", "needs you", text, "--set recording.time_field=none")


def _fields_finding(cloud: CloudMessage) -> Finding:
    names = ", ".join(f"{name} ({dtype.name})" for name, (_, dtype) in cloud.fields.items())
    shape = f"{cloud.height}x{cloud.width} points" if cloud.height > 1 else f"{cloud.width} points"
    return Finding("fields", "fine", f"{names}; {shape} of {cloud.point_step} bytes in the first scan")
