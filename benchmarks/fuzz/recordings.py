"""Damaged recordings of every format, processed like a user does."""

import gc
import io
import math
import os
import random
import re
import resource
import signal
import struct
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import app.calibration.calibrate
import app.evaluation.truth
import app.export.exports
import app.mapping.opening
import app.slam.doubts  # noqa: F401
from app.__main__ import main
from app.sensors.cloud_types import read_point_cloud_2
from app.sensors.live.feed import packets_of
from app.sensors.live.livox_udp import SLOT_NS, LivoxWriter
from app.sensors.recording import ImuEntry, ScanEntry, open_recording
from app.sensors.robosense import AIRY, BPEARL, Model
from app.sensors.ros import CLOUD, IMU, IMU_TOPIC, LIDAR_TOPIC, header, serialised
from app.sensors.simulator import simulate
from app.sensors.source import Source
from app.slam.errors import HemislamError
from app.slam.metrics import compare
from app.slam.params import Params
from app.slam.trajectory import read_tum
from app.slam.types import Scan
from app.slam.warmup import compile_kernels
from benchmarks.fuzz.damage import MESSAGES, Entry, bytes_damaged

FORMATS = ("mcap-livox", "mcap", "mcap-lz4", "mcap-plain", "bag", "bag-bz2", "bag-lz4", "db3", "pcap")
ONLY_BYTES = ("mcap-livox", "pcap")
"""Formats whose messages are not damaged individually."""
MOST_S, MOST_BYTES = 60, 2 << 30
"""Limits of one run."""
TOLERANCE = 0.01
"""Share of the path length: if a trajectory is off by more, the program must say that it is in doubt."""
PORTS = (6699, 7788, 7799)
"""Ports of the LiDAR, of its settings and of the IMU."""
Packet = tuple[int, int, bytes]
"""Time in ns, UDP port, payload."""
ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
CUSTOM_POINT, CUSTOM_MSG = "livox_ros_driver2/msg/CustomPoint", "livox_ros_driver2/msg/CustomMsg"
ROS2.register(
    get_types_from_msg(
        "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line", CUSTOM_POINT
    )
    | get_types_from_msg(
        "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
        "livox_ros_driver2/CustomPoint[] points",
        CUSTOM_MSG,
    )
)
POINT = np.dtype(
    [("offset_time", "<u4"), ("xyz", "<f4", 3), ("reflectivity", "u1"), ("tag", "u1"), ("line", "u1"), ("pad", "u1")]
)
"""A CustomPoint among others."""
SAYS_SO = re.compile(r"^(WARNING|noted|dropped|needs you|corrected)\b.*", re.MULTILINE)


