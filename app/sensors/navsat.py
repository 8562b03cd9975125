"""Satellite fixes of a recording: NavSatFix messages."""

from pathlib import Path
from typing import Any

import numpy as np

from app.georeference.fixes import Fixes
from app.sensors.ros import header, new, stamp_ns
from app.sensors.source import Source
from app.slam.errors import HemislamError

NAVSAT = "sensor_msgs/msg/NavSatFix"
TOPIC = "/fix"
_UNKNOWN, _DIAGONAL = 0, 2
"""NavSatFix's types of covariance."""


def navsat_topic(source: Source) -> str:
    """The topic with the most fixes; "" if there is none."""
    topics = [topic for topic in source.topics if topic.type == NAVSAT and topic.messages]
    return max(topics, key=lambda topic: topic.messages).name if topics else ""


def fix_of(message: Any) -> Fixes:
    """One NavSatFix as one fix, with nan for a place where the receiver had none."""
    place = [message.latitude, message.longitude, message.altitude]
    if message.status.status < 0:
        place = [np.nan] * 3
    variances = np.asarray(message.position_covariance, np.float64)[[0, 4, 8]]
    if message.position_covariance_type == _UNKNOWN:
        variances[:] = np.nan
    return Fixes.of([stamp_ns(message.header.stamp)], [place], np.sqrt(np.maximum(variances, 0.0)))


def navsat_message(fixes: Fixes, index: int) -> Any:
    """One of the fixes as NavSatFix."""
    latitude, longitude, height = fixes.places[index].tolist()
    variances = fixes.sigmas[index] ** 2
    known = bool(np.isfinite(variances).all())
    return new(
        NAVSAT,
        header=header(int(fixes.stamps_ns[index]), "gnss"),
        status=new("sensor_msgs/msg/NavSatStatus", status=0, service=1),
        latitude=latitude,
        longitude=longitude,
        altitude=height,
        position_covariance=np.diag(variances).ravel() if known else np.zeros(9),
        position_covariance_type=_DIAGONAL if known else _UNKNOWN,
    )


def recorded_fixes(recording: Path) -> Fixes:
    """All fixes of a recording, above the ellipsoid. Raises HemislamError: it has none, or they make no sense."""
    with Source(recording) as source:
        topic = navsat_topic(source)
        if not topic:
            raise HemislamError(f"{recording} has no topic of type {NAVSAT} with fixes; give a file of fixes.")
        every = [fix_of(message) for _, message in source.readable(topic)]
    columns = ("stamps_ns", "places", "sigmas")
    fixes = Fixes(*(np.concatenate([getattr(fix, name) for fix in every]) for name in columns))
    return fixes.sound(f"Topic {topic} of {recording}")
