"""A network capture as a recording: a sensor's packets and `imu-udp` datagrams of a .pcap or .pcapng.

Opening reads the file once and notes where each scan was complete, so that reading can begin near any time. The packets
are recognised by their content, whatever their ports. Packets of a second LiDAR are left out.
"""

import bisect
from abc import ABC, abstractmethod
from array import array
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from ipaddress import ip_address
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from app.sensors import ros
from app.sensors.clocks import TOLERANCE_S
from app.sensors.findings import Finding
from app.sensors.live.clock import JUMP_NS, ClockMap
from app.sensors.live.devices import DEVICES, device_of, mount_finding
from app.sensors.live.difop import DIFOP_ID, Difop, read_angles, read_difop
from app.sensors.live.frames import Assembler, Revolution, sensor_of
from app.sensors.live.imu_udp import IMU_MAGIC, ImuOrder, ImuSample, is_imu, read_imu
from app.sensors.live.livox_udp import read_points
from app.sensors.live.msop import other_sensor
from app.sensors.live.pcap import Capture, CapturePlace, Datagram
from app.sensors.live.status import Counters
from app.sensors.log_times import LATEST_NS
from app.sensors.robosense import Model
from app.slam.errors import HemislamError, quoted
from app.slam.text_files import is_file
from app.slam.types import I64, Scan

SUFFIXES = (".pcap", ".pcapng")
_COMPARED = 1_000
"""Number of measurement packets (half a second) that decide which of several LiDARs is read, and number of messages
that decide whether two clocks agree."""
_RUN_IN = 2
"""Reading begins at the place where the scan this many earlier was complete, which is before all packets of the wanted
scan."""

_SILENCE_NS = 1_000_000_000
"""Packets wait this long for the rest of their scan, as live ones."""
_WILD_NS = 10_000_000_000
"""A log time that is farther than this from those around it is wrong."""

V = TypeVar("V")
Shifts = list[tuple[int, int]]
"""Log times, each with the ns that are added to a sensor's stamps from then on."""


