"""A rotating LiDAR with an IMU that the tests make recordings of: every value is known exactly.

Nothing here uses the code under test; messages are built with `struct` and written by rosbags.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
ELEVATIONS_DEG = np.array([3.0, 12.0, 21.0, 30.0, 45.0, 60.0, 75.0, 85.0])
"""Of the 8 scan lines, lowest first: the rank is the ring."""
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
FORMATS = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}

Vector = tuple[float, float, float]

TYPESTORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}


@dataclass
class Turn:
    """One revolution in firing order: (n, 3) m, (n,) ns after `begin_ns`, and so on."""

    begin_ns: int
    points: np.ndarray
    offsets_ns: np.ndarray
    ring: np.ndarray
    intensity: np.ndarray
    ground: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    def only(self, keep: np.ndarray) -> "Turn":
        kept = (a[keep] for a in (self.points, self.offsets_ns, self.ring, self.intensity, self.ground))
        return Turn(self.begin_ns, *kept)


def turn(number: int = 0, columns: int = 90, *, clockwise: bool = True, channels: Iterable[int] | None = None) -> Turn:
    """The `number`-th revolution. `channels`: the order in which the lines fire in each column."""
    order = np.array(list(channels) if channels is not None else [5, 0, 3, 7, 1, 6, 2, 4])
    lines = len(order)
    ring = np.tile(order, columns)
    slot = np.arange(columns * lines)
    offsets_ns = (slot * (PERIOD_NS / len(slot))).astype(np.int64)
    azimuth = (-1 if clockwise else 1) * 2 * np.pi * (slot // lines) / columns
    elevation = np.radians(ELEVATIONS_DEG)[ring]
    distance = 6.0 + 2.0 * np.sin(3 * azimuth + ring) + 0.01 * number
    points = distance[:, None] * np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    intensity = (slot % 200).astype(float)
    return Turn(START_NS + number * PERIOD_NS, points.astype(np.float32), offsets_ns, ring, intensity, (ring < 2) * 1)


@dataclass
class Layout:
    """How a driver packs a revolution into a PointCloud2 message.

    `fields`: (name, type, source) in order; `source` is x, y, z, intensity, ring, ground, time, or the
    time's seconds or nanoseconds.
    """

    fields: list[tuple[str, str, str]] = field(
        default_factory=lambda: [
            ("x", "f4", "x"),
            ("y", "f4", "y"),
            ("z", "f4", "z"),
            ("intensity", "f4", "intensity"),
            ("ring", "u2", "ring"),
            ("timestamp", "f8", "time"),
        ]
    )
    unit_ns: int = 1_000_000_000
    absolute: bool = True
    clock_ns: int = 0
    """What the points' clock shows at the epoch, for sensors with a clock of their own."""
    time_from: str = "first"
    """Relative times count from the first or the last point."""
    header: str = "last"
    gaps: list[int] = field(default_factory=list)
    """Unused bytes before each field, and after the last one."""
    row_padding: int = 0
    rows: int = 1
    big_endian: bool = False


RELATIVE = [
    ("x", "f4", "x"), ("y", "f4", "y"), ("z", "f4", "z"), ("ring", "u2", "ring"), ("time", "f4", "time"),
]  # fmt: skip
"""Fields of a driver that counts seconds from the scan's first point."""


def message(turned: Turn, layout: Layout | None = None, ros: int = 2, lost: Iterable[int] = ()) -> Any:
    """A PointCloud2 of it, written value by value. `lost`: slots without a return, stored as NaN."""
    layout = layout or Layout()
    types = TYPESTORES[ros].types
    gaps = [*layout.gaps, *[0] * len(layout.fields)][: len(layout.fields) + 1]
    gaps += [0] * (len(layout.fields) + 1 - len(gaps))
    offset, placed = 0, []
    for (name, kind, source), gap in zip(layout.fields, gaps[:-1], strict=True):
        offset += gap
        placed.append((name, kind, source, offset))
        offset += int(kind[1])
    step = offset + gaps[len(layout.fields)]
    width = len(turned) // layout.rows
    row_step = width * step + layout.row_padding
    data = bytearray(layout.rows * row_step)
    end_ns = turned.begin_ns + PERIOD_NS
    missing = set(lost)
    order = ">" if layout.big_endian else "<"
    for slot in range(len(turned)):
        at = slot // width * row_step + slot % width * step
        stamp = turned.begin_ns + int(turned.offsets_ns[slot])
        if layout.absolute:
            time_ns = stamp + layout.clock_ns
        else:
            time_ns = stamp - (turned.begin_ns if layout.time_from == "first" else end_ns)
        for _name, kind, source, offset in placed:
            if source in "xyz":
                value = float("nan") if slot in missing else float(turned.points[slot]["xyz".index(source)])
            elif source == "time":
                value = time_ns / layout.unit_ns if kind[0] == "f" else time_ns // layout.unit_ns
            elif source in ("seconds", "nanoseconds"):
                value = divmod(time_ns, 10**9)[source == "nanoseconds"]
            else:
                value = getattr(turned, source)[slot]
            struct.pack_into(order + FORMATS[kind], data, at + offset, float(value) if kind[0] == "f" else int(value))
    point_field = types["sensor_msgs/msg/PointField"]
    return types["sensor_msgs/msg/PointCloud2"](
        header=header(turned.begin_ns if layout.header == "first" else end_ns, ros),
        height=layout.rows,
        width=width,
        fields=[point_field(name=n, offset=o, datatype=DATATYPES[k], count=1) for n, k, _, o in placed],
        is_bigendian=layout.big_endian,
        point_step=step,
        row_step=row_step,
        data=np.frombuffer(bytes(data), np.uint8),
        is_dense=not missing,
    )


