"""Signs that a run cannot be right: no person moves like that, or the sensors contradict each other."""

import numpy as np

from app.slam import iekf
from app.slam.imu import LONG_GAP
from app.slam.map_frame import NO_PAUSES
from app.slam.pause import PAUSE_S
from app.slam.run_log import RunLog
from app.slam.types import F64, I64, FrameStatus

IN_DOUBT = "This run is doubtful."
"""How a notice about a doubt begins."""
FASTEST = 10.0
"""m/s between two frames; a sprint."""
HARDEST = 60.0
"""m/s^2 between three frames, lasting a tenth of a second: over 5 g, a fall onto the floor."""
LEAP, LEAP_TIMES = 0.5, 4.0
"""A leap is a step between two frames that is longer than this (m) and this many times as fast as those beside it."""
MOST_LOST, MOST_DROPPED = 0.1, 0.5
"""Shares of the frames that may be lost, and of the scans that may be dropped."""
WALKING = 0.1
"""m/s; a device at rest gives no evidence about its IMU."""
TAKEN_BACK, NOISE = 0.07, 0.05
"""Share of the IMU's velocity changes that the scans may take back, beyond NOISE m/s. It is 0.01 to 0.02 for a clean
sensor, 0.05 for one with all the errors that data sheets allow, and 0.07 to 0.4 with swapped axes, a mounting off by
5 deg or a clock off by 20 ms."""
OFTEN = 3
"""A run is doubtful if in this many frames the sensors contradict each other, or no sensor shows the motion."""
UNCERTAIN = 0.2
"""m: the filter's standard deviation of the position. While scans show the motion, it stays below 0.03."""
LATE_S = 0.01
"""How late or early the IMU's clock may seem: data sheets and links allow 6 ms, and the estimate is off by 1 ms."""


def doubts(log: RunLog, tied_ns: I64 = NO_PAUSES) -> tuple[str, ...]:
    """Reasons why the trajectory cannot be right, one sentence each, with the time when it begins; empty if none.

    Args:
        tied_ns: (m,) ends of the pauses that loops span (`tied_pauses`).
    """
    found = []
    positions, times = log.odometry.positions, np.asarray((log.stamps_ns - log.stamps_ns[:1]) * 1e-9)
    finite = np.asarray(np.isfinite(positions).all(axis=1))
    if not finite.all():
        found.append(f"{np.count_nonzero(~finite)} poses are not finite{_since(times, ~finite)}.")
    elif len(positions) > 2:
        found += _of_motion(positions, times)
    lost, total = log.statuses[FrameStatus.LOST], len(log)
    if lost > MOST_LOST * total:
        is_lost = np.array([frame.status is FrameStatus.LOST for frame in log.frames])
        found.append(f"Tracking was lost in {lost} of {total} frames{_since(times, is_lost)}.")
    dropped = log.dropped.total()
    if dropped > MOST_DROPPED * (total + dropped):
        reason, _ = log.dropped.most_common(1)[0]
        found.append(f"{dropped} of {total + dropped} scans were dropped, mostly because {reason}.")
    of_sensors = _of_imu(log) or _of_surprise(log, times)  # a wrong mounting surprises as well
    return (
        *found,
        *_of_pauses(log, times, tied_ns),
        *_of_silence(log, times),
        *_of_unobserved(log, times),
        *_of_clock(log),
        *of_sensors,
    )


def _of_pauses(log: RunLog, times: F64, tied_ns: I64) -> list[str]:
    """Whether there was neither a scan nor an IMU sample for a while, as when the recorder was paused."""
    if not len(times):
        return []
    waited, gap = np.diff(times, prepend=times[:1]), log.readout("imu_gap_s")
    blank = (waited > PAUSE_S) & ((gap > PAUSE_S) | (gap == 0))  # 0: there was no sample at all
    blank[np.searchsorted(log.stamps_ns, tied_ns[tied_ns <= log.stamps_ns[-1]])] = False
    if not blank.any():
        return []
    return [
        f"There are neither scans nor IMU samples for {waited[blank].max():.1f} s{_since(times - waited, blank)}; how "
        "the device moved meanwhile is a guess, and so far no loop ties what follows to what was mapped before: they "
        "may lie metres apart."
    ]


