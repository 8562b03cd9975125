"""How a recording's clouds and IMU are to be read: each `auto` decided from its first messages.

Every decision states its evidence, and names the option that overrules it.
"""

from dataclasses import dataclass

import numpy as np

from app.sensors.findings import Finding
from app.sensors.pointcloud import INTENSITY_NAMES, CloudLayout, CloudMessage, exact_ns
from app.sensors.rings import Rings
from app.slam.params import Recording

TIME_NAMES = ("timestamp", "time", "t", "offset_time", "time_stamp", "timeoffset", "time_offset", "stamp")
RING_NAMES = ("ring", "line", "channel", "laser_id", "row")
UNITS_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}


@dataclass(frozen=True, slots=True)
class Probe:
    """One cloud of the first few: when it was logged, and what it holds."""

    log_ns: int
    cloud: CloudMessage


def settle_cloud(probes: list[Probe], chosen: Recording) -> tuple[CloudLayout, list[Finding]]:
    """Decide a topic's layout from its first clouds (at least one with points)."""
    findings: list[Finding] = []
    cloud = probes[0].cloud
    names = {name.lower(): name for name in cloud.fields}
    field = next((names[name] for name in TIME_NAMES if name in names), None)
    assert field is not None
    stamps = np.array([probe.cloud.stamp_ns for probe in probes])
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1e8
    column = cloud.column(field)
    span = float(column.max()) - float(column.min())
    unit = min(UNITS_NS.values(), key=lambda ns: abs(np.log(max(span, 1e-12) * ns / period)))
    base, _rel = exact_ns(column, unit)
    absolute = abs(base - cloud.stamp_ns) < 1_000_000_000
    ring = next((names[name] for name in RING_NAMES if name in names), None)
    layout = CloudLayout(
        time_field=field,
        unit_ns=unit,
        anchor="absolute" if absolute else "header",
        shift_ns=0,
        rings=Rings(ring),
        intensity_field=next((names[name] for name in INTENSITY_NAMES if name in names), None),
        ground_field=names.get("ground"),
    )
    return layout, findings
