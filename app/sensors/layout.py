"""How point clouds are read: each `auto` is settled from the first clouds.

Every decision is a `Finding` that states its evidence and names the option that changes it. `imu_units.py` does the
same for the IMU.
"""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from app.sensors.azimuth import sense_of_rotation, settle_spin, share_of_turn
from app.sensors.cloud_types import POINT_CLOUD_2, CloudMessage, CloudType, Probe
from app.sensors.findings import Finding
from app.sensors.pointcloud import CloudLayout
from app.sensors.rings import settle_rings
from app.sensors.timing import Timing, scan_period_ns, settle_timing
from app.slam.errors import HemislamError
from app.slam.sections import RecordingParams
from app.slam.types import F32, U16


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # invalid numbers are left out, or give a finding
def settle_cloud(
    probes: list[Probe], chosen: RecordingParams, where: str, kind: CloudType = POINT_CLOUD_2
) -> tuple[CloudLayout, list[Finding]]:
    """Decide the layout of topic `where` from its first clouds, each with at least one valid point.

    Raises:
        HemislamError: the clouds lack x, y, z, or the chosen time field.
    """
    (usual, _), *_ = Counter(tuple(probe.cloud.fields) for probe in probes).most_common()
    probes = [probe for probe in probes if tuple(probe.cloud.fields) == usual]  # others are left out later
    fields = probes[0].cloud.fields
    names = {name.lower(): name for name in reversed(fields)}
    if chosen.time_field not in ("auto", "none") and chosen.time_field not in fields:
        raise HemislamError(
            f"The clouds of {where} have no field `{chosen.time_field}` for the time; they have "
            f"{', '.join(fields)}: start hemislam with --set recording.time_field=NAME, or `none`."
        )
    timing, time_findings = settle_timing(probes, kind, chosen)
    probes = [probe for cloud in probes if len((probe := replace(cloud, time=timing.field)).points)]
    rings, ring_finding = settle_rings(probes, kind, names)
    clouds = [(probe.points, rings.of(probe.cloud, probe.points, probe.index)) for probe in probes]
    spin = None
    if timing.field is None:
        spin = settle_spin(clouds, timing.period_ns / 1e9)
        if not spin.ordered:
            text = f"{time_findings[0].text}; but the order of the points shows no rotation, so this is a guess"
            time_findings[0] = replace(time_findings[0], verdict="needs you", text=text)
        else:
            _, turns = sense_of_rotation(*clouds[0])
            share = share_of_turn(np.stack([points[0] for points, _ in clouds]), spin.clockwise, turns)
            if share < 1.0:
                rate = share * 1e9 / scan_period_ns(probes, 0.0)[0]
                time_findings[0] = _of_parts(time_findings[0], share, rate, chosen.rotation_rate)
        if spin.start is None:  # then the header stamp can only be the time of the cloud's own first or last point
            timing = replace(timing, anchor="last" if timing.shift_ns else "first", shift_ns=0)
    elif rings.of_lines:
        firsts = np.stack([probe.points[probe.column(timing.field).argmin()] for probe in probes])
        time_findings.append(_rotation_finding(clouds[-1], probes[-1].column(timing.field), timing, firsts))
    layout = CloudLayout(
        timing=timing,
        rings=rings,
        spin=spin,
        intensity_field=next((names[name] for name in kind.intensities if name in names), None),
        ground_field=names.get("ground"),
        kind=kind,
        stamped=probes[0].stamped,
    )
    findings = [_fields_finding(probes[0].cloud), *time_findings, ring_finding]
    if any(probe.cloud.swapped for probe in probes):
        text = "the clouds state a wrong byte order (is_bigendian); they are read in the other one"
        findings.append(Finding("fields", "corrected", text))
    return layout, findings


def _of_parts(found: Finding, share: float, rate: float, chosen_rate: float) -> Finding:
    """The finding on times from the azimuth if each message holds only this share of a turn."""
    text = f"the sensor turns {rate:.3g} times a second, and {_held(share)}; times are {found.text}"
    if abs(chosen_rate - rate) < 0.1 * rate:
        return replace(found, verdict="corrected", text=text)
    return replace(found, verdict="needs you", text=text, option=f"--set recording.rotation_rate={rate:.3g}")


def _held(share: float) -> str:
    return (
        f"each message holds {360 * share:.0f} degrees of a turn, and mapping is better with 360: make the driver "
        "publish whole turns, if it can"
    )


def _rotation_finding(cloud: tuple[F32, U16], time: npt.NDArray[Any], timing: Timing, firsts: F32) -> Finding:
    """Whether the azimuth follows the points' times, as it must on a rotating sensor. firsts: as `share_of_turn`."""
    points, ring = cloud
    order = np.argsort(time, kind="stable")
    clockwise, turns = sense_of_rotation(points[order], ring[order])
    if turns < 2.5:
        period_s = float(time.max() - time.min()) * timing.unit_ns / 1e9 / turns
        sense = "clockwise" if clockwise else "counter-clockwise"
        text = f"the points' times follow their azimuth: one turn in {period_s:.4f} s, {sense} seen from +z"
        share = share_of_turn(firsts, clockwise, turns)
        if share < 1.0:
            return Finding("rotation", "needs you", f"{text}; {_held(share)}")
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