class PacketStream(ABC):
    """The common part of the captures of all LiDARs; see `app.sensors.source.Stream`.

    Packets are combined into contents: all packets of a scan, an IMU sample, or a sensor's settings.

    Args:
        is_measured: whether a packet holds measurements of such a LiDAR. topics: by the type of a content; contents of
            other types give no messages.

    Attributes:
        complete: whether the file has its end. shortened: whether packets were not captured whole.
        findings: the kinds of packets, and how many were lost.
    """

    by_log_time, wild = True, 0
    counts: dict[str, tuple[str, int]]
    findings: tuple[Finding, ...]

    def __init__(self, path: Path, is_measured: Callable[[bytes], bool]) -> None:
        """Raises CaptureError: the file is not a capture."""
        self._path, self._capture, self._is_measured = path, Capture(path), is_measured
        senders = (one.sender for one in self._capture.datagrams() if is_measured(one.payload))
        most = Counter(islice(senders, _COMPARED)).most_common(1)  # in a tie, the first
        self._sender = most[0][0] if most else None
        self._other_senders: set[bytes] = set()
        self._complete_at: list[tuple[int, CapturePlace]] = []
        self._topics: dict[type, str] = {}
        self.start_ns = self.end_ns = 0

    def messages(self, topics: tuple[str, ...], start_ns: int, stop_ns: int) -> Iterator[tuple[str, int, Any]]:
        """(topic, log time ns, message) of what was logged within [start, stop), by log time."""
        number = bisect.bisect_left(self._complete_at, start_ns, key=lambda row: row[0]) - _RUN_IN
        running_ns, place = self._complete_at[number] if number >= 0 else (0, None)
        for log_ns, _, content in self._read(place, running_ns):
            if log_ns >= stop_ns:
                return
            topic = self._topics.get(type(content), "")
            if log_ns >= start_ns and topic in topics:
                yield topic, log_ns, self._message(content, log_ns)

    def close(self) -> None:
        """Nothing stays open between two readings."""
        return

    @abstractmethod
    def _contents(self, datagrams: Iterator[tuple[int, Datagram | None]]) -> Iterator[Any]:
        """The contents that these datagrams complete.

        datagrams: each with its log time, which never steps back; None after the last one before a silence.
        """

    @abstractmethod
    def _message(self, content: Any, log_ns: int) -> Any:
        """The content as a message of its topic."""

    def _index(self, scans: type) -> Iterator[tuple[int, Any]]:
        """Log times and contents of the first reading, which finds start and end, and where scans are complete."""
        for log_ns, place, content in self._read(None, 0):
            if type(content) in self._topics:
                self.start_ns = self.start_ns or log_ns
                self.end_ns = log_ns
            if isinstance(content, scans):
                self._complete_at.append((log_ns, place))
            yield log_ns, content
        self.complete, self.shortened = self._capture.complete, self._capture.shortened

    def _read(self, place: CapturePlace | None, running_ns: int) -> Iterator[tuple[int, CapturePlace, Any]]:
        """Log time, place in the file, and the content that was complete there; from a place on, or all.

        running_ns: the newest log time before that place.
        """
        at = place or CapturePlace(0)

        def datagrams() -> Iterator[tuple[int, Datagram | None]]:
            nonlocal at, running_ns
            for time_ns, datagram in _without_wild_times(self._capture.datagrams(place), running_ns):
                if time_ns - running_ns > _SILENCE_NS:
                    yield running_ns, None
                at, running_ns = datagram.place, max(running_ns, time_ns)
                yield running_ns, datagram

        for content in self._contents(datagrams()):
            yield running_ns, at, content

    def _is_of_another(self, datagram: Datagram) -> bool:
        """Whether a datagram comes from another address than the LiDAR's. Other LiDARs are noted."""
        if datagram.sender == self._sender:
            return False
        if self._is_measured(datagram.payload):
            self._other_senders.add(datagram.sender)
        return True

    def _senders_finding(self) -> list[Finding]:
        """The finding on which of several LiDARs is read, and how to read another one."""
        if self._sender is None or not self._other_senders:
            return []
        used, left_out = (
            ip_address(self._sender),
            ", ".join(str(ip_address(one)) for one in sorted(self._other_senders)),
        )
        text = (
            f"{1 + len(self._other_senders)} LiDARs send in this capture; only {used} is read, and {left_out} left "
            "out. A .json or .angles.csv beside the file must belong to the LiDAR that is read. To read another, "
            f"remove this one: `tcpdump -r {quoted(self._path)} -w other.pcap not src host {used}`"
        )
        return [Finding("LiDARs", "needs you", text)]


