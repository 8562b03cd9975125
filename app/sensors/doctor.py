"""The recording doctor: what a recording holds, what was corrected, and what only the user can settle.

Opening a recording already probes its first messages (`Recording.findings`); `examine` adds what
only a full pass can tell. Both speak in `Finding`s.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from app.sensors.clocks import TOLERANCE_S, clock_finding, clock_offset_s, offset_spread_s
from app.sensors.findings import Finding as Finding
from app.sensors.findings import Verdict
from app.sensors.recording import ImuEntry, Recording, ScanEntry, open_recording
from app.sensors.sequencer import Sequencer
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import I64, DroppedScan, Scan

DAMAGE = "file"
"""Subject of what is wrong with the file itself."""


def examine(
    path: Path, params: Params, progress: Callable[[float], None] = lambda fraction: None
) -> tuple[Finding, ...]:
    """Read all of a recording and tell what there is to know before mapping it.

    Args:
        progress: told the fraction read, 0-1, now and then.

    Raises:
        HemislamError: the recording cannot be opened. Damage further on is a finding.
    """
    with open_recording(path, params) as recording:
        census = _Census(Sequencer(params.imu.max_gap))
        damage = None
        try:
            for number, entry in enumerate(recording.entries()):
                census.add(entry)
                if number % 100 == 0:
                    progress(recording.fraction_at(entry.log_ns))
        except HemislamError as error:
            damage = Finding(DAMAGE, "needs you", str(error))
        census.finish()
        progress(1.0)
        known = ("clocks", DAMAGE) if damage else ("clocks",)
        probed = [finding for finding in recording.findings if finding.subject not in known]
        found = [
            _topics(recording),
            *probed,
            *_rates(census),
            census.clocks(params),
            *_imu_continuity(census, params),
            *_scan_continuity(census),
            _returns(census),
        ]
        return (*([damage] if damage else []), *found)


@dataclass(slots=True)
class _Census:
    """What a full pass counts; of each message only its times are kept."""

    sequencer: Sequencer
    scan_times: list[tuple[int, int, int]] = field(default_factory=list)
    """Log time, begin and end of each decoded scan, ns."""
    imu_times: list[tuple[int, int]] = field(default_factory=list)
    """Log time and stamp of each IMU sample, ns."""
    places: int = 0
    nan: int = 0
    returns: int = 0
    paired: int = 0
    reasons: Counter[str] = field(default_factory=Counter)

    def add(self, entry: ScanEntry | ImuEntry) -> None:
        if isinstance(entry, ImuEntry):
            self.imu_times.append((entry.log_ns, entry.stamp_ns))
            self.sequencer.add_imu(entry.stamp_ns, entry.gyro, entry.accel)
        else:
            if entry.cloud is not None:
                self.places += len(entry.cloud)
                self.nan += int(np.isnan(entry.cloud.xyz()).any(axis=1).sum())
            if isinstance(entry.scan, Scan):
                self.scan_times.append((entry.log_ns, entry.scan.stamp_ns, entry.scan.end_ns))
                self.returns += len(entry.scan)
            self.sequencer.add_scan(entry.scan)
        self._take(last=False)

    def finish(self) -> None:
        self._take(last=True)

    def _take(self, *, last: bool) -> None:
        for paired in self.sequencer.finish() if last else self.sequencer.ready():
            if isinstance(paired, DroppedScan):
                self.reasons[paired.reason] += 1
            else:
                self.paired += 1

    def clocks(self, params: Params) -> Finding:
        scans, imu = _columns(self.scan_times, 3), _columns(self.imu_times, 2)
        if not len(scans) or not len(imu):
            return Finding("clocks", "needs you", "there are no scans and IMU samples to compare")
        copied = np.all(np.abs(scans[:, 0] - scans[:, 2]) < 2_000) and np.all(np.abs(imu[:, 0] - imu[:, 1]) < 2_000)
        times = scans[:, 0], scans[:, 2], imu[:, 0], imu[:, 1]
        spread = offset_spread_s(*times)
        if spread > TOLERANCE_S:
            text = (
                f"the offset between the LiDAR's and the IMU's stamps changes by {spread:.3f} s on the way: a clock "
                "was set or drifts; use a part before that (--start, --duration), and one clock for both next time"
            )
            return Finding("clocks", "needs you", text)
        return clock_finding(clock_offset_s(*times), params.recording.imu_time_offset, not copied)


def _topics(recording: Recording) -> Finding:
    listed = ", ".join(f"{topic.name} ({topic.type.split('/')[-1]}, {topic.messages})" for topic in recording.topics)
    return Finding("topics", "fine", f"{recording.duration_s:.1f} s; {listed}")


def _rates(census: _Census) -> list[Finding]:
    findings = []
    for name, stamps, least in (
        ("scan rate", _columns(census.scan_times, 3)[:, 1], 4.0),
        ("IMU rate", _columns(census.imu_times, 2)[:, 1], 90.0),
    ):
        steps = np.diff(stamps)
        steps = steps[steps > 0]
        if not len(steps):
            findings.append(Finding(name, "needs you", "too few messages to tell"))
            continue
        rate = 1e9 / float(np.median(steps))
        spread = (np.percentile(steps, 99) - np.percentile(steps, 1)) / 1e6
        text = f"{rate:.2f} Hz, {len(stamps)} messages; 98 % of the intervals within {spread:.2f} ms"
        if rate < least:
            text += f"; that is little: {least:g} Hz or more is wanted for mapping by hand"
        findings.append(Finding(name, "fine" if rate >= least else "needs you", text))
    return findings


def _imu_continuity(census: _Census, params: Params) -> list[Finding]:
    counts = census.sequencer.counts
    limit = params.imu.max_gap
    if counts.imu_gaps:
        longest = counts.longest_imu_gap_s
        text = f"{counts.imu_gaps} longer than {limit:g} s, the longest {longest:.3f} s; scans inside are left out"
        # A short gap can be bridged for the scans inside as well; over a long one the pose would be a guess.
        option = f"--set imu.max_gap={longest + 0.01:.2f}" if longest < 0.3 else ""
        gaps = Finding("IMU gaps", "needs you", text, option)
    else:
        gaps = Finding("IMU gaps", "fine", f"none longer than {limit:g} s")
    wrong = [
        f"{count} {what}"
        for count, what in (
            (counts.imu_back_steps, "steps back"),
            (counts.imu_duplicates, "repeated stamps"),
            (counts.imu_invalid, "NaN samples"),
        )
        if count
    ]
    text = f"{', '.join(wrong)}; those samples are left out" if wrong else "the stamps only ever rise"
    return [gaps, Finding("IMU time", "corrected" if wrong else "fine", text)]


def _scan_continuity(census: _Census) -> list[Finding]:
    times = _columns(census.scan_times, 3)
    steps = np.diff(times[:, 1])
    forward = steps[steps > 0]
    findings = []
    if len(forward):
        usual = float(np.median(forward))
        back, missing = int((steps < 0).sum()), int(np.rint(forward[forward > 1.5 * usual] / usual - 1).sum())
        wrong = [f"{n} {what}" for n, what in ((back, "steps back"), (missing, "missing")) if n]
        longest = float(forward.max()) / 1e9
        text = (
            f"{', '.join(wrong)}; the longest interval is {longest:.3f} s" if wrong else "no scan missing or repeated"
        )
        findings.append(Finding("scan time", "corrected" if wrong else "fine", text))
    dropped = census.reasons.total()
    if not dropped:
        findings.append(Finding("pairing", "fine", f"all {census.paired} scans are covered by IMU samples"))
    else:
        why = ", ".join(f"{count} because {reason}" for reason, count in census.reasons.most_common(3))
        verdict: Verdict = "corrected" if dropped < 0.1 * (dropped + census.paired) else "needs you"
        text = f"{census.paired} scans can be used, {dropped} are left out: {why}"
        findings.append(Finding("pairing", verdict, text))
    return findings


def _returns(census: _Census) -> Finding:
    if not census.places:
        return Finding("returns", "needs you", "the clouds hold no points")
    nan, returns = census.nan / census.places, census.returns / census.places
    scans = max(len(census.scan_times), 1)
    text = f"{census.returns // scans} a scan; of the places in the clouds {nan:.1%} are NaN, {returns:.1%} are returns"
    return Finding("returns", "fine" if returns > 0.05 else "needs you", text)


def _columns(rows: list[tuple[int, ...]] | list[tuple[int, int]] | list[tuple[int, int, int]], width: int) -> I64:
    return np.array(rows, np.int64).reshape(-1, width)
