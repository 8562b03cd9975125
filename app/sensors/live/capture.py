"""A network capture as a recording: the RS-Bpearl's packets and `imu-udp` datagrams of a .pcap or .pcapng.

Opening reads the file once and notes where each revolution begins, so that reading can begin at any of
them. The packets are known by their content, whatever the ports.
"""

import bisect
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from app.sensors import ros
from app.sensors.clocks import TOLERANCE_S
from app.sensors.findings import Finding
from app.sensors.live.clock import ClockMap
from app.sensors.live.counters import Counters
from app.sensors.live.difop import DIFOP_ID, Difop, read_angles, read_difop
from app.sensors.live.frames import JUMP_NS, Assembler, Frame
from app.sensors.live.imu_udp import IMU_MAGIC, ImuOrder, ImuSample
from app.sensors.live.msop import BLOCKS, MSOP_ID, stamp_of
from app.sensors.live.pcap import Capture
from app.sensors.rsbpearl import Model
from app.slam.types import Scan

SUFFIXES = (".pcap", ".pcapng")
_COMPARED = 1_000


@dataclass(frozen=True, slots=True)
class _Begin:
    """Where a revolution begins, and what reading from there must know.

    Attributes:
        log_ns: when it was complete. position: in the file; running_ns: the newest log time until there.
        device: which of the device's settings holds.
    """

    log_ns: int
    position: int
    running_ns: int
    model: Model
    first: int
    given_ns: int | None
    device: int


Read = tuple[int, Frame | ImuSample]
"""Log time, and what was complete then."""


