"""A bounded buffer between the receiving threads and the engine's side. It never blocks the receiving threads.

When the engine falls behind, the oldest waiting scans are dropped, and each is reported as a `DroppedScan`. IMU samples
are kept unless nobody reads them for minutes.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from app.sensors.clocks import TOLERANCE_S
from app.sensors.findings import Finding
from app.sensors.imu_units import (
    AS_RECORDED,
    DOUBTFUL,
    TOO_FAST,
    ImuProbe,
    ImuUnits,
    measured,
    settle_imu,
    too_fast,
    turning_rate,
)
from app.sensors.live.clock import JUMP_NS, ClockMap, OffsetEstimate
from app.sensors.live.recorder import Recorder
from app.sensors.live.status import Counters, Kind, LiveState, Status
from app.sensors.recording import ImuEntry, ScanEntry
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import DroppedScan, Scan, Vector

MAX_BACKLOG = 100
"""Most scans that wait for the engine: ten seconds at 10 Hz, enough to start another engine."""
MAX_WAITING = 600_000
"""Most IMU samples and news that wait: twenty minutes at 500 Hz. Beyond that, the oldest are dropped."""
MAX_HELD = 50_000
"""Most entries that wait for the start: 10 s of an IMU at 5 kHz. Without a limit, a clock set back could add more."""
_SETTLE_NS = 1_000_000_000
_SETTLE_SCANS = 3
_SWAY_NS = 2_000_000_000
"""Samples must span this time to determine a gyroscope's unit."""
_TOO_FAST_SAMPLES = 20
"""If this many samples in a row are too fast, it was not a knock."""
_AHEAD_NS, _LATE_NS = -50_000_000, 2_000_000_000
"""If the age of stamps on arrival is between these, they are taken as the time of day."""
_MOST_ONCE = 100
"""At most this many messages that are put only once are remembered; a network may hold any number of senders."""
BUSY = "too many scans waited (mapping was paused, or slower than the scanner)"
NO_IMU = "no IMU sample came to cover it"

Clock = Literal["auto", "sensor", "host"]


@dataclass(frozen=True, slots=True)
class Settled:
    """What was settled in the first second, and the state of the clocks, for another intake to continue with.

    Attributes:
        clock: which clock stamps the data. maps: by sensor. units: of the IMU.
    """

    clock: Clock
    maps: dict[str, ClockMap]
    units: ImuUnits


