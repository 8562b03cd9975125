"""A recording on disk as a stream of measurements: open, look, read. Constant memory throughout."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from app.sensors.findings import Finding
from app.sensors.layout import Probe, settle_cloud
from app.sensors.pointcloud import CloudError, CloudMessage, decode
from app.sensors.sequencer import Sequencer
from app.sensors.source import IMU, POINTCLOUD, SUFFIXES, Source
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import DroppedScan, Measurement, Scan

PROBED_CLOUDS = 10


class Recording:
    """An open recording. Use as a context manager; made by `open_recording`."""

    def __init__(self, source: Source, params: Params) -> None:
        self._source = source
        self._params = params
        self.path = source.path
        self.lidar_topic = self._choose(POINTCLOUD, params.recording.lidar_topic)
        self.imu_topic = self._choose(IMU, params.recording.imu_topic)
        self.scan_count = next(t.messages for t in source.topics if t.name == self.lidar_topic)
        probes = []
        for _, log_ns, message in source.messages((self.lidar_topic,)):
            cloud = CloudMessage.from_ros(message)
            if len(cloud):
                probes.append(Probe(log_ns, cloud))
            if len(probes) == PROBED_CLOUDS:
                break
        self._layout, findings = settle_cloud(probes, params.recording)
        self.findings: tuple[Finding, ...] = tuple(findings)
        self.start_ns = decode(probes[0].cloud, self._layout).stamp_ns
        self._log_delay_ns = probes[0].log_ns - self.start_ns
        self.duration_s = (source.end_ns - probes[0].log_ns) / 1e9

    def _choose(self, kind: str, wanted: str) -> str:
        topics = [topic.name for topic in self._source.topics if topic.type == kind]
        if wanted and wanted not in topics:
            raise HemislamError(f"{self.path} has no topic {wanted} of type {kind}; it has {', '.join(topics)}.")
        if not topics:
            raise HemislamError(f"{self.path} holds no {kind}.")
        return wanted or topics[0]

    def measurements(
        self, start_s: float = 0.0, duration_s: float | None = None
    ) -> Iterator[Measurement | DroppedScan]:
        """Scans from `start_s` after `start_ns` on, each with its IMU samples, in order of time."""
        first_ns = self.start_ns + round(start_s * 1e9)
        stop_ns = None if duration_s is None else first_ns + round(duration_s * 1e9)
        sequencer = Sequencer(self._params.imu.max_gap)
        for topic, _, message in self._source.messages((self.lidar_topic, self.imu_topic)):
            if topic == self.lidar_topic:
                scan = self._scan(message)
                if scan.stamp_ns >= first_ns and (stop_ns is None or scan.stamp_ns < stop_ns):
                    sequencer.add_scan(scan)
            else:
                stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
                w, a = message.angular_velocity, message.linear_acceleration
                if stamp >= first_ns - 200_000_000:
                    sequencer.add_imu(stamp, (w.x, w.y, w.z), (a.x, a.y, a.z))
            yield from sequencer.ready()
            if stop_ns is not None and sequencer._stamps and sequencer._stamps[-1] > stop_ns + 1_000_000_000:
                return
        yield from sequencer.finish()

    def _scan(self, message: Any) -> Scan | DroppedScan:
        try:
            cloud = CloudMessage.from_ros(message)
            return decode(cloud, self._layout)
        except CloudError as error:
            stamp = message.header.stamp
            return DroppedScan(stamp.sec * 1_000_000_000 + stamp.nanosec, str(error))

    def close(self) -> None:
        self._source.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def open_recording(path: Path, params: Params) -> Recording:
    """Open and look at the first messages. Raises HemislamError."""
    source = Source(path)
    try:
        return Recording(source, params)
    except BaseException:
        source.close()
        raise


def find_recordings(folder: Path) -> list[Path]:
    """Recordings below a folder: .bag, .mcap, .db3 files, and ROS 2 folders as one entry each."""
    found = []
    for path in sorted(folder.rglob("*")):
        inside_bag = any(
            (parent / "metadata.yaml").is_file() for parent in path.parents if parent.is_relative_to(folder)
        )
        if (path.is_dir() and (path / "metadata.yaml").is_file()) or (
            path.suffix in SUFFIXES and path.is_file() and not inside_bag
        ):
            found.append(path)
    return found


def input_hash(path: Path) -> str:
    """SHA-256 of the recording's file, or of all files of its folder, as hex; streamed."""
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    for file in files:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
