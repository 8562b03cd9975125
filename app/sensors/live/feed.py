"""Plays a recording out as a live sensor: its packets, or a Foxglove server. To try live without a sensor."""

import heapq
import math
import queue
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from app.sensors import ros
from app.sensors.live.difop import NOMINAL, Calibration, Difop, read_angles, write_difop
from app.sensors.live.firings import firings_of, fit_angles, rate_of
from app.sensors.live.foxglove_server import FoxgloveServer, Offer
from app.sensors.live.imu_udp import ImuSample, write_imu
from app.sensors.live.msop import PacketWriter
from app.sensors.live.urls import Address
from app.sensors.recording import Recording, ScanEntry, open_recording
from app.sensors.rsbpearl import BPEARL, Model
from app.sensors.source import Source
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import Scan

LIDAR, DEVICE, IMU = 0, 1, 2
_DEVICE_PERIOD_NS = 1_000_000_000
_FITTED = 5
"""Scans that the unit's angles are read off."""


@dataclass(frozen=True, slots=True, order=True)
class Sent:
    """Something to be sent: when it would be by the sensor's clock, on which stream, what."""

    time_ns: int
    number: int
    stream: int
    data: bytes = field(compare=False)


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast to play. speed: times real time, inf: at once. stop: set to end early.

    progress: told the seconds of the recording that were played.
    """

    speed: float = 1.0
    stop: threading.Event = field(default_factory=threading.Event)
    progress: Callable[[float], None] = lambda seconds: None


def packets_of(
    recording: Recording, duration_s: float | None = None, model: Model = BPEARL, angles: Calibration | None = None
) -> Iterator[Sent]:
    """Everything the sensors would have sent, in order of time.

    Raises:
        HemislamError: it is a recording of another LiDAR.
    """
    stop_ns = math.inf if duration_s is None else recording.start_ns + duration_s * 1e9
    first = _first_scans(recording)
    rate = rate_of(first)
    calibration = angles or fit_angles(first, model, rate)
    # A packet's angles have two decimals, the nominal ones four: who is not told any others takes these.
    own = None if calibration.same(NOMINAL) else calibration
    difop = Difop(rpm=60 * rate, serial="68656d690001", calibration=own)
    writer = PacketWriter(model)
    waiting: list[Sent] = []
    number = samples = 0
    device_ns = 0

    def push(time_ns: int, stream: int, data: bytes) -> None:
        nonlocal number
        heapq.heappush(waiting, Sent(time_ns, number, stream, data))
        number += 1

    for entry in recording.entries():
        if isinstance(entry, ScanEntry):
            if entry.scan.stamp_ns >= stop_ns + 3e8:
                break
            if not isinstance(entry.scan, Scan) or entry.scan.stamp_ns >= stop_ns:
                continue
            firings = firings_of(entry.scan, calibration, model, rate)
            for time_ns, packet in writer.add(firings.times_ns, firings.azimuth, firings.counts, firings.intensity):
                push(time_ns, LIDAR, packet)
            if entry.scan.stamp_ns - device_ns > _DEVICE_PERIOD_NS:
                device_ns = entry.scan.stamp_ns
                push(device_ns, DEVICE, write_difop(difop, device_ns))
            until = entry.scan.end_ns
            while waiting and waiting[0].time_ns <= until:
                yield heapq.heappop(waiting)
        elif entry.stamp_ns < stop_ns + 2e8:
            sample = ImuSample(samples, entry.stamp_ns, entry.gyro, entry.accel)
            samples += 1
            push(entry.stamp_ns, IMU, write_imu(sample))
    for time_ns, packet in writer.flush():
        push(time_ns, LIDAR, packet)
    while waiting:
        yield heapq.heappop(waiting)


def feed(
    path: Path,
    params: Params,
    to: Address,
    imu_to: Address | None = None,
    *,
    pace: Pace | None = None,
    duration_s: float | None = None,
    wait_s: float = math.inf,
) -> int:
    """Play a recording out to its end; returns how many packets or messages were sent.

    Args:
        wait_s: a Foxglove server waits so long for somebody who wants to receive.

    Raises:
        HemislamError: the recording cannot be read, or not be played out so; nobody came.
    """
    params = params.with_values({"recording.imu_time_offset": 0.0})  # the receiver applies it
    pace = pace or Pace()
    if to.scheme == "rsbpearl":
        if imu_to is None or imu_to.scheme != "imu-udp":
            raise HemislamError("Packets hold no IMU samples; add --imu-to imu-udp://127.0.0.1:6700.")
        with open_recording(path, params) as recording:
            return _feed_packets(recording, to, imu_to, pace, duration_s)
    if to.scheme == "foxglove":
        with open_recording(path, params) as recording:
            topics = (recording.lidar_topic, recording.imu_topic)
        return _feed_foxglove(path, topics, to, pace, duration_s, wait_s)
    raise HemislamError("Play it out to rsbpearl:// or foxglove://.")


def _feed_packets(recording: Recording, to: Address, imu_to: Address, pace: Pace, duration_s: float | None) -> int:
    lidar, imu = to.host or "127.0.0.1", imu_to.host or "127.0.0.1"
    peers = ((lidar, to.ports[0]), (lidar, to.ports[1]), (imu, imu_to.ports[0]))
    angles = read_angles(Path(to.options["angles"])) if "angles" in to.options else None
    count = 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for sent in _paced(_ahead(packets_of(recording, duration_s, angles=angles), pace.stop), pace):
            try:
                sender.sendto(sent.data, peers[sent.stream])
            except ConnectionRefusedError:  # nobody receives there yet
                continue
            count += 1
    return count


def _feed_foxglove(
    path: Path, topics: tuple[str, str], to: Address, pace: Pace, duration_s: float | None, wait_s: float
) -> int:
    offers = [
        Offer(topic, kind, ros.definition(kind)) for topic, kind in zip(topics, (ros.CLOUD, ros.IMU), strict=True)
    ]
    count = 0
    with Source(path) as source, FoxgloveServer(to.host or "127.0.0.1", to.ports[0], offers) as server:
        deadline = time.monotonic() + wait_s
        while not server.wait_for_subscribers(0.2):
            if pace.stop.is_set():
                return 0
            if time.monotonic() > deadline:
                raise HemislamError(f"Nobody came to ws://{to.host or '127.0.0.1'}:{server.port} to receive.")
        for sent in _paced(_messages_of(source, topics, duration_s), pace):
            server.publish(sent.stream, sent.time_ns, sent.data)
            count += 1
        time.sleep(0.2)  # so that the last message is read before the connection is closed
    return count


def _messages_of(source: Source, topics: tuple[str, str], duration_s: float | None) -> Iterator[Sent]:
    stop_ns = None if duration_s is None else source.start_ns + round(duration_s * 1e9)
    for number, (topic, log_ns, message) in enumerate(source.messages(topics, None, stop_ns)):
        yield Sent(log_ns, number, topics.index(topic), ros.serialised(message))


def _ahead(items: Iterator[Sent], stop: threading.Event) -> Iterator[Sent]:
    """The same, made ahead on another thread: making one scan's packets must not delay another's."""
    made: queue.Queue[Sent | BaseException | None] = queue.Queue(4_000)
    done = threading.Event()

    def put(item: Sent | BaseException | None) -> None:
        while not (done.is_set() or stop.is_set()):
            try:
                return made.put(item, timeout=0.2)
            except queue.Full:
                continue
        return None

    def make() -> None:
        try:
            for item in items:
                put(item)
                if done.is_set() or stop.is_set():
                    return
            put(None)
        except BaseException as error:  # raised again where the items are used
            put(error)

    thread = threading.Thread(target=make, daemon=True, name="feed")
    thread.start()
    try:
        while not stop.is_set():
            try:
                item = made.get(timeout=0.2)
            except queue.Empty:
                continue
            if item is None:
                return
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        done.set()
        thread.join()


def _paced(items: Iterator[Sent], pace: Pace) -> Iterator[Sent]:
    """Each at its time. Late ones at once, so that a hiccup does not slow down all that follows."""
    begin: tuple[float, int] | None = None
    told = -1.0
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
        if played - told > 0.5:
            told = played
            pace.progress(played)
        yield item


def _first_scans(recording: Recording) -> list[Scan]:
    scans: list[Scan] = []
    for entry in recording.entries():
        if isinstance(entry, ScanEntry) and isinstance(entry.scan, Scan):
            scans.append(replace(entry.scan))
            if len(scans) == _FITTED:
                break
    return scans