class Intake:
    """Receiving threads call `put_...`; one reader calls `take`.

    For the first second, or two if the gyroscope may be in deg/s, it holds everything back, until it knows the units
    and whether the clocks of the two sensors agree. The log time of an entry is the time of its arrival.

    Attributes:
        params: as given. counters: shared with the receiving threads. sensor: what the LiDAR reports about itself.
        recorder: gets everything that comes, stamped in the engine's time. Data that the engine never gets, because no
            sample or no scan came with it, is stamped in the sensor's own time. None: nothing is recorded.

    Args:
        counters, settled: of an intake that this one continues.
    """

    def __init__(
        self,
        params: Params,
        clock: Clock = "auto",
        counters: Counters | None = None,
        settled: Settled | None = None,
    ) -> None:
        self.params = params
        self.counters = counters or Counters()
        self.sensor = ""
        self.recorder: Recorder | None = None
        self._clock: Clock = clock
        self._changed = threading.Condition()
        self._scans: deque[Scan] = deque()
        self._rest: deque[ImuEntry | DroppedScan | Status] = deque()
        self._held: deque[ScanEntry | ImuEntry] | None = deque()
        self._suspect: ImuEntry | None = None
        self._put_once: set[str] = set()
        self._maps = {"LiDAR": ClockMap(), "IMU": ClockMap()}
        self._offset = OffsetEstimate()
        self._arrivals: dict[str, deque[int]] = {"LiDAR": deque(maxlen=50), "IMU": deque(maxlen=1000)}
        self._units = AS_RECORDED
        self._units_settled = self._units_tried = False
        self._too_fast, self._unit_reported = 0, params.recording.gyroscope_unit != "auto"
        if settled is not None:
            self._held = None
            self._clock, self._maps, self._units = settled.clock, settled.maps, settled.units

    # --- the receiving threads -------------------------------------------------------------------

    def put_scan(self, scan: Scan | DroppedScan, arrival_ns: int) -> None:
        with self._changed:
            if isinstance(scan, Scan):
                self._offset.add_scan(scan.end_ns, arrival_ns)
                self._arrivals["LiDAR"].append(arrival_ns)
            self._put(ScanEntry(arrival_ns, None, scan))

    def put_imu(self, stamp_ns: int, gyro: Vector, accel: Vector, arrival_ns: int) -> None:
        with self._changed:
            stamp_ns += round(self.params.recording.imu_time_offset * 1e9)
            self._offset.add_imu(stamp_ns, arrival_ns)
            self._arrivals["IMU"].append(arrival_ns)
            self._put(ImuEntry(arrival_ns, stamp_ns, gyro, accel))

    def put_status(self, kind: Kind, text: str, *, once: bool = False) -> None:
        """Add news. once: unless the same was added since the source last connected."""
        with self._changed:
            if kind == "connected":
                self._put_once.clear()
            if once and (text in self._put_once or len(self._put_once) == _MOST_ONCE):
                return
            if once:
                self._put_once.add(text)
            self._rest.append(Status(kind, text))
            self._changed.notify()

    def put_findings(self, kind: Kind, findings: list[Finding]) -> None:
        """Report findings that are not as expected."""
        for finding in findings:
            if finding.verdict != "fine":
                self.put_status(kind, f"{finding.subject}: {finding.spoken}")

    def end(self) -> None:
        """Record what is still held back; from now on, nothing is accepted."""
        with self._changed:
            while self._held:
                self._record_unused(self._held.popleft())

    # --- the reader ------------------------------------------------------------------------------

    def take(self, timeout_s: float, *, scan: bool) -> tuple[list[ImuEntry | DroppedScan | Status], Scan | None]:
        """All entries except scans, in the order of arrival, and the oldest scan if wanted. Waits this long for any."""

        def some() -> bool:
            return bool(self._rest) or (scan and bool(self._scans))

        with self._changed:
            self._changed.wait_for(some, timeout_s)
            rest = list(self._rest)
            self._rest.clear()
            return rest, self._scans.popleft() if scan and self._scans else None

    def settled(self) -> Settled | None:
        """The state with which another intake can continue; None while it is unknown."""
        with self._changed:
            if self._held is not None:
                return None
            return Settled(self._clock, deepcopy(self._maps), self._units)

    def state(self) -> LiveState:
        now = time.time_ns()
        with self._changed:
            ages = {name: (now - times[-1]) / 1e9 if times else None for name, times in self._arrivals.items()}
            return LiveState(
                counters=replace(self.counters),
                lidar_hz=_rate(self._arrivals["LiDAR"], now),
                imu_hz=_rate(self._arrivals["IMU"], now),
                lidar_age_s=ages["LiDAR"],
                imu_age_s=ages["IMU"],
                backlog=len(self._scans),
                clock="" if self._held is not None else self._clock,
                imu_lag_s=self._offset.seconds(),
                sensor=self.sensor,
            )

    # --- under the lock --------------------------------------------------------------------------

    def _put(self, entry: ScanEntry | ImuEntry) -> None:
        if self._held is None:
            self._release(entry)
        else:
            self._held.append(entry)
            if self._settle():
                held, self._held = self._held, None
                for waiting in held:
                    self._release(waiting)
        while len(self._scans) > MAX_BACKLOG:
            oldest = self._scans.popleft()
            self._rest.append(DroppedScan(oldest.stamp_ns, BUSY))
            self.counters.dropped += 1
        while len(self._rest) > MAX_WAITING:
            self._rest.popleft()
        self._changed.notify()

    def _settle(self) -> bool:
        """Decide unit and clock; False until a second of IMU samples and a few scans are held, for 10 s at most."""
        assert self._held is not None
        while len(self._held) > MAX_HELD or self._held[-1].log_ns - self._held[0].log_ns > 10 * _SETTLE_NS:
            old = self._held.popleft()
            self._record_unused(old)
            if isinstance(old, ScanEntry):
                self.counters.dropped += 1
                self._rest.append(DroppedScan(old.scan.stamp_ns, NO_IMU))
        # Thousands of samples may be held; going through all of them at each scan is enough.
        if not isinstance(self._held[-1], ScanEntry):
            return False
        scans = sum(isinstance(entry, ScanEntry) and isinstance(entry.scan, Scan) for entry in self._held)
        if scans < _SETTLE_SCANS or not self._settle_units():
            return False
        self._settle_clock()
        return True

    def _settle_units(self) -> bool:
        """Whether the units are known, once there is a second of samples."""
        if self._units_settled:
            return True
        samples = [entry for entry in self._held or () if isinstance(entry, ImuEntry)]
        if len(samples) < 20:
            return False
        span_ns = abs(samples[-1].stamp_ns - samples[0].stamp_ns)
        if span_ns < _SETTLE_NS:
            if samples[-1].log_ns - samples[0].log_ns > 5 * _SETTLE_NS:
                self.put_status("clocks", "the IMU's stamps do not advance; check its driver", once=True)
            return False
        stamps = np.array([sample.stamp_ns for sample in samples], np.int64)
        accel = np.array([sample.accel for sample in samples], np.float64)
        gyro = np.array([sample.gyro for sample in samples], np.float64)
        good = measured(gyro, accel)
        if not good.any():
            return False
        if span_ns < _SWAY_NS and turning_rate(gyro[good]) > DOUBTFUL and not self._unit_reported:
            return False
        probe = ImuProbe(stamps[good], stamps[good], gyro[good], accel[good])
        try:
            self._units, findings = settle_imu(probe, self.params.recording)
        except HemislamError as error:
            self.put_status("units", str(error), once=True)
            return False
        self.put_findings("units", findings)
        self._unit_reported |= any("deg/s" in finding.text for finding in findings)
        self._units_settled = True
        return True

    def _record_unused(self, entry: ScanEntry | ImuEntry) -> None:
        """Record an entry that the reader does not get, in the sensor's own time, as the clock is not settled."""
        if self.recorder is None:
            return
        if isinstance(entry, ImuEntry):
            if not self._units_tried:  # no scan came to do it
                self._units_tried = True
                self._settle_units()
            entry = ImuEntry(entry.log_ns, entry.stamp_ns, *self._units.apply(entry.gyro, entry.accel))
        self.recorder.add(entry)

    def _settle_clock(self) -> None:
        offset = self._offset.seconds() or 0.0
        apart = abs(offset) > TOLERANCE_S
        wrong = f"the IMU's stamps are {abs(offset):.3f} s {'behind' if offset > 0 else 'ahead of'} the LiDAR's"
        if self._clock == "auto":
            late = offset < 0 and self._stamps_are_of_day()
            self._clock = "host" if apart and not late else "sensor"
            if apart and late:
                text = (
                    f"the scans arrive {-offset:.3f} s after the IMU's samples of the same time, as over a slow network"
                )
                self.put_status("clocks", f"{text}; the stamps are used: if they are wrong, use ?clock=host")
            elif apart:
                self.put_status("clocks", f"{wrong}: both are stamped by the host's clock instead, on arrival")
        elif self._clock == "sensor" and apart:
            self.put_status("clocks", f"{wrong}; use ?clock=host, or --set recording.imu_time_offset={offset:.3f}")
        for clock_map in self._maps.values():
            clock_map.host = self._clock == "host"

    def _stamps_are_of_day(self) -> bool:
        """Whether both sensors' stamps are the time of day, some seconds old at most."""
        held = self._held or ()
        scans = [e.log_ns - e.scan.end_ns for e in held if isinstance(e, ScanEntry) and isinstance(e.scan, Scan)]
        samples = [entry.log_ns - entry.stamp_ns for entry in held if isinstance(entry, ImuEntry)]
        return all(_AHEAD_NS < np.median(ages) < _LATE_NS for ages in (scans, samples))

    def _release(self, entry: ScanEntry | ImuEntry) -> None:
        """Stamp an entry in the engine's time and pass it to the recorder and the reader."""
        if isinstance(entry, ScanEntry):
            self._release_scan(entry)
        elif not self._maps["IMU"].jumps(entry.stamp_ns, entry.log_ns):
            self.counters.strays += self._suspect is not None
            self._suspect = None
            self._release_imu(entry)
        elif self._suspect is not None and abs(entry.stamp_ns - self._suspect.stamp_ns) < JUMP_NS:
            suspect, self._suspect = self._suspect, None
            self._release_imu(suspect)
            self._release_imu(entry)
        else:  # another time, which the next sample must confirm
            self.counters.strays += self._suspect is not None
            self._suspect = entry

    def _release_imu(self, entry: ImuEntry) -> None:
        stamp = self._mapped("IMU", entry.stamp_ns, entry.log_ns)
        entry = ImuEntry(entry.log_ns, stamp, *self._units.apply(entry.gyro, entry.accel))
        if self.recorder is not None:
            self.recorder.add(entry)
        rate = math.hypot(*entry.gyro)
        self._too_fast = self._too_fast + 1 if rate > TOO_FAST else 0
        if self._too_fast == _TOO_FAST_SAMPLES and not self._unit_reported:
            self._unit_reported = True
            self.put_findings("units", [too_fast(rate)])
        self._rest.append(entry)

    def _release_scan(self, entry: ScanEntry) -> None:
        scan = entry.scan
        if isinstance(scan, DroppedScan):
            self._rest.append(DroppedScan(scan.stamp_ns + self._maps["LiDAR"].shift_ns, scan.reason))
            return
        shift = self._mapped("LiDAR", scan.end_ns, entry.log_ns) - scan.end_ns
        scan = replace(scan, stamp_ns=scan.stamp_ns + shift) if shift else scan
        if self.recorder is not None:
            self.recorder.add(replace(entry, scan=scan))
        self._scans.append(scan)

    def _mapped(self, name: Literal["LiDAR", "IMU"], stamp_ns: int, arrival_ns: int) -> int:
        clock_map, other = self._maps[name], self._maps["IMU" if name == "LiDAR" else "LiDAR"]
        before = clock_map.jumped_at_ns
        mapped = clock_map.map(stamp_ns, arrival_ns, other)
        if clock_map.jumped_at_ns != before:
            self.counters.jumps += 1
            self._offset.clear()
            text = f"the {name}'s clock was set by {clock_map.jump_ns / 1e9:+.3f} s; its time continues"
            self.put_status("jump", text)
        return mapped


def _rate(times: deque[int], now: int) -> float:
    """Arrivals per second over the last three seconds."""
    recent = [time for time in times if time > now - 3_000_000_000]
    return (len(recent) - 1) * 1e9 / (recent[-1] - recent[0]) if len(recent) > 1 and recent[-1] > recent[0] else 0.0


Receive = Callable[[threading.Event], None]
"""Runs in a receiving thread: puts what comes into its intake until the event is set."""
