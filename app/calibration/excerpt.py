"""A recording as calibration needs it: scans thinned to a few thousand points, and all IMU samples."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from app.sensors.recording import ImuEntry, Recording, ScanEntry
from app.slam import rest
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.types import F64, I64, ImuSamples, Scan
from app.slam.voxel import VoxelGrid

LONGEST_S = 120.0
"""More of a recording costs time and adds little."""
LEAST_SCANS = 50
REST_S = 1.0
VOXEL = 0.3
"""m; of each voxel the first point stays, with its own time."""


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
        HemislamError: too short, or damaged from the start.
    """
    scans: list[Scan] = []
    stamps: list[int] = []
    values: list[tuple[float, ...]] = []
    grid = VoxelGrid()
    stop_ns = recording.start_ns + round(duration_s * 1e9)
    for entry in recording.entries(None, stop_ns):
        if isinstance(entry, ImuEntry):
            stamps.append(entry.stamp_ns)
            values.append((*entry.gyro, *entry.accel))
        elif isinstance(entry, ScanEntry) and isinstance(entry.scan, Scan) and entry.scan.end_ns < stop_ns:
            scans.append(_thinned(entry.scan, params, grid))
            progress(min((entry.scan.end_ns - recording.start_ns) / min(duration_s, recording.duration_s) * 1e-9, 1.0))
    scans.sort(key=lambda scan: scan.end_ns)
    usable = [after for before, after in pairwise(scans) if after.end_ns > before.end_ns and len(after)]
    if len(usable) < LEAST_SCANS or len(stamps) < 10:
        raise HemislamError(
            f"{recording.path} has {len(usable)} usable scans and {len(stamps)} IMU samples; calibration needs"
            f" at least {LEAST_SCANS} scans, better 30 s of lively motion."
        )
    imu = _samples(stamps, values)
    begin_ns = _sets_off_ns(imu)
    lines = 1 + max(int(scan.ring.max()) for scan in usable) if recording.has_lines else 0
    return Excerpt(tuple(scan for scan in usable if scan.end_ns >= begin_ns), imu, lines)


def _sets_off_ns(imu: ImuSamples) -> int:
    """REST_S before the IMU first moves; a map of many scans from one place would hold the LiDAR there."""
    rest_ns = round(REST_S * 1e9)
    for begin in range(int(imu.stamps_ns[0]), int(imu.stamps_ns[-1]), rest_ns // 4):
        part = slice(*np.searchsorted(imu.stamps_ns, [begin, begin + rest_ns // 2]))
        if part.stop - part.start > 3 and rest.is_moving(
            ImuSamples(imu.stamps_ns[part], imu.gyro[part], imu.accel[part])
        ):
            return begin - rest_ns
    return int(imu.stamps_ns[0])


def _samples(stamps: list[int], values: list[tuple[float, ...]]) -> ImuSamples:
    """In order of time, each once, without those that no IMU measures."""
    rows = np.array(values, np.float64)
    times, first = np.unique(np.array(stamps, np.int64), return_index=True)
    rows = rows[first]
    good = np.isfinite(rows).all(axis=1) & rows[:, 3:].any(axis=1)
    return ImuSamples(times[good], rows[good, :3], rows[good, 3:])


def _thinned(scan: Scan, params: Params, grid: VoxelGrid) -> Scan:
    near, far = params.sensor.min_range, params.sensor.max_range
    distance = np.linalg.norm(scan.points, axis=1)
    within = np.flatnonzero((distance > near) & (distance < far))
    first = within[grid.downsample(np.ascontiguousarray(scan.points[within]), VOXEL).source]
    late = np.argmax(scan.offsets_ns) if len(scan) else 0
    kept = np.unique(np.append(first, late)) if len(first) else first  # the last point gives the scan's end
    return scan.part(kept)
