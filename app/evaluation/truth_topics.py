"""Truth from a topic of the recording itself: odometry, poses, or satellite fixes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from app.evaluation.truth import Truth
from app.sensors.source import Source
from app.slam.errors import HemislamError
from app.slam.types import F64

_EARTH_A, _EARTH_E2 = 6_378_137.0, 6.694379990141316e-3
"""WGS84: m, and squared eccentricity."""

_POSES: dict[str, Callable[[Any], Any]] = {
    "nav_msgs/msg/Odometry": lambda message: message.pose.pose,
    "geometry_msgs/msg/PoseStamped": lambda message: message.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: message.pose.pose,
}
_FIX = "sensor_msgs/msg/NavSatFix"
TYPES = (*_POSES, _FIX)


def read_topic(recording: Path, topic: str) -> Truth:
    """All poses of a topic.

    Raises:
        HemislamError: there is no such topic, or it holds no poses.
    """
    with Source(recording) as source:
        kinds = {entry.name: entry.type for entry in source.topics}
        if topic not in kinds:
            usable = [name for name, kind in kinds.items() if kind in TYPES]
            hint = f"it has {', '.join(usable)}" if usable else "none of its topics holds poses or fixes"
            raise HemislamError(f"{recording} has no topic {topic} to take as truth; {hint}.")
        kind = kinds[topic]
        if kind not in TYPES:
            raise HemislamError(
                f"Topic {topic} is of type {kind}, which is no truth; use one of type {', '.join(TYPES)}."
            )
        stamps, rows = [], []
        for _, _, message in source.messages((topic,)):
            row = _fix(message) if kind == _FIX else _pose(_POSES[kind](message))
            if row is not None:
                stamps.append(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
                rows.append(row)
    table = np.array(rows, dtype=np.float64)
    stamps_ns = np.array(stamps, dtype=np.int64)
    name = f"Topic {topic}"
    if not len(table):
        raise HemislamError(f"Topic {topic} of {recording} holds no usable pose.")
    if kind == _FIX:
        return Truth(name, "satellite fixes", stamps_ns, _east_north_up(table), None)
    lengths = np.linalg.norm(table[:, 3:], axis=1)
    if not (np.abs(lengths - 1) <= 0.01).all():  # nan is none either
        raise HemislamError(
            f"Topic {topic} holds orientations that are no unit quaternions; it can not be used as truth."
        )
    return Truth(name, "poses of a topic", stamps_ns, table[:, :3], table[:, 3:], own_axes=True)


def _pose(pose: Any) -> list[float]:
    p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


def _fix(message: Any) -> list[float] | None:
    """Latitude and longitude in degrees, height in m; None if there was no fix."""
    row = [message.latitude, message.longitude, message.altitude]
    return row if message.status.status >= 0 and np.isfinite(row).all() else None


def _east_north_up(fixes: F64) -> F64:
    """Geodetic (n, 3) degrees, degrees, m on WGS84 to metres east, north, up of the first."""
    latitude, longitude = np.radians(fixes[:, 0]), np.radians(fixes[:, 1])
    radius = _EARTH_A / np.sqrt(1 - _EARTH_E2 * np.sin(latitude) ** 2)
    flat = (radius + fixes[:, 2]) * np.cos(latitude)
    z = (radius * (1 - _EARTH_E2) + fixes[:, 2]) * np.sin(latitude)
    earth = np.column_stack([flat * np.cos(longitude), flat * np.sin(longitude), z])
    s, c, sl, cl = np.sin(latitude[0]), np.cos(latitude[0]), np.sin(longitude[0]), np.cos(longitude[0])
    R_enu_earth = np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
    return np.asarray((earth - earth[0]) @ R_enu_earth.T)