class Recordings:
    """Makes cases of a simulated walk and judges how they end. Close it at the end.

    Attributes:
        good: the undamaged walk. said: output of a run on it. packets: those that an RS-Bpearl, a Mid-360 and an Airy
            would have sent.
    """

    def __init__(self) -> None:
        compile_kernels()  # like the imports above: forks need not load again what exists before them
        self._folder = tempfile.TemporaryDirectory()
        self._path = Path(self._folder.name)
        self.good = self._path / "good.mcap"
        simulate("room", self.good, duration_s=8.0, every_block=10)
        self._params = (self._path / "good.params.yaml").read_text(encoding="utf-8")
        with Source(self.good) as source:
            self._entries = list(source.messages((LIDAR_TOPIC, IMU_TOPIC)))
        simulate("room", self._path / "airy.mcap", duration_s=4.0, every_block=10, scanner="airy")
        self.packets = [
            self._sent(self.good, BPEARL),
            self._mid360(),
            self._sent(self._path / "airy.mcap", AIRY),
        ]
        self._files: dict[str, bytes] = {}
        gc.freeze()  # otherwise garbage collection in each fork would copy all of this memory
        code, said, _, _ = self._run(self.good)
        assert code == 0, said
        self.said = {*SAYS_SO.findall(said)}
        self._truth = read_tum(self._path / "out" / "trajectory.tum")

    def close(self) -> None:
        self._folder.cleanup()

    def _sent(self, path: Path, model: Model) -> list[Packet]:
        with open_recording(path, Params()) as recording:
            sending = packets_of(recording, model=model)
            return [(sent.time_ns, PORTS[sent.stream], sent.data) for sent in sending]

    def _mid360(self) -> list[Packet]:
        """Packets of the same recording, as if a Mid-360 had measured one point after another."""
        writer, sent = LivoxWriter(), []
        with open_recording(self.good, Params()) as recording:
            for entry in recording.entries():
                if isinstance(entry, ScanEntry) and isinstance(entry.scan, Scan):
                    offsets = np.arange(len(entry.scan), dtype=np.int32) * SLOT_NS
                    packets = writer.add(replace(entry.scan, offsets_ns=offsets))
                    sent += [(time_ns, PORTS[0], packet) for time_ns, packet in packets]
                elif isinstance(entry, ImuEntry):
                    sent.append((entry.stamp_ns, PORTS[2], writer.imu(entry.stamp_ns, entry.gyro, entry.accel)))
        return sorted(sent)

    def broken(self, seed: int) -> str:
        """The invariant that the case breaks, and how; "" if none."""
        luck = random.Random(seed)
        path, what = self._damaged(luck)
        code, said, seconds, peak = self._run(path)
        what = f"{what}: exit {code} after {seconds:.1f} s"
        if code not in (0, 2):
            return f"{what}; {said[-600:]}"
        if at := re.search(r"Traceback|Warning:", said):
            return f"{what}, with a traceback or a raw warning; {said[max(at.start() - 200, 0) :][:3000]}"
        if code == 2 and not re.search(r"^hemislam: .{20,}", said, re.MULTILINE):
            return f"{what} without a sentence; {said[-300:]}"
        if seconds > MOST_S or peak > MOST_BYTES:
            return f"{what} with {peak >> 20} MB"
        return self._wrong(said, what) if code == 0 else ""

    def _wrong(self, said: str, what: str) -> str:
        """Whether a successful run is wrong without saying so."""
        try:
            ours = read_tum(self._path / "out" / "trajectory.tum")
            error = compare(ours, self._truth)["ate_m"]["max"]
        except HemislamError as problem:
            ours, error = self._truth, math.inf
            what = f"{what} ({problem})"
        if not np.isfinite(ours.positions).all():
            return f"{what}; the poses are not finite"
        doubted = {*SAYS_SO.findall(said)} - self.said
        whole = len(ours) > 0.98 * len(self._truth)
        if not doubted and not (whole and error < TOLERANCE * self._truth.distance):
            return f"{what}; {len(ours)} poses, off by {error:.3f} m, and nothing was said; {said[-600:]}"
        return ""

    def _damaged(self, luck: random.Random) -> tuple[Path, str]:
        kind = luck.choice(FORMATS)
        if kind in ONLY_BYTES or luck.random() < 0.5:
            data = bytes_damaged(luck, self._file(kind))
            path = self._path / f"case.{kind.partition('-')[0]}"
            path.write_bytes(data)
            return self._with_params(path), f"bytes of {kind}"
        entries = [(topic, log_ns, _copied(message)) for topic, log_ns, message in self._entries]
        chosen = luck.choices(MESSAGES, k=luck.choice([1, 1, 1, 2]))
        for damage in chosen:
            damage(luck, entries)
        luck_of_schema = random.Random(luck.random()) if kind.startswith("mcap") and luck.random() < 0.1 else None
        path = self._written(kind, entries, luck_of_schema)
        names = ", ".join(damage.__name__ for damage in chosen) + (" and schema" if luck_of_schema else "")
        return self._with_params(path), f"{names} of {kind}"

    def _file(self, kind: str) -> bytes:
        """The undamaged walk in a format, written on first use, since each takes seconds."""
        if kind not in self._files:
            self._files[kind] = self._written(kind, self._entries).read_bytes()
        return self._files[kind]

    def _with_params(self, path: Path) -> Path:
        path.with_name(f"{path.stem}.params.yaml").write_text(self._params, encoding="utf-8")
        return path

    def _written(self, kind: str, entries: list[Entry], luck_of_schema: random.Random | None = None) -> Path:
        path = self._path / f"case.{kind.partition('-')[0]}"
        path.unlink(missing_ok=True)
        match kind.partition("-")[0]:
            case "mcap":
                _write_mcap(path, kind.partition("-")[2], entries, luck_of_schema)
            case "bag":
                _write_bag(path, kind.partition("-")[2], entries)
            case "db3":
                _write_db3(path, entries)
            case "pcap":
                path.write_bytes(pcap(self.packets[0]))
        return path

    def _run(self, path: Path) -> tuple[int, str, float, int]:
        """Exit code, output, duration (s) and peak memory (bytes) of `hemislam run`."""
        begin = time.monotonic()
        with tempfile.TemporaryFile() as said:
            child = os.fork()
            if not child:
                _become_hemislam(["run", str(path), "--out", str(self._path / "out"), "--force"], said.fileno())
            _, status, used = os.wait4(child, 0)
            said.seek(0)
            text = said.read().decode(errors="replace")
        code = os.waitstatus_to_exitcode(status)
        return code, text, time.monotonic() - begin, used.ru_maxrss * 1024


def _become_hemislam(arguments: list[str], said: int) -> None:
    """Run the command line in a child process and end it."""
    for stream in (1, 2):
        os.dup2(said, stream)
    sys.stdout, sys.stderr = (io.TextIOWrapper(os.fdopen(stream, "wb", 0), write_through=True) for stream in (1, 2))
    signal.alarm(MOST_S + 10)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    sys.argv = ["hemislam", *arguments, "--set", "loops.enabled=false"]
    code: object = 1
    try:
        main()
    except SystemExit as end:
        code = end.code or 0
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code if isinstance(code, int) else 1)


