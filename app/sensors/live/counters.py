"""Counts of what was received and what became of it."""

from dataclasses import dataclass, fields


@dataclass(slots=True)
class Counters:
    """Attributes:
    packets, difop: measurement and device packets used. frames: revolutions made of them.
    lost: packets that never came. reordered: packets that came after a later one and were put in order.
    late: packets that came after their revolution was complete. duplicates: packets that came twice.
    foreign: packets of another sensor. truncated: packets cut short. strays: packets whose time no other confirms.
    undated: packets without a date, stamped on arrival. bad_blocks: blocks of a packet without their mark.
    imu, imu_lost, imu_late, imu_foreign: datagrams or messages of the IMU.
    jumps: of a sensor's clock. dropped: scans that the engine was too busy for.
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
