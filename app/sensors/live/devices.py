"""The sensors whose packets can be read, live and from captures: one entry in `DEVICES` each."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from ipaddress import ip_address
from itertools import islice
from pathlib import Path

from app.sensors import ros
from app.sensors.findings import Finding
from app.sensors.live.difop import DIFOP_PORT
from app.sensors.live.frames import sensor_of
from app.sensors.live.imu_udp import AIRY_IMU_PORT
from app.sensors.live.livox_udp import IMU_PORT, MID360, POINTS_PORT, Livox
from app.sensors.live.msop import MSOP_PORT
from app.sensors.live.pcap import Datagram
from app.sensors.robosense import AIRY, BPEARL, BPV4, Model
from app.slam import lie
from app.slam.types import F64


@dataclass(frozen=True, slots=True, eq=False)
class Device:
    """A LiDAR that sends packets.

    Attributes:
        models: that send the same packets. ports: by default, of measurements, then of the others.
        layout: topics and type of its clouds, as its ROS driver names them. has_imu: whether it sends IMU samples.
        has_angles: whether its channels have directions of their own, which it states once a second.
    """

    models: tuple[Model | Livox, ...]
    ports: tuple[int, ...]
    layout: ros.Layout
    has_imu: bool = True
    has_angles: bool = True

    @property
    def model(self) -> Model | Livox:
        return self.models[0]


DEVICES = {
    "rsbpearl": Device((BPEARL, BPV4), (MSOP_PORT, DIFOP_PORT), ros.Layout(), has_imu=False),
    "airy": Device((AIRY,), (MSOP_PORT, DIFOP_PORT, AIRY_IMU_PORT), ros.AIRY_LAYOUT),
    "mid360": Device((MID360,), (POINTS_PORT, IMU_PORT), ros.MID360_LAYOUT, has_angles=False),
}
"""By the scheme of their addresses."""

_COMPARED = 1_000
"""Packets of measurements, half a second of a sensor, that settle which of several LiDARs is read."""


def device_of(packets: Iterable[bytes]) -> Device | None:
    """The sensor of the first packet that holds measurements."""
    sensors = (sensor_of(packet) for packet in packets)
    found = next((sensor for sensor in sensors if sensor is not None), None)
    return next((device for device in DEVICES.values() if found in device.models), None)


def sender_of(datagrams: Iterable[Datagram], measured: Callable[[bytes], bool]) -> bytes | None:
    """The address that most of the first packets of measurements come from; of equals, the first."""
    senders = (datagram.sender for datagram in datagrams if measured(datagram.payload))
    return next((sender for sender, _ in Counter(islice(senders, _COMPARED)).most_common(1)), None)


def senders_finding(path: Path, used: bytes | None, others: set[bytes]) -> list[Finding]:
    """Which of several LiDARs in a capture is read, and how to read another."""
    if used is None or not others:
        return []
    left_out = ", ".join(str(ip_address(other)) for other in sorted(others))
    text = (
        f"{1 + len(others)} LiDARs send in this capture; only {ip_address(used)} is read, and {left_out} left out. A "
        ".json or .angles.csv beside the file must belong to the LiDAR that is read. To read another, remove this one: "
        f"`tcpdump -r {path} -w other.pcap not src host {ip_address(used)}`"
    )
    return [Finding("LiDARs", "needs you", text)]


def mount_finding(T_imu_lidar: F64) -> Finding:
    """The mount that a unit reports, and how to use it. T_imu_lidar: (4, 4), m."""
    place = ", ".join(f"{x:.5f}" for x in T_imu_lidar[:3, 3])
    angles = ", ".join(f"{angle:.2f}" for angle in lie.rpy_degrees(T_imu_lidar[:3, :3]))
    option = f"--set 'sensor.translation=[{place}]' --set 'sensor.rotation=[{angles}]'"
    return Finding(
        "unit's mount", "fine", f"the unit says how its LiDAR sits relative to its IMU; to use that: {option}"
    )
