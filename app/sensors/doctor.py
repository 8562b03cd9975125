"""The recording doctor: what a recording holds, what was corrected, and what only the user can settle.

Opening a recording already examines its first messages (`Recording.findings`); `examine` adds findings that need a full
pass.
"""

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from app.sensors.clocks import clock_finding, is_copy
from app.sensors.cloud_types import CLOUD_TYPES
from app.sensors.findings import Finding as Finding
from app.sensors.findings import FindingVerdict
from app.sensors.layout import settle_cloud
from app.sensors.probe import choose_topic, probe_clouds
from app.sensors.recording import LACKS, Entry, ImuEntry, LostEntry, ScanEntry, open_recording
from app.sensors.sequencer import STUCK_SAMPLES, Counts, Sequencer
from app.sensors.source import Source, Topic
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.pause import PAUSE_S
from app.slam.sections import ImuParams
from app.slam.types import F64, I64, DroppedScan, Scan, Vector

MOST_IN_BATCH = 50
"""Samples that are read at a time."""
MOST_BEHIND = 20
"""Samples that may be left out because their stamps step back: a tenth of a second, which the filter can bridge."""
DAMAGE = "file"
"""Subject of findings about the file itself."""


def examine(
    path: Path, params: Params, progress: Callable[[float], None] = lambda fraction: None
) -> tuple[Finding, ...]:
    """Read all of a recording and report what to know before mapping it.

    Args:
        progress: called with the fraction read, 0-1, now and then.

    Raises:
        HemislamError: the file cannot be opened. Damage further on, or a missing sensor, is a finding.
    """
    try:
        recording = open_recording(path, params)
    except HemislamError as error:
        return _not_mappable(path, params, str(error))
    with recording:
        census = _Census(recording.sequencer())
        damage, number = list[Finding](), 0
        try:
            for number, entry in enumerate(recording.entries(), 1):
                census.add(entry)
                if number % 100 == 0:
                    progress(recording.fraction_at(entry.log_ns))
            if recording.lacks_messages(number):
                damage = [Finding(DAMAGE, "needs you", f"{LACKS}; copy {path} again, or use what is there")]
        except HemislamError as error:
            damage = [Finding(DAMAGE, "needs you", str(error))]
        if census.lost:
            count = len(census.lost)  # without an index, only one of each topic is known of a damaged chunk
            text = f"{census.lost[0]}; messages lost: at least {count}; all others are used. Copy {path} again"
            damage.insert(0, Finding(DAMAGE, "needs you", text))
        census.take(last=True)
        progress(1.0)
        scans, imu = census.times()
        scans[:, 0], imu[:, 0] = recording.log_times(scans[:, 0]), recording.log_times(imu[:, 0])
        counts = census.sequencer.counts
        pauses = _pauses(scans, imu)
        known = ("clocks", DAMAGE) if damage else ("clocks",)
        of_imu = (
            _rate("IMU rate", imu[:, 1], 90.0),
            clock_finding(scans, imu, params.recording.imu_time_offset),
            _imu_gaps(counts, params.imu.max_gap, len(pauses)),
            _imu_time(counts),
            _imu_values(counts, len(imu), params.imu),
        )
        return (
            *damage,
            _topics(recording.topics, recording.duration_s),
            *(finding for finding in recording.findings if finding.subject not in known),
            _rate("scan rate", scans[:, 1], 4.0),
            *(of_imu if recording.imu_topic else ()),
            *_scan_time(scans, census.copies),
            *_of_pauses(pauses),
            _pairing(counts.paired, census.reasons),
            _returns(census, len(scans)),
        )


