"""The sensors whose packets can be read, live and from captures: one entry in `DEVICES` each."""

from collections.abc import Iterable
from dataclasses import dataclass

from app.sensors import ros
from app.sensors.findings import Finding
from app.sensors.live.difop import DIFOP_PORT
from app.sensors.live.frames import sensor_of
from app.sensors.live.imu_udp import AIRY_IMU_PORT
from app.sensors.live.livox_udp import IMU_PORT, MID360, POINTS_PORT, Livox
from app.sensors.live.msop import MSOP_PORT
from app.sensors.robosense import AIRY, BPEARL, BPV4, Model
from app.slam import lie
from app.slam.types import F64


@dataclass(frozen=True, slots=True, eq=False)
class Device:
    """A LiDAR that sends packets.

    Attributes:
        models: models with the same packets. ports: defaults, for measurements, then for other packets.
        layout: topics and type of its clouds, as its ROS driver names them. has_imu: whether it sends IMU samples.
        has_angles: whether each unit has channel directions of its own, which it states once a second.
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
"""Devices by the scheme of their addresses."""


def device_of(packets: Iterable[bytes]) -> Device | None:
    """The sensor of the first packet that holds measurements."""
    sensors = (sensor_of(packet) for packet in packets)
    found = next((sensor for sensor in sensors if sensor is not None), None)
    return next((device for device in DEVICES.values() if found in device.models), None)


def mount_finding(T_imu_lidar: F64) -> Finding:
    """The finding on the mounting that a unit reports, and how to use it. T_imu_lidar: (4, 4), m."""
    place = ", ".join(f"{x:.5f}" for x in T_imu_lidar[:3, 3])
    angles = ", ".join(f"{angle:.2f}" for angle in lie.rpy_degrees(T_imu_lidar[:3, :3]))
    option = f"--set 'sensor.translation=[{place}]' --set 'sensor.rotation=[{angles}]'"
    return Finding("unit's mount", "fine", f"the unit reports the pose of its LiDAR on its IMU; to use it: {option}")
