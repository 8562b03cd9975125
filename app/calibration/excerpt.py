"""A recording as calibration needs it: the engine's input, with scans thinned to a few thousand points."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from app.sensors.recording import Recording
from app.slam import rest
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import F64, I64, ImuSamples, Measurement, Scan
from app.slam.voxel import VoxelGrid

LONGEST_S = 120.0
"""More of a recording costs time and adds little."""
PAUSE_NS = 5_000_000_000
"""Scans farther apart than this do not belong together."""
LEAST_SCANS = 50
REST_S = 1.0
VOXEL = 0.3
"""m: edge of the voxels of which only the first point stays, with its own time."""


@dataclass(frozen=True, slots=True)
class Excerpt:
    """Scans in order of their ends, and the IMU samples around them, in order of time.

    Attributes:
        lines: how many scan lines the LiDAR has; 0: none, or too few points on them.
    """

    scans: tuple[Scan, ...]
    imu: ImuSamples
    lines: int = 0

    @property
    def ends_ns(self) -> I64:
        return np.array([scan.end_ns for scan in self.scans], np.int64)

    @property
    def duration_s(self) -> float:
        return float(self.ends_ns[-1] - self.ends_ns[0]) * 1e-9

    def seconds(self, stamps_ns: I64) -> F64:
        """Times after the end of the first scan."""
        return np.asarray((stamps_ns - self.scans[0].end_ns) * 1e-9)


def read_excerpt(
    recording: Recording,
    params: Params,
    duration_s: float = LONGEST_S,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Excerpt:
    """The first `duration_s` of a recording.

    Args:
        progress: called with the fraction read, 0-1.

    Raises:
        HemislamError: the recording is too short, or damaged from the start.
    """
    measurements: list[Measurement] = []
    grid = VoxelGrid()
    for entry in recording.measurements(0.0, duration_s):
        if isinstance(entry, Measurement):
            measurements.append(replace(entry, scan=_thinned(entry.scan, params, grid)))
            read_s = (entry.scan.end_ns - recording.start_ns) * 1e-9
            progress(min(max(read_s / min(duration_s, recording.duration_s), 0.0), 1.0))
    measurements = _longest_part(measurements)
    usable = [measurement.scan for measurement in measurements[1:] if len(measurement.scan)]
    imu = _samples(measurements)
    if measurements and not usable:
        near, far = params.sensor.min_range, params.sensor.max_range
        raise HemislamError(
            f"None of the {len(measurements)} scans of {recording.path} has a return within {near:g} to {far:g} m"
            " (sensor.min_range, sensor.max_range); `hemislam info` shows how far they are."
        )
    if len(usable) < LEAST_SCANS or len(imu) < 10:
        raise HemislamError(
            f"{recording.path} has {len(usable)} usable scans and {len(imu)} IMU samples; calibration needs"
            f" at least {LEAST_SCANS} scans, better 30 s of lively motion."
        )
    begin_ns = _sets_off_ns(imu)
    lines = 1 + max(int(scan.ring.max()) for scan in usable) if recording.has_lines else 0
    return Excerpt(tuple(scan for scan in usable if scan.end_ns >= begin_ns), imu, lines)


def _longest_part(measurements: list[Measurement]) -> list[Measurement]:
    """The longest part between pauses and steps of the clock."""
    ends_ns = np.array([measurement.scan.end_ns for measurement in measurements], np.int64)
    edges = np.r_[0, np.flatnonzero(np.diff(ends_ns) > PAUSE_NS) + 1, len(ends_ns)]
    longest = int(np.argmax(np.diff(edges)))
    return measurements[edges[longest] : edges[longest + 1]]


def _sets_off_ns(imu: ImuSamples) -> int:
    """Time, ns, REST_S before the IMU first moves. A map of many scans from one place would hold the LiDAR there."""
    rest_ns = round(REST_S * 1e9)
    for begin in range(int(imu.stamps_ns[0]), int(imu.stamps_ns[-1]), rest_ns // 4):
        part = slice(*np.searchsorted(imu.stamps_ns, [begin, begin + rest_ns // 2]))
        if part.stop - part.start > 3 and rest.is_moving(imu.part(part)):
            return begin - rest_ns
    return int(imu.stamps_ns[0])


def _samples(measurements: list[Measurement]) -> ImuSamples:
    """All samples, each once, without those of the first measurement, which may be from before a pause."""
    parts = [measurement.imu for measurement in measurements[1:]] or [m.imu for m in measurements]
    stamps_ns, first = np.unique(np.concatenate([part.stamps_ns for part in parts]), return_index=True)
    gyro, accel = (np.concatenate([getattr(part, name) for part in parts]) for name in ("gyro", "accel"))
    return ImuSamples(stamps_ns, gyro[first], accel[first])


def _thinned(scan: Scan, params: Params, grid: VoxelGrid) -> Scan:
    near, far = params.sensor.min_range, params.sensor.max_range
    distance = np.linalg.norm(scan.points, axis=1)
    within = np.flatnonzero((distance > near) & (distance < far))
    first = within[grid.downsample(np.ascontiguousarray(scan.points[within]), VOXEL).source]
    late = np.argmax(scan.offsets_ns) if len(scan) else 0
    kept = np.unique(np.append(first, late)) if len(first) else first  # the last point gives the scan's end
    return scan.part(kept)
