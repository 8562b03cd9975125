"""News, counts and state of a live source."""

from dataclasses import dataclass, field, fields, replace
from typing import Literal

Kind = Literal[
    "connected", "disconnected", "silent", "back", "jump", "configuration", "clocks", "units", "recording", "restarted",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Status:
    """An event of a source, which continues. text: one sentence for the user."""

    kind: Kind
    text: str


@dataclass(slots=True)
class Counters:
    """Attributes:
    packets, difop: measurement and device packets used. frames: revolutions made of them.
    lost: packets that never came. reordered: packets that came after a later one and were put in order.
    late: packets that came after their revolution was complete. duplicates: packets that came twice.
    foreign: packets of another sensor. truncated: packets cut short. strays: packets whose time no other confirms.
    undated: packets without a date, stamped on arrival. bad_blocks: blocks of a packet without their mark.
    imu, imu_lost, imu_late, imu_foreign: datagrams or messages of the IMU.
    jumps: of a sensor's clock. dropped: scans that had to wait for too long.
    reconnects: of a connection. unreadable: messages that could not be decoded.
    restarts: of the receiving process.
    """

    packets: int = 0
    difop: int = 0
    frames: int = 0
    lost: int = 0
    reordered: int = 0
    late: int = 0
    duplicates: int = 0
    foreign: int = 0
    truncated: int = 0
    strays: int = 0
    undated: int = 0
    bad_blocks: int = 0
    imu: int = 0
    imu_lost: int = 0
    imu_late: int = 0
    imu_foreign: int = 0
    jumps: int = 0
    dropped: int = 0
    reconnects: int = 0
    unreadable: int = 0
    restarts: int = 0

    def describe(self) -> str:
        """The counts that are not zero, in words."""
        named = ((field.name.replace("_", " "), getattr(self, field.name)) for field in fields(self))
        return ", ".join(f"{count} {name}" for name, count in named if count)


@dataclass(frozen=True, slots=True)
class LiveState:
    """The state of a live source, for display.

    Attributes:
        lidar_hz, imu_hz: over the last seconds. lidar_age_s, imu_age_s: since the last arrival, None before the first.
        backlog: scans that wait for the engine. clock: which clock stamps the measurements, "" while not settled.
        imu_lag_s: how far the IMU's stamps lag behind the LiDAR's, estimated from arrival times; None if unknown.
        sensor: what the LiDAR reports about itself. recorded: bytes written, None if not recording.
    """

    counters: Counters = field(default_factory=Counters)
    lidar_hz: float = 0.0
    imu_hz: float = 0.0
    lidar_age_s: float | None = None
    imu_age_s: float | None = None
    backlog: int = 0
    clock: str = ""
    imu_lag_s: float | None = None
    sensor: str = ""
    recorded: int | None = None

    def unheard(self, seconds: float) -> "LiveState":
        """The same state after a time in which the source did not answer."""
        lidar, imu = (None if age is None else age + seconds for age in (self.lidar_age_s, self.imu_age_s))
        return replace(self, lidar_hz=0.0, imu_hz=0.0, lidar_age_s=lidar, imu_age_s=imu)
