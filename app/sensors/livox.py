"""`CustomMsg` of livox_ros_driver and livox_ros_driver2, read and written as bytes: objects per point are slow."""

import struct
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from app.slam.types import F32, I64, U8, Scan

DRIVERS = ("livox_ros_driver2", "livox_ros_driver")
CUSTOM_MSGS = tuple(f"{driver}/msg/CustomMsg" for driver in DRIVERS)
_POINT = {"offset_time": "u4", "x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "tag": "u1", "line": "u1"}
"""Members of a point: ns after the first one, m, m, m. They are packed in ROS 1; CDR aligns each point to 4 bytes."""
DOUBTFUL = 0x20
"""Bit of `tag` that marks a return of low confidence (Mid-360), or a second one (earlier units)."""
_SURE = 0x10
"""`tag` of an ordinary return."""
_FRAME = b"livox_frame\0"
DEFINITION = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
================================================================================
MSG: livox_ros_driver2/CustomPoint
uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
"""The definition of livox_ros_driver2's message in ROS 2."""


@dataclass(frozen=True, slots=True)
class CustomMsg:
    """One message.

    Attributes:
        header: with the `stamp` that every message has. stated: `point_num`.
        points: (n,) of `_POINT`, as many as there are.
    """

    header: SimpleNamespace
    stated: int
    points: npt.NDArray[Any]

    @classmethod
    def of(cls, data: bytes, encoding: str) -> "CustomMsg":
        """From a message in CDR or in ROS 1's encoding. Raises struct.error if it ends before its points."""
        order, at, step = "<", 4, 19  # after the sequence number
        if encoding == "cdr":
            order, at, step = "<" if data[1] & 1 else ">", 4, 20  # after the encapsulation header
        seconds, nanoseconds, length = struct.unpack_from(f"{order}3I", data, at)
        at += 12 + length
        if encoding == "cdr":
            at += -(at - 4) % 8
        _, stated, _, held = struct.unpack_from(f"{order}Q3I", data, at)
        body = data[at + 20 :] + bytes(1)  # the last point is not padded
        points = np.frombuffer(body, _dtype(order, step), count=min(held, len(body) // step))
        return cls._of(seconds, nanoseconds, stated, points)

    @classmethod
    def made(
        cls, times_ns: I64, points: F32, reflectivity: npt.ArrayLike, tag: npt.ArrayLike, line: npt.ArrayLike = 0
    ) -> "CustomMsg":
        """From points (n, 3) m at times (n,), stamped at the earliest; the rest for each or for all."""
        begin_ns = int(times_ns.min())
        rows = np.zeros(len(points), _dtype("<", 20))
        rows["x"], rows["y"], rows["z"] = points.T
        rows["offset_time"] = np.minimum(times_ns - begin_ns, np.iinfo(np.uint32).max)
        rows["reflectivity"], rows["tag"], rows["line"] = reflectivity, tag, line
        return cls._of(*divmod(begin_ns, 1_000_000_000), len(rows), rows)

    @classmethod
    def _of(cls, seconds: int, nanoseconds: int, stated: int, points: npt.NDArray[Any]) -> "CustomMsg":
        return cls(SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=nanoseconds)), stated, points)

    @property
    def fields(self) -> dict[str, tuple[int, np.dtype[Any]]]:
        """Fields of a point: name -> (offset in bytes, type)."""
        return {name: (at, kind) for name, (kind, at, *_) in (self.points.dtype.fields or {}).items()}

    @property
    def data(self) -> U8:
        """(bytes,) of the points."""
        return self.points.view(np.uint8)

    def cdr(self) -> bytes:
        """As livox_ros_driver2 sends it in ROS 2."""
        stamp = self.header.stamp
        head = struct.pack("<4B3I", 0, 1, 0, 0, stamp.sec, stamp.nanosec, len(_FRAME)) + _FRAME
        head += bytes(-(len(head) - 4) % 8)
        count, begin_ns = len(self.points), stamp.sec * 1_000_000_000 + stamp.nanosec
        rows = np.zeros(count, _dtype("<", 20))
        rows[:] = self.points
        return head + struct.pack("<QIB3xI", begin_ns, self.stated, 0, count) + rows.tobytes()[:-1]


def definition(kind: str) -> str:
    """The text of a driver's message, in ROS 2."""
    return DEFINITION.replace(DRIVERS[0], kind.partition("/")[0])


def encoded(scan: Scan) -> bytes:
    """The scan as livox_ros_driver2 sends it: CDR, stamped at the first point, lines 0 to 3 in turn."""
    times_ns = scan.stamp_ns + scan.offsets_ns.astype(np.int64)
    return CustomMsg.made(times_ns, scan.points, scan.intensity, _SURE, np.arange(len(scan)) % 4).cdr()


def _dtype(order: str, step: int) -> np.dtype[Any]:
    formats = [order + kind for kind in _POINT.values()]
    return np.dtype({"names": [*_POINT], "formats": formats, "offsets": [0, 4, 8, 12, 16, 17, 18], "itemsize": step})
