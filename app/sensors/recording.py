"""A recording on disk as a stream of measurements: open, look, read. Constant memory throughout."""

import hashlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from app.sensors.clocks import clock_finding, clock_offset_s
from app.sensors.findings import Finding
from app.sensors.layout import ImuProbe, Probe, gravity_findings, settle_cloud, settle_imu
from app.sensors.pointcloud import CloudError, CloudMessage, decode, stamp_ns, valid_points
from app.sensors.sequencer import Sequencer
from app.sensors.source import SUFFIXES, Source
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement, Scan

POINTCLOUD = "sensor_msgs/msg/PointCloud2"
IMU = "sensor_msgs/msg/Imu"

PROBED_CLOUDS = 20
PROBED_IMU_NS = 2_000_000_000
LOG_MARGIN_NS = 2_000_000_000
"""How much later or earlier than usual a message may have been logged and still be found by time."""
IMU_BEFORE_NS = 200_000_000
"""IMU samples given from before `start_s`."""


class Recording:
    """An open recording, made by `open_recording`. A context manager.

    Attributes:
        path: as given. topics: all there are. lidar_topic, imu_topic: the ones used.
        scan_count: messages on the LiDAR topic. findings: of the first messages.
        start_ns: first point of the first usable scan. duration_s: from there to the last message.
    """

    def __init__(self, source: Source, params: Params) -> None:
        self._source = source
        self._params = params
        self.path = source.path
        self.topics = source.topics
        self.lidar_topic, lidar_finding = self._choose(POINTCLOUD, params.recording.lidar_topic, "lidar")
        self.imu_topic, imu_finding = self._choose(IMU, params.recording.imu_topic, "imu")
        self.scan_count = sum(topic.messages for topic in source.topics if topic.name == self.lidar_topic)
        self._lidar_stamped = self._imu_stamped = True

        probes, unusable = self._probe_clouds()
        self._layout, cloud_findings = settle_cloud(probes, params.recording, self.lidar_topic)
        imu = self._probe_imu()
        self._accel_scale, imu_findings = settle_imu(imu, params.recording)
        stamped = [
            Finding("stamps", "corrected", f"the headers of {topic} carry no time; the log times are used instead")
            for topic, has in ((self.lidar_topic, self._lidar_stamped), (self.imu_topic, self._imu_stamped))
            if not has
        ]
        scans = [decode(probe.cloud, self._layout) for probe in probes]
        self.start_ns = scans[0].stamp_ns
        self._log_after_stamp_ns = probes[0].log_ns - self.start_ns
        self.duration_s = max((source.end_ns - probes[0].log_ns) / 1e9, 0.0) + (scans[0].end_ns - self.start_ns) / 1e9
        self._clocks = self._compare_clocks(probes, scans, imu)
        self.findings: tuple[Finding, ...] = (
            *source.findings,
            lidar_finding,
            imu_finding,
            *unusable,
            *stamped,
            *cloud_findings,
            *imu_findings,
            self._clocks,
            *gravity_findings(imu, self._accel_scale, params),
        )

    def measurements(
        self, start_s: float = 0.0, duration_s: float | None = None
    ) -> Iterator[Measurement | DroppedScan]:
        """Scans that begin within [start_s, start_s + duration_s) after `start_ns`, with their IMU samples.

        Raises:
            HemislamError: at the end, if no scan could be used; or where the file is damaged, after
                all that comes before the damage.
        """
        first_ns = self.start_ns + round(start_s * 1e9)
        stop_ns = None if duration_s is None else first_ns + round(duration_s * 1e9)
        sequencer = Sequencer(self._params.imu.max_gap)
        reasons: Counter[str] = Counter()
        damage = None
        try:
            for entry in self._entries(first_ns if start_s > 0 else None, stop_ns):
                if isinstance(entry, Scan | DroppedScan):
                    if entry.stamp_ns >= first_ns and (stop_ns is None or entry.stamp_ns < stop_ns):
                        sequencer.add_scan(entry)
                elif start_s <= 0 or entry[0] >= first_ns - IMU_BEFORE_NS:
                    sequencer.add_imu(*entry)
                yield from _counted(sequencer.ready(), reasons)
        except HemislamError as error:
            damage = error
        yield from _counted(sequencer.finish(), reasons)
        if damage is not None:
            raise damage
        if not sequencer.counts.paired:
            raise HemislamError(self._nothing_usable(reasons, start_s, duration_s))

    def _entries(
        self, first_ns: int | None, stop_ns: int | None
    ) -> Iterator[Scan | DroppedScan | tuple[int, list[float], list[float]]]:
        """Decoded scans and IMU samples (stamp ns, rad/s, m/s^2) by log time, around [first, stop)."""
        offset = self._log_after_stamp_ns
        log_first = None if first_ns is None else first_ns + offset - LOG_MARGIN_NS
        log_stop = None if stop_ns is None else stop_ns + offset + LOG_MARGIN_NS
        for topic, log_ns, message in self._source.messages((self.lidar_topic, self.imu_topic), log_first, log_stop):
            yield self._scan(message, log_ns) if topic == self.lidar_topic else self._imu_sample(message, log_ns)

    def _scan(self, message: Any, log_ns: int) -> Scan | DroppedScan:
        try:
            return decode(self._cloud(message, log_ns), self._layout)
        except CloudError as error:
            return DroppedScan(stamp_ns(message.header.stamp) if self._lidar_stamped else log_ns, str(error))

    def _cloud(self, message: Any, log_ns: int) -> CloudMessage:
        cloud = CloudMessage.from_ros(message)
        return cloud if self._lidar_stamped else replace(cloud, stamp_ns=log_ns)

    def _imu_sample(self, message: Any, log_ns: int) -> tuple[int, list[float], list[float]]:
        stamp = stamp_ns(message.header.stamp) if self._imu_stamped else log_ns
        w, a, k = message.angular_velocity, message.linear_acceleration, self._accel_scale
        offset = round(self._params.recording.imu_time_offset * 1e9)
        return stamp + offset, [w.x, w.y, w.z], [k * a.x, k * a.y, k * a.z]

    def _choose(self, kind: str, wanted: str, name: str) -> tuple[str, Finding]:
        """The topic to use of this type, and the finding about it. Raises HemislamError if there is none."""
        what = "point clouds" if kind == POINTCLOUD else "IMU samples"
        listed = ", ".join(f"{topic.name} ({topic.type})" for topic in self._source.topics)
        candidates = [topic for topic in self._source.topics if topic.type == kind and topic.messages]
        others = [topic.name for topic in candidates if topic.name != wanted]
        option = f"--set recording.{name}_topic="
        if wanted:
            chosen = next((topic for topic in candidates if topic.name == wanted), None)
            if chosen is None:
                found = next((topic for topic in self._source.topics if topic.name == wanted), None)
                why = "has no topic" if found is None else ("no messages on" if found.type == kind else f"no {what} on")
                hint = f"choose {' or '.join(others)} by {option}{others[0]}" if others else f"it has {listed}"
                raise HemislamError(f"{self.path} {why} {wanted}; {hint}.")
            return wanted, Finding(f"{name} topic", "fine", f"{wanted}, {chosen.messages} messages, as you set it")
        if not candidates:
            empty = [topic.name for topic in self._source.topics if topic.type == kind]
            why = f"no messages on {empty[0]}" if empty else f"no topic of type {kind}"
            raise HemislamError(f"{self.path} holds no {what}: {why}; it has {listed}.")
        chosen = max(candidates, key=lambda topic: topic.messages)  # the first of equals
        if len(candidates) == 1:
            return chosen.name, Finding(f"{name} topic", "fine", f"{chosen.name}, {chosen.messages} messages")
        rest = ", ".join(topic.name for topic in candidates if topic is not chosen)
        text = f"{chosen.name} has the most messages ({chosen.messages}); there are also {rest}"
        return chosen.name, Finding(f"{name} topic", "needs you", text, f"{option}{chosen.name}")

    def _probe_clouds(self) -> tuple[list[Probe], list[Finding]]:
        """The first clouds that have points. Raises HemislamError if there are not two."""
        probes: list[Probe] = []
        unusable, reason = 0, ""
        for _, log_ns, message in self._source.messages((self.lidar_topic,)):
            try:
                cloud = CloudMessage.from_ros(message)
                has_points = len(valid_points(cloud.xyz())[0]) > 0
            except CloudError as error:
                has_points, reason = False, str(error)
            if has_points:
                probes.append(Probe(log_ns, cloud))
            else:
                unusable += 1
            if len(probes) == PROBED_CLOUDS:
                break
        if not probes:
            why = reason or "each is empty, or all of its points are NaN or zero"
            raise HemislamError(
                f"None of the {unusable} point clouds on {self.lidar_topic} in {self.path} has a usable point ({why}); "
                "check the LiDAR's driver, or choose another topic by --lidar-topic."
            )
        if len(probes) == 1:
            raise HemislamError(
                f"{self.path} holds a single usable scan on {self.lidar_topic}, and a map needs at least two; record longer."
            )
        if len({probe.cloud.stamp_ns for probe in probes}) == 1:
            self._lidar_stamped = False
            probes = [Probe(probe.log_ns, replace(probe.cloud, stamp_ns=probe.log_ns)) for probe in probes]
        text = f"{unusable} of the first {unusable + len(probes)} clouds have no usable point and are left out"
        return probes, [Finding("empty clouds", "corrected", text)] if unusable else []

    def _probe_imu(self) -> ImuProbe:
        rows, logs = [], []
        for _, log_ns, message in self._source.messages((self.imu_topic,)):
            w, a = message.angular_velocity, message.linear_acceleration
            rows.append((stamp_ns(message.header.stamp), w.x, w.y, w.z, a.x, a.y, a.z))
            logs.append(log_ns)
            if log_ns - logs[0] > PROBED_IMU_NS:
                break
        stamps = np.array([row[0] for row in rows], np.int64)
        if len(rows) > 1 and np.all(stamps == stamps[0]):
            self._imu_stamped = False
            stamps = np.array(logs, np.int64)
        values = np.array([row[1:] for row in rows], np.float64)
        good = np.isfinite(values).all(axis=1)
        if not good.any():
            raise HemislamError(
                f"The first {len(rows)} IMU samples on {self.imu_topic} in {self.path} are all NaN; check the IMU's driver."
            )
        stamps += round(self._params.recording.imu_time_offset * 1e9)
        return ImuProbe(np.array(logs, np.int64)[good], stamps[good], values[good, :3], values[good, 3:])

    def _compare_clocks(self, probes: list[Probe], scans: list[Scan], imu: ImuProbe) -> Finding:
        scan_logs = np.array([probe.log_ns for probe in probes], np.int64)
        ends = np.array([scan.end_ns for scan in scans], np.int64)
        offset = clock_offset_s(scan_logs, ends, imu.log_ns, imu.stamps_ns)
        headers = np.array([probe.cloud.stamp_ns for probe in probes], np.int64)
        copied = np.all(np.abs(scan_logs - headers) < 2_000) and np.all(np.abs(imu.log_ns - imu.stamps_ns) < 2_000)
        return clock_finding(offset, self._params.recording.imu_time_offset, not copied)

    def _nothing_usable(self, reasons: Counter[str], start_s: float, duration_s: float | None) -> str:
        if not reasons:
            until = "" if duration_s is None else f" and before {start_s + duration_s:g} s"
            return f"{self.path} has no scan after {start_s:g} s{until}; it lasts {self.duration_s:.1f} s."
        reason, count = reasons.most_common(1)[0]
        hint = f"{self._clocks.text}: try {self._clocks.option}" if self._clocks.option else "run `hemislam info` on it"
        return f"None of the {reasons.total()} scans of {self.path} can be used ({count} times: {reason}); {hint}."

    def close(self) -> None:
        self._source.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def open_recording(path: Path, params: Params) -> Recording:
    """Open and look at the first messages.

    Raises:
        HemislamError: the file can not be read, has no LiDAR or IMU, or nothing usable on them.
    """
    source = Source(path)
    try:
        return Recording(source, params)
    except BaseException:
        source.close()
        raise


def find_recordings(folder: Path) -> list[Path]:
    """Recordings below a folder: .bag, .mcap, .db3 files, and ROS 2 folders as one entry each, sorted."""
    found: list[Path] = []
    for entry in sorted(folder.iterdir()):
        if entry.name.startswith("."):
            continue
        if entry.is_dir():
            found += [entry] if (entry / "metadata.yaml").is_file() else find_recordings(entry)
        elif entry.suffix in SUFFIXES:
            found.append(entry)
    return found


def input_hash(path: Path) -> str:
    """SHA-256, as hex, of the recording's file, or of the files of its folder in order of name; streamed."""
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    for file in files:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()


def _counted(
    entries: Iterator[Measurement | DroppedScan], reasons: Counter[str]
) -> Iterator[Measurement | DroppedScan]:
    for entry in entries:
        if isinstance(entry, DroppedScan):
            reasons[entry.reason] += 1
        yield entry
