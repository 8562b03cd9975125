"""ROS messages without ROS: read from bytes, made from scans and IMU samples, written to .mcap files.

Clouds are written in the vendor's layout: x, y, z, intensity (f32), ring (u16), `ground` (u8, only if the truth is
known) and the absolute time of each point. Their stamp is the time of the last point.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from app.sensors import livox
from app.sensors.livox import CUSTOM_MSGS, CustomMsg
from app.slam.types import Scan, Vector

LIDAR_TOPIC, IMU_TOPIC = "/rslidar_points", "/imu/data"
CLOUD, IMU = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Imu"
ENCODINGS: Final = {"cdr": "ros2msg", "ros1": "ros1msg"}
"""Message encodings that can be read, with the format of their definitions."""
_STORES: Final = {"cdr": Stores.ROS2_HUMBLE, "ros1": Stores.ROS1_NOETIC}

DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8", 9: "i8", 10: "u8"}
"""PointField.datatype as numpy's; 9 and 10 (64-bit integers) are an extension that some drivers use."""
_DATATYPE_OF = {np.dtype(kind): number for number, kind in DATATYPES.items()}


@dataclass(frozen=True, slots=True)
class Lost:
    """A message that cannot be read. why: in the words of the library."""

    why: str


def read_or_lose(read: Callable[..., Any], data: bytes, *kind: str) -> Any:
    """`read(data, *kind)`, or Lost if it fails. Messages that cannot be unpacked come without bytes."""
    try:
        return read(data, *kind) if data else Lost("the bytes are not as they were written")
    except Exception as error:  # the libraries let errors of struct, numpy and assert pass
        return Lost(brief(error))


class Deserialiser:
    """Reads messages of the standard types, and of those whose definitions it was given.

    A standard type is read by its standard definition, whatever a file states about it.

    Args:
        learnt: other types, by encoding.
    """

    def __init__(self, learnt: dict[str, Typestore] | None = None) -> None:
        self._learnt = learnt or {}

    def learn(self, kind: str, definition: str, encoding: str) -> None:
        """Read messages of this type too; a definition that makes no sense is ignored."""
        if not definition or kind in CUSTOM_MSGS or kind in self._store(kind, encoding).types:
            return
        store = self._learnt.setdefault(encoding, get_typestore(_STORES[encoding]))
        try:
            found = get_types_from_msg(definition, kind)
            store.register({name: fields for name, fields in found.items() if name not in store.types})
        except Exception:  # the parser raises errors of its own and of Python
            return

    def read(self, data: bytes, kind: str, encoding: str) -> Any:
        """The message. Raises whatever the library raises for bytes that are not such a message."""
        if kind in CUSTOM_MSGS:
            return CustomMsg.of(data, encoding)
        store = self._store(kind, encoding)
        view = memoryview(data)  # the library slices this; slices of bytes would copy every cloud
        return store.deserialize_ros1(view, kind) if encoding == "ros1" else store.deserialize_cdr(view, kind)

    def _store(self, kind: str, encoding: str) -> Typestore:
        standard = _standard(encoding)
        return standard if kind in standard.types else self._learnt.get(encoding, standard)


@cache
def _standard(encoding: str) -> Typestore:
    """The standard types of an encoding. All share them, since a store writes the code that reads a type on first use,
    which takes some 40 ms."""
    return get_typestore(_STORES[encoding])


def brief(error: BaseException) -> str:
    """The library's own words, shortened to fit into a sentence."""
    text = " ".join(str(error).split()).rstrip(".")
    return text[:120] or type(error).__name__


def ros2_type(name: str) -> str:
    """`sensor_msgs/Imu` of ROS 1 as `sensor_msgs/msg/Imu`."""
    package, slash, rest = name.partition("/")
    return f"{package}/msg/{rest}" if slash and not rest.startswith("msg/") else name


