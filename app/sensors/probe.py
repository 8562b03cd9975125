"""The first messages of a recording: which topics to use, the first clouds and IMU samples."""

from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from typing import Any, Literal

import numpy as np

from app.sensors.cloud_types import CLOUD_TYPES, CloudError, Probe, stamped
from app.sensors.findings import Finding
from app.sensors.imu_units import ImuProbe, holds_gravity, measured
from app.sensors.ros import IMU, imu_values, stamp_fault, stamp_ns
from app.sensors.source import Source, Topic
from app.slam.errors import HemislamError

_CONTENT = {"lidar": "point clouds", "imu": "IMU samples"}

PROBED_CLOUDS = 10
PROBED_IMU_NS = 20_000_000_000

PACKETS = {
    "VelodyneScan", "PacketMsg", "RslidarPacket", "rslidarScan", "PandarScan", "UdpFrame", "UdpPacket", "NebulaPackets"
}  # fmt: skip
"""Names of message types that hold raw packets: of the Velodyne, Ouster, RoboSense and Hesai drivers, and of Nebula."""


def _set_aside(why: str) -> Finding:
    text = (
        f"{why}, so the IMU is not used: motion is estimated from the LiDAR alone, less accurately, and not in quick "
        "turns; have the driver send raw measurements, or start hemislam with --imu-topic and another topic"
    )
    return Finding("IMU topic", "needs you", text)


NO_IMU = Finding(
    "IMU topic",
    "corrected",
    "there is no IMU: motion is estimated from the LiDAR alone, less accurately, and not in quick turns",
)
NO_GRAVITY = _set_aside("its accelerations hold no gravity")
NO_NUMBERS = _set_aside("its first samples are all NaN or absurd")
WITHOUT_IMU = frozenset({NO_IMU, NO_GRAVITY, NO_NUMBERS})
"""One of these is among the findings if the LiDAR is used alone."""


def usable_types(sensor: Literal["lidar", "imu"]) -> tuple[str, ...]:
    """Message types that hold measurements of this sensor."""
    return tuple(CLOUD_TYPES) if sensor == "lidar" else (IMU,)


def choose_topic(source: Source, sensor: Literal["lidar", "imu"], wanted: str) -> tuple[Topic, Finding]:
    """The topic to use for a sensor, by name if `wanted`, else by type.

    Raises:
        HemislamError: there is none with messages; names the topics of the recording.
    """
    kinds, content, option = usable_types(sensor), _CONTENT[sensor], f"--{sensor}-topic "
    candidates = [topic for topic in source.topics if topic.type in kinds and topic.messages]
    listed = ", ".join(f"{topic.name} ({topic.type})" for topic in source.topics)
    subject = f"{sensor} topic" if sensor == "lidar" else "IMU topic"
    if wanted:
        for topic in candidates:
            if topic.name == wanted:
                return topic, Finding(subject, "fine", f"{wanted}, {topic.messages} messages, as you set it")
        found = next((topic for topic in source.topics if topic.name == wanted), None)
        why = "no topic" if found is None else ("no messages on" if found.type in kinds else f"no {content} on")
        others = " or ".join(option + topic.name for topic in candidates)
        hint = f"start hemislam with {others}" if others else f"it has {listed}"
        raise HemislamError(f"{source.path} has {why} {wanted}; {hint}.")
    if not candidates:
        empty = [topic.name for topic in source.topics if topic.type in kinds]
        why = f"no messages on {empty[0]}" if empty else f"no topic of type {' or '.join(kinds)}"
        packets = [topic.name for topic in source.topics if topic.type.rpartition("/")[2] in PACKETS and topic.messages]
        if packets and sensor == "lidar":
            raise HemislamError(
                f"{source.path} holds no {content}, only packets as the sensor sends them ({', '.join(packets)}): run "
                "its ROS driver on the recording, and record the PointCloud2 that the driver makes of them."
            )
        raise HemislamError(f"{source.path} holds no {content}: {why}; it has {listed}.")
    if len(candidates) == 1:
        return candidates[0], Finding(subject, "fine", f"{candidates[0].name}, {candidates[0].messages} messages")
    content_of = {topic.name: _content(source, topic) for topic in candidates}
    fullest = max(content_of.values())
    chosen = max(candidates, key=lambda topic: (content_of[topic.name], topic.messages))  # in a tie, the first
    rest = ", ".join(topic.name for topic in candidates if topic is not chosen)
    if sum(content == fullest for content in content_of.values()) == 1:
        what = "times or rings" if sensor == "lidar" else "both accelerations and rates"
        text = f"{chosen.name}, {chosen.messages} messages, chosen because it holds {what}; there are also {rest}"
        return chosen, Finding(subject, "corrected", text, option + rest.split(", ")[0])
    text = f"{chosen.name} has the most messages ({chosen.messages}); there are also {rest}"
    return chosen, Finding(subject, "needs you", text, option + chosen.name)