class CaptureStream:
    """Topics and messages of a capture, as `McapStream` gives those of a file.

    Attributes:
        counts: topic -> (type, number of messages). start_ns, end_ns: capture times.
        complete: whether the file has its end. findings: what the packets are, and what was lost of them.
    """

    by_log_time = True

    def __init__(self, path: Path) -> None:
        """Raises CaptureError: the file is no capture. HemislamError: the angles beside it are none."""
        from app.sensors.live.decoder import Decoder

        self._capture = Capture(path)
        sidecar = path.with_name(f"{path.stem}.angles.csv")
        self._decoder = Decoder(read_angles(sidecar) if sidecar.is_file() else None)
        self._angles = f"from {sidecar.name}" if sidecar.is_file() else ""
        self._devices: list[Difop] = []
        self._begins: list[_Begin] = []
        self._counters = Counters()
        self._index()
        self.complete = self._capture.complete
        self.findings = self._findings()

    def messages(self, topics: tuple[str, ...], start_ns: int, stop_ns: int) -> Iterator[tuple[str, int, Any]]:
        """(topic, log time ns, message) of what was logged within [start, stop), by log time."""
        number = bisect.bisect_left(self._begins, start_ns, key=lambda begin: begin.log_ns) - 1
        device = -1
        for log_ns, content in self._read(self._begins[number] if number >= 0 else None):
            if log_ns >= stop_ns:
                return
            if isinstance(content, ImuSample):
                if log_ns >= start_ns and ros.IMU_TOPIC in topics:
                    stamp_ns = content.stamp_ns + self._imu_shift(log_ns)
                    yield ros.IMU_TOPIC, log_ns, ros.imu_message(stamp_ns, content.gyro, content.accel)
                continue
            number = max(number, 0)
            begin, shift_ns = self._begins[number], self._lidar_shifts[number]
            number += 1
            if log_ns < start_ns or ros.LIDAR_TOPIC not in topics:
                continue
            if begin.device != device and self._devices:
                device = begin.device
                self._decoder.configure(self._devices[device])
            scan = self._decoder.decode(content)
            if isinstance(scan, Scan):
                message = ros.cloud_message(replace(scan, stamp_ns=scan.stamp_ns + shift_ns), exact=True)
            else:
                message = ros.empty_cloud(scan.stamp_ns + shift_ns)
            yield ros.LIDAR_TOPIC, log_ns, message

    def close(self) -> None:
        """Nothing stays open between two readings."""

    # --- the first reading -------------------------------------------------------------------------

    def _index(self) -> None:
        lidar, imu = array("q"), array("q")
        self.start_ns = self.end_ns = 0
        for log_ns, content in self._read(None, noting=True):
            if isinstance(content, Frame):
                lidar.extend((int(content.stamps_ns[-1]), log_ns))
            else:
                imu.extend((content.stamp_ns, log_ns))
            self.start_ns = self.start_ns or log_ns
            self.end_ns = log_ns
        self.counts: dict[str, tuple[str, int]] = {}
        frames, samples = np.array(lidar, np.int64).reshape(-1, 2), np.array(imu, np.int64).reshape(-1, 2)
        if len(frames):
            self.counts[ros.LIDAR_TOPIC] = (ros.CLOUD, len(frames))
        if len(samples):
            self.counts[ros.IMU_TOPIC] = (ros.IMU, len(samples))
        self._settle_clocks(frames, samples)

    def _settle_clocks(self, frames: Any, samples: Any) -> None:
        """The sensors' own clocks if these agree, else the host's; and steps on the way taken out."""
        delays = [np.median(part[:_COMPARED, 1] - part[:_COMPARED, 0]) / 1e9 for part in (frames, samples) if len(part)]
        self._apart_s = float(delays[1] - delays[0]) if len(delays) == 2 else 0.0
        self._host = abs(self._apart_s) > TOLERANCE_S
        lidar, imu = ClockMap(self._host), ClockMap(self._host)
        self._lidar_shifts = [lidar.map(stamp, arrival) - stamp for stamp, arrival in frames.tolist()]
        self._imu_shifts: list[tuple[int, int]] = [(0, 0)]
        rows = samples.tolist()
        for number, (stamp, arrival) in enumerate(rows):
            following = rows[number + 1][0] if number + 1 < len(rows) else None
            if imu.jumps(stamp, arrival) and (following is None or abs(following - stamp) > JUMP_NS):
                continue  # no clock that was set, but one wrong stamp
            shift = imu.map(stamp, arrival, lidar) - stamp
            if abs(shift - self._imu_shifts[-1][1]) > 10_000 or not number:
                self._imu_shifts.append((arrival, shift))
        self._jumps = [c.jump_ns for c in (lidar, imu) if c.jumped_at_ns]

    def _imu_shift(self, log_ns: int) -> int:
        return self._imu_shifts[bisect.bisect_right(self._imu_shifts, log_ns, key=lambda row: row[0]) - 1][1]

    def _findings(self) -> tuple[Finding, ...]:
        counters = self._counters
        wrong = counters.lost or counters.truncated or counters.late or counters.imu_lost or not self.complete
        text = counters.describe() + ("" if self.complete else "; the file is cut off there")
        found = [Finding("packets", "corrected" if wrong else "fine", text)]
        if ros.LIDAR_TOPIC in self.counts:
            device = self._devices[0] if self._devices else None
            model = self._begins[0].model.name
            changed = f"; set to other values {len(self._devices) - 1} times" if len(self._devices) > 1 else ""
            text = f"{model}, {device.describe() if device else 'without a DIFOP packet'}{changed}"
            found.append(Finding("sensor", "fine" if device else "corrected", text))
            angles = self._angles or ("from the device's DIFOP packet" if device and device.calibration else "")
            missing = "nominal, for this unit's own were not sent; put them beside it as NAME.angles.csv"
            found.append(Finding("angles", "fine" if angles else "needs you", angles or missing))
        if self._host:
            side = "behind" if self._apart_s > 0 else "ahead of"
            text = f"the IMU's stamps are {abs(self._apart_s):.3f} s {side} the LiDAR's: both were put on the capture's"
            found.append(Finding("sensor clocks", "corrected", f"{text} clock"))
        if self._jumps:
            text = f"set by {', '.join(f'{jump / 1e9:+.3f} s' for jump in self._jumps)} on the way; their time goes on"
            found.append(Finding("sensor clocks", "corrected", text))
        return tuple(found)

    # --- every reading -----------------------------------------------------------------------------

    def _read(self, begin: _Begin | None, *, noting: bool = False) -> Iterator[Read]:
        """Revolutions and samples from a revolution's begin on, or all.

        Args:
            noting: note where revolutions begin, what is lost, and what the device says.
        """
        assembler = Assembler(self._counters if noting else None)
        order = ImuOrder(assembler.counters)
        places = _Places()
        running = 0
        if begin is not None:
            assembler.resume(begin.model, begin.first, begin.given_ns)
            running = begin.running_ns
        for datagram in self._capture.datagrams(begin.position if begin else None):
            before, running = running, max(running, datagram.time_ns)
            payload = datagram.payload
            if payload[:8] == MSOP_ID:
                if noting:
                    places.add(stamp_of(payload) or running, datagram.first, before)
                for frame in assembler.add(payload, running):
                    if noting:
                        self._note(frame, running, places)
                    yield running, frame
            elif payload[:4] == IMU_MAGIC:
                yield from ((running, sample) for sample in order.add(payload))
            elif noting and payload[:8] == DIFOP_ID and (said := read_difop(payload)) is not None:
                self._counters.difop += 1
                if not self._devices or not said.same(self._devices[-1]):
                    self._devices.append(said)
        for frame in assembler.flush():
            if noting:
                self._note(frame, running, places)
            yield running, frame
        yield from ((running, sample) for sample in order.flush())

    def _note(self, frame: Frame, log_ns: int, places: "_Places") -> None:
        position, running_ns = places.of(frame)
        device = max(len(self._devices) - 1, 0)
        self._begins.append(
            _Begin(log_ns, position, running_ns, frame.model, frame.first, places.given_ns(frame), device)
        )


class _Places:
    """Where the packets of the present revolutions are in the file."""

    def __init__(self) -> None:
        self._of: dict[int, tuple[int, int]] = {}
        self._given_ns: int | None = None

    def add(self, stamp_ns: int, position: int, running_ns: int) -> None:
        self._of.setdefault(stamp_ns, (position, running_ns))

    def of(self, frame: Frame) -> tuple[int, int]:
        """Position of its first packet in the file, and the newest time before."""
        found = min(self._of[stamp] for stamp in frame.stamps_ns.tolist())
        last = int(frame.stamps_ns[-1])
        near = (stamp for stamp in self._of if last <= stamp or stamp < last - 10 * JUMP_NS)
        self._of = {stamp: self._of[stamp] for stamp in near}
        return found

    def given_ns(self, frame: Frame) -> int | None:
        """Time of the last packet that belongs to earlier revolutions alone; None after a jump."""
        before = self._given_ns
        stamps = frame.stamps_ns.tolist()
        if frame.stop == BLOCKS or len(stamps) > 1:
            self._given_ns = stamps[-1] if frame.stop == BLOCKS else stamps[-2]
        return before if before is not None and abs(stamps[0] - before) < JUMP_NS else None
