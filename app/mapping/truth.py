"""The error of a trajectory to another one of the same session, such as the truth."""

from contextlib import suppress

import numpy as np

from app.slam.errors import HemislamError
from app.slam.metrics import MAX_TRUTH_GAP_S, umeyama
from app.slam.types import F64, I64

LEAST_EXTENT_M = 0.5
"""The truth is aligned once the trajectory spans this much. Before that, any noise would fit."""


def compared(truth_stamps_ns: I64, truth_positions: F64, stamps_ns: I64, positions: F64) -> tuple[F64 | None, F64]:
    """Align the truth with a trajectory and measure the distance between them.

    Args:
        truth_stamps_ns, truth_positions: (m,) and (m, 3) m, in the truth's frame.
        stamps_ns, positions: (n,) and (n, 3) m, of the trajectory in the map.

    Returns:
        (4, 4) T_map_truth, None while the trajectory is too short or too straight to determine it.
        (n,) m from each pose to the truth; nan where it is unknown.
    """
    there, T_map_truth = _interpolated(truth_stamps_ns, truth_positions, stamps_ns), None
    known = np.isfinite(there[:, 0])
    if known.any() and np.linalg.norm(np.ptp(there[known], axis=0)) >= LEAST_EXTENT_M:
        with suppress(HemislamError):  # a straight line so far
            T_map_truth = umeyama(there[known], positions[known])
    if T_map_truth is None:
        return None, np.full(len(positions), np.nan)
    laid = there @ T_map_truth[:3, :3].T + T_map_truth[:3, 3]
    return T_map_truth, np.linalg.norm(laid - positions, axis=1)


def _interpolated(truth_stamps_ns: I64, truth_positions: F64, stamps_ns: I64) -> F64:
    """(n, 3) true positions at these times, linear between two poses; nan outside the truth and in its gaps."""
    right = np.searchsorted(truth_stamps_ns, stamps_ns).clip(1, len(truth_stamps_ns) - 1)
    before, after = truth_stamps_ns[right - 1], truth_stamps_ns[right]
    fraction = ((stamps_ns - before) / (after - before))[:, None]
    positions: F64 = (1 - fraction) * truth_positions[right - 1] + fraction * truth_positions[right]
    outside = (stamps_ns < truth_stamps_ns[0]) | (stamps_ns > truth_stamps_ns[-1])
    positions[outside | (after - before > MAX_TRUTH_GAP_S * 1e9)] = np.nan
    return positions
