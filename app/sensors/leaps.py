"""Leaps of a clock in the middle of a recording, and how they are bridged.

A scanner counts from power-on until it has found its time server, and the clock of a small computer is set once there
is a network. LiDAR, IMU and recorder may each have a clock of their own. The time after a clock's last leap is taken as
right, and earlier times are shifted so that time is continuous. If LiDAR and IMU agreed only before the leaps, the
time before is taken as right instead.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise

import numpy as np

from app.slam.types import F64, I64, Scan

LEAST_NS = 500_000_000
"""Smaller changes are delays of logging, or drift."""
JITTER_NS = 50_000_000
"""Steps that differ by less count as the same."""
ALIKE = 1.5, 2.0
"""An IMU or a view continues across a silence if it changes by less than this many times its change within 2 s."""
STRIDE_NS = 5_000_000_000
"""Silence is looked for at intervals of this."""
AROUND_NS = 2_000_000_000
"""Time on either side of a leap that is examined."""
END_NS = 2**62

Times = Callable[[int, int], Iterable[tuple[int, int]]]
"""Log time and stamp, ns, of each message of a topic that was logged within [first, stop)."""


@dataclass(frozen=True, slots=True)
class Leap:
    """A clock that was set. at_ns: log time of the first message after it. by_ns: how far it leapt.

    A leap at `END_NS` moves all times back to the clock before the other leaps.
    """

    at_ns: int
    by_ns: int


@dataclass(frozen=True, slots=True)
class Leaps:
    """The leaps of the LiDAR's stamps, of the IMU's stamps and of the recorder's clock, each in order of time."""

    lidar: tuple[Leap, ...] = ()
    imu: tuple[Leap, ...] = ()
    log: tuple[Leap, ...] = ()

    def recorded_ns(self, log_ns: int) -> int:
        """The log time in the file that becomes this one by bridging."""
        for leap in reversed(self.log):
            if log_ns < leap.at_ns:
                log_ns = min(log_ns - leap.by_ns, leap.at_ns)
        return log_ns


def added_ns(leaps: tuple[Leap, ...], log_ns: int) -> int:
    """ns to add to the time of a message that was logged at `log_ns`, to bridge the leaps."""
    return sum(leap.by_ns for leap in leaps if log_ns < leap.at_ns)


def all_added_ns(leaps: tuple[Leap, ...], log_ns: I64) -> I64:
    """The same for each of (n,) messages."""
    return np.array([added_ns(leaps, one) for one in log_ns.tolist()], np.int64)


def find_leaps(
    lidar: Times, imu: Times | None, start_ns: int, end_ns: int, scans_ns: int, continues: Callable[[int, int], bool]
) -> Leaps:
    """Find the leaps by bisection: where stamps and log times part, and where all clocks leap ahead.

    Args:
        start_ns, end_ns: log times of the first and last message. scans_ns: total duration of the scans.
        continues: whether the scan logged at the second time continues the one logged at the first.
    """
    topics = [lidar] if imu is None else [lidar, imu]
    moments = sorted(moment for times in topics for moment in _moments(times, start_ns, end_ns))
    if not moments and end_ns - start_ns - scans_ns > 2 * AROUND_NS:
        moments = _silences(lidar, start_ns, end_ns)
    of_lidar: list[Leap] = []
    of_imu: list[Leap] = []
    of_log: list[Leap] = []
    done_ns = start_ns
    for before_ns, after_ns in moments:
        if before_ns < done_ns:  # the other topic leaps as well
            continue
        done_ns = after_ns + AROUND_NS
        steps = [_greatest_steps(times, before_ns, after_ns) for times in topics]
        log_ns = min((log.by_ns for _, log in steps), key=abs)
        # what a topic was silent for beyond the other one, as while its sensor started anew, is no leap
        steps = [(_without(own, log.by_ns - log_ns), log) for own, log in steps]
        (of_scans, log_of_scans), (of_samples, log) = steps[0], steps[-1]
        # what is the same in all is due to messages that were lost meanwhile
        lost_ns = min((of_scans.by_ns, of_samples.by_ns, log_ns), key=abs)
        if abs(lost_ns) < JITTER_NS or (lost_ns > AROUND_NS and continues(before_ns, after_ns)):
            lost_ns = 0
        same = abs(of_scans.by_ns - of_samples.by_ns) < JITTER_NS
        for leaps, at_ns, by_ns in (
            (of_lidar, of_scans.at_ns, of_scans.by_ns),
            (of_imu, of_samples.at_ns, of_scans.by_ns if same else of_samples.by_ns),
            (of_log, min(log.at_ns, log_of_scans.at_ns), log_ns),
        ):
            if abs(by_ns - lost_ns) > LEAST_NS:
                leaps.append(Leap(at_ns, by_ns - lost_ns))
    if imu is not None and bool(of_lidar) != bool(of_imu):
        first, last = (_apart(topics, *part) for part in ((start_ns, end_ns), (end_ns - AROUND_NS, end_ns)))
        if abs(last) > abs(first) + LEAST_NS:
            leaps = of_lidar or of_imu
            leaps.append(Leap(END_NS, -sum(leap.by_ns for leap in leaps)))
    return Leaps(tuple(of_lidar), tuple(of_imu), tuple(of_log))


