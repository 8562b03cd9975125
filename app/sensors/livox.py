"""`CustomMsg` of livox_ros_driver and livox_ros_driver2, read from its bytes; an object for each point is too slow."""

import struct
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from app.slam.types import U8

DRIVERS = ("livox_ros_driver2", "livox_ros_driver")
CUSTOM_MSGS = tuple(f"{driver}/msg/CustomMsg" for driver in DRIVERS)
_POINT = {"offset_time": "u4", "x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "tag": "u1", "line": "u1"}
"""Members of a point: ns after the first one, m, m, m. They are packed in ROS 1; CDR aligns each point to 4 bytes."""
_DOUBTFUL = 0x20
"""Bit of `tag` that marks a return of low confidence (Mid-360), or a second one (earlier units)."""


@dataclass(frozen=True, slots=True)
class CustomMsg:
    """One message.

    Attributes:
        header: with the `stamp` that every message has. stated: `point_num`.
        points: (n,) of `_POINT`, as many as there are. Doubtful returns are at zero, as where nothing came back.
    """

    header: SimpleNamespace
    stated: int
    points: npt.NDArray[Any]

    @classmethod
    def of(cls, data: bytes, encoding: str) -> "CustomMsg":
        """Of a message in CDR or in ROS 1's encoding. Raises struct.error if it ends before its points."""
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
        doubtful = (points["tag"] & _DOUBTFUL) != 0
        if doubtful.any():
            points = points.copy()
            for axis in "xyz":
                points[axis][doubtful] = 0.0
        stamp = SimpleNamespace(sec=seconds, nanosec=nanoseconds)
        return cls(SimpleNamespace(stamp=stamp), stated, points)

    @property
    def fields(self) -> dict[str, tuple[int, np.dtype[Any]]]:
        """Name -> (offset in bytes, type), of a point."""
        return {name: (at, kind) for name, (kind, at, *_) in (self.points.dtype.fields or {}).items()}

    @property
    def data(self) -> U8:
        """(bytes,) of the points."""
        return self.points.view(np.uint8)


def _dtype(order: str, step: int) -> np.dtype[Any]:
    formats = [order + kind for kind in _POINT.values()]
    return np.dtype({"names": [*_POINT], "formats": formats, "offsets": [0, 4, 8, 12, 16, 17, 18], "itemsize": step})