def stamp_ns(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def stamp_fault(stamps: list[int]) -> str:
    """What headers carry instead of times: "no time" if all are the same, or "whole seconds only"; "" for times."""
    different = set(stamps)
    if len(different) < 2:
        return "no time"
    whole = len(different) < len(stamps) and not any(stamp % 1_000_000_000 for stamp in different)
    return "whole seconds only" if whole else ""


def imu_values(message: Any) -> tuple[Vector, Vector]:
    """Angular velocity and acceleration of an Imu, in its own units."""
    w, a = message.angular_velocity, message.linear_acceleration
    return (w.x, w.y, w.z), (a.x, a.y, a.z)


def new(kind: str, **fields: Any) -> Any:
    """A message of a standard type."""
    return _standard("cdr").types[kind](**fields)


def cloud_message(scan: Scan, *, exact: bool = False, stamp_ns: int | None = None, frame: str = "rslidar") -> Any:
    """A PointCloud2 with the points' absolute times in `timestamp`, in f64 seconds as drivers write them.

    Args:
        exact: the times in int64 ns instead, which is exact but not a standard type of field.
        stamp_ns: of the message; None: the time of the last point. frame: name of its frame.
    """
    point = _point_type("<i8" if exact else "<f8", scan.truth_ground is not None)
    points = np.zeros(len(scan), point)
    points["x"], points["y"], points["z"] = scan.points.T
    points["intensity"], points["ring"] = scan.intensity, scan.ring
    if scan.truth_ground is not None:
        points["ground"] = scan.truth_ground
    stamps = scan.stamp_ns + scan.offsets_ns.astype(np.int64)
    points["timestamp"] = stamps if exact else stamps * 1e-9
    return points_message(points, scan.end_ns if stamp_ns is None else stamp_ns, frame)


def points_message(points: npt.NDArray[Any], stamp_ns: int, frame: str) -> Any:
    """A PointCloud2 of a structured array (n,)."""
    columns: dict[str, Any] = dict(points.dtype.fields or {})
    return new(
        CLOUD,
        header=header(stamp_ns, frame),
        height=1,
        width=len(points),
        fields=[
            new("sensor_msgs/msg/PointField", name=name, offset=at, datatype=_DATATYPE_OF[kind], count=1)
            for name, (kind, at, *_) in columns.items()
        ],
        is_bigendian=False,
        point_step=points.itemsize,
        row_step=points.nbytes,
        data=points.view(np.uint8),
        is_dense=True,
    )


def empty_cloud(stamp_ns: int) -> Any:
    """A PointCloud2 without points, for a revolution without returns."""
    return points_message(np.empty(0, _point_type("<i8", False)), stamp_ns, "rslidar")


def imu_message(stamp_ns: int, gyro: Vector, accel: Vector) -> Any:
    """An Imu in rad/s and m/s^2, without orientation."""
    unknown = np.zeros(9)
    return new(
        IMU,
        header=header(stamp_ns, "imu"),
        orientation=new("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.array([-1.0] + [0.0] * 8),
        angular_velocity=_vector(gyro),
        angular_velocity_covariance=unknown,
        linear_acceleration=_vector(accel),
        linear_acceleration_covariance=unknown,
    )


def header(stamp_ns: int, frame: str) -> Any:
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = new("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def serialised(message: Any) -> bytes:
    """As CDR, which ROS 2 sends and records."""
    if isinstance(message, CustomMsg):
        return message.cdr()
    return bytes(_standard("cdr").serialize_cdr(message, message.__msgtype__))


def definition(kind: str) -> str:
    """The type's text, with the types that it contains."""
    if kind in CUSTOM_MSGS:
        return livox.definition(kind)
    return str(_standard("cdr").generate_msgdef(kind)[0])


@dataclass(frozen=True, slots=True)
class Layout:
    """How a driver records its scanner.

    Attributes:
        kind: type of the clouds. encode: a cloud as CDR.
    """

    lidar_topic: str = LIDAR_TOPIC
    imu_topic: str = IMU_TOPIC
    kind: str = CLOUD
    encode: Callable[[Scan], bytes] = lambda scan: serialised(cloud_message(scan))


AIRY_LAYOUT = Layout(imu_topic="/rslidar_imu_data")
MID360_LAYOUT = Layout("/livox/lidar", "/livox/imu", CUSTOM_MSGS[0], livox.encoded)


class RecordingWriter:
    """A ROS 2 recording of one LiDAR and one IMU as a bare .mcap, written in the order of the calls."""

    def __init__(self, file: BinaryIO, layout: Layout | None = None) -> None:
        layout = layout or Layout()
        self._encode = layout.encode
        self._mcap = Writer(file, compression=CompressionType.ZSTD)
        self._mcap.start(profile="ros2")
        self._lidar = self._channel(layout.lidar_topic, layout.kind)
        self._imu = self._channel(layout.imu_topic, IMU)
        self._others: dict[str, int] = {}

    def add_scan(self, scan: Scan, log_ns: int) -> None:
        self._add(self._lidar, self._encode(scan), log_ns)

    def add_imu(self, stamp_ns: int, gyro: Vector, accel: Vector, log_ns: int) -> None:
        self._add(self._imu, serialised(imu_message(stamp_ns, gyro, accel)), log_ns)

    def add(self, topic: str, message: Any, log_ns: int) -> None:
        """A message of a standard type on any other topic."""
        if topic not in self._others:
            self._others[topic] = self._channel(topic, message.__msgtype__)
        self._add(self._others[topic], serialised(message), log_ns)

    def flush(self) -> None:
        """End a chunk, so that everything written so far can be read even if the file is never finished."""
        self._mcap.flush()  # type: ignore[no-untyped-call]  # mcap leaves it untyped

    def finish(self) -> None:
        """Write the index and the end of the file."""
        self._mcap.finish()  # type: ignore[no-untyped-call]  # mcap leaves it untyped

    def _channel(self, topic: str, kind: str) -> int:
        schema = self._mcap.register_schema(kind, "ros2msg", definition(kind).encode())
        return self._mcap.register_channel(topic, "cdr", schema, {"offered_qos_profiles": ""})

    def _add(self, channel: int, data: bytes, log_ns: int) -> None:
        self._mcap.add_message(channel, log_ns, data, publish_time=log_ns)


def _vector(values: Vector) -> Any:
    x, y, z = map(float, values)
    return new("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _point_type(timestamp: str, ground: bool) -> np.dtype[Any]:
    columns = {"x": ("<f4", 0), "y": ("<f4", 4), "z": ("<f4", 8), "intensity": ("<f4", 12), "ring": ("<u2", 16)}
    if ground:
        columns["ground"] = ("u1", 18)
    at = 20 if ground else 18
    return structure(at + 8, **columns, timestamp=(timestamp, at))


def structure(size: int, **fields: tuple[Any, int]) -> np.dtype[Any]:
    """A structure of this many bytes, with fields of these types at these places."""
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": [*fields], "formats": [*formats], "offsets": [*offsets], "itemsize": size})
