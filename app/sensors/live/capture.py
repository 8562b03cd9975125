"""A network capture as a recording: a sensor's packets and `imu-udp` datagrams of a .pcap or .pcapng.

Opening reads the file once and notes where each revolution was complete, so that reading can begin near any time. The
packets are recognised by their content, whatever their ports. Those of a second LiDAR are left out.
"""

import bisect
from array import array
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from app.sensors import ros
from app.sensors.clocks import TOLERANCE_S
from app.sensors.findings import Finding
from app.sensors.live.clock import JUMP_NS, ClockMap
from app.sensors.live.devices import DEVICES, device_of, mount_finding, sender_of, senders_finding
from app.sensors.live.difop import DIFOP_ID, Difop, read_angles, read_difop
from app.sensors.live.frames import Assembler, Revolution, sensor_of
from app.sensors.live.imu_udp import IMU_MAGIC, ImuOrder, ImuSample, is_imu, read_imu
from app.sensors.live.livox_udp import read_points
from app.sensors.live.msop import other_sensor
from app.sensors.live.pcap import Capture, CapturePlace
from app.sensors.live.status import Counters
from app.sensors.robosense import Model
from app.slam.errors import HemislamError
from app.slam.types import I64, Scan

SUFFIXES = (".pcap", ".pcapng")
_COMPARED = 1_000
_RUN_IN = 2
"""Reading begins where this many revolutions earlier was complete: all packets of the wanted one lie behind that."""

V = TypeVar("V")
Shifts = list[tuple[int, int]]
"""From which log time on how many ns are added to a sensor's stamps."""