def _copied(message: Any) -> Any:
    """A copy of a message whose parts can be changed; its points are shared."""
    import copy

    return (
        copy.deepcopy(message, {id(message.data): message.data}) if hasattr(message, "data") else copy.deepcopy(message)
    )


def _write_mcap(path: Path, compression: str, entries: list[Entry], luck: random.Random | None) -> None:
    kinds = {"": CompressionType.ZSTD, "lz4": CompressionType.LZ4}
    cloud = CUSTOM_MSG if compression == "livox" else CLOUD
    with path.open("wb") as file:
        writer = McapWriter(file, compression=kinds.get(compression, CompressionType.NONE), chunk_size=200_000)
        writer.start(profile="ros2")
        channels = {}
        for topic, kind in ((LIDAR_TOPIC, cloud), (IMU_TOPIC, IMU)):
            text, encoding = ROS2.generate_msgdef(kind)[0].encode(), "cdr"
            if luck is not None:
                text = bytes_damaged(luck, text)
                topic += luck.choice(["", "\x1b[31m", "\n", "é" * 300])
                encoding = luck.choice(["cdr", "cdr", "ros1", "json"])
            schema = writer.register_schema(kind, "ros2msg", text)
            channels[topic[:5]] = writer.register_channel(topic, encoding, schema)
        for topic, log_ns, message in entries:
            data = _as_custom_msg(message) if compression == "livox" and topic == LIDAR_TOPIC else _serialised(message)
            writer.add_message(channels[topic[:5]], log_ns, data, log_ns)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it untyped


def _as_custom_msg(message: Any) -> bytes:
    """The same cloud in the message type of Livox's driver."""
    cloud = read_point_cloud_2(message)
    times = cloud.column("timestamp")
    begin_ns = round(float(times.min()) * 1e9)
    made = ROS2.types[CUSTOM_MSG](
        header=header(begin_ns, "livox_frame"), timebase=begin_ns, point_num=len(times), lidar_id=0,
        rsvd=np.zeros(3, np.uint8), points=[],
    )  # fmt: skip
    points = np.zeros(len(times), POINT)  # as rosbags would write them one by one, which takes seconds
    points["offset_time"] = np.rint((times - times.min()) * 1e9)
    points["xyz"], points["reflectivity"], points["tag"] = cloud.xyz(), 10, 16
    head = bytes(ROS2.serialize_cdr(made, CUSTOM_MSG))[:-4]  # its list is empty
    return head + struct.pack("<I", len(points)) + points.tobytes()[:-1]  # no padding after the last


def _serialised(message: Any) -> bytes:
    with np.errstate(all="ignore"):
        return serialised(message)


def _write_bag(path: Path, compression: str, entries: list[Entry]) -> None:
    writer = BagWriter(path)
    writer.chunk_threshold = 200_000
    if compression:
        writer.set_compression(BagWriter.CompressionFormat[compression.upper()])
    with writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=ROS1)
            for topic, kind in ((LIDAR_TOPIC, CLOUD), (IMU_TOPIC, IMU))
        }
        for topic, log_ns, message in sorted(entries, key=lambda entry: entry[1]):
            header, stamp = message.header, message.header.stamp
            time_ = ROS1.types["builtin_interfaces/msg/Time"](sec=stamp.sec, nanosec=stamp.nanosec)
            ours = ROS1.types["std_msgs/msg/Header"](seq=0, stamp=time_, frame_id=header.frame_id)
            values = {**vars(message), "header": ours}
            values = {name: value for name, value in values.items() if not name.startswith("__")}
            made = ROS1.types[message.__msgtype__](**values)
            writer.write(connections[topic], log_ns, ROS1.serialize_ros1(made, message.__msgtype__))


def _write_db3(path: Path, entries: list[Entry]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        inside = Path(folder) / "walk"
        with FolderWriter(inside, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
            connections = {
                topic: writer.add_connection(topic, kind, typestore=ROS2)
                for topic, kind in ((LIDAR_TOPIC, CLOUD), (IMU_TOPIC, IMU))
            }
            for topic, log_ns, message in entries:
                writer.write(connections[topic], log_ns, _serialised(message))
        path.write_bytes(next(inside.glob("*.db3")).read_bytes())


def pcap(packets: list[Packet]) -> bytes:
    """Write a capture of UDP datagrams (time, port, payload) with nanosecond stamps."""
    made = [struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 65535, 1)]
    for time_ns, port, data in packets:
        frame = bytes(12) + b"\x08\x00" + struct.pack(">BBHHHBBHII", 0x45, 0, 28 + len(data), 1, 0, 64, 17, 0, 1, 2)
        frame += struct.pack(">4H", 40_000, port, 8 + len(data), 0) + data
        made.append(struct.pack("<4I", *divmod(time_ns, 10**9), len(frame), len(frame)) + frame)
    return b"".join(made)
