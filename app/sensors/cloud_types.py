"""The types of point-cloud message that can be read: one entry in `CLOUD_TYPES` and one function each.

A type's function turns a deserialised message into a `CloudMessage`, which is the same for all types: named columns of
numbers, as the sensor sent them. What the columns mean is settled once for a recording (`layout.py`).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from app.sensors.livox import CUSTOM_MSGS, DOUBTFUL, CustomMsg
from app.sensors.ros import DATATYPES, stamp_fault, stamp_ns
from app.slam.errors import printable
from app.slam.types import F32, U8

Column = npt.NDArray[Any]

FARTHEST_M = 10_000.0
"""m on one axis; no LiDAR sees farther."""
LATEST = 1e19
"""Largest time of a point, in any unit: years in ns. Beyond it, integers overflow."""

JOINED = " + "
"""Between the names of two integer fields that only together are a time: seconds, and the nanoseconds after them."""

_LIVOX = {"tag", "line"}
"""Fields of clouds of the Livox drivers, as `CustomMsg` and as PointCloud2."""


class CloudError(ValueError):
    """One point-cloud message cannot be read; the text gives the reason, as for `DroppedScan.reason`."""


@dataclass(frozen=True, slots=True)
class CloudMessage:
    """A cloud with its columns as views of the message's bytes.

    Attributes:
        stamp_ns: header stamp. height, width: as in the message; firing order is row-major.
        fields: name -> (offset in bytes, numpy dtype with byte order). data: (bytes,) uint8.
        swapped: whether its byte order is not the one that the message states.
    """

    stamp_ns: int
    height: int
    width: int
    point_step: int
    row_step: int
    fields: dict[str, tuple[int, np.dtype[Any]]]
    data: U8
    swapped: bool = False

    def __len__(self) -> int:
        return self.height * self.width

    def column(self, name: str) -> Column:
        """(n,) values of one field in its own type, native byte order. Raises CloudError if absent.

        Of two fields whose names are `JOINED`: int64 ns.
        """
        seconds, joined, nanoseconds = name.partition(JOINED)
        if joined and name not in self.fields:
            return self.column(seconds).astype(np.int64) * 1_000_000_000 + self.column(nanoseconds).astype(np.int64)
        if name not in self.fields:
            raise CloudError(f"the cloud has no field `{name}` (it has {', '.join(self.fields) or 'none'})")
        offset, dtype = self.fields[name]
        if not len(self):
            return np.empty(0, dtype.newbyteorder("="))
        view: Column = np.ndarray(
            (self.height, self.width), dtype, self.data.data, offset, (self.row_step, self.point_step)
        )
        return view.reshape(-1).astype(dtype.newbyteorder("="), copy=False)

    def xyz(self) -> F32:
        """(n, 3) float32 m, as stored, including NaN and zeros. Returns of low confidence of a Livox become zeros."""
        points: F32 = np.stack([self.column(name).astype(np.float32) for name in "xyz"], axis=1)
        if self.fields.keys() >= _LIVOX and (tag := self.column("tag")).dtype == np.uint8:
            points[(tag & DOUBTFUL) != 0] = 0.0
        return points


@dataclass(frozen=True, slots=True)
class CloudType:
    """One type of point-cloud message, and the names that its writers usually give to fields.

    Attributes:
        name: as in ROS 2; the ROS 1 type with the same name is read as well.
        read: reads a deserialised message. Raises CloudError if its content contradicts itself.
        times, rings, intensities: lower-case names of fields, the most usual first.
        time_unit: of the points' times where the type fixes it; "auto" where it is judged by the data.
    """

    name: str
    read: Callable[[Any], CloudMessage]
    times: tuple[str, ...]
    rings: tuple[str, ...]
    intensities: tuple[str, ...]
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = "auto"


def read_point_cloud_2(message: Any) -> CloudMessage:
    """sensor_msgs/PointCloud2 of ROS 1 or ROS 2: any order, type, padding and byte order of the fields."""
    order = ">" if message.is_bigendian else "<"
    fields = {
        printable(field.name): (int(field.offset), np.dtype(order + DATATYPES[field.datatype]))
        for field in message.fields
        if field.datatype in DATATYPES
    }
    height, width, point_step = int(message.height), int(message.width), int(message.point_step)
    row_step = int(message.row_step)
    data = np.asarray(message.data, dtype=np.uint8)
    if height <= 1 or row_step == 0:  # many writers leave row_step unset; one row needs none
        row_step = width * point_step
    needed = (height - 1) * row_step + width * point_step if height and width else 0
    if height and width and point_step < 1:  # any number of points fits into no bytes
        raise CloudError(f"the cloud states {height}x{width} points of {point_step} bytes")
    if needed > data.size:
        raise CloudError(f"the cloud states {height}x{width} points, {needed} bytes, but holds {data.size}")
    if row_step < width * point_step:
        raise CloudError(f"the cloud's row_step {row_step} is shorter than its {width} points")
    for name, (offset, dtype) in fields.items():
        if offset + dtype.itemsize > point_step and needed:
            raise CloudError(f"field `{name}` ends after the point_step of {point_step} bytes")
    return _in_true_byte_order(
        CloudMessage(stamp_ns(message.header.stamp), height, width, point_step, row_step, fields, data)
    )


def _in_true_byte_order(cloud: CloudMessage) -> CloudMessage:
    """The same, in the other byte order if only that gives plausible coordinates: some drivers state it wrongly."""
    if not {"x", "y", "z"} <= cloud.fields.keys() or _share_of_lengths(cloud) > 0.5:
        return cloud
    fields = {name: (offset, dtype.newbyteorder()) for name, (offset, dtype) in cloud.fields.items()}
    other = replace(cloud, fields=fields, swapped=True)
    return other if _share_of_lengths(other) > 0.9 else cloud


@np.errstate(invalid="ignore")
def _share_of_lengths(cloud: CloudMessage) -> float:
    """Share of some numbers among the coordinates that are lengths in m; 1 if there are none."""
    xyz = np.stack([cloud.column(name)[:: max(len(cloud) // 300, 1)] for name in "xyz"]).astype(np.float64)
    size = np.abs(xyz[xyz == xyz])
    size = size[size > 0]
    return float(np.mean((size > 1e-6) & (size < FARTHEST_M))) if len(size) else 1.0


POINT_CLOUD_2 = CloudType(
    name="sensor_msgs/msg/PointCloud2",
    read=read_point_cloud_2,
    times=("timestamp", "time", "t", "offset_time", "time_stamp", "timeoffset", "time_offset", "stamp", "ts"),
    rings=("ring", "line", "channel", "laser_id", "laser"),
    intensities=("intensity", "intensities", "reflectivity", "reflectance", "i"),
)


def read_custom_msg(message: CustomMsg) -> CloudMessage:
    """CustomMsg of the Livox drivers: all points of a tenth of a second, without scan lines."""
    count, step = len(message.points), message.points.itemsize
    if message.stated != count:
        raise CloudError(f"the cloud states {message.stated} points, but holds {count}")
    return CloudMessage(stamp_ns(message.header.stamp), 1, count, step, count * step, message.fields, message.data)


LIVOX_CUSTOM_MSGS = tuple(
    CloudType(name, read_custom_msg, ("offset_time",), (), ("reflectivity",), time_unit="ns") for name in CUSTOM_MSGS
)

CLOUD_TYPES: dict[str, CloudType] = {kind.name: kind for kind in (POINT_CLOUD_2, *LIVOX_CUSTOM_MSGS)}
"""Every type that can be read, by name."""


@dataclass(frozen=True)
class Probe:
    """One of the first clouds of a topic, which determine how all of its clouds are read.

    Attributes:
        log_ns: when it was logged. cloud: its content.
        stamped: False if its header carries no time, and `cloud.stamp_ns` is the log time.
        time: name of the field with the points' times, once it is known; points without a time are then not valid.
    """

    log_ns: int
    cloud: CloudMessage
    stamped: bool = True
    time: str | None = None

    @cached_property
    def _valid(self) -> tuple[F32, npt.NDArray[np.intp], int]:
        return valid_points(self.cloud.xyz(), None if self.time is None else self.cloud.column(self.time))

    @property
    def points(self) -> F32:
        """(n, 3) float32 m, the valid points."""
        return self._valid[0]

    @property
    def index(self) -> npt.NDArray[np.intp]:
        """(n,) indices of the valid points in the message."""
        return self._valid[1]

    def column(self, name: str) -> Column:
        """(n,) values of a field at the valid points."""
        return self.cloud.column(name)[self.index]


def stamped(probes: list[Probe]) -> list[Probe]:
    """The same, or stamped by their log times where their headers carry no times."""
    if not stamp_fault([probe.cloud.stamp_ns for probe in probes]):
        return probes
    return [Probe(probe.log_ns, replace(probe.cloud, stamp_ns=probe.log_ns), stamped=False) for probe in probes]


def valid_points(xyz: F32, time: Column | None = None) -> tuple[F32, npt.NDArray[np.intp], int]:
    """Points that can be a return (nearer than `FARTHEST_M`, with a time), their indices, and the number of others.

    Points that are NaN or all zero are not counted: drivers write them for beams without a return.
    """
    x, y, z = xyz.T
    farthest = np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z))  # NaN if any of them is
    valid = (farthest < FARTHEST_M) & (farthest > 0)
    if time is not None and time.dtype.kind == "f":
        valid &= np.abs(time) < LATEST
    index = np.flatnonzero(valid)
    return values_at(xyz, index), index, int(np.count_nonzero(farthest > 0)) - len(index)


def values_at(column: Column, index: npt.NDArray[np.intp]) -> Column:
    """The values at these ascending, unique indices; the column itself if they are all of its rows."""
    return column if len(index) == len(column) else column.take(index, axis=0)
