"""Clouds that arrive as messages, examined before any of them is decoded."""

from typing import Any

from app.sensors.cloud_types import CloudError, CloudType, Probe, stamped
from app.sensors.layout import settle_cloud
from app.sensors.live.intake import Intake
from app.sensors.pointcloud import CloudLayout, read_scan
from app.sensors.probe import PROBED_CLOUDS
from app.sensors.ros import stamp_ns
from app.slam.errors import HemislamError
from app.slam.types import DroppedScan, Scan

_GIVE_UP = 100
"""Number of clouds without a usable point after which reading fails with an error."""


class CloudReader:
    """Examines the first clouds of a topic before it decodes any, and again if their fields change.

    How clouds are read, or why they cannot be read, is reported to the intake.
    """

    def __init__(self, intake: Intake, topic: str, kind: CloudType) -> None:
        self._intake, self._topic, self._kind = intake, topic, kind
        self._layout: CloudLayout | None = None
        self._fields: dict[str, Any] = {}
        self._waiting: list[tuple[Any, Probe, int]] = []
        self._unusable = 0

    def add(self, message: Any, log_ns: int, arrival_ns: int) -> list[tuple[Scan | DroppedScan, int]]:
        """The scans that are ready after this message, each with its arrival: none at first, then all that waited.

        Args:
            message: deserialised. log_ns: the time at which its sender passed it on.
        """
        try:
            return self._read(message, log_ns, arrival_ns)
        except HemislamError as error:
            self._intake.counters.unreadable += 1
            self._intake.put_status("configuration", str(error), once=True)
            return []

    def _read(self, message: Any, log_ns: int, arrival_ns: int) -> list[tuple[Scan | DroppedScan, int]]:
        """As `add`. Raises HemislamError, with the reason, if such clouds cannot be read at all."""
        if self._layout is not None:
            cloud, scan = read_scan(message, log_ns, self._layout)
            if cloud is None or cloud.fields == self._fields:
                return [(scan, arrival_ns)]
            self._layout = None
        try:
            probe = Probe(log_ns, self._kind.read(message))
        except CloudError as error:
            return [(DroppedScan(stamp_ns(message.header.stamp), str(error)), arrival_ns)]
        cloud = probe.cloud
        if cloud.fields != self._fields:
            self._waiting.clear()
            self._fields = cloud.fields
        if not {"x", "y", "z"} <= cloud.fields.keys():
            raise HemislamError(
                f"The clouds on {self._topic} have no x, y, z, but {', '.join(cloud.fields)}; start hemislam with "
                "--lidar-topic and another topic."
            )
        if not len(probe.points):
            self._unusable += 1
            if self._unusable == _GIVE_UP:
                raise HemislamError(f"None of the clouds on {self._topic} has a usable point; check the LiDAR.")
            return [(DroppedScan(cloud.stamp_ns, "none of its points is a return"), arrival_ns)]
        self._waiting.append((message, probe, arrival_ns))
        return self._settle() if len(self._waiting) == PROBED_CLOUDS else []

    def _settle(self) -> list[tuple[Scan | DroppedScan, int]]:
        waiting, self._waiting = self._waiting, []
        probes = stamped([probe for _, probe, _ in waiting])
        layout, findings = settle_cloud(probes, self._intake.params.recording, self._topic, self._kind)
        self._layout = layout
        self._intake.put_findings("configuration", findings)
        return [(read_scan(message, probe.log_ns, layout)[1], at) for message, probe, at in waiting]
