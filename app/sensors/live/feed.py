"""Plays a recording as a live sensor would send it, as packets or through a Foxglove server, to try live mapping."""

import bisect
import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from operator import attrgetter
from pathlib import Path

import numpy as np

from app.sensors import ros
from app.sensors.live.clock import ClockMap
from app.sensors.live.devices import DEVICES
from app.sensors.live.difop import ChannelAngles, Difop, read_angles, write_difop
from app.sensors.live.firings import firings_of, fit_angles, rate_of
from app.sensors.live.foxglove import Channel
from app.sensors.live.foxglove_server import FoxgloveServer
from app.sensors.live.imu_udp import ImuSample, write_airy_imu, write_imu
from app.sensors.live.livox_udp import Livox, LivoxWriter
from app.sensors.live.msop import PacketWriter
from app.sensors.live.urls import Address
from app.sensors.recording import ImuEntry, LostEntry, Recording, ScanEntry, open_recording
from app.sensors.robosense import AIRY, BPEARL, Model
from app.sensors.source import Source
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import F64, Scan, Vector

LIDAR, DEVICE, IMU = 0, 1, 2
_DEVICE_PERIOD_NS = 1_000_000_000
_AFTER_NS = 1_000_000
"""A packet is sent at most this long after the last point of its scan."""
_FITTED = 5
"""Scans from which the unit's angles are read."""


@dataclass(frozen=True, slots=True)
class Sent:
    """Data to be sent: the time by the sensor's clock, the stream, and the content."""

    time_ns: int
    stream: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast to play. speed: in multiples of real time; inf: at once. stop: set this to end early.

    progress: called with the seconds of the recording that have been played. lost: called with the reason for each
    message that is passed over, since it cannot be read.
    """

    speed: float = 1.0
    stop: threading.Event = field(default_factory=threading.Event)
    progress: Callable[[float], None] = lambda seconds: None
    lost: Callable[[str], None] = lambda why: None


class _RoboSense:
    """A RoboSense, and the IMU inside or beside it, that send what a recording holds; as `LivoxWriter`."""

    def __init__(self, recording: Recording, model: Model, angles: ChannelAngles | None, pose: F64 | None) -> None:
        """Raises HemislamError: it is a recording of another LiDAR."""
        scans = (entry.scan for entry in recording.entries() if isinstance(entry, ScanEntry))
        first = list(islice((scan for scan in scans if isinstance(scan, Scan)), _FITTED))
        self._model, self._rate_hz = model, rate_of(first)
        self._angles = angles or fit_angles(first, model, self._rate_hz)
        # A packet's angles have two decimals, the nominal ones four: a receiver without angles uses the nominal ones.
        own = None if self._angles.same(ChannelAngles.nominal(model)) else self._angles
        self._difop = Difop(rpm=60 * self._rate_hz, serial="68656d690001", calibration=own, T_imu_lidar=pose)
        self._packets, self._samples = PacketWriter(model), 0

    def add(self, scan: Scan) -> list[tuple[int, bytes]]:
        return self._packets.add(firings_of(scan, self._angles, self._model, self._rate_hz))

    def flush(self) -> list[tuple[int, bytes]]:
        return self._packets.flush()

    def settings(self, stamp_ns: int) -> bytes:
        return write_difop(self._difop, stamp_ns, self._model)

    def imu(self, stamp_ns: int, gyro: Vector, accel: Vector) -> bytes:
        sample, self._samples = ImuSample(self._samples, stamp_ns, gyro, accel), self._samples + 1
        return write_airy_imu(sample) if self._model is AIRY else write_imu(sample)


def packets_of(
    recording: Recording,
    duration_s: float | None = None,
    model: Model | Livox = BPEARL,
    angles: ChannelAngles | None = None,
    pose: F64 | None = None,
    lost: Callable[[str], None] = lambda why: None,
) -> Iterator[Sent]:
    """Everything that the sensors would have sent, in order of time. A wrong stamp is sent when it was logged.

    pose: (4, 4) T_imu_lidar that an Airy states. lost: as in `Pace`.

    Raises:
        HemislamError: it is a recording of another LiDAR.
    """
    stop_ns = math.inf if duration_s is None else recording.start_ns + duration_s * 1e9
    sensor = LivoxWriter() if isinstance(model, Livox) else _RoboSense(recording, model, angles, pose)
    waiting: list[Sent] = []
    by_time = attrgetter("time_ns")
    lidar, imu = ClockMap(), ClockMap()
    stated_ns = shift_ns = before_ns = end_ns = 0

    def packets(made: list[tuple[int, bytes]]) -> list[Sent]:
        """Packets of a scan and of the previous one's end, which was at `before_ns` and may have a wrong stamp."""
        last_ns = end_ns + _AFTER_NS
        return [Sent(min(max(time_ns + shift_ns, before_ns), last_ns), LIDAR, packet) for time_ns, packet in made]

    for entry in recording.entries():
        if isinstance(entry, ScanEntry):
            scan = entry.scan
            if not isinstance(scan, Scan):
                lost(scan.reason)
                continue
            mapped_ns = lidar.map(scan.end_ns, entry.log_ns)
            begin_ns = mapped_ns - (scan.end_ns - scan.stamp_ns)
            if begin_ns >= stop_ns + 3e8:
                break
            if begin_ns >= stop_ns:
                continue
            before_ns, end_ns, shift_ns = end_ns, mapped_ns, mapped_ns - scan.end_ns
            waiting += packets(sensor.add(scan))
            if begin_ns - stated_ns > _DEVICE_PERIOD_NS and (said := sensor.settings(scan.stamp_ns)) is not None:
                stated_ns = begin_ns
                waiting.append(Sent(stated_ns, DEVICE, said))
            waiting.sort(key=by_time)
            due = bisect.bisect_right(waiting, end_ns, key=by_time)
            yield from waiting[:due]
            del waiting[:due]
        elif isinstance(entry, ImuEntry) and np.isfinite(entry.gyro + entry.accel).all():
            time_ns = imu.map(entry.stamp_ns, entry.log_ns)
            if time_ns < stop_ns + 2e8:
                waiting.append(Sent(time_ns, IMU, sensor.imu(entry.stamp_ns, entry.gyro, entry.accel)))
        elif isinstance(entry, LostEntry):
            lost(entry.said)
    waiting += packets(sensor.flush())
    yield from sorted(waiting, key=by_time)


