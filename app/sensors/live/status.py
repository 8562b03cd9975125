"""News and state of a live source."""

from dataclasses import dataclass, field, replace
from typing import Literal

from app.sensors.live.counters import Counters

Kind = Literal[
    "connected", "disconnected", "silent", "back", "jump", "configuration", "clocks", "units", "recording", "restarted",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Status:
    """Something happened to a source, which goes on.

    Attributes:
        sensor: what it happened to, "LiDAR", "IMU" or "source". text: one sentence for the user.
        at_ns: when, by the host's clock.
    """

    kind: Kind
    sensor: Literal["LiDAR", "IMU", "source"]
    text: str
    at_ns: int


@dataclass(frozen=True, slots=True)
class LiveState:
    """How a live source is doing, to be shown.

    Attributes:
        lidar_hz, imu_hz: over the last seconds. lidar_age_s, imu_age_s: since the last arrival, None before the first.
        backlog: scans that wait for the engine. clock: which clock stamps the measurements, "" while not settled.
        offset_s: how far the IMU's stamps lag behind the LiDAR's, estimated from arrival times; None if unknown.
        sensor: what the LiDAR reports about itself. recorded: bytes written, None if not recording.
    """

    counters: Counters = field(default_factory=Counters)
    lidar_hz: float = 0.0
    imu_hz: float = 0.0
    lidar_age_s: float | None = None
    imu_age_s: float | None = None
    backlog: int = 0
    clock: str = ""
    offset_s: float | None = None
    sensor: str = ""
    recorded: int | None = None

    def unheard(self, seconds: float) -> "LiveState":
        """The same after a time in which the source did not answer."""
        lidar, imu = (None if age is None else age + seconds for age in (self.lidar_age_s, self.imu_age_s))
        return replace(self, lidar_hz=0.0, imu_hz=0.0, lidar_age_s=lidar, imu_age_s=imu)