@dataclass(slots=True)
class _Census:
    """What a full pass counts; only the times of each message are kept.

    Attributes:
        scan_times: log time, start and end of each scan, ns. imu_times: log time and stamp of each sample.
        places: points that the messages have room for. nan, returns: how many of these are NaN, or returns.
        refused: points that cannot be returns. copies: scans that came twice. reasons: why scans are left out.
        lost: where the file is damaged, for each message that cannot be read.
    """

    sequencer: Sequencer
    scan_times: list[tuple[int, int, int]] = field(default_factory=list)
    imu_times: list[tuple[int, int]] = field(default_factory=list)
    places: int = 0
    nan: int = 0
    refused: int = 0
    returns: int = 0
    copies: int = 0
    last: Scan | None = None
    last_sample: tuple[int, Vector, Vector] | None = None
    reasons: Counter[str] = field(default_factory=Counter)
    lost: list[str] = field(default_factory=list)

    def add(self, entry: Entry) -> None:
        if isinstance(entry, ImuEntry):
            sample = (entry.stamp_ns, entry.gyro, entry.accel)
            if sample != self.last_sample:  # a repeated sample says nothing about the rate
                self.imu_times.append((entry.log_ns, entry.stamp_ns))
            self.last_sample = sample
            self.sequencer.add_imu(entry.stamp_ns, entry.gyro, entry.accel)
        elif isinstance(entry, ScanEntry):
            if isinstance(entry.scan, Scan):
                if is_copy(entry.scan, self.last):
                    self.copies += 1
                    return
                self.last = entry.scan
                self.scan_times.append((entry.log_ns, entry.scan.stamp_ns, entry.scan.end_ns))
                self.returns += len(entry.scan)
                self.refused += entry.scan.refused
            if entry.cloud is not None:
                self.places += len(entry.cloud)
                self.nan += int(np.isnan(entry.cloud.xyz()).any(axis=1).sum())
            self.sequencer.add_scan(entry.scan)
        elif isinstance(entry, LostEntry):
            self.lost.append(entry.said)
            if entry.scan is not None:
                self.sequencer.add_scan(entry.scan)
        self.take(last=False)

    def take(self, *, last: bool) -> None:
        """Count the results of pairing."""
        paired = self.sequencer.finish() if last else self.sequencer.ready()
        self.reasons.update(entry.reason for entry in paired if isinstance(entry, DroppedScan))

    def times(self) -> tuple[I64, I64]:
        """(n, 3) of scans and (k, 2) of IMU samples."""
        return np.array(self.scan_times, np.int64).reshape(-1, 3), np.array(self.imu_times, np.int64).reshape(-1, 2)


def _not_mappable(path: Path, params: Params, why: str) -> tuple[Finding, ...]:
    """The findings of a recording that cannot be mapped: why, its topics, and how its clouds are read."""
    with Source(path) as source:
        findings = [Finding("use", "needs you", why), _topics(source.topics, (source.end_ns - source.start_ns) / 1e9)]
        with suppress(HemislamError):
            lidar, lidar_finding = choose_topic(source, "lidar", params.recording.lidar_topic)
            probes, probe_findings = probe_clouds(source, lidar)
            _, cloud_findings = settle_cloud(probes, params.recording, lidar.name, CLOUD_TYPES[lidar.type])
            findings += [lidar_finding, *probe_findings, *cloud_findings]
        return (*source.findings, *findings)


def _topics(topics: tuple[Topic, ...], duration_s: float) -> Finding:
    listed = ", ".join(f"{topic.name} ({topic.type.split('/')[-1]}, {topic.messages})" for topic in topics)
    return Finding("topics", "fine", f"{duration_s:.1f} s; {listed}")


def _rate(subject: str, stamps: I64, least: float) -> Finding:
    steps = np.diff(stamps)
    steps = steps[steps >= 0]
    if not steps.any():
        return Finding(subject, "needs you", "too few messages to determine it")
    usual = float(np.median(steps))
    mean = float(np.mean(steps[steps <= max(usual, PAUSE_S * 1e9)]))
    batches = int(np.count_nonzero(steps > 2.0 * mean))
    if usual < 0.5 * mean and len(steps) < MOST_IN_BATCH * batches:
        text = (
            f"{1e9 / mean:.2f} Hz on average, but stamped in batches of {len(steps) / batches:.0f}: the driver has to "
            "stamp each sample when it is measured, not when it is read"
        )
        return Finding(subject, "needs you", text)
    steps = steps[steps > 0]
    rate = 1e9 / float(np.median(steps))
    spread = (np.percentile(steps, 99) - np.percentile(steps, 1)) / 1e6
    text = f"{rate:.2f} Hz, {len(stamps)} messages; 98 % of the intervals within {spread:.2f} ms"
    if rate < least:
        text += f"; this is too slow: handheld mapping needs {least:g} Hz or more"
    return Finding(subject, "fine" if rate >= least else "needs you", text)


def _pauses(scans: I64, imu: I64) -> F64:
    """(m, 2) s, start (after the first scan) and duration of each pause, without scans and IMU samples."""
    if not len(scans):
        return np.empty((0, 2))
    begin, end = scans[:, 1].min(), scans[:, 2].max()
    samples = imu[(imu[:, 1] > begin) & (imu[:, 1] < end), 1]
    times = (np.sort(np.concatenate([scans[:, 1:].ravel(), samples])) - begin) * 1e-9
    lasts = np.diff(times)
    return np.asarray(np.column_stack([times[:-1], lasts])[lasts > PAUSE_S])