def _without(leap: Leap, silence_ns: int) -> Leap:
    """The leap of stamps without what passed in a silence; less may be a delay of logging."""
    return Leap(leap.at_ns, leap.by_ns - silence_ns) if silence_ns > LEAST_NS else leap


def _apart(topics: list[Times], first_ns: int, end_ns: int) -> int:
    """ns by which the LiDAR's stamps are ahead of the IMU's at a part's start; 0 if it lacks one of the two."""
    looks = [_look(times, first_ns, end_ns) for times in topics]
    return looks[0][1] - looks[1][1] if looks[0] and looks[1] else 0


def leap_sentences(leaps: Leaps, start_ns: int) -> dict[int, str]:
    """A sentence for each leap, by its log time in the file; `start_ns` is the first log time after bridging."""
    moments: dict[int, dict[str, list[str]]] = {}
    for name, own in (("LiDAR", leaps.lidar), ("IMU", leaps.imu), ("recorder", leaps.log)):
        for leap in own:
            if leap.at_ns != END_NS:
                at_ns = next((known for known in moments if abs(known - leap.at_ns) < AROUND_NS), leap.at_ns)
                moments.setdefault(at_ns, {}).setdefault(f"{leap.by_ns / 1e9:+.3f} s", []).append(name)
    return {
        at_ns: f"a clock was set {(at_ns + added_ns(leaps.log, at_ns) - start_ns) / 1e9:.1f} s after the start: "
        + " and ".join(f"the times of the {' and '.join(names)} leap by {by}" for by, names in steps.items())
        + "; this is bridged, so that time goes on"
        for at_ns, steps in sorted(moments.items())
    }


def _moments(times: Times, start_ns: int, end_ns: int) -> list[tuple[int, int]]:
    """Log times of each pair of successive messages of a topic between which stamps and log times part."""
    first, last = _look(times, start_ns, end_ns), None
    at_ns, back_ns = end_ns, LEAST_NS
    while first and not last and at_ns > start_ns:  # from the topic's end, which may be earlier
        at_ns = max(end_ns - back_ns, start_ns)
        last = _look(times, at_ns, end_ns)
        back_ns *= 4
    return _between(times, (start_ns, first[1]), (at_ns, last[1])) if first and last else []


def _between(times: Times, first: tuple[int, int], last: tuple[int, int]) -> list[tuple[int, int]]:
    """The same between two log times, each with the lead of the stamps from then on."""
    if abs(last[1] - first[1]) < LEAST_NS:
        return []
    if last[0] - first[0] > AROUND_NS:
        middle_ns = (first[0] + last[0]) // 2
        look = _look(times, middle_ns, END_NS)
        middle = (middle_ns, look[1] if look else last[1])
        return _between(times, first, middle) + _between(times, middle, last)
    messages = np.array([*times(first[0], last[0]), *islice(times(last[0], END_NS), 5)], np.int64).reshape(-1, 2)
    parted = np.abs(np.diff(messages[:, 1] - messages[:, 0]))
    if not len(parted) or parted.max() < LEAST_NS:  # they drift apart
        return []
    most = int(parted.argmax())
    return [(int(messages[most, 0]), int(messages[most + 1, 0]))]


