"""The distance of a trajectory from another one of the same walk, such as the truth."""

from contextlib import suppress

import numpy as np

from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.metrics import places_at, umeyama
from app.slam.types import F64, I64

LEAST_EXTENT_M = 0.5
"""m: the truth is aligned once the trajectory spans this much. On a shorter one, noise would decide the alignment."""


def compared(truth_stamps_ns: I64, truth_positions: F64, stamps_ns: I64, positions: F64) -> tuple[F64 | None, F64]:
    """Align the truth with a trajectory and measure the distance between them.

    Args:
        truth_stamps_ns, truth_positions: (m,) and (m, 3) m, in the truth's frame.
        stamps_ns, positions: (n,) and (n, 3) m, of the trajectory in the map.

    Returns:
        (4, 4) T_map_truth, None while the trajectory is too short or too straight to determine it.
        (n,) m from each pose to the truth; nan where it is unknown.
    """
    there, T_map_truth = places_at(truth_stamps_ns, truth_positions, stamps_ns), None
    known = np.isfinite(there[:, 0])
    if known.any() and np.linalg.norm(np.ptp(there[known], axis=0)) >= LEAST_EXTENT_M:
        with suppress(HemislamError):  # a straight line so far
            T_map_truth = umeyama(there[known], positions[known])
    if T_map_truth is None:
        return None, np.full(len(positions), np.nan)
    aligned = lie.moved(T_map_truth, there)
    return T_map_truth, np.linalg.norm(aligned - positions, axis=1)
