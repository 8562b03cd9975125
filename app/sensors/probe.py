"""A look at a recording's first messages: which topics to use, the first clouds and IMU samples."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from app.sensors.findings import Finding
from app.sensors.layout import ImuProbe, Probe
from app.sensors.pointcloud import CloudError, CloudMessage, stamp_ns, valid_points
from app.sensors.source import Source
from app.slam.errors import HemislamError

TYPES = {"lidar": "sensor_msgs/msg/PointCloud2", "imu": "sensor_msgs/msg/Imu"}
_CONTENT = {"lidar": "point clouds", "imu": "IMU samples"}

PROBED_CLOUDS = 10
PROBED_IMU_NS = 2_000_000_000


def choose_topic(source: Source, sensor: Literal["lidar", "imu"], wanted: str) -> tuple[str, Finding]:
    """The topic to use for a sensor, by name if `wanted`, else by type.

    Raises:
        HemislamError: there is none with messages; names those that there are.
    """
    kind, content, option = TYPES[sensor], _CONTENT[sensor], f"--{sensor}-topic "
    candidates = [topic for topic in source.topics if topic.type == kind and topic.messages]
    listed = ", ".join(f"{topic.name} ({topic.type})" for topic in source.topics)
    subject = f"{sensor} topic" if sensor == "lidar" else "IMU topic"
    if wanted:
        chosen = next((topic for topic in candidates if topic.name == wanted), None)
        if chosen is None:
            found = next((topic for topic in source.topics if topic.name == wanted), None)
            why = "no topic" if found is None else ("no messages on" if found.type == kind else f"no {content} on")
            others = " or ".join(option + topic.name for topic in candidates)
            hint = f"use {others}" if others else f"it has {listed}"
            raise HemislamError(f"{source.path} has {why} {wanted}; {hint}.")
        return wanted, Finding(subject, "fine", f"{wanted}, {chosen.messages} messages, as you set it")
    if not candidates:
        empty = [topic.name for topic in source.topics if topic.type == kind]
        why = f"no messages on {empty[0]}" if empty else f"no topic of type {kind}"
        raise HemislamError(f"{source.path} holds no {content}: {why}; it has {listed}.")
    chosen = max(candidates, key=lambda topic: topic.messages)  # the first of equals
    if len(candidates) == 1:
        return chosen.name, Finding(subject, "fine", f"{chosen.name}, {chosen.messages} messages")
    rest = ", ".join(topic.name for topic in candidates if topic is not chosen)
    text = f"{chosen.name} has the most messages ({chosen.messages}); there are also {rest}"
    return chosen.name, Finding(subject, "needs you", text, option + chosen.name)


def probe_clouds(source: Source, topic: str) -> tuple[list[Probe], bool, list[Finding]]:
    """The first clouds that have points, whether their headers carry time, and findings.

    Raises:
        HemislamError: there are not two of them.
    """
    probes: list[Probe] = []
    unusable, reason = 0, ""
    for _, log_ns, message in _readable(source.messages((topic,))):
        try:
            cloud = CloudMessage.from_ros(message)
            if not {"x", "y", "z"} <= cloud.fields.keys():
                raise CloudError(f"they have no x, y, z, but {', '.join(cloud.fields) or 'no fields'}")
            has_points = len(valid_points(cloud.xyz())[0]) > 0
        except CloudError as error:
            has_points, reason = False, str(error)
        if has_points:
            probes.append(Probe(log_ns, cloud))
        else:
            unusable += 1
        if len(probes) == PROBED_CLOUDS:
            break
    if not probes:
        why = reason or "each is empty, or all of its points are NaN or zero"
        raise HemislamError(
            f"None of the {unusable} point clouds on {topic} in {source.path} has a usable point ({why}); "
            "check the LiDAR's driver, or choose another topic by --lidar-topic."
        )
    if len(probes) == 1:
        raise HemislamError(
            f"{source.path} holds a single usable scan on {topic}, and a map needs at least two; record more."
        )
    findings = []
    if unusable:
        text = f"{unusable} of the first {unusable + len(probes)} clouds have no usable point and are left out"
        findings.append(Finding("empty clouds", "corrected", text))
    stamped = len({probe.cloud.stamp_ns for probe in probes}) > 1
    if not stamped:
        probes = [Probe(probe.log_ns, replace(probe.cloud, stamp_ns=probe.log_ns), stamped=False) for probe in probes]
        findings.append(_unstamped(topic))
    return probes, stamped, findings


def probe_imu(source: Source, topic: str, time_offset_s: float) -> tuple[ImuProbe, bool, list[Finding]]:
    """The first IMU samples that are numbers, whether their headers carry time, and findings.

    Raises:
        HemislamError: all of them are NaN.
    """
    logs, stamps, values = [], [], []
    for _, log_ns, message in _readable(source.messages((topic,))):
        w, a = message.angular_velocity, message.linear_acceleration
        logs.append(log_ns)
        stamps.append(stamp_ns(message.header.stamp))
        values.append((w.x, w.y, w.z, a.x, a.y, a.z))
        if log_ns - logs[0] > PROBED_IMU_NS:
            break
    stamped = len(set(stamps)) > 1
    rows = np.array(values, np.float64).reshape(-1, 6)
    good = np.isfinite(rows).all(axis=1)
    if not good.any():
        raise HemislamError(
            f"The first {len(rows)} IMU samples on {topic} in {source.path} are all NaN; check the IMU's driver."
        )
    times = np.array(stamps if stamped else logs, np.int64) + round(time_offset_s * 1e9)
    probe = ImuProbe(np.array(logs, np.int64)[good], times[good], rows[good, :3], rows[good, 3:])
    return probe, stamped, [] if stamped else [_unstamped(topic)]


def _unstamped(topic: str) -> Finding:
    return Finding("stamps", "corrected", f"the headers of {topic} carry no time; the log times are used instead")


def _readable(entries: Iterator[tuple[str, int, Any]]) -> Iterator[tuple[str, int, Any]]:
    """What comes before a damage, if anything does; whoever reads the recording is told of it then."""
    some = False
    try:
        for entry in entries:
            some = True
            yield entry
    except HemislamError:
        if not some:
            raise