class CaptureStream:
    """Topics and messages of a capture; see `app.sensors.source.Stream`.

    Attributes:
        complete: whether the file has its end. findings: what the packets are, and what was lost of them.
    """

    by_log_time = True

    def __init__(self, path: Path) -> None:
        """Raises CaptureError: it is no capture. HemislamError: its sensor, or the angles beside it, cannot be read."""
        from app.sensors.live.decoder import Decoder

        self._path, self._capture = path, Capture(path)
        sidecar = path.with_name(f"{path.stem}.angles.csv")
        self._sender = sender_of(self._capture.datagrams(), lambda payload: sensor_of(payload) is not None)
        self._other_senders: set[bytes] = set()
        found = device_of(one.payload for one in self._capture.datagrams() if one.sender == self._sender)
        others = (other for one in self._capture.datagrams() if (other := other_sensor(one.payload)))
        if found is None and (other := next(others, "")):
            raise HemislamError(
                f"{path} holds packets of {other}, which are not read; record the topics of its ROS driver instead."
            )
        self._device = found or DEVICES["rsbpearl"]
        self._lidar_topic, self._imu_topic = self._device.layout.lidar_topic, self._device.layout.imu_topic
        model, own = self._device.model, sidecar.is_file() and self._device.has_angles
        self._decoder = Decoder(read_angles(sidecar) if own else None, model) if isinstance(model, Model) else None
        self._angles = f"from {sidecar.name}" if own else ""
        self._devices: list[tuple[int, Difop]] = []
        self._complete_at: list[tuple[int, CapturePlace]] = []
        self._counters = Counters()
        self._beside = self._own = False  # whether there are samples of `imu-udp`, and of the sensor's own IMU
        self._index()
        self.complete = self._capture.complete
        self.findings = self._findings()

    def messages(self, topics: tuple[str, ...], start_ns: int, stop_ns: int) -> Iterator[tuple[str, int, Any]]:
        """(topic, log time ns, message) of what was logged within [start, stop), by log time."""
        number = bisect.bisect_left(self._complete_at, start_ns, key=lambda row: row[0]) - _RUN_IN
        running_ns, place = self._complete_at[number] if number >= 0 else (0, None)
        device = None
        for log_ns, _, content in self._read(place, running_ns, Counters()):
            if log_ns >= stop_ns:
                return
            if log_ns < start_ns:
                continue
            if isinstance(content, ImuSample) and self._imu_topic in topics:
                stamp_ns = content.stamp_ns + _value_at(self._imu_shifts, log_ns)
                yield self._imu_topic, log_ns, ros.imu_message(stamp_ns, content.gyro, content.accel)
            elif isinstance(content, Revolution) and self._lidar_topic in topics:
                if self._devices and (difop := _value_at(self._devices, log_ns)) is not device:
                    device = difop
                    if self._decoder is not None:
                        self._decoder.configure(difop)
                yield self._lidar_topic, log_ns, self._cloud(content, _value_at(self._lidar_shifts, log_ns))

    def _cloud(self, frame: Revolution, shift_ns: int) -> Any:
        """The message of a revolution."""
        if self._decoder is None:
            return read_points(frame.packets, shift_ns)
        scan = self._decoder.decode(frame)
        stamp_ns = scan.stamp_ns + shift_ns
        if isinstance(scan, Scan):
            return ros.cloud_message(replace(scan, stamp_ns=stamp_ns), exact=True)
        return ros.empty_cloud(stamp_ns)

    def close(self) -> None:
        """Nothing stays open between two readings."""

    def _read(
        self, place: CapturePlace | None, running_ns: int, counters: Counters
    ) -> Iterator[tuple[int, CapturePlace, Revolution | ImuSample | Difop]]:
        """Log time, place in the file, and what was complete there; from a place on, or all.

        Args:
            running_ns: the newest log time before that place. counters: of what was lost.
        """
        assembler, order = Assembler(counters), ImuOrder(counters)
        at = place or CapturePlace(0)
        for datagram in self._capture.datagrams(place):
            at, running_ns, payload = datagram.place, max(running_ns, datagram.time_ns), datagram.payload
            found: list[Any] = []
            beside = payload.startswith(IMU_MAGIC)
            if not beside and datagram.sender != self._sender is not None:
                counters.foreign += 1
                if sensor_of(payload) is not None:
                    self._other_senders.add(datagram.sender)
            elif is_imu(payload):
                if beside and not self._beside and read_imu(payload):
                    self._beside, order = True, ImuOrder(counters)
                    counters.imu_foreign += counters.imu
                    counters.imu = counters.imu_lost = counters.imu_late = 0
                self._own |= not beside
                if beside is self._beside:
                    found = order.add(payload)
                else:
                    counters.imu_foreign += 1
            elif payload[:8] == DIFOP_ID:
                model = self._device.model
                difop = read_difop(payload, model) if isinstance(model, Model) else None
                found = [difop] if difop is not None else []
            elif (sensor := sensor_of(payload)) is None or sensor in self._device.models:
                found = assembler.add(payload, running_ns)
            else:
                counters.foreign += 1
            for content in found:
                yield running_ns, at, content
        rest: list[Any] = [*assembler.flush(), *order.flush()]
        for content in rest:
            yield running_ns, at, content

    def _index(self) -> None:
        """The first reading: times of all messages, what the device says, what is lost."""
        lidar, of_imus = array("q"), {False: array("q"), True: array("q")}
        self.start_ns = self.end_ns = 0
        for log_ns, place, content in self._read(None, 0, self._counters):
            if isinstance(content, Difop):
                self._counters.difop += 1
                if not self._devices or not content.same(self._devices[-1][1]):
                    self._devices.append((log_ns, content))
                continue
            if isinstance(content, Revolution):
                lidar.extend((int(content.stamps_ns[-1]), log_ns))
                self._complete_at.append((log_ns, place))
                self._model = content.model.name
            else:
                of_imus[self._beside].extend((content.stamp_ns, log_ns))
            self.start_ns = self.start_ns or log_ns
            self.end_ns = log_ns
        imu = of_imus[self._beside]
        frames, samples = np.array(lidar, np.int64).reshape(-1, 2), np.array(imu, np.int64).reshape(-1, 2)
        of_topics = ((self._lidar_topic, self._device.layout.kind, frames), (self._imu_topic, ros.IMU, samples))
        self.counts = {topic: (kind, len(rows)) for topic, kind, rows in of_topics if len(rows)}
        self._settle_clocks(frames, samples)

    def _settle_clocks(self, frames: I64, samples: I64) -> None:
        """The sensors' own clocks if they agree, else the host's; steps of a clock are taken out.

        Args:
            frames, samples: (n, 2) stamp and log time.
        """
        delays = [np.median(part[:_COMPARED, 1] - part[:_COMPARED, 0]) / 1e9 for part in (frames, samples) if len(part)]
        self._apart_s = float(delays[1] - delays[0]) if len(delays) == 2 else 0.0
        self._host = abs(self._apart_s) > TOLERANCE_S
        lidar, imu = ClockMap(self._host), ClockMap(self._host)
        self._lidar_shifts: Shifts = []
        for stamp, log_ns in frames.tolist():
            self._lidar_shifts.append((log_ns, lidar.map(stamp, log_ns) - stamp))
        self._imu_shifts: Shifts = []
        following = [*samples[1:, 0].tolist(), None]
        for (stamp, log_ns), after in zip(samples.tolist(), following, strict=False):
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
        found += senders_finding(self._path, self._sender, self._other_senders)
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


def _value_at(rows: list[tuple[int, V]], log_ns: int) -> V:
    """The value that holds at a log time; before the first, the first."""
    return rows[max(bisect.bisect_right(rows, log_ns, key=lambda row: row[0]) - 1, 0)][1]