def _of_silence(log: RunLog, times: F64) -> list[str]:
    """Whether the scans leave the motion open while the IMU is silent."""
    is_lost = np.array([frame.status is FrameStatus.LOST for frame in log.frames], dtype=bool)
    blind = is_lost & (log.readout("imu_gap_s") > LONG_GAP)
    if np.count_nonzero(blind) < OFTEN:
        return []
    return [
        f"In {np.count_nonzero(blind)} frames the IMU is silent and the scans leave the motion open"
        f"{_since(times, blind)}; the map may be metres off from then on."
    ]


def _of_unobserved(log: RunLog, times: F64) -> list[str]:
    """Whether the scans leave a direction unobserved for so long that the IMU cannot tell the position along it."""
    sigma = log.readout("position_sigma")
    uncertain = (sigma > UNCERTAIN) & ~(log.readout("imu_gap_s") > LONG_GAP)
    if np.count_nonzero(uncertain) < OFTEN:
        return []
    return [
        f"In {np.count_nonzero(uncertain)} frames the scans leave a direction unobserved{_since(times, uncertain)}. "
        f"The position along it is uncertain by up to {sigma[uncertain].max():.1f} m (one standard deviation). If the "
        "map is off from then on, add a loop by hand."
    ]


def _of_clock(log: RunLog) -> list[str]:
    late = float(log.readout("clock_late_s")[-1]) if len(log) else 0.0
    if not abs(late) > LATE_S:
        return []
    return [
        f"The IMU's clock seems to be about {abs(late) * 1e3:.0f} ms {'late' if late > 0 else 'early'}; "
        "`hemislam calibrate` finds by how much."
    ]


def _of_imu(log: RunLog) -> list[str]:
    """Whether the scans undo the velocity changes that the IMU measures, in a quarter of the frames or more."""
    change, correction, speed = (log.readout(name) for name in ("predicted_change", "correction", "speed"))
    known = np.isfinite(correction) & ~(speed < WALKING)
    if np.count_nonzero(known) < 20:
        return []
    predicted, taken_back = (float(np.percentile(values[known], 75)) for values in (change, correction))
    share = taken_back / np.hypot(predicted, NOISE)
    if share < TAKEN_BACK:
        return []
    return [
        f"The scans contradict the IMU: of the changes of velocity that it measures they take {share:.0%} back. "
        "Check its units, axes and clock, and the mounting of the LiDAR on it: `hemislam calibrate` finds the last two."
    ]


def _of_surprise(log: RunLog, times: F64) -> list[str]:
    """Whether scans and IMU disagree about where the scanner is, by more than the uncertainty of both."""
    surprising = log.readout("surprise") > iekf.SURPRISING
    if np.count_nonzero(surprising) < OFTEN:
        return []
    return [
        f"In {np.count_nonzero(surprising)} frames the scan and the IMU contradict each other about the motion"
        f"{_since(times, surprising)}. The scans may show little but people or false points there, or the IMU was "
        "knocked. The map may be metres off from then on; if it is, add a loop by hand."
    ]


def _of_motion(positions: F64, times: F64) -> list[str]:
    found = []
    steps, intervals = np.diff(positions, axis=0), np.maximum(np.diff(times), 1e-3)
    lengths = np.linalg.norm(steps, axis=1)
    speeds = lengths / intervals
    if (fast := speeds > FASTEST).any():
        found.append(f"It moves at up to {speeds.max():.3g} m/s{_since(times[1:], fast)}.")
    velocities = steps / intervals[:, None]
    spans = np.maximum((intervals[1:] + intervals[:-1]) / 2, 0.1)
    hard = np.linalg.norm(np.diff(velocities, axis=0), axis=1) / spans
    before, after = np.r_[speeds[:1], speeds[:-1]], np.r_[speeds[1:], speeds[-1:]]
    leaps = (lengths > LEAP) & (speeds > LEAP_TIMES * np.maximum(before, after))
    if leaps.any():
        found.append(f"It leaps by up to {lengths[leaps].max():.1f} m between two frames{_since(times[1:], leaps)}.")
    if not found and (too_hard := hard > HARDEST).any():
        found.append(f"It is accelerated by up to {hard.max():.0f} m/s²{_since(times[2:], too_hard)}.")
    return found


def _since(times: F64, where: np.ndarray) -> str:
    """`, first at 12.3 s`, from the first frame on."""
    return f", first at {times[np.argmax(where)]:.1f} s"
