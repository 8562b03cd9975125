"""sensor_msgs/PointCloud2 to `Scan`: any field order, type, padding and byte order, no loop over points.

`CloudMessage` gives the fields as strided views of the message's bytes; `CloudLayout` holds what had
to be decided once for a recording (see `layout.py`); `decode` applies it to one message.
"""

from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

from app.sensors.azimuth import Spin
from app.sensors.rings import Rings
from app.slam.types import F32, I64, U8, Scan

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""PointField.datatype to numpy; 9 and 10 (64-bit integers) are an extension some drivers use."""
_TYPES |= {9: "i8", 10: "u8"}


class CloudError(ValueError):
    """One point cloud message can not be read; the text says why, fit for `DroppedScan.reason`."""


@dataclass(frozen=True, slots=True)
class CloudMessage:
    """A PointCloud2 message with its fields as views.

    Attributes:
        stamp_ns: header stamp. height, width: as in the message; firing order is row-major.
        fields: name -> (offset in bytes, numpy dtype with byte order). data: (bytes,) uint8.
    """

    stamp_ns: int
    height: int
    width: int
    point_step: int
    row_step: int
    fields: dict[str, tuple[int, np.dtype[Any]]]
    data: U8

    @classmethod
    def from_ros(cls, message: Any) -> Self:
        """Of a deserialised ROS 1 or ROS 2 message.

        Raises:
            CloudError: the sizes that the message states contradict each other.
        """
        order = ">" if message.is_bigendian else "<"
        fields = {
            field.name: (int(field.offset), np.dtype(order + _TYPES[field.datatype]))
            for field in message.fields
            if field.datatype in _TYPES
        }
        height, width, point_step = int(message.height), int(message.width), int(message.point_step)
        row_step = int(message.row_step)
        data = np.asarray(message.data, dtype=np.uint8)
        if height <= 1 or row_step == 0:  # many writers leave row_step unset; one row needs none
            row_step = width * point_step
        needed = (height - 1) * row_step + width * point_step if height and width else 0
        if height and width and point_step < 1:  # of nothing there is any number
            raise CloudError(f"the cloud states {height}x{width} points of {point_step} bytes")
        if needed > data.size:
            raise CloudError(f"the cloud states {height}x{width} points, {needed} bytes, but holds {data.size}")
        if row_step < width * point_step:
            raise CloudError(f"the cloud's row_step {row_step} is shorter than its {width} points")
        for name, (offset, dtype) in fields.items():
            if offset + dtype.itemsize > point_step and needed:
                raise CloudError(f"field `{name}` ends after the point_step of {point_step} bytes")
        return cls(stamp_ns(message.header.stamp), height, width, point_step, row_step, fields, data)

    def __len__(self) -> int:
        return self.height * self.width

    def column(self, name: str) -> npt.NDArray[Any]:
        """(n,) values of one field in its own type, native byte order. Raises CloudError if absent."""
        if name not in self.fields:
            raise CloudError(f"the cloud has no field `{name}` (it has {', '.join(self.fields) or 'none'})")
        offset, dtype = self.fields[name]
        if not len(self):
            return np.empty(0, dtype.newbyteorder("="))
        view: npt.NDArray[Any] = np.ndarray(
            (self.height, self.width), dtype, self.data.data, offset, (self.row_step, self.point_step)
        )
        return view.reshape(-1).astype(dtype.newbyteorder("="), copy=False)

    def xyz(self) -> F32:
        """(n, 3) float32 m, as stored: NaN and zeros included."""
        offsets = [self.fields.get(name, (-1, np.dtype("V1"))) for name in "xyz"]
        first, dtype = offsets[0]
        if dtype == np.dtype("<f4") and len(self) and offsets == [(first + 4 * i, dtype) for i in range(3)]:
            strides = (self.row_step, self.point_step, 4)
            view: F32 = np.ndarray((self.height, self.width, 3), dtype, self.data.data, first, strides)
            return view.reshape(-1, 3)
        return np.stack([self.column(name).astype(np.float32) for name in "xyz"], axis=1)


@dataclass(frozen=True, slots=True)
class CloudLayout:
    """How every cloud of one topic is to be read; all questions settled.

    Attributes:
        time_field: per-point time; None: derived from the azimuth by `spin`.
        unit_ns: nanoseconds in one unit of it.
        anchor: "absolute": it is Unix time. "header": it counts from the header stamp plus
            `shift_ns`. "first"/"last": it counts from anywhere (the sensor's own clock), and the
            scan's earliest/latest point is at the header stamp.
        rings: where the ring comes from. spin: rotation, for clouds without time.
        intensity_field, ground_field: None if there is none.
    """

    time_field: str | None
    unit_ns: int
    anchor: Literal["absolute", "header", "first", "last"]
    shift_ns: int
    rings: Rings
    spin: Spin | None = None
    intensity_field: str | None = None
    ground_field: str | None = None


def decode(cloud: CloudMessage, layout: CloudLayout) -> Scan:
    """One message as a `Scan`: points without a return (NaN, infinite or all zero) removed.

    Raises:
        CloudError: no valid point is left, a field is missing, or the times make no scan.
    """
    time = cloud.column(layout.time_field) if layout.time_field is not None else None
    points, index = valid_points(cloud.xyz(), time)
    if not len(points):
        raise CloudError(_nothing_left(cloud))

    def kept(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return values if index is None else values.take(index, axis=0)

    ring = layout.rings.of(cloud, points, index)
    if time is None:
        assert layout.spin is not None
        base_ns, times_ns = 0, layout.spin.times_ns(points, ring)
    else:
        base_ns, times_ns = exact_ns(kept(time), layout.unit_ns)
    earliest, latest = int(times_ns.min()), int(times_ns.max())
    if latest - earliest > np.iinfo(np.int32).max:
        raise CloudError("its points are more than 2 s apart, which is no single scan")
    match layout.anchor:
        case "absolute":
            stamp_ns = base_ns + earliest
        case "header":
            stamp_ns = cloud.stamp_ns + layout.shift_ns + base_ns + earliest
        case "first":
            stamp_ns = cloud.stamp_ns
        case "last":
            stamp_ns = cloud.stamp_ns - (latest - earliest)
    offsets_ns = (times_ns - earliest).astype(np.int32)
    intensity = (
        kept(cloud.column(layout.intensity_field)).astype(np.float32)
        if layout.intensity_field
        else np.zeros(len(points), np.float32)
    )
    ground = (kept(cloud.column(layout.ground_field)) != 0).astype(np.uint8) if layout.ground_field else None
    for array in (points, offsets_ns, intensity, ring, ground):
        if array is not None:
            array.setflags(write=False)
    return Scan(stamp_ns, points, offsets_ns, intensity, ring, ground)


def valid_points(xyz: F32, time: npt.NDArray[Any] | None = None) -> tuple[F32, npt.NDArray[np.intp] | None]:
    """Points with a return (finite, not all zero, with a finite time), and their indices; None: all are."""
    x, y, z = xyz[:, 0], xyz[:, 1], xyz[:, 2]
    # Overflow is no finite number either, so the sum tells all three at once.
    valid = np.isfinite(x + y + z) & ((x != 0) | (y != 0) | (z != 0))
    if time is not None and time.dtype.kind == "f":
        valid &= np.isfinite(time)
    if valid.all():
        return np.ascontiguousarray(xyz), None
    index = np.flatnonzero(valid)
    return xyz.take(index, axis=0), index


def exact_ns(time: npt.NDArray[Any], unit_ns: int) -> tuple[int, I64]:
    """Times of any type as (base, (n,) int64 after it), ns, without losing digits of large values."""
    if time.dtype.kind == "f":
        values = time.astype(np.float64)
        whole = float(np.floor(values.min()))
        return int(whole) * unit_ns, np.rint((values - whole) * unit_ns).astype(np.int64)
    least = time.min()
    return int(least) * unit_ns, (time - least).astype(np.int64) * unit_ns


def stamp_ns(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _nothing_left(cloud: CloudMessage) -> str:
    if not len(cloud):
        return "the cloud holds no points"
    share = float(np.isnan(cloud.xyz()).any(axis=1).mean())
    return "all its points are NaN" if share == 1.0 else "none of its points is a return (NaN, zero or without time)"
