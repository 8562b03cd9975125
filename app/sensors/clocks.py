"""Whether the LiDAR's and the IMU's stamps come from the same clock, judged by when they were logged."""

from itertools import pairwise

import numpy as np

from app.sensors.findings import Finding
from app.slam.types import I64, Scan

TOLERANCE_S = 0.15
"""Drivers may log a scan this late; a smaller difference is a delay, not a different clock."""
OVERLAP, LEAST_OVERLAPS = 0.2, 0.4
"""Two scans overlap if they share more than 20 % of their duration; if over 40 % of neighbouring scans do, two LiDARs
send on the topic."""


def clock_finding(scans: I64, imu: I64, applied_s: float) -> Finding:
    """Compare the stamps of LiDAR and IMU, and find out whether their difference changes, as when a clock is set.

    Args:
        scans: (n, 3) ns, when each scan was logged, when it begins and when it ends.
        imu: (k, 2) ns, when each sample was logged, and its stamp with `recording.imu_time_offset` added.
        applied_s: this offset.
    """
    if not len(scans) or not len(imu):
        return Finding("clocks", "needs you", "there are no scans and IMU samples to compare")
    if _stands_still(scans) and _stands_still(imu):
        text = (
            "all messages were logged at about the same time, which shows neither whether the two clocks agree nor "
            "where a start and a duration in seconds lie; write the recording with log times"
        )
        return Finding("clocks", "needs you", text)
    spread = _offset_spread_s(scans, imu)
    if spread > TOLERANCE_S:
        text = (
            f"the offset between the LiDAR's and the IMU's stamps changes by {spread:.3f} s during "
            "the recording: a clock was set or drifts; map a part before that (start hemislam with --start and "
            "--duration), and use one clock for both next time"
        )
        return Finding("clocks", "needs you", text)
    offset = _offset_s(scans, imu)
    if abs(offset) > TOLERANCE_S:
        side = "behind" if offset > 0 else "ahead of"
        text = f"the IMU's stamps are {abs(offset):.3f} s {side} the LiDAR's, judged by when they were logged"
        return Finding("clocks", "needs you", text, f"--set recording.imu_time_offset={applied_s + offset:.3f}")
    applied = f" (with your imu_time_offset of {applied_s:g} s)" if applied_s else ""
    if _copied(scans) and _copied(imu):
        text = f"log times are copies of the stamps, so they do not show whether the two clocks agree{applied}"
    else:
        text = f"LiDAR and IMU stamps agree within {abs(offset) * 1e3:.0f} ms, judged by when they were logged{applied}"
    return Finding("clocks", "fine", text)


def is_copy(scan: Scan, before: Scan | None) -> bool:
    """Whether a scan repeats the previous one: some recorders write a message twice."""
    return before is not None and scan.stamp_ns == before.stamp_ns and np.array_equal(scan.points, before.points)


def overlap_finding(scans: I64, topic: str) -> list[Finding]:
    """Whether the scans of a topic overlap in time, which scans of a single LiDAR cannot. scans: as above."""
    begin, end = scans[np.lexsort((scans[:, 2], scans[:, 1])), 1:].T
    overlaps = end[:-1] - begin[1:] > OVERLAP * np.median(end - begin)
    if not len(overlaps) or overlaps.mean() < LEAST_OVERLAPS:
        return []
    text = f"the scans on {topic} overlap in time, as if two LiDARs sent on it; record each on a topic of its own"
    return [Finding("scans", "needs you", text)]


def _offset_s(scans: I64, imu: I64) -> float:
    """Seconds by which the IMU's stamps lag behind the LiDAR's, assuming that logging has no delay."""
    scan_delay, imu_delay = (np.median((times[:, 0] - times[:, -1]).astype(np.float64)) for times in (scans, imu))
    return float(imu_delay - scan_delay) / 1e9


def _offset_spread_s(scans: I64, imu: I64, parts: int = 10) -> float:
    """Seconds by which this offset changes over a recording."""
    if min(len(scans), len(imu)) < 10 * parts:
        return 0.0
    offsets = []
    for begin, end in pairwise(np.linspace(scans[0, 0], scans[-1, 0], parts + 1)):
        some_scans, some_imu = (times[(times[:, 0] >= begin) & (times[:, 0] <= end)] for times in (scans, imu))
        if len(some_scans) and len(some_imu):
            offsets.append(_offset_s(some_scans, some_imu))
    return max(offsets) - min(offsets) if offsets else 0.0


def _stands_still(times: I64) -> bool:
    """Whether the log times, the first column, do not advance with the stamps, the last one."""
    return bool(np.ptp(times[:, 0]) < 0.1 * np.ptp(times[:, -1]))


def _copied(times: I64) -> bool:
    """Whether the log times, the first column, are just copies of one of the others."""
    return bool((np.abs(times[:, 1:] - times[:, :1]).max(axis=0) < 2_000).any())
