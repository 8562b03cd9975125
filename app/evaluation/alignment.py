"""The offset between two clocks, found from the motion that both trajectories show, in any coordinate frames."""

from dataclasses import dataclass

import numpy as np

from app.slam.errors import HemislamError
from app.slam.metrics import interpolate
from app.slam.trajectory import Trajectory
from app.slam.types import F64, I64

GRID_S = 0.05
FINE_S = 0.001
MIN_OVERLAP_S = 10.0
MIN_CORRELATION = 0.6


@dataclass(frozen=True, slots=True)
class Offset:
    """Attributes:
    offset_s: time to add to the truth's stamps. correlation: of both motions then, up to 1.
    what: the quantity that was compared.
    """

    offset_s: float
    correlation: float
    what: str


def find_offset(estimate: Trajectory, truth: Trajectory, *, by_rotation: bool) -> Offset:
    """Compare the angular speed (or, without orientations, the speed), which does not depend on the axes.

    First over all offsets at which both overlap for at least half of the shorter one, then around the best to FINE_S.

    Raises:
        HemislamError: they are too short, or similar at no offset.
    """
    what = "angular speed" if by_rotation else "speed"
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
            f"The {what} of the truth matches that of the recording at no offset (correlation"
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
    return Offset(float(starts + candidates[chosen]), float(scores[chosen]), what)


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
    known_a, known_b = np.isfinite(a), np.isfinite(b)
    x = np.where(known_a, a - np.nanmean(a), 0.0)
    y = np.where(known_b, b - np.nanmean(b), 0.0)
    ma, mb = known_a.astype(np.float64), known_b.astype(np.float64)

    size = len(a) + len(b) - 1

    def over(u: F64, v: F64) -> F64:
        return np.fft.irfft(np.fft.rfft(u, size) * np.fft.rfft(v[::-1], size), size)

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
