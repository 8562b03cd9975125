"""The error of a trajectory to another one of the same session, such as the truth."""

import numpy as np

from app.slam.errors import HemislamError
from app.slam.metrics import MAX_TRUTH_GAP_S, umeyama
from app.slam.trajectory import Trajectory
from app.slam.types import F64, I64

LEAST_EXTENT_M = 0.5
"""The truth is aligned once the trajectory spans this much. Before that, any noise would fit."""


def align(truth_at: F64, positions: F64) -> F64 | None:
    """(4, 4) T_map_truth that lays the truth over the trajectory; None while that is undetermined.

    Args:
        truth_at: (n, 3) true positions at the frames, see `interpolated`. positions: (n, 3) in the map.
    """
    known = np.isfinite(truth_at[:, 0])
    if not known.any() or np.linalg.norm(np.ptp(truth_at[known], axis=0)) < LEAST_EXTENT_M:
        return None
    try:
        return umeyama(truth_at[known], positions[known])
    except HemislamError:  # a straight line so far
        return None


def distances(T_map_truth: F64 | None, truth_at: F64, positions: F64) -> F64:
    """(n,) m from the truth to the trajectory; nan where there is none. Arguments as of `align`."""
    if T_map_truth is None:
        return np.full(len(positions), np.nan)
    laid = truth_at @ T_map_truth[:3, :3].T + T_map_truth[:3, 3]
    return np.asarray(np.linalg.norm(laid - positions, axis=1))


def interpolated(truth_stamps_ns: I64, truth_positions: F64, stamps_ns: I64) -> F64:
    """(n, 3) true positions at these times, linear between two poses; nan outside the truth and in its gaps."""
    right = np.searchsorted(truth_stamps_ns, stamps_ns).clip(1, len(truth_stamps_ns) - 1)
    before, after = truth_stamps_ns[right - 1], truth_stamps_ns[right]
    fraction = ((stamps_ns - before) / (after - before))[:, None]
    positions: F64 = (1 - fraction) * truth_positions[right - 1] + fraction * truth_positions[right]
    outside = (stamps_ns < truth_stamps_ns[0]) | (stamps_ns > truth_stamps_ns[-1])
    positions[outside | (after - before > MAX_TRUTH_GAP_S * 1e9)] = np.nan
    return positions


def errors(truth: Trajectory, ours: Trajectory) -> F64:
    """(n,) m from each pose to the truth, which is aligned to all of them; nan where there is none."""
    there = interpolated(truth.stamps_ns, truth.positions, ours.stamps_ns)
    return distances(align(there, ours.positions), there, ours.positions)