def feed(
    path: Path,
    params: Params,
    to: Address,
    imu_to: Address | None = None,
    *,
    pace: Pace | None = None,
    duration_s: float | None = None,
) -> int:
    """Play a recording to its end (as a Foxglove server: once a client subscribes). Returns how much was sent.

    Raises:
        HemislamError: the recording cannot be read, or not be played in this way.
    """
    params = params.with_values({"recording.imu_time_offset": 0.0})  # the receiver applies it
    pace = pace or Pace()
    if to.scheme in DEVICES:
        if not DEVICES[to.scheme].has_imu and (imu_to is None or imu_to.scheme != "imu-udp"):
            raise HemislamError("Packets hold no IMU samples; add --imu-to imu-udp://127.0.0.1:6700.")
        with open_recording(path, params) as recording:
            pose = lie.transform(lie.from_rpy_degrees(params.sensor.rotation), np.array(params.sensor.translation))
            return _feed_packets(recording, to, imu_to, pace, duration_s, pose)
    if to.scheme == "foxglove":
        with open_recording(path, params) as recording:
            topics = tuple(filter(None, (recording.lidar_topic, recording.imu_topic)))
        return _feed_foxglove(path, topics, to, pace, duration_s)
    raise HemislamError(f"Play it out to {'://, '.join(DEVICES)}:// or foxglove://.")


def _feed_packets(
    recording: Recording, to: Address, imu_to: Address | None, pace: Pace, duration_s: float | None, pose: F64
) -> int:
    device, lidar = DEVICES[to.scheme], to.host or "127.0.0.1"
    peers = {LIDAR: (lidar, to.ports[0]), DEVICE: (lidar, to.ports[1]), IMU: (lidar, to.ports[-1])}
    if imu_to is not None:
        peers[IMU] = (imu_to.host or "127.0.0.1", imu_to.ports[0])
    angles = read_angles(Path(to.options["angles"])) if "angles" in to.options else None
    sending = packets_of(recording, duration_s, device.model, angles, pose, pace.lost)
    number = 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for sent in _paced(sending, pace):
            try:
                sender.sendto(sent.data, peers[sent.stream])
            except ConnectionRefusedError:  # nobody receives there yet
                continue
            number += 1
    return number


def _feed_foxglove(path: Path, topics: tuple[str, ...], to: Address, pace: Pace, duration_s: float | None) -> int:
    host, number = to.host or "127.0.0.1", 0
    with Source(path) as source:
        kinds = {topic.name: topic.type for topic in source.topics}
        channels = [
            Channel(i, topic, "cdr", kinds[topic], ros.definition(kinds[topic])) for i, topic in enumerate(topics)
        ]
        with FoxgloveServer(host, to.ports[0], channels) as server:
            while not server.wait_for_subscribers(0.2):
                if pace.stop.is_set():
                    return 0
            stop_ns = None if duration_s is None else source.start_ns + round(duration_s * 1e9)

            def sending() -> Iterator[Sent]:
                for topic, log_ns, said in source.messages(topics, None, stop_ns):
                    if isinstance(said, ros.Lost):
                        pace.lost(said.why)
                    else:
                        yield Sent(log_ns, topics.index(topic), ros.serialised(said))

            for sent in _paced(sending(), pace):
                server.publish(sent.stream, sent.time_ns, sent.data)
                number += 1
            time.sleep(0.2)  # so that the last message is read before the connection is closed
    return number


def _paced(items: Iterator[Sent], pace: Pace) -> Iterator[Sent]:
    """Each item at its time. Late items follow at once, so that one delay does not slow down everything after it."""
    begin: tuple[float, int] | None = None
    reported = -1.0
    for item in items:
        if pace.stop.is_set():
            return
        now = time.monotonic()
        if begin is None:
            begin = (now, item.time_ns)
        played = (item.time_ns - begin[1]) / 1e9
        ahead = begin[0] + played / pace.speed - now
        if ahead > 0.0005 and pace.stop.wait(ahead):
            return
        if played - reported > 0.5:
            reported = played
            pace.progress(played)
        yield item