def _content(source: Source, topic: Topic) -> int:
    """How much of the needed content a topic's first messages hold. Clouds of a depth camera, or clouds that a program
    has registered, have neither times nor rings, and some IMUs send accelerations and rates on two topics."""
    first = [message for _, message in islice(_until_damage(source.readable(topic.name)), 5)]
    if topic.type == IMU:
        accel, gyro = (np.array([imu_values(message)[part] for message in first]) for part in (1, 0))
        return int(accel.any()) + int(gyro.any())
    kind = CLOUD_TYPES[topic.type]
    names: set[str] = set()
    for message in first:
        with suppress(CloudError):
            names |= {name.lower() for name in kind.read(message).fields}
    fixed = kind.time_unit != "auto"  # the type is a scanner's own
    return 2 if fixed else sum(not names.isdisjoint(usual) for usual in (kind.times, kind.rings))


def probe_clouds(source: Source, topic: Topic) -> tuple[list[Probe], list[Finding]]:
    """The first clouds that have points, and findings.

    Raises:
        HemislamError: there are fewer than two.
    """
    probes: list[Probe] = []
    unusable, reason = 0, ""
    for log_ns, message in _until_damage(source.readable(topic.name)):
        try:
            probe = Probe(log_ns, CLOUD_TYPES[topic.type].read(message))
            if not {"x", "y", "z"} <= probe.cloud.fields.keys():
                raise CloudError(f"they have no x, y, z, but {', '.join(probe.cloud.fields) or 'no fields'}")
            has_points = len(probe.points) > 0
        except CloudError as error:
            has_points, reason = False, str(error)
        if has_points:
            probes.append(probe)
        else:
            unusable += 1
        if len(probes) == PROBED_CLOUDS:
            break
    if not probes:
        why = reason or "each is empty, or all of its points are beyond 10 km, NaN or zero"
        raise HemislamError(
            f"None of the {unusable} point clouds on {topic.name} in {source.path} has a usable point ({why}); "
            "check the LiDAR's driver, or start hemislam with --lidar-topic and another topic."
        )
    if len(probes) == 1:
        raise HemislamError(
            f"{source.path} holds a single usable scan on {topic.name}, and a map needs at least two; record more."
        )
    findings = []
    if unusable:
        text = f"{unusable} of the first {unusable + len(probes)} clouds have no usable point and are left out"
        findings.append(Finding("empty clouds", "corrected", text))
    findings += _stamp_findings([probe.cloud.stamp_ns for probe in probes], topic.name)
    return stamped(probes), findings


def probe_imu(source: Source, topic: str, time_offset_s: float) -> tuple[ImuProbe, bool, list[Finding]]:
    """The first IMU samples that are numbers, which may be none, whether their headers carry time, and findings."""
    logs, stamps, values = [], [], []
    for log_ns, message in _until_damage(source.readable(topic)):
        logs.append(log_ns)
        stamps.append(stamp_ns(message.header.stamp))
        values.append(imu_values(message))
        if log_ns - logs[0] > PROBED_IMU_NS:
            break
    findings = _stamp_findings(stamps, topic)
    rows = np.array(values, np.float64).reshape(-1, 6)
    good = measured(rows[:, :3], rows[:, 3:])
    times = np.array(logs if findings else stamps, np.int64) + round(time_offset_s * 1e9)
    probe = ImuProbe(np.array(logs, np.int64)[good], times[good], rows[good, :3], rows[good, 3:])
    return probe, not findings, findings


def unfit_imu(imu: ImuProbe, unit: str) -> Finding | None:
    """Why the IMU cannot be used, if so. Gravity is not asked for if the user sets the unit."""
    if not len(imu.accel):
        return NO_NUMBERS
    return None if unit != "auto" or holds_gravity(imu) else NO_GRAVITY


def _stamp_findings(stamps: list[int], topic: str) -> list[Finding]:
    if not (carried := stamp_fault(stamps)):
        return []
    text = f"the headers of {topic} carry {carried}; the log times are used instead, less exact: check the driver"
    return [Finding("stamps", "corrected", text)]


def _until_damage(entries: Iterator[tuple[int, Any]]) -> Iterator[tuple[int, Any]]:
    """The entries up to where the file cannot be read any further; reading the recording reports that later."""
    some = False
    try:
        for entry in entries:
            some = True
            yield entry
    except HemislamError:
        if not some:
            raise