class CaptureStream(PacketStream):
    """A capture of one of `DEVICES`, or of `imu-udp` alone."""

    def __init__(self, path: Path) -> None:
        """Raises CaptureError: it is no capture. HemislamError: its sensor, or the angles beside it, cannot be read."""
        from app.sensors.live.decoder import Decoder

        super().__init__(path, lambda packet: sensor_of(packet) is not None)
        sidecar = path.with_name(f"{path.stem}.angles.csv")
        found = device_of(one.payload for one in self._capture.datagrams() if one.sender == self._sender)
        others = (other for one in self._capture.datagrams() if (other := other_sensor(one.payload)))
        if found is None and (other := next(others, "")):
            raise HemislamError(
                f"{path} holds packets of {other}, which are not read; record the topics of its ROS driver instead."
            )
        self._device = found or DEVICES["rsbpearl"]
        self._lidar_topic, self._imu_topic = self._device.layout.lidar_topic, self._device.layout.imu_topic
        self._topics = {Revolution: self._lidar_topic, ImuSample: self._imu_topic}
        model, own = self._device.model, is_file(sidecar) and self._device.has_angles
        self._decoder = Decoder(read_angles(sidecar) if own else None, model) if isinstance(model, Model) else None
        self._angles = f"from {sidecar.name}" if own else ""
        self._devices: list[tuple[int, Difop]] = []
        self._beside = self._own = False  # whether there are samples of `imu-udp`, and of the sensor's own IMU
        self._take_stock()
        self.findings = self._findings()

    def _message(self, content: Revolution | ImuSample, log_ns: int) -> Any:
        if isinstance(content, ImuSample):
            stamp_ns = _bounded(content.stamp_ns + _value_at(self._imu_shifts, log_ns))
            return ros.imu_message(stamp_ns, content.gyro, content.accel)
        if self._decoder is not None and self._devices:
            difop = _value_at(self._devices, log_ns)
            if difop is not self._decoder.difop:
                self._decoder.configure(difop)
        return self._cloud(content, _bounded(_value_at(self._lidar_shifts, log_ns)))

    def _cloud(self, frame: Revolution, shift_ns: int) -> Any:
        """The message of a revolution."""
        if self._decoder is None:
            return read_points(frame.packets, shift_ns)
        scan = self._decoder.decode(frame)
        stamp_ns = _bounded(scan.stamp_ns + shift_ns)
        if isinstance(scan, Scan):
            return ros.cloud_message(replace(scan, stamp_ns=stamp_ns), exact=True)
        return ros.empty_cloud(stamp_ns)

    def _contents(self, datagrams: Iterator[tuple[int, Datagram | None]]) -> Iterator[Revolution | ImuSample | Difop]:
        counters = self._counters = Counters()
        assembler, order, model = Assembler(counters, self._device.models), ImuOrder(counters), self._device.model
        for log_ns, datagram in datagrams:
            if datagram is None or log_ns - (assembler.pending_since() or log_ns) > _SILENCE_NS:
                yield from assembler.flush()
            if datagram is None:
                yield from order.flush()
                continue
            payload = datagram.payload
            beside = payload.startswith(IMU_MAGIC)
            if not beside and self._sender is not None and self._is_of_another(datagram):
                counters.foreign += 1
            elif is_imu(payload):
                if beside and not self._beside and read_imu(payload):
                    self._beside, order = True, ImuOrder(counters)
                    counters.imu_foreign += counters.imu
                    counters.imu = counters.imu_lost = counters.imu_late = 0
                self._own |= not beside
                if beside is self._beside:
                    yield from order.add(payload)
                else:
                    counters.imu_foreign += 1
            elif payload[:8] == DIFOP_ID:
                if isinstance(model, Model) and (difop := read_difop(payload, model)) is not None:
                    counters.difop += 1
                    yield difop
            else:
                yield from assembler.add(payload, log_ns)
        yield from assembler.flush()
        yield from order.flush()

    def _take_stock(self) -> None:
        """Read the file for the first time: times of all messages, what the device states, what is lost."""
        lidar, of_imus = array("q"), {False: array("q"), True: array("q")}
        for log_ns, content in self._index(Revolution):
            if isinstance(content, Difop):
                if not self._devices or not content.same(self._devices[-1][1]):
                    self._devices.append((log_ns, content))
            elif isinstance(content, Revolution):
                lidar.extend((int(content.stamps_ns[-1]), content.arrival_ns, log_ns))
                self._model = content.model.name
            else:
                of_imus[self._beside].extend((content.stamp_ns, log_ns, log_ns))
        imu = of_imus[self._beside]
        frames, samples = np.array(lidar, np.int64).reshape(-1, 3), np.array(imu, np.int64).reshape(-1, 3)
        of_topics = ((self._lidar_topic, self._device.layout.kind, frames), (self._imu_topic, ros.IMU, samples))
        self.counts = {topic: (kind, len(rows)) for topic, kind, rows in of_topics if len(rows)}
        self._settle_clocks(frames, samples)

    def _settle_clocks(self, frames: I64, samples: I64) -> None:
        """Use the sensors' own clocks if they agree, else the host's clock; remove steps of a clock.

        Args:
            frames, samples: (n, 3) stamp, when the last packet came, and log time.
        """
        self._host, self._apart_s = False, 0.0
        self._take_out_steps(frames, samples)
        if len(frames) and len(samples):  # a clock that was set on the way is compared as it goes on
            ages = [
                np.median(
                    [at_ns - stamp - _value_at(shifts, log_ns) for stamp, at_ns, log_ns in part[:_COMPARED].tolist()]
                )
                for part, shifts in ((frames, self._lidar_shifts), (samples, self._imu_shifts))
            ]
            self._apart_s = float(ages[1] - ages[0]) / 1e9
        if abs(self._apart_s) > TOLERANCE_S:
            self._host = True
            self._take_out_steps(frames, samples)

    def _take_out_steps(self, frames: I64, samples: I64) -> None:
        """Find what is added to stamps so that no clock is set on the way; arguments as above."""
        lidar, imu = ClockMap(self._host), ClockMap(self._host)
        self._lidar_shifts: Shifts = []
        for stamp, arrival_ns, log_ns in frames.tolist():
            self._lidar_shifts.append((log_ns, lidar.map(stamp, arrival_ns) - stamp))
        self._imu_shifts: Shifts = []
        following = [*samples[1:, 0].tolist(), None]
        for (stamp, _, log_ns), after in zip(samples.tolist(), following, strict=False):
            if imu.jumps(stamp, log_ns) and (after is None or abs(after - stamp) > JUMP_NS):
                continue  # a single wrong stamp, not a clock that was set
            shift = imu.map(stamp, log_ns, lidar) - stamp
            if not self._imu_shifts or abs(shift - self._imu_shifts[-1][1]) > 10_000:
                self._imu_shifts.append((log_ns, shift))
        self._jumps = [c.jump_ns for c in (lidar, imu) if c.jumped_at_ns]

    def _findings(self) -> tuple[Finding, ...]:
        counters = self._counters
        wrong = counters.lost or counters.truncated or counters.late or counters.imu_lost or not self.complete
        text = counters.describe() + ("" if self.complete else "; the file is cut off there")
        found = [Finding("packets", "corrected" if wrong else "fine", text)]
        found += self._senders_finding()
        if self._lidar_topic in self.counts:
            found += self._device_findings()
        if self._beside and self._own:
            text = "the samples of imu-udp are used; those of the sensor's own IMU are left out and counted as foreign"
            found.append(Finding("IMU", "corrected", text))
        if self._host:
            side = "behind" if self._apart_s > 0 else "ahead of"
            text = f"the IMU's stamps are {abs(self._apart_s):.3f} s {side} the LiDAR's: both were put on the capture's"
            found.append(Finding("sensor clocks", "corrected", f"{text} clock"))
        if self._jumps:
            jumps = ", ".join(f"{jump / 1e9:+.3f} s" for jump in self._jumps)
            found.append(
                Finding("sensor clocks", "corrected", f"set by {jumps} on the way; these steps were taken out")
            )
        return tuple(found)

    def _device_findings(self) -> list[Finding]:
        """What the sensor states about itself."""
        if not self._device.has_angles:
            return [Finding("sensor", "fine", self._model)]
        device = self._devices[0][1] if self._devices else None
        changed = f"; set to other values {len(self._devices) - 1} times" if len(self._devices) > 1 else ""
        text = f"{self._model}, {device.describe() if device else 'without a DIFOP packet'}{changed}"
        found = [Finding("sensor", "fine" if device else "corrected", text)]
        angles = self._angles or ("from the device's DIFOP packet" if device and device.calibration else "")
        missing = "nominal, since the unit did not send its own; put them beside the file as NAME.angles.csv"
        found.append(Finding("angles", "fine" if angles else "needs you", angles or missing))
        if device and device.T_imu_lidar is not None:
            found.append(mount_finding(device.T_imu_lidar))
        return found


def _without_wild_times(datagrams: Iterator[Datagram], before_ns: int) -> Iterator[tuple[int, Datagram]]:
    """Each datagram with its log time, or with that of a neighbour if its own is far from both neighbours'.

    Args:
        before_ns: the log time before the first; 0: none, so the first is compared with the two after it.
    """
    ahead = deque(islice(datagrams, 2))
    while ahead:
        ahead.extend(islice(datagrams, 1))
        datagram = ahead.popleft()
        after = [one.time_ns for one in ahead] or [before_ns or datagram.time_ns]
        middle_ns = sorted((before_ns or after[-1], datagram.time_ns, after[0]))[1]
        before_ns = middle_ns if abs(datagram.time_ns - middle_ns) > _WILD_NS else datagram.time_ns
        yield before_ns, datagram


def _value_at(rows: list[tuple[int, V]], log_ns: int) -> V:
    """The value in force at a log time; before the first one, the first value."""
    return rows[max(bisect.bisect_right(rows, log_ns, key=lambda row: row[0]) - 1, 0)][1]


def _bounded(ns: int) -> int:
    return max(-LATEST_NS, min(ns, LATEST_NS))
