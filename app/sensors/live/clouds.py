"""Point cloud messages as they come, read by the same rules as a recording's."""

from dataclasses import dataclass, replace
from typing import Any

from app.sensors.findings import Finding
from app.sensors.layout import Probe, settle_cloud
from app.sensors.pointcloud import CloudError, CloudLayout, CloudMessage, decode, stamp_ns, valid_points
from app.sensors.probe import PROBED_CLOUDS
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import DroppedScan, Scan

_GIVE_UP = 100
"""Clouds without a usable point among them, before that is told."""


@dataclass(frozen=True, slots=True)
class Arrived:
    """A scan, and when its message came by the host's clock."""

    scan: Scan | DroppedScan
    arrival_ns: int


class CloudReader:
    """Looks at the first clouds of a topic before it decodes any, and again if their fields change.

    Attributes:
        findings: how they are read; new ones each time that was decided.
    """

    def __init__(self, params: Params, topic: str) -> None:
        self.findings: list[Finding] = []
        self._params, self._topic = params, topic
        self._layout: CloudLayout | None = None
        self._stamped = True
        self._fields: dict[str, Any] = {}
        self._waiting: list[tuple[CloudMessage, int, int]] = []
        self._unusable = 0

    def add(self, message: Any, log_ns: int, arrival_ns: int) -> list[Arrived]:
        """The scans that this message completes: none at first, then those that waited, then one each.

        Args:
            message: a deserialised PointCloud2. log_ns: when its sender passed it on.

        Raises:
            HemislamError: such clouds can not be read at all, and why.
        """
        try:
            cloud = CloudMessage.from_ros(message)
        except CloudError as error:
            return [Arrived(DroppedScan(stamp_ns(message.header.stamp), str(error)), arrival_ns)]
        if self._layout is not None and cloud.fields != self._fields:
            self._layout = None
        if self._layout is not None:
            return [Arrived(self._decoded(cloud, log_ns, self._layout), arrival_ns)]
        if self._waiting and cloud.fields != self._waiting[-1][0].fields:
            self._waiting.clear()
        if not {"x", "y", "z"} <= cloud.fields.keys():
            raise HemislamError(f"The clouds on {self._topic} have no x, y, z, but {', '.join(cloud.fields)}.")
        if not len(valid_points(cloud.xyz())[0]):
            self._unusable += 1
            if self._unusable == _GIVE_UP:
                raise HemislamError(f"None of the clouds on {self._topic} has a usable point; check the LiDAR.")
            return [Arrived(DroppedScan(cloud.stamp_ns, "none of its points is a return"), arrival_ns)]
        self._waiting.append((cloud, log_ns, arrival_ns))
        return self._settle() if len(self._waiting) == PROBED_CLOUDS else []

    def _settle(self) -> list[Arrived]:
        waiting, self._waiting = self._waiting, []
        self._stamped = len({cloud.stamp_ns for cloud, _, _ in waiting}) > 1
        probes = [
            Probe(log_ns, cloud if self._stamped else replace(cloud, stamp_ns=log_ns), self._stamped)
            for cloud, log_ns, _ in waiting
        ]
        layout, self.findings = settle_cloud(probes, self._params.recording, self._topic)
        self._layout, self._fields = layout, waiting[-1][0].fields
        return [Arrived(self._decoded(cloud, log_ns, layout), arrival) for cloud, log_ns, arrival in waiting]

    def _decoded(self, cloud: CloudMessage, log_ns: int, layout: CloudLayout) -> Scan | DroppedScan:
        if not self._stamped:
            cloud = replace(cloud, stamp_ns=log_ns)
        try:
            return decode(cloud, layout)
        except CloudError as error:
            return DroppedScan(cloud.stamp_ns, str(error))
