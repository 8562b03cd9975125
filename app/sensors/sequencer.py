"""Pairs each scan with the IMU samples that cover it, and with the samples of any other sensor.

Recordings and live sources use it in the same way: they call `add_imu`, `add_scan` and `add` in the order of arrival,
and `ready()` returns complete measurements. Pairing goes by the time of measurement, never by arrival. Gaps, repeated
samples and steps back in time are detected, counted and reported. Once the IMU has covered a scan, later scans without
samples are used too: then the LiDAR alone shows the motion.
"""

import bisect
import math
from collections.abc import Iterator, Mapping
from copy import copy
from dataclasses import dataclass, field, fields, replace
from statistics import median
from typing import Any

import numpy as np

from app.slam.sections import ImuParams
from app.slam.types import I64, DroppedScan, ImuSamples, Measurement, Samples, Scan, Vector

OUTAGE_NS = 1_000_000_000
"""The first sample, and the first after a gap, must be confirmed by another sample within this time."""

MAX_WAITING = 64
"""Most scans that wait for IMU samples; bounds the memory when the IMU falls silent."""

BLIND_NS = 10_000_000_000
"""If a scan is this much later than the previous one, and beyond the IMU's samples, its clock is wrong."""

MAX_SAMPLES = 100_000
"""Most IMU samples that wait for a scan, eight minutes at 200 Hz: dead reckoning is useless for longer."""

MAX_HELD = 10_000
"""Most samples of another sensor that wait for a scan; the oldest are dropped first."""

GYRO, ACCEL = slice(0, 3), slice(3, 6)
SPIKE_FLOOR = ((GYRO, 0.5), (ACCEL, 3.0))
"""rad/s, m/s^2: a sample that differs less from its neighbours is never a spike."""
STUCK_SAMPLES = 200
COARSE = (0.005, 0.05)
"""rad/s, m/s^2: an IMU with a coarser resolution than this reads the same number for long at rest and is not stuck."""
SPIKE_TO_NEIGHBOURS, SPIKE_TO_USUAL = 4.0, 10.0
"""A spike deviates from the line between its neighbours by this many times their difference and the usual deviation."""


@dataclass(slots=True)
class Counts:
    """Counts of the sequencer."""

    imu_duplicates: int = 0
    imu_back_steps: int = 0
    imu_behind: int = 0
    imu_far_off: int = 0
    imu_invalid: int = 0
    imu_weightless: int = 0
    imu_out_of_range: int = 0
    imu_spikes: int = 0
    imu_stuck: int = 0
    imu_gaps: int = 0
    longest_imu_gap_s: float = 0.0
    paired: int = 0