def imu(stamp_ns: int, accel: Vector = (0.0, 0.0, 9.81), gyro: Vector = (0.0, 0.0, 0.0), ros: int = 2) -> Any:
    """An Imu message without orientation."""
    types = TYPESTORES[ros].types
    vector = types["geometry_msgs/msg/Vector3"]
    return types["sensor_msgs/msg/Imu"](
        header=header(stamp_ns, ros),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0, y=0, z=0, w=1),
        orientation_covariance=np.array([-1.0] + [0.0] * 8),
        angular_velocity=vector(*map(float, gyro)),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(*map(float, accel)),
        linear_acceleration_covariance=np.zeros(9),
    )


def header(stamp_ns: int, ros: int) -> Any:
    types = TYPESTORES[ros].types
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    extra = {"seq": 0} if ros == 1 else {}
    return types["std_msgs/msg/Header"](stamp=stamp, frame_id="lidar", **extra)


Entry = tuple[str, int, Any]
"""Topic, log time ns, message."""


def walk(
    turns: int = 6,
    layout: Layout | None = None,
    *,
    ros: int = 2,
    imu_period_ns: int = 10_000_000,
    imu_start_ns: int = -50_000_000,
    imu_stop_ns: int | None = None,
    delay_ns: int = 3_000_000,
    lidar_topic: str = "/points",
    imu_topic: str = "/imu",
    columns: int = 90,
) -> list[Entry]:
    """A recording of so many revolutions, each logged `delay_ns` after its end, with the IMU around them."""
    layout = layout or Layout()
    entries: list[Entry] = []
    for number in range(turns):
        made = turn(number, columns)
        entries.append((lidar_topic, made.begin_ns + PERIOD_NS + delay_ns, message(made, layout, ros)))
    stop = turns * PERIOD_NS + 50_000_000 if imu_stop_ns is None else imu_stop_ns
    stamps = range(START_NS + imu_start_ns, START_NS + stop, imu_period_ns)
    noise = np.random.default_rng(0).normal(size=(len(stamps), 6)) * 1e-3
    entries.extend(
        (imu_topic, stamp + 500_000, imu(stamp, (ax, ay, 9.81 + az), (wx, wy, wz), ros=ros))
        for stamp, (wx, wy, wz, ax, ay, az) in zip(stamps, noise.tolist(), strict=True)
    )
    return sorted(entries, key=lambda entry: entry[1])


def write(path: Path, entries: list[Entry], container: str = "mcap") -> Path:
    """Write a recording; returns what a user would open.

    `container`: bag, bag-bz2, bag-lz4, sqlite3, sqlite3-message, sqlite3-file, mcap, mcap-zstd (all
    but the bags are folders), bare-mcap, bare-db3, small-chunks (a bare .mcap of many zstd chunks).
    """
    if container == "small-chunks":
        return write_mcap(path.with_suffix(".mcap"), entries)
    if container.startswith("bag"):
        path = path.with_suffix(".bag")
        writer: Any = Writer1(path)
        writer.chunk_threshold = 30_000
        if "-" in container:
            writer.set_compression(Writer1.CompressionFormat[container[4:].upper()])
        _fill(writer, entries, 1)
        return path
    kind = container.removeprefix("bare-")
    plugin = StoragePlugin.MCAP if kind.startswith("mcap") else StoragePlugin.SQLITE3
    writer = Writer2(path, version=9, storage_plugin=plugin)
    mode = {"mcap-zstd": "STORAGE", "sqlite3-message": "MESSAGE", "sqlite3-file": "FILE"}.get(kind)
    if mode:
        writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    _fill(writer, entries, 2)
    if container.startswith("bare-"):
        return next(path.glob("*.mcap" if kind == "mcap" else "*.db3"))
    return path


def write_mcap(path: Path, entries: list[Entry], *, counts: bool = True, **options: Any) -> Path:
    """A bare .mcap of many chunks.

    counts: tell how many messages each topic has. options: of mcap's writer.
    """
    with path.open("wb") as stream:
        writer: Any = McapWriter(stream, **{"chunk_size": 30_000, **options})
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for topic, log_ns, sent in entries:
            kind = sent.__msgtype__
            if topic not in channels:
                text = TYPESTORES[2].generate_msgdef(kind, ros_version=2)[0]
                schema = writer.register_schema(kind, "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = bytes(TYPESTORES[2].serialize_cdr(sent, kind))
            writer.add_message(channels[topic], log_ns, data, publish_time=log_ns)
        if not counts:
            writer._Writer__statistics.channel_message_counts.clear()
        writer.finish()
    return path


def _fill(writer: Any, entries: list[Entry], ros: int) -> None:
    typestore = TYPESTORES[ros]
    with writer:
        connections: dict[str, Any] = {}
        for topic, log_ns, sent in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, sent.__msgtype__, typestore=typestore)
            serialize = typestore.serialize_ros1 if ros == 1 else typestore.serialize_cdr
            writer.write(connections[topic], log_ns, serialize(sent, sent.__msgtype__))