def _of_pauses(pauses: F64) -> list[Finding]:
    if not len(pauses):
        return []
    begin, longest = pauses[pauses[:, 1].argmax()]
    text = (
        f"{len(pauses)} without scans and IMU samples, the longest {longest:.1f} s, at {begin:.1f} s: the recorder was "
        "paused or too slow. The map begins anew there, and only loops tie its parts: go on where you stopped, facing "
        "the same way"
    )
    return [Finding("pauses", "needs you", text)]


def _imu_gaps(counts: Counts, limit_s: float, pauses: int) -> Finding:
    if counts.imu_gaps <= pauses:
        pauses_apart = " apart from the pauses" if pauses else ""
        return Finding("IMU gaps", "fine", f"none longer than {limit_s:g} s{pauses_apart}")
    longest = counts.longest_imu_gap_s
    text = (
        f"{counts.imu_gaps} longer than {limit_s:g} s, the longest {longest:.3f} s; "
        "in these gaps, only the scans show the motion: check the IMU's cable and driver"
    )
    return Finding("IMU gaps", "needs you", text)


def _imu_time(counts: Counts) -> Finding:
    wrong = _listed(
        (counts.imu_back_steps, "steps back"),
        (counts.imu_far_off, "stamps far from those around them"),
        (counts.imu_duplicates, "repeated stamps"),
        (counts.imu_invalid, "NaN samples"),
    )
    if counts.imu_behind > MOST_BEHIND:
        text = (
            f"{wrong}; the {counts.imu_behind} samples until the stamps have caught up are left out, and what was "
            "walked meanwhile is missing: if the clock was set back, map the parts before and after it by --start and "
            "--duration"
        )
        return Finding("IMU time", "needs you", text)
    text = f"{wrong}; those samples are left out" if wrong else "the stamps only ever rise"
    return Finding("IMU time", "corrected" if wrong else "fine", text)


def _imu_values(counts: Counts, samples: int, limits: ImuParams) -> Finding:
    bounds = f"{limits.max_acceleration:g} m/s² or {limits.max_rate:g} rad/s"
    left_out = counts.imu_out_of_range + counts.imu_spikes + counts.imu_weightless
    wrong = _listed(
        (counts.imu_out_of_range, f"beyond {bounds}"),
        (counts.imu_spikes, "single spikes"),
        (counts.imu_weightless, "without acceleration, not even gravity's"),
    )
    if counts.imu_stuck:
        text = f"an axis reads the same number for {STUCK_SAMPLES} samples or more; check the IMU's driver"
        return Finding("IMU values", "needs you", text)
    if not wrong:
        return Finding("IMU values", "fine", f"none beyond {bounds}, no spikes")
    verdict: FindingVerdict = "corrected" if left_out < 0.01 * samples else "needs you"
    return Finding("IMU values", verdict, f"of {samples} samples {wrong}; those are left out")


def _scan_time(scans: I64, copies: int) -> list[Finding]:
    steps = np.diff(scans[:, 1])
    forward = steps[steps > 0]
    if not len(forward):
        return []
    usual = float(np.median(forward))
    missing = int(np.rint(forward[forward > 1.5 * usual] / usual - 1).sum())
    wrong = _listed((int((steps < 0).sum()), "steps back"), (missing, "missing"), (copies, "came twice"))
    longest = float(forward.max()) / 1e9
    text = f"{wrong}; the longest interval is {longest:.3f} s" if wrong else "no scan missing or repeated"
    return [Finding("scan time", "corrected" if wrong else "fine", text)]


def _pairing(paired: int, reasons: Counter[str]) -> Finding:
    dropped = reasons.total()
    if not dropped:
        return Finding("pairing", "fine", f"all {paired} scans can be used")
    why = ", ".join(f"{count} because {reason}" for reason, count in reasons.most_common(3))
    verdict: FindingVerdict = "corrected" if dropped < 0.1 * (dropped + paired) else "needs you"
    return Finding("pairing", verdict, f"{paired} scans can be used, {dropped} are left out: {why}")


def _returns(census: _Census, scans: int) -> Finding:
    if not census.places:
        return Finding("returns", "needs you", "the clouds hold no points")
    nan, returns = census.nan / census.places, census.returns / census.places
    each = census.returns // max(scans, 1)
    text = f"{each} a scan; of the places in the clouds {nan:.1%} are NaN, {returns:.1%} are returns"
    if census.refused:
        text += f"; {census.refused / census.places:.1%} are beyond 10 km or without a time and are left out"
    usual: FindingVerdict = "corrected" if census.refused else "fine"
    return Finding("returns", usual if returns > 0.05 and census.refused < 0.3 * census.places else "needs you", text)


def _listed(*counted: tuple[int, str]) -> str:
    return ", ".join(f"{count} {what}" for count, what in counted if count)
