"""A recording on disk as a stream of measurements, read in constant memory."""

from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from app.sensors.clocks import clock_finding, is_copy, overlap_finding
from app.sensors.cloud_types import CLOUD_TYPES, CloudError, CloudMessage, Probe
from app.sensors.distances import distance_findings
from app.sensors.findings import Finding
from app.sensors.imu_units import AS_RECORDED, ImuProbe, gravity_findings, settle_imu
from app.sensors.layout import settle_cloud
from app.sensors.leaps import (
    AROUND_NS,
    Leaps,
    Times,
    added_ns,
    all_added_ns,
    find_leaps,
    leap_sentences,
    same_motion,
    same_view,
)
from app.sensors.navsat import fix_of, navsat_topic
from app.sensors.pointcloud import decode, read_scan
from app.sensors.presets import preset_for
from app.sensors.probe import NO_IMU, choose_topic, probe_clouds, probe_imu, unfit_imu, usable_types
from app.sensors.rings import line_findings
from app.sensors.ros import Lost, imu_values, stamp_ns
from app.sensors.sequencer import Sequencer
from app.sensors.source import LOG_MARGIN_NS, Mark, Source
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import I64, DroppedScan, Measurement, Samples, Scan, Vector

SILENCE_S = 0.5
"""A gap without scans at the end, while the IMU continues, is reported if it is longer than this."""
LOST = "its part of the file is damaged"
LACKS = "the file is damaged: its index tells of more messages than there are"
IMU_BEFORE_NS = 200_000_000
"""IMU samples given from before `start_s`."""


@dataclass(frozen=True, slots=True)
class ScanEntry:
    """A point cloud message: its log time, its content (None if malformed), and the scan decoded from it."""

    log_ns: int
    cloud: CloudMessage | None
    scan: Scan | DroppedScan


@dataclass(frozen=True, slots=True)
class ImuEntry:
    """An IMU message: its log time, its stamp with all corrections, rad/s and m/s^2 in the IMU frame."""

    log_ns: int
    stamp_ns: int
    gyro: Vector
    accel: Vector


@dataclass(frozen=True, slots=True)
class LostEntry:
    """A message that cannot be read. scan: in its place, if it was a point cloud. said: where, and why."""

    log_ns: int
    scan: DroppedScan | None
    said: str


@dataclass(frozen=True, slots=True)
class OtherEntry:
    """A message of a sensor other than LiDAR and IMU."""

    log_ns: int
    samples: Samples


Entry = ScanEntry | ImuEntry | OtherEntry | LostEntry