def _silences(times: Times, start_ns: int, end_ns: int) -> list[tuple[int, int]]:
    """Log times of each pair of successive messages that are far apart; pairs less than 7 s apart may be missed."""
    found, at_ns = [], start_ns
    while (look := _look(times, at_ns, end_ns)) is not None:
        if look[0] - at_ns > AROUND_NS and len(before := _listed(times, at_ns - STRIDE_NS, at_ns)):
            found.append((int(before[-1, 0]), look[0]))
        at_ns = look[0] + STRIDE_NS
    return found


def same_motion(before: F64, after: F64) -> bool:
    """Whether the IMU's values (n, 6) and (m, 6) on either side of a silence are those of one motion."""
    if min(len(before), len(after)) < 20:
        return False
    usual = np.percentile(np.abs(np.vstack([np.diff(before, axis=0), np.diff(after, axis=0)])), 99, axis=0)
    return bool((np.abs(after[0] - before[-1]) <= ALIKE[0] * usual).all())


def same_view(before: Sequence[Scan], after: Sequence[Scan]) -> bool:
    """Whether the last scans before a silence and the first after it show the same surroundings."""
    if min(len(before), len(after)) < 2:
        return False
    views = [_view(scan) for scan in (*before[-3:], *after[:3])]
    changes = [_change(one, other) for one, other in pairwise(views)]
    across = changes.pop(min(len(before), 3) - 1)
    return across < ALIKE[1] * max(changes) + 0.001


def _view(scan: Scan) -> F64:
    """(288,) log of the median distance in each direction; NaN where nothing is."""
    x, y, z = scan.points.astype(np.float64).T
    distance = np.sqrt(x * x + y * y + z * z)
    azimuth = ((np.arctan2(y, x) / np.pi + 1.0) * 12).astype(np.int64) % 24
    height = np.minimum((np.arccos(z / distance) / np.pi * 12).astype(np.int64), 11)
    cell = azimuth * 12 + height
    order = np.lexsort((distance, cell))
    cells, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    view = np.full(288, np.nan)
    view[cells] = np.log(distance[order][first + count // 2])
    return view


def _change(before: F64, after: F64) -> float:
    both = np.abs(after - before)[np.isfinite(after - before)]
    return float(np.median(both)) if len(both) else np.inf


def _look(times: Times, first_ns: int, end_ns: int) -> tuple[int, int] | None:
    """Log time of the first message from `first_ns` on, and the lead of its stamp over it; None without a message."""
    messages = np.array(list(islice(times(first_ns, end_ns + 1), 3)), np.int64).reshape(-1, 2)
    return (int(messages[0, 0]), int(np.median(messages[:, 1] - messages[:, 0]))) if len(messages) else None


def _greatest_steps(times: Times, before_ns: int, after_ns: int) -> tuple[Leap, Leap]:
    """The greatest step of a topic's stamps around this moment, and that of its log times, beyond the usual step."""
    messages = _listed(times, before_ns - AROUND_NS, after_ns + AROUND_NS)
    if len(messages) < 3:
        return Leap(after_ns, 0), Leap(after_ns, 0)
    steps = np.diff(messages, axis=0)
    steps -= int(np.median(steps[:, 1]))
    greatest = np.abs(steps).argmax(axis=0).tolist()
    log, stamps = (Leap(int(messages[k + 1, 0]), int(steps[k, part])) for part, k in enumerate(greatest))
    return stamps, log


def _listed(times: Times, first_ns: int, stop_ns: int) -> I64:
    """(n, 2) log times and stamps."""
    return np.array(list(times(first_ns, stop_ns)), np.int64).reshape(-1, 2)
