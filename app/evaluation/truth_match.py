"""Transform true poses to the clock, point and axes of the IMU.

Everything that had to be assumed or estimated for this is returned in words, for the report.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from app.evaluation.truth import TruePoses
from app.slam.errors import HemislamError
from app.slam.metrics import ate, interpolate, umeyama
from app.slam.trajectory import Trajectory
from app.slam.types import F64, I64

ODD_AXES_DEG = 10.0
"""Orientations that differ from ours by a constant angle above this may be in other axes."""
GRID_S = 0.05
FINE_S = 0.001
MIN_OVERLAP_S = 10.0
MIN_CORRELATION = 0.6
"""Grids of the first and of the second search for an offset, and the least overlap and correlation."""


@dataclass(frozen=True, slots=True)
class Matched:
    """The truth for an estimate: T_world_imu in the recording's clock.

    Attributes:
        has_rotation: whether the orientations are the truth's own, in known axes. If not, they are those of the
            estimate, so that motions can be compared, and rotation errors mean nothing.
        offset_s: time added to the truth's stamps. notes: what was assumed or estimated.
    """

    trajectory: Trajectory
    has_rotation: bool
    offset_s: float
    notes: tuple[str, ...]


def match(truth: TruePoses, estimate: Trajectory, offset_s: float | None = None) -> Matched:
    """Transform the truth to the clock, point and axes of the estimate.

    Args:
        offset_s: time to add to the truth's stamps if it has its own clock; None: find it.

    Raises:
        HemislamError: the two have no time or no motion in common.
    """
    notes: list[str] = []
    added_s = 0.0
    if truth.stamps_ns is None:
        if len(truth) != len(estimate):
            raise HemislamError(
                f"{truth.source} holds {len(truth)} poses without times, but the recording {len(estimate)} frames;"
                " put their times, a line each, into a file times.txt beside it."
            )
        truth = replace(truth, stamps_ns=estimate.stamps_ns)
        notes.append("The truth holds no times: one pose was assigned to each frame.")
    stamps_ns = truth.stamps_ns
    assert stamps_ns is not None
    quaternions = truth.quaternions if truth.quaternions is not None else np.tile([0.0, 0.0, 0.0, 1.0], (len(truth), 1))
    there = Trajectory(stamps_ns, truth.positions, quaternions)

    if truth.own_clock and offset_s is not None:
        added_s = offset_s
    elif truth.own_clock:
        by_rotation = truth.quaternions is not None
        added_s, correlation = find_offset(estimate, there, by_rotation=by_rotation)
        notes.append(
            f"The truth has a clock of its own: {added_s:+.3f} s were added to its stamps, found by aligning the"
            f" {_speed(by_rotation)} of both (correlation {correlation:.3f})."
        )
    there = replace(there, stamps_ns=stamps_ns + round(added_s * 1e9))
    lever = np.array(truth.lever)
    if truth.quaternions is None:
        there = _borrow_rotation(there, estimate)
        notes.append("The truth has no orientations: rotation errors cannot be measured.")
    if lever.any():
        there = replace(there, positions=there.positions - there.rotations.apply(lever))
        axes = "the axes of its body" if truth.quaternions is not None else "the IMU's axes"
        notes.append(
            f"The truth's point lies {_vector(lever)} m from the IMU, in {axes}; this lever arm was subtracted."
        )
    has_rotation = truth.quaternions is not None
    if has_rotation:
        there, has_rotation, note = _common_axes(there, estimate, certainly=truth.own_axes)
        notes += [note] if note else []
    return Matched(there if has_rotation else _turned_alike(there, estimate), has_rotation, added_s, tuple(notes))


def _borrow_rotation(there: Trajectory, estimate: Trajectory) -> Trajectory:
    """The truth with the orientations of the estimate, in the world of the truth, over their common time."""
    inside = (there.stamps_ns >= estimate.stamps_ns[0]) & (there.stamps_ns <= estimate.stamps_ns[-1])
    there = there.chosen(inside)
    if len(there) < 3:
        raise HemislamError("The truth has fewer than 3 poses within the time of the trajectory; check its stamps.")
    ours, usable = interpolate(there, estimate.stamps_ns)
    T = umeyama(estimate.chosen(usable).positions, ours.positions)
    start = estimate.stamps_ns[0]
    turning = Slerp((estimate.stamps_ns - start) * 1e-9, estimate.rotations)
    rotations = Rotation.from_matrix(T[:3, :3]) * turning((there.stamps_ns - start) * 1e-9)
    return replace(there, quaternions=rotations.as_quat())


def _turned_alike(there: Trajectory, estimate: Trajectory) -> Trajectory:
    """The truth at the estimate's stamps, with the estimate's orientations. Those at the fixes cannot be interpolated,
    since a hand turns back and forth between two of them."""
    theirs, usable = interpolate(there, estimate.stamps_ns)
    if len(theirs) < 3:
        return there  # the metrics report it
    ours = estimate.chosen(usable)
    T = umeyama(ours.positions, theirs.positions)
    return replace(theirs, quaternions=(Rotation.from_matrix(T[:3, :3]) * ours.rotations).as_quat())


def _common_axes(there: Trajectory, estimate: Trajectory, *, certainly: bool) -> tuple[Trajectory, bool, str]:
    """The truth in the IMU's axes, using the mean rotation between both, if its axes `certainly` differ.

    Also returns whether the orientations are still the truth's own, and a note for the report.
    """
    theirs, usable = interpolate(there, estimate.stamps_ns)
    if len(theirs) < 3:
        return there, True, ""  # the metrics report it
    aligned = ate(estimate, there)
    if aligned.doubt and not certainly:
        return there, True, ""
    if aligned.doubt:
        why = "The truth's axes are not the IMU's, and this trajectory does not determine the rotation between them."
        return _borrow_rotation(there, estimate), False, f"{why} {aligned.doubt}"
    R_truth_estimate = Rotation.from_matrix(aligned.T_truth_estimate[:3, :3])
    between = theirs.rotations.inv() * R_truth_estimate * estimate.rotations[usable]
    R_body_imu = between.mean()
    angle = float(np.degrees(R_body_imu.magnitude()))
    spread = float(np.degrees(np.median((R_body_imu.inv() * between).magnitude())))
    if certainly:
        note = (
            f"The truth's axes are not the IMU's: the constant rotation between them ({angle:.1f}°) was estimated as"
            f" the mean over the trajectory (spread {spread:.2f}°) and removed, so rotation errors do not contain it."
        )
        return replace(there, quaternions=(there.rotations * R_body_imu).as_quat()), True, note
    note = (
        f"The truth's orientations differ from ours by a constant {angle:.0f}°. Its axes may not be the IMU's;"
        " rotation errors and RPE then mean little."
    )
    return there, True, note if angle > ODD_AXES_DEG and spread < angle / 3 else ""


def _vector(values: F64) -> str:
    return "(" + ", ".join(f"{value:+.3f}" for value in values) + ")"


# --- the offset between two clocks ----------------------------------------------------------------
def find_offset(estimate: Trajectory, truth: Trajectory, *, by_rotation: bool) -> tuple[float, float]:
    """Find the clock offset from the angular speeds (or, without orientations, speeds), which do not depend on axes.

    The first search covers all offsets at which both overlap for at least half of the shorter one; the second refines
    the best offset to FINE_S.

    Returns:
        s to add to the truth's stamps, and the correlation of both motions at this offset, up to 1.

    Raises:
        HemislamError: they are too short, or not similar at any offset.
    """
    window_s = 0.2 if by_rotation else 1.0
    spans = [(t.stamps_ns[-1] - t.stamps_ns[0]) * 1e-9 for t in (estimate, truth)]
    if min(spans) < MIN_OVERLAP_S:
        raise HemislamError(
            f"To align the clock of the truth, both need {MIN_OVERLAP_S:g} s of motion, not {min(spans):.1f} s;"
            " use a longer part."
        )
    ours = _motion(estimate, GRID_S, window_s, by_rotation)
    theirs = _motion(truth, GRID_S, window_s, by_rotation)
    lags, correlations = _correlations(ours, theirs, round(max(MIN_OVERLAP_S, min(spans) / 2) / GRID_S))
    best = int(np.argmax(correlations))
    if correlations[best] < MIN_CORRELATION:
        raise HemislamError(
            f"The {_speed(by_rotation)} of the truth matches that of the recording at no offset (correlation"
            f" {correlations[best]:.2f} at best); is it the truth of this recording?"
        )
    coarse = lags[best] * GRID_S

    fine = _motion(truth, FINE_S, window_s, by_rotation)
    grid = np.arange(len(fine)) * FINE_S
    at = np.arange(len(ours)) * GRID_S
    candidates = coarse + np.arange(-2 * GRID_S, 2 * GRID_S, FINE_S)
    scores = [_pearson(ours, np.interp(at - shift, grid, fine, left=np.nan, right=np.nan)) for shift in candidates]
    chosen = int(np.argmax(scores))
    starts = (estimate.stamps_ns[0] - truth.stamps_ns[0]) * 1e-9
    return float(starts + candidates[chosen]), float(scores[chosen])


def _speed(by_rotation: bool) -> str:
    return "angular speed" if by_rotation else "speed"


def _motion(trajectory: Trajectory, step_s: float, window_s: float, by_rotation: bool) -> F64:
    """Speed at times k * step_s after the start, over a window around each; NaN where it is unknown."""
    span_ns = int(trajectory.stamps_ns[-1] - trajectory.stamps_ns[0])
    times: I64 = trajectory.stamps_ns[0] + np.arange(0, span_ns + 1, round(step_s * 1e9), dtype=np.int64)
    half = round(window_s * 0.5e9)
    before, there = interpolate(trajectory, times - half)
    after, here = interpolate(trajectory, times + half)
    both = there & here
    first, second = before.chosen(both[there]), after.chosen(both[here])
    if by_rotation:
        way = (first.rotations.inv() * second.rotations).magnitude()
    else:
        way = np.linalg.norm(second.positions - first.positions, axis=1)
    speed = np.full(len(times), np.nan)
    speed[both] = way / window_s
    return speed


def _correlations(a: F64, b: F64, least: int) -> tuple[I64, F64]:
    """Pearson correlation of a[i] with b[i - lag] over all values known in both, for every lag."""
    from scipy.signal import correlate  # type: ignore[attr-defined]  # takes half a second, and most truths need none

    known_a, known_b = np.isfinite(a), np.isfinite(b)
    x = np.where(known_a, a - np.nanmean(a), 0.0)
    y = np.where(known_b, b - np.nanmean(b), 0.0)
    ma, mb = known_a.astype(np.float64), known_b.astype(np.float64)
    over: Callable[[F64, F64], F64] = partial(correlate, method="fft")
    count = np.maximum(np.rint(over(ma, mb)), 1.0)
    sum_x, sum_y = over(x, mb), over(ma, y)
    variance_x = over(x**2, mb) - sum_x**2 / count
    variance_y = over(ma, y**2) - sum_y**2 / count
    covariance = over(x, y) - sum_x * sum_y / count
    scale = np.sqrt(np.maximum(variance_x, 1e-12) * np.maximum(variance_y, 1e-12))
    lags = np.arange(-(len(b) - 1), len(a))
    return lags, np.where(count >= least, covariance / scale, -1.0)


def _pearson(a: F64, b: F64) -> float:
    both = np.isfinite(a) & np.isfinite(b)
    return float(np.corrcoef(a[both], b[both])[0, 1]) if np.count_nonzero(both) > 10 else -1.0
