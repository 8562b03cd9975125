"""Scans and IMU samples as ROS messages in the vendor's layout: to be recorded, published, or read like a recording."""

from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from app.slam.types import Scan

LIDAR_TOPIC, IMU_TOPIC = "/rslidar_points", "/imu/data"
CLOUD, IMU = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Imu"

STORE = get_typestore(Stores.ROS2_HUMBLE)
_TYPES = STORE.types

_DATATYPES = {"<f4": 7, "<f8": 8, "<u2": 4, "<i8": 9}


def _point(timestamp: str) -> np.dtype[Any]:
    names = ["x", "y", "z", "intensity", "ring", "timestamp"]
    return np.dtype(list(zip(names, ["<f4", "<f4", "<f4", "<f4", "<u2", timestamp], strict=True)))


_POINT, _EXACT = _point("<f8"), _point("<i8")

Vector = tuple[float, float, float]


def _fields(point: np.dtype[Any]) -> list[Any]:
    fields: dict[str, Any] = dict(point.fields or {})
    return [
        _TYPES["sensor_msgs/msg/PointField"](name=name, offset=at, datatype=_DATATYPES[kind.str], count=1)
        for name, (kind, at, *_) in fields.items()
    ]


_FIELDS, _EXACT_FIELDS = _fields(_POINT), _fields(_EXACT)


def cloud_message(scan: Scan, *, exact: bool = False) -> Any:
    """A PointCloud2 stamped with its last point; `timestamp` is absolute, in f64 seconds as drivers have it.

    Args:
        exact: `timestamp` in int64 ns instead, which loses nothing but is no standard type of field.
    """
    points = np.zeros(len(scan), _EXACT if exact else _POINT)
    points["x"], points["y"], points["z"] = scan.points.T
    points["intensity"], points["ring"] = scan.intensity, scan.ring
    stamps = scan.stamp_ns + scan.offsets_ns.astype(np.int64)
    points["timestamp"] = stamps if exact else stamps * 1e-9
    return _TYPES[CLOUD](
        header=_header(scan.end_ns, "rslidar"),
        height=1,
        width=len(points),
        fields=_EXACT_FIELDS if exact else _FIELDS,
        is_bigendian=False,
        point_step=points.itemsize,
        row_step=points.nbytes,
        data=points.view(np.uint8),
        is_dense=True,
    )


def empty_cloud(stamp_ns: int) -> Any:
    """A PointCloud2 without a point, for a revolution that saw nothing."""
    nothing = np.empty(0)
    scan = Scan(stamp_ns, np.empty((0, 3), np.float32), *(nothing.astype(kind) for kind in ("i4", "f4", "u2")))
    return cloud_message(scan, exact=True)


def imu_message(stamp_ns: int, gyro: Vector, accel: Vector) -> Any:
    """An Imu in rad/s and m/s^2, without orientation."""
    vector = _TYPES["geometry_msgs/msg/Vector3"]
    unknown = np.zeros(9)
    return _TYPES[IMU](
        header=_header(stamp_ns, "imu"),
        orientation=_TYPES["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.array([-1.0] + [0.0] * 8),
        angular_velocity=vector(*gyro),
        angular_velocity_covariance=unknown,
        linear_acceleration=vector(*accel),
        linear_acceleration_covariance=unknown,
    )


def serialised(message: Any, msgtype: str) -> bytes:
    """As CDR, what ROS 2 sends and records."""
    return bytes(STORE.serialize_cdr(message, msgtype))


def definition(msgtype: str) -> str:
    """The type's text, with those it is made of."""
    return str(STORE.generate_msgdef(msgtype)[0])


def _header(stamp_ns: int, frame: str) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = _TYPES["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    return _TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)
