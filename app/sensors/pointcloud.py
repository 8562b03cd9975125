"""From a point-cloud message to a `Scan`, without a loop over points.

`CloudLayout` holds everything that was settled for a topic (`layout.py`); `read_scan` applies it to one message.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from app.sensors.azimuth import Spin
from app.sensors.cloud_types import POINT_CLOUD_2, CloudError, CloudMessage, CloudType, valid_points, values_at
from app.sensors.rings import Rings
from app.sensors.ros import stamp_ns
from app.sensors.timing import Timing, exact_ns
from app.slam.types import DroppedScan, Scan


@dataclass(frozen=True, slots=True)
class CloudLayout:
    """How every cloud of one topic is read.

    Attributes:
        timing: where the points' times come from. rings: where the ring comes from.
        spin: rotation, for clouds without times.
        intensity_field, ground_field: None if there is none.
        kind: type of the messages. stamped: False if headers carry no time, and log times stand for it.
    """

    timing: Timing
    rings: Rings
    spin: Spin | None = None
    intensity_field: str | None = None
    ground_field: str | None = None
    kind: CloudType = POINT_CLOUD_2
    stamped: bool = True


@np.errstate(over="ignore", invalid="ignore")  # results of invalid numbers are left out
def read_scan(message: Any, log_ns: int, layout: CloudLayout) -> tuple[CloudMessage | None, Scan | DroppedScan]:
    """A deserialised message: its content (None if malformed), and the scan, or why there is none."""
    cloud = None
    try:
        cloud = layout.kind.read(message)
        if not layout.stamped:
            cloud = replace(cloud, stamp_ns=log_ns)
        return cloud, decode(cloud, layout)
    except CloudError as error:
        stamp = stamp_ns(message.header.stamp) if layout.stamped else log_ns
        return cloud, DroppedScan(stamp, str(error))


def decode(cloud: CloudMessage, layout: CloudLayout) -> Scan:
    """One message as a `Scan`: points without a return (NaN, infinite, beyond 10 km or all zero) removed.

    Raises:
        CloudError: no valid point is left, a field is missing, or the times make no scan.
    """
    timing = layout.timing
    time = cloud.column(timing.field) if timing.field is not None else None
    points, index, refused = valid_points(cloud.xyz(), time)
    if not len(points):
        raise CloudError(_nothing_left(cloud))

    ring = layout.rings.of(cloud, points, index)
    if time is None:
        assert layout.spin is not None
        base_ns, times_ns = 0, layout.spin.times_ns(points, ring)
    else:
        base_ns, times_ns = exact_ns(values_at(time, index), timing.unit_ns)
    earliest, latest = int(times_ns.min()), int(times_ns.max())
    if latest - earliest > np.iinfo(np.int32).max:
        raise CloudError("its points are more than 2 s apart, too long for one scan")
    match timing.anchor:
        case "absolute":
            begin_ns = base_ns + earliest
        case "header":
            begin_ns = cloud.stamp_ns + timing.shift_ns + base_ns + earliest
        case "first":
            begin_ns = cloud.stamp_ns
        case "last":
            begin_ns = cloud.stamp_ns - (latest - earliest)
    if abs(begin_ns) > np.iinfo(np.int64).max // 2:
        raise CloudError("its time is in no calendar")
    offsets_ns = (times_ns - earliest).astype(np.int32)
    intensity = (
        values_at(cloud.column(layout.intensity_field), index).astype(np.float32)
        if layout.intensity_field
        else np.zeros(len(points), np.float32)
    )
    ground = None
    if layout.ground_field:
        ground = (values_at(cloud.column(layout.ground_field), index) != 0).astype(np.uint8)
    return Scan(begin_ns, points, offsets_ns, intensity, ring, ground, refused)


def _nothing_left(cloud: CloudMessage) -> str:
    if not len(cloud):
        return "the cloud holds no points"
    share = float(np.isnan(cloud.xyz()).any(axis=1).mean())
    return "all its points are NaN" if share == 1.0 else "none of its points is a return (NaN, zero or without time)"