class Recording(AbstractContextManager["Recording"]):
    """An open recording, made by `open_recording`. A context manager.

    Attributes:
        path, params: as given. topics: of the file. lidar_topic, imu_topic, gnss_topic: the ones used; ""
            if there is none.
        scan_count: messages on the LiDAR topic. findings: from the first messages.
        preset: of the scanner that the clouds look like; "" if unknown.
        start_ns: first point of the first usable scan. duration_s: from there to the last message.
    """

    def __init__(self, source: Source, params: Params) -> None:
        self._source = source
        self.params = params
        self.path = source.path
        self.topics = source.topics
        chosen = params.recording
        lidar, lidar_finding = choose_topic(source, "lidar", chosen.lidar_topic)
        self.lidar_topic, self.imu_topic, topic_finding = lidar.name, "", NO_IMU
        if chosen.imu_topic or any(topic.type in usable_types("imu") and topic.messages for topic in source.topics):
            imu_topic, topic_finding = choose_topic(source, "imu", chosen.imu_topic)
            self.imu_topic = imu_topic.name
        imu: ImuProbe | None = None
        imu_findings: list[Finding] = []
        self._imu_stamped = True
        if self.imu_topic:
            imu, self._imu_stamped, imu_findings = probe_imu(source, self.imu_topic, chosen.imu_time_offset)
            if unfit := unfit_imu(imu, chosen.acceleration_unit):
                self.imu_topic, topic_finding, imu, imu_findings = "", unfit, None, []
        self.scan_count = lidar.messages
        self.gnss_topic = navsat_topic(source)
        self._topics = tuple(filter(None, (self.lidar_topic, self.imu_topic, self.gnss_topic)))

        probes, probe_findings = probe_clouds(source, lidar)
        self._layout, cloud_findings = settle_cloud(probes, chosen, self.lidar_topic, CLOUD_TYPES[lidar.type])
        probes, scans = self._decode_probes(probes, cloud_findings)
        self._imu_units, self._leaps = AS_RECORDED, Leaps()
        self._log_after_stamp_ns = 0  # known below; places of lost messages do not matter to leaps
        self._leaps = self._find_leaps()
        source.first_scan_ns = probes[0].log_ns
        scan_times = np.array([(p.log_ns, s.stamp_ns, s.end_ns) for p, s in zip(probes, scans, strict=True)], np.int64)
        scan_times[:, 1:] += all_added_ns(self._leaps.lidar, scan_times[:, 0])[:, None]
        scan_times[:, 0] = self.log_times(scan_times[:, 0])
        log_start_ns, self.start_ns, first_end_ns = scan_times[0].tolist()
        self._log_after_stamp_ns = log_start_ns - self.start_ns
        self._leaps_told = leap_sentences(self._leaps, log_start_ns)
        self.duration_s = (max(source.end_ns - log_start_ns, 0) + first_end_ns - self.start_ns) / 1e9
        once = [True, *(not is_copy(scan, before) for before, scan in pairwise(scans))]
        self._clocks = Finding("clocks", "fine", "there is one only")
        self.preset = preset_for(lidar.type, probes[0])
        if imu is not None:
            imu_findings += self._settle_imu(imu, scan_times)
        self.findings: tuple[Finding, ...] = (
            *source.findings,
            lidar_finding,
            topic_finding,
            *(Finding("clock leap", "corrected", text) for text in self._leaps_told.values()),
            *overlap_finding(scan_times[once], self.lidar_topic),
            *probe_findings,
            *cloud_findings,
            *line_findings(scans, self.has_lines, params.sensor),
            *distance_findings(scans, params.sensor),
            *imu_findings,
        )

    def _find_leaps(self) -> Leaps:
        """Where clocks leap, by messages that are read without bridging any."""

        def times(topic: str) -> Times:
            return lambda first_ns, stop_ns: (
                (entry.log_ns, entry.scan.stamp_ns if isinstance(entry, ScanEntry) else entry.stamp_ns)
                for entry in self._read((topic,), first_ns, stop_ns, None)
                if isinstance(entry, ImuEntry) or (isinstance(entry, ScanEntry) and isinstance(entry.scan, Scan))
            )

        def continues(before_ns: int, after_ns: int) -> bool:
            entries = list(self._read(topics, before_ns - AROUND_NS, after_ns + AROUND_NS, None))
            middle_ns = (before_ns + after_ns) // 2
            parts = [e for e in entries if e.log_ns < middle_ns], [e for e in entries if e.log_ns >= middle_ns]
            values = [[(*e.gyro, *e.accel) for e in part if isinstance(e, ImuEntry)] for part in parts]
            scans = [[e.scan for e in part if isinstance(e, ScanEntry) and isinstance(e.scan, Scan)] for part in parts]
            return same_motion(*map(np.array, values)) and same_view(*scans)

        topics = (self.lidar_topic, self.imu_topic)
        source = self._source
        of_imu = times(self.imu_topic) if self.imu_topic else None
        scans_ns = self.scan_count * self._layout.timing.period_ns
        return find_leaps(times(self.lidar_topic), of_imu, source.start_ns, source.end_ns, scans_ns, continues)

    def _settle_imu(self, imu: ImuProbe, scan_times: I64) -> list[Finding]:
        """Settle how IMU samples are read, from the first ones; `scan_times` as for `clock_finding`."""
        chosen = self.params.recording
        bridged = imu.stamps_ns + all_added_ns(self._leaps.imu, imu.log_ns)
        imu = replace(imu, log_ns=self.log_times(imu.log_ns), stamps_ns=bridged)
        self._imu_units, imu_findings = settle_imu(imu, chosen)
        self._clocks = clock_finding(scan_times, np.column_stack([imu.log_ns, imu.stamps_ns]), chosen.imu_time_offset)
        gravity = gravity_findings(imu, self._imu_units, self.params, self.preset)
        return [*imu_findings, self._clocks, *gravity]

    @property
    def has_lines(self) -> bool:
        """Whether `Scan.ring` names the LiDAR's scan lines, and not steps of elevation."""
        return self._layout.rings.of_lines

    def sequencer(self) -> Sequencer:
        """A new sequencer, set up for the sensors of this recording."""
        return Sequencer(self.params.imu, without_imu=not self.imu_topic)

    def measurements(
        self, start_s: float = 0.0, duration_s: float | None = None, *, after: "Place | None" = None
    ) -> "Measurements":
        """Scans that begin within [start_s, start_s + duration_s) after `start_ns`, with their IMU samples.

        Args:
            after: the place of an earlier reading of the same part; this reading continues exactly from there.
        """
        return Measurements(self, start_s, duration_s, after)

    def entries(
        self, first_ns: int | None = None, stop_ns: int | None = None, after: Mark | None = None
    ) -> Iterator[Entry]:
        """Decoded scans and samples in the order of the file, from some time before `first` to some time after `stop`.

        Args:
            after: only entries after this message.

        Raises:
            HemislamError: the file cannot be read beyond this place.
        """
        offset, leaps = self._log_after_stamp_ns, self._leaps
        log_first = None if first_ns is None else leaps.recorded_ns(first_ns + offset - LOG_MARGIN_NS)
        log_stop = None if stop_ns is None else leaps.recorded_ns(stop_ns + offset + LOG_MARGIN_NS)
        return self._read(self._topics, log_first, log_stop, after)

    def _read(
        self, topics: tuple[str, ...], log_first: int | None, log_stop: int | None, after: Mark | None
    ) -> Iterator[Entry]:
        """Entries of some topics that were logged within [log_first, log_stop)."""
        offset_ns = round(self.params.recording.imu_time_offset * 1e9)
        for topic, log_ns, message in self._source.messages(topics, log_first, log_stop, after):
            if isinstance(message, Lost):
                stamp = log_ns + added_ns(self._leaps.log, log_ns) - self._log_after_stamp_ns
                at_s = (log_ns - self._source.start_ns) / 1e9
                # in whole seconds, so that messages of one place have one sentence
                said = f"the file is damaged {at_s:.0f} s after its start: what was there is lost ({message.why})"
                yield LostEntry(log_ns, DroppedScan(stamp, LOST) if topic == self.lidar_topic else None, said)
            elif topic == self.lidar_topic:
                cloud, scan = read_scan(message, log_ns, self._layout)
                if added := added_ns(self._leaps.lidar, log_ns):
                    scan = replace(scan, stamp_ns=scan.stamp_ns + added)
                yield ScanEntry(log_ns, cloud, scan)
            elif topic == self.gnss_topic:
                yield OtherEntry(log_ns, fix_of(message))
            else:
                stamp = stamp_ns(message.header.stamp) if self._imu_stamped else log_ns
                added = offset_ns + added_ns(self._leaps.imu, log_ns)
                yield ImuEntry(log_ns, stamp + added, *self._imu_units.apply(*imu_values(message)))

    def log_times(self, recorded_ns: I64) -> I64:
        """(n,) log times in the file, with the leaps of the recorder's clock bridged."""
        return recorded_ns + all_added_ns(self._leaps.log, recorded_ns)

    def lacks_messages(self, read: int) -> bool:
        """Whether `read` messages, from a complete reading, are fewer than the file's index states."""
        return self._source.lacks(self._topics, read)

    def leaps_told(self, after_ns: int, until_ns: int) -> list[str]:
        """A sentence for each leap of a clock between two log times in the file."""
        return [text for at_ns, text in self._leaps_told.items() if after_ns < at_ns <= until_ns]

    def fraction_at(self, log_ns: int) -> float:
        """Share of the recording, 0-1, that was logged before this time."""
        length = self._source.end_ns - self._source.start_ns
        return min(max((log_ns - self._source.start_ns) / length, 0.0), 1.0) if length > 0 else 1.0

    def _decode_probes(self, probes: list[Probe], findings: list[Finding]) -> tuple[list[Probe], list[Scan]]:
        """The probes that make scans, and the scans. Raises HemislamError if none does (a wrong time unit, say)."""
        decoded, reason = [], ""
        for probe in probes:
            try:
                decoded.append((probe, decode(probe.cloud, self._layout)))
            except CloudError as error:
                reason = str(error)
        if not decoded:
            advice = next((f.spoken.rstrip(".") for f in findings if f.verdict == "needs you"), "")
            raise HemislamError(
                f"The clouds on {self.lidar_topic} in {self.path} make no scans: {reason}"
                f"; {advice or 'check the recording.time_* settings'}."
            )
        return [probe for probe, _ in decoded], [scan for _, scan in decoded]

    def nothing_usable(self, reasons: Counter[str], start_s: float, duration_s: float | None) -> str:
        """Why no measurement could be read, in a sentence. reasons: of the scans that were left out."""
        if not reasons:
            until = "" if duration_s is None else f" and before {start_s + duration_s:g} s"
            return f"{self.path} has no scan after {start_s:g} s{until}; it lasts {self.duration_s:.1f} s."
        reason, count = reasons.most_common(1)[0]
        hint = self._clocks.spoken if self._clocks.option else "run `hemislam info` on it"
        return f"None of the {reasons.total()} scans of {self.path} can be used ({count} times: {reason}); {hint}."

    def close(self) -> None:
        self._source.close()

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass(frozen=True, slots=True)
class Place:
    """The place of a reading between two measurements: the last message read, and the state of pairing."""

    message: Mark | None
    sequencer: Sequencer
    reasons: Counter[str]
    ended: bool


