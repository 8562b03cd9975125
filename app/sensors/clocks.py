"""Whether the LiDAR's and the IMU's stamps come from the same clock, judged by when they were logged."""

from itertools import pairwise

import numpy as np

from app.sensors.findings import Finding
from app.slam.types import I64

TOLERANCE_S = 0.15
"""Drivers log a scan up to this late; a smaller difference is delay, not another clock."""


def clock_offset_s(scan_log_ns: I64, scan_end_ns: I64, imu_log_ns: I64, imu_stamps_ns: I64) -> float:
    """Seconds by which the IMU's stamps lag behind the LiDAR's, if everything was logged without delay.

    Args: log times and the times of measurement, (n,) of scans and (k,) of IMU samples.
    """
    scan_delay = np.median((scan_log_ns - scan_end_ns).astype(np.float64))
    imu_delay = np.median((imu_log_ns - imu_stamps_ns).astype(np.float64))
    return float(imu_delay - scan_delay) / 1e9


def offset_spread_s(scan_log_ns: I64, scan_end_ns: I64, imu_log_ns: I64, imu_stamps_ns: I64, parts: int = 10) -> float:
    """Seconds by which this offset changes over a recording, as when a clock is set or drifts."""
    if min(len(scan_log_ns), len(imu_log_ns)) < 10 * parts:
        return 0.0
    edges = np.linspace(scan_log_ns[0], scan_log_ns[-1], parts + 1)
    offsets = []
    for begin, end in pairwise(edges):
        scans = (scan_log_ns >= begin) & (scan_log_ns <= end)
        imu = (imu_log_ns >= begin) & (imu_log_ns <= end)
        if scans.any() and imu.any():
            offsets.append(clock_offset_s(scan_log_ns[scans], scan_end_ns[scans], imu_log_ns[imu], imu_stamps_ns[imu]))
    return max(offsets) - min(offsets) if offsets else 0.0


def clock_finding(offset_s: float, applied_s: float, logged_apart: bool) -> Finding:
    """What the offset means.

    Args:
        offset_s: of `clock_offset_s`, with `recording.imu_time_offset` applied_s already added.
        logged_apart: whether the log times are not just copies of the stamps.
    """
    if abs(offset_s) <= TOLERANCE_S:
        applied = f" (with your imu_time_offset of {applied_s:g} s)" if applied_s else ""
        text = (
            f"LiDAR and IMU stamps agree within {abs(offset_s) * 1e3:.0f} ms, judged by when they were logged{applied}"
        )
        if not logged_apart:
            text = f"log times are copies of the stamps, so they do not show whether the two clocks agree{applied}"
        return Finding("clocks", "fine", text)
    text = (
        f"the IMU's stamps are {abs(offset_s):.3f} s {'behind' if offset_s > 0 else 'ahead of'} the LiDAR's, judged by "
        "when they were logged"
    )
    return Finding("clocks", "needs you", text, f"--set recording.imu_time_offset={applied_s + offset_s:.3f}")