@dataclass(slots=True)
class Sequencer:
    """The only place that pairs a scan with the IMU samples that cover it. Implausible samples are left out.

    Attributes:
        limits: `max_gap`: a longer interval between IMU samples is a gap, and reported. `max_rate`,
            `max_acceleration`: samples beyond are refused.
        without_imu: if there is no IMU, scans go out as they come, without samples.
        counts: gaps, repeated samples and the like.
    """

    limits: ImuParams
    without_imu: bool = False
    counts: Counts = field(default_factory=Counts)
    _stamps: list[int] = field(default_factory=list)
    _values: list[tuple[float, ...]] = field(default_factory=list)
    _waiting: list[Scan | DroppedScan] = field(default_factory=list)
    _held: dict[type[Samples], Samples] = field(default_factory=dict)
    _notices: list[str] = field(default_factory=list)
    _last_stamp_ns: int | None = None
    _last_end_ns: int | None = None
    _intervals_ns: list[int] = field(default_factory=list)
    _behind: bool = False
    _told_gap_ns: int = -1
    _told_silence_ns: int = -1
    """Stamps of the last sample before the gap, and before the ongoing silence, that were reported last."""
    _suspect: tuple[int, tuple[float, ...]] | None = None
    """The first sample, or the first after a gap. Its stamp counts as wrong unless the next sample follows it."""
    _usual: list[float] = field(default_factory=lambda: [0.0, 0.0])
    """How far samples usually are from the line between their neighbours: rad/s, m/s^2."""
    _begun: bool = False
    _same: list[int] = field(default_factory=lambda: [0] * 6)
    """For how many samples each axis has read the same number."""
    _finest: list[float] = field(default_factory=lambda: [math.inf] * 2)
    """Smallest step between successive samples, on any axis: rad/s, m/s^2."""

    def copy(self) -> "Sequencer":
        """An independent copy in the same state. Scans and samples are shared: they never change."""
        return replace(self, **{column.name: copy(getattr(self, column.name)) for column in fields(self)})

    def tail(self) -> "Sequencer":
        """A sequencer that takes over after this one's last scan, and reports what is missing in between."""
        return replace(
            self.copy(),
            _stamps=self._stamps[-1:],
            _values=self._values[-1:],
            _waiting=[],
            _held={},
            _notices=[],
            _behind=False,
            _suspect=None,
        )

    def add_imu(self, stamp_ns: int, gyro: Vector, accel: Vector) -> None:
        """One IMU sample: rad/s and m/s^2, IMU frame."""
        values = (*gyro, *accel)
        if not all(map(math.isfinite, values)):
            self._count("imu_invalid", "an IMU sample is NaN or infinite and was left out")
            return
        if not any(accel):
            self._count("imu_weightless", "an IMU sample has no acceleration, not even gravity's, and was left out")
            return
        if max(map(abs, gyro)) > self.limits.max_rate or max(map(abs, accel)) > self.limits.max_acceleration:
            self._count("imu_out_of_range", "an IMU sample is beyond what an IMU can measure and was left out")
            return
        newest = self._stamps[-1] if self._stamps else None
        suspect, self._suspect = self._suspect, None
        confirmed = suspect is not None and 0 < stamp_ns - suspect[0] <= OUTAGE_NS
        doubtful = newest is None or stamp_ns > newest + min(self.limits.max_gap * 1e9, OUTAGE_NS)
        if suspect is not None and doubtful and confirmed:
            self._append(*suspect)
        elif suspect is not None and suspect[0] != stamp_ns:
            self._count("imu_far_off", "an IMU sample was stamped far from those around it and was left out")
        if doubtful and not confirmed:
            self._suspect = (stamp_ns, values)
            return
        if newest is not None and stamp_ns <= newest:
            if stamp_ns == newest:
                self.counts.imu_duplicates += 1
                return
            if len(self._stamps) > 1 and stamp_ns > self._stamps[-2] and not self._behind:  # neighbours change places
                self._stamps.insert(-1, stamp_ns)
                self._values.insert(-1, values)
                if len(self._values) > 2:
                    self._check(-3, -2, -1)
                return
            self.counts.imu_behind += 1
            if not self._behind:
                back = (newest - stamp_ns) / 1e9
                self._count("imu_back_steps", f"IMU time stepped back by {back:.4f} s; samples until then left out")
                self._behind = True
            return
        self._behind = False
        self._append(stamp_ns, values)

    def _append(self, stamp_ns: int, values: tuple[float, ...]) -> None:
        if self._stamps:
            self._count_gap(self._stamps[-1], stamp_ns)
        self._note_stuck_axes(values)
        self._stamps.append(stamp_ns)
        self._values.append(values)
        if len(self._stamps) > MAX_SAMPLES:  # the LiDAR is silent: a gap begins where its last scan ended
            given_up = slice(int(self._last_end_ns is not None), MAX_SAMPLES // 2)
            del self._stamps[given_up], self._values[given_up]
        if len(self._values) > 2:
            self._check(-3, -2, -1)
            if not self._begun and len(self._values) > 2:  # the very first has neighbours on one side only
                self._begun = True
                self._check(-2, -3, -1)

    def _count_gap(self, before_ns: int, after_ns: int) -> None:
        gap_s = (after_ns - before_ns) / 1e9
        if gap_s > self.limits.max_gap:
            self.counts.imu_gaps += 1
            self.counts.longest_imu_gap_s = max(self.counts.longest_imu_gap_s, gap_s)

    def _note_stuck_axes(self, values: tuple[float, ...]) -> None:
        """Report stuck axes. An axis never reads the same number for long, unless its resolution hides the noise."""
        if not self._values:
            return
        for axis, (last, value) in enumerate(zip(self._values[-1], values, strict=True)):
            part = axis // 3
            if value != last:
                self._same[axis] = 0
                self._finest[part] = min(self._finest[part], abs(value - last))
                continue
            self._same[axis] += 1
            if self._same[axis] == STUCK_SAMPLES and self._finest[part] < COARSE[part]:
                self.counts.imu_stuck += 1
                name = f"{'accelerometer' if axis > 2 else 'gyroscope'} {'xyz'[axis % 3]}"
                self._notices.append(f"the {name} has read the same number for {STUCK_SAMPLES} samples: it is stuck")

    def _check(self, before: int, this: int, after: int) -> None:
        """Remove this sample if it alone differs from its neighbours: no motion lasts only one sample."""
        values, spike = self._values, False
        for n, (part, floor) in enumerate(SPIKE_FLOOR):
            first, second, third = values[before][part], values[this][part], values[after][part]
            off, apart = math.dist(first, second) + math.dist(second, third), math.dist(first, third)
            off = (off - apart) / 2  # 0 on the line from one neighbour to the other, however steep
            if off > max(floor, SPIKE_TO_NEIGHBOURS * apart, SPIKE_TO_USUAL * self._usual[n]):
                spike = True
            else:
                self._usual[n] += 0.02 * (off - self._usual[n])
        if spike:
            del self._stamps[this], self._values[this]
            self._count("imu_spikes", "an IMU sample is far from those before and after it and was left out")

    def notice(self, text: str) -> None:
        """Report this text, once, with the next measurement."""
        if text not in self._notices:
            self._notices.append(text)

    def add(self, samples: Samples) -> None:
        """Samples of any other sensor. Each goes out once, with the first measurement that ends at or after it.

        A sample that arrives too late goes out with the next measurement.
        """
        kind = type(samples)
        held = _joined(self._held[kind], samples) if kind in self._held else samples
        self._held[kind] = _rows(held, slice(-MAX_HELD, None))

    def add_scan(self, scan: Scan | DroppedScan) -> None:
        """One scan, or the notice that one could not be read, which keeps its place in the sequence."""
        bisect.insort(self._waiting, scan, key=lambda waiting: waiting.stamp_ns)

    @property
    def waiting(self) -> int:
        """How many scans wait for IMU samples."""
        return len(self._waiting)

    @property
    def newest_imu_ns(self) -> int | None:
        """Time of the newest IMU sample that was accepted; None before the first."""
        return self._stamps[-1] if self._stamps else None

    @property
    def silent_s(self) -> float:
        """For how long there have been IMU samples but no scan."""
        return (self._stamps[-1] - self._last_end_ns) / 1e9 if self._stamps and self._last_end_ns is not None else 0.0

    def ready(self, most_waiting: int = MAX_WAITING) -> Iterator[Measurement | DroppedScan]:
        """The measurements that are complete by now, in order of time.

        Args:
            most_waiting: scans that may wait for samples; if there are more, the oldest go out without samples. At
                least 1 while scans come, since a later scan may arrive first.
        """
        most = min(most_waiting, 1) if self.without_imu else most_waiting
        while self._waiting:
            scan = self._waiting[0]
            end_ns = scan.end_ns if isinstance(scan, Scan) else scan.stamp_ns
            covered = len(self._stamps) > 1 and self._stamps[-2] >= end_ns  # the newest may be a spike
            if not covered and len(self._waiting) <= most:
                return
            yield self._take(self._waiting.pop(0))

    def finish(self) -> Iterator[Measurement | DroppedScan]:
        """The input has ended: the measurements that are still waiting."""
        yield from self.ready(0)
        if self._stamps and self._last_end_ns is not None:
            self._count_gap(self._stamps[-1], self._last_end_ns)

    def _take(self, scan: Scan | DroppedScan) -> Measurement | DroppedScan:
        reason = scan.reason if isinstance(scan, DroppedScan) else self._objection(scan)
        if reason or isinstance(scan, DroppedScan):
            return DroppedScan(scan.stamp_ns, reason)
        end_ns = scan.end_ns
        begin_ns = self._stamps[0] if self._last_end_ns is None and self._stamps else self._last_end_ns or 0
        first = max(bisect.bisect_right(self._stamps, begin_ns) - 1, 0)
        last = bisect.bisect_left(self._stamps, end_ns)
        self._note_missing_scans(scan)
        if scan.refused:
            self._notices.append("points beyond 10 km or without a time were left out")
        imu = self._samples(first, last + 1)
        self._tell_gaps(imu.stamps_ns, end_ns)
        measurement = Measurement(scan, imu, tuple(self._notices), self._take_streams(end_ns))
        self._notices.clear()
        self._last_stamp_ns, self._last_end_ns = scan.stamp_ns, end_ns
        keep = max(bisect.bisect_right(self._stamps, end_ns) - 1, 0)
        del self._stamps[:keep], self._values[:keep]
        self.counts.paired += 1
        return measurement

    def _take_streams(self, end_ns: int) -> Mapping[type[Samples], Samples]:
        """The held samples of other sensors up to this time, sorted by time."""
        taken: dict[type[Samples], Samples] = {}
        for kind, held in self._held.items():
            order = np.argsort(held.stamps_ns, kind="stable")
            count = int(np.searchsorted(held.stamps_ns[order], end_ns, side="right"))
            taken[kind], self._held[kind] = _rows(held, order[:count]), _rows(held, order[count:])
        return {kind: samples for kind, samples in taken.items() if len(samples)}

    def _objection(self, scan: Scan) -> str:
        """Why a scan cannot be used; "" if it can. Without numbers, so that equal reasons can be counted."""
        begin_ns, end_ns = scan.stamp_ns, scan.end_ns
        if self._last_stamp_ns is not None and self._last_end_ns is not None:
            if begin_ns == self._last_stamp_ns:
                return "it repeats the scan before it (same time)"
            if begin_ns < self._last_stamp_ns or end_ns <= self._last_end_ns:
                return "its time steps back before the scan before it"
            if self._last_end_ns - begin_ns > end_ns - self._last_end_ns:
                return "most of it is from the time of the scan before it"
        if self.without_imu:
            return ""
        if not self._stamps:
            return "there is no IMU sample"
        # samples from before the last scan's end are gone by now; the poses there are extrapolated
        continued = self._last_end_ns is not None and self._stamps[0] <= self._last_end_ns
        if begin_ns < self._stamps[0] and not continued:
            return "the IMU starts after it"
        if end_ns > self._stamps[-1]:
            if self._last_end_ns is None:
                return "the IMU stops before its end"
            if begin_ns > self._last_end_ns + BLIND_NS:
                return "its time is far ahead of the scan before it and of the IMU"
        return ""

    def _tell_gaps(self, stamps_ns: I64, end_ns: int) -> None:
        """Report each gap once, with the first scan by which its end is known."""
        if self.without_imu:
            return
        gaps = np.diff(stamps_ns) > self.limits.max_gap * 1e9
        for before, after in zip(stamps_ns[:-1][gaps].tolist(), stamps_ns[1:][gaps].tolist(), strict=True):
            if before > self._told_gap_ns:
                self._notices.append(f"no IMU sample for {(after - before) / 1e9:.3f} s")
                self._told_gap_ns = before
        newest = int(stamps_ns[-1])
        if end_ns - newest > self.limits.max_gap * 1e9 and newest > self._told_silence_ns:
            self._notices.append("the IMU has fallen silent: until it is back, the LiDAR alone shows the motion")
            self._told_silence_ns = newest

    def _note_missing_scans(self, scan: Scan) -> None:
        if self._last_stamp_ns is None:
            return
        interval = scan.stamp_ns - self._last_stamp_ns
        # at first only the scan itself shows how often scans come
        lasts = max(scan.end_ns - scan.stamp_ns, 100_000_000)
        usual = median(self._intervals_ns) if len(self._intervals_ns) >= 5 else lasts
        if interval > 1.5 * usual:
            missing = round(interval / usual) - 1
            self._notices.append(f"no usable scan for {interval / 1e9:.3f} s before this one ({missing} missing)")
        self._intervals_ns = [*self._intervals_ns[-20:], interval]

    def _samples(self, first: int, stop: int) -> ImuSamples:
        stamps = np.array(self._stamps[first:stop], np.int64)
        values = np.array(self._values[first:stop], np.float64).reshape(-1, 6)
        gyro, accel = np.ascontiguousarray(values[:, :3]), np.ascontiguousarray(values[:, 3:])
        for array in (stamps, gyro, accel):
            array.setflags(write=False)
        return ImuSamples(stamps, gyro, accel)

    def _count(self, name: str, notice: str) -> None:
        setattr(self.counts, name, getattr(self.counts, name) + 1)
        self._notices.append(notice)


def _joined(first: Samples, second: Samples) -> Samples:
    """Samples of one sensor after earlier ones of the same type."""
    both = ((getattr(first, column.name), getattr(second, column.name)) for column in fields(first))
    return type(first)(*map(np.concatenate, both))


def _rows(samples: Samples, chosen: slice | np.ndarray[Any, Any]) -> Samples:
    """The chosen samples, in that order and read-only."""
    columns = [getattr(samples, column.name)[chosen] for column in fields(samples)]
    for column in columns:
        column.setflags(write=False)
    return type(samples)(*columns)
