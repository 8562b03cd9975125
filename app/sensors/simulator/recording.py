"""Writes what was simulated as a ROS 2 recording in the vendor's layout.

`/rslidar_points` is a dense PointCloud2 of x y z intensity (f32), ring (u16), ground (u8: the
truth, 1 = floor or terrain) and timestamp (f64, absolute seconds), stamped with its last point;
`/imu/data` is a sensor_msgs/Imu in SI units without orientation.
"""

from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from app.sensors.simulator.lidar import Returns
from app.slam.types import F64

LIDAR_TOPIC, IMU_TOPIC = "/rslidar_points", "/imu/data"

POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "ground", "timestamp"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "u1", "<f8"],
        "offsets": [0, 4, 8, 12, 16, 18, 20],
        "itemsize": 28,
    }
)
_ROS_DATATYPE = {"<f4": 7, "<f8": 8, "<u2": 4, "|u1": 2}

TRANSPORT_NS = 4_000_000
"""A cloud reaches the recorder this long after its last point."""


class RecordingWriter:
    """A bare .mcap file, written message by message in the order in which a recorder gets them."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._mcap = Writer(self._file, compression=CompressionType.ZSTD)
        self._mcap.start(profile="ros2")
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._types = self._store.types
        self._lidar = self._channel(LIDAR_TOPIC, "sensor_msgs/msg/PointCloud2")
        self._imu = self._channel(IMU_TOPIC, "sensor_msgs/msg/Imu")
        self._fields = [
            self._types["sensor_msgs/msg/PointField"](
                name=name, offset=POINT.fields[name][1], datatype=_ROS_DATATYPE[POINT.fields[name][0].str], count=1
            )
            for name in POINT.names or ()
            if POINT.fields is not None
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._mcap.finish()  # type: ignore[no-untyped-call]  # mcap leaves it untyped
        finally:
            self._file.close()

    def add_cloud(self, returns: Returns, end_ns: int) -> None:
        """One revolution, stamped `end_ns`."""
        points = np.zeros(len(returns.points), POINT)
        points["x"], points["y"], points["z"] = returns.points.T
        points["intensity"] = returns.intensity
        points["ring"] = returns.ring
        points["ground"] = returns.ground
        points["timestamp"] = returns.stamps_ns * 1e-9
        message = self._types["sensor_msgs/msg/PointCloud2"](
            header=self._header(end_ns, "rslidar"),
            height=1,
            width=len(points),
            fields=self._fields,
            is_bigendian=False,
            point_step=POINT.itemsize,
            row_step=points.nbytes,
            data=points.view(np.uint8),
            is_dense=True,
        )
        self._write(self._lidar, "sensor_msgs/msg/PointCloud2", message, end_ns + TRANSPORT_NS)

    def add_imu(self, stamp_ns: int, gyro: F64, accel: F64) -> None:
        """One sample: gyro (3,) rad/s, accel (3,) m/s^2."""
        vector = self._types["geometry_msgs/msg/Vector3"]
        unknown = np.zeros(9)
        message = self._types["sensor_msgs/msg/Imu"](
            header=self._header(stamp_ns, "imu"),
            orientation=self._types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=np.array([-1.0] + [0.0] * 8),
            angular_velocity=vector(*map(float, gyro)),
            angular_velocity_covariance=unknown,
            linear_acceleration=vector(*map(float, accel)),
            linear_acceleration_covariance=unknown,
        )
        self._write(self._imu, "sensor_msgs/msg/Imu", message, stamp_ns)

    def _channel(self, topic: str, msgtype: str) -> int:
        definition, _ = self._store.generate_msgdef(msgtype)
        schema = self._mcap.register_schema(msgtype, "ros2msg", definition.encode())
        return self._mcap.register_channel(topic, "cdr", schema, {"offered_qos_profiles": ""})

    def _header(self, stamp_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        stamp = self._types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        return self._types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)

    def _write(self, channel: int, msgtype: str, message: Any, log_ns: int) -> None:
        data = bytes(self._store.serialize_cdr(message, msgtype))
        self._mcap.add_message(channel, log_ns, data, publish_time=log_ns)