class Measurements(Iterator[Measurement | DroppedScan]):
    """A reading of a recording, made by `Recording.measurements`.

    Iterating raises HemislamError at the end if no scan could be used, or where the file cannot be read any further.
    """

    def __init__(self, recording: Recording, start_s: float, duration_s: float | None, after: Place | None) -> None:
        self._recording = recording
        self._part = (start_s, duration_s)
        self._message = after.message if after else None
        self._sequencer = after.sequencer.copy() if after else recording.sequencer()
        self._reasons = after.reasons.copy() if after else Counter[str]()
        self._ended = after is not None and after.ended
        self._entries = self._read()

    def __next__(self) -> Measurement | DroppedScan:
        entry = next(self._entries)
        if isinstance(entry, DroppedScan):
            self._reasons[entry.reason] += 1
        return entry

    def place(self) -> Place:
        """The present place; cheap."""
        return Place(self._message, self._sequencer.copy(), self._reasons.copy(), self._ended)

    def _read(self) -> Iterator[Measurement | DroppedScan]:
        start_s, duration_s = self._part
        recording, sequencer = self._recording, self._sequencer
        first_ns = recording.start_ns + round(start_s * 1e9)
        stop_ns = None if duration_s is None else first_ns + round(duration_s * 1e9)
        damage = None
        if not self._ended:
            yield from sequencer.ready()
            try:
                for entry in recording.entries(first_ns if start_s > 0 else None, stop_ns, self._message):
                    for text in recording.leaps_told(self._message.log_ns, entry.log_ns) if self._message else ():
                        sequencer.notice(text)
                    self._message = Mark.after(self._message, entry.log_ns)
                    if isinstance(entry, LostEntry):
                        sequencer.notice(entry.said)
                    if isinstance(entry, ScanEntry | LostEntry):
                        scan = entry.scan
                        if scan and scan.stamp_ns >= first_ns and (stop_ns is None or scan.stamp_ns < stop_ns):
                            sequencer.add_scan(scan)
                    elif isinstance(entry, OtherEntry):
                        sequencer.add(entry.samples)
                    elif start_s <= 0 or entry.stamp_ns >= first_ns - IMU_BEFORE_NS:
                        sequencer.add_imu(entry.stamp_ns, entry.gyro, entry.accel)
                    yield from sequencer.ready()
            except HemislamError as error:
                damage = error
        self._ended = damage is None
        yield from sequencer.finish()
        if stop_ns is None and damage is None and sequencer.silent_s > SILENCE_S:
            yield DroppedScan(first_ns, "the LiDAR falls silent before the recording ends")
        if self._ended and self._part == (0.0, None) and self._message and recording.lacks_messages(self._message.read):
            yield DroppedScan(first_ns, LACKS)
        if damage is not None:
            raise damage
        if not sequencer.counts.paired:
            raise HemislamError(recording.nothing_usable(self._reasons, start_s, duration_s))


def open_recording(path: Path, params: Params) -> Recording:
    """Open a recording and examine its first messages.

    Raises:
        HemislamError: the file cannot be read, has no LiDAR topic, or has nothing usable on its topics.
    """
    source = Source(path)
    try:
        return Recording(source, params)
    except BaseException:
        source.close()
        raise
