"""The numbers the page plots for every frame, and the error to the truth while walking."""

from dataclasses import dataclass

import numpy as np

from app.server.delta import Rows
from app.server.protocol import SERIES
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.metrics import MAX_TRUTH_GAP_S, umeyama
from app.slam.trajectory import Trajectory
from app.slam.types import F64, StepResult

LEAST_EXTENT_M = 0.5
"""Truth is aligned once the walk spans this much; before, any noise would fit."""


@dataclass(frozen=True, slots=True)
class ReadoutsState:
    """What `Readouts.restore` needs beside the positions, which the readouts keep."""

    walked: float
    last: F64 | None
    compared: int
    T_map_truth: F64 | None


class Readouts:
    """Turns results into rows of SERIES; knows the distance walked and the truth.

    Attributes:
        T_map_truth: (4, 4), the truth laid over the walk so far; None until that is determined.
        error: of the newest frame to it, m; nan where there is none.
    """

    def __init__(self, start_ns: int, truth: Trajectory | None = None) -> None:
        self._start_ns = start_ns
        self._truth = truth
        self._walked = 0.0
        self._last: F64 | None = None
        self._theirs, self._ours = Rows(3), Rows(3)  # row by frame; theirs is nan where there is no truth
        self.T_map_truth: F64 | None = None
        self.error = float("nan")

    def checkpoint(self) -> ReadoutsState:
        return ReadoutsState(self._walked, self._last, len(self._ours), self.T_map_truth)

    def restore(self, state: ReadoutsState) -> None:
        """Go back to a checkpoint, or forth again to one whose frames were not replaced since."""
        self._walked, self._last, self.T_map_truth = state.walked, state.last, state.T_map_truth
        self._theirs.go_to(state.compared)
        self._ours.go_to(state.compared)

    def row(self, result: StepResult) -> list[float]:
        """The readouts of one frame, in the order of SERIES. Call it once for every frame."""
        position = result.T_map_imu[:3, 3]
        if self._last is not None:
            self._walked += float(np.linalg.norm(position - self._last))
        self._last = position
        self.error = self._error(result.stamp_ns, position)
        state, ground, registration = result.state, result.ground, result.registration
        values = {
            "stamp_s": (result.stamp_ns - self._start_ns) * 1e-9,
            "planarity": ground.planarity,
            "seeds": ground.seeds,
            "ground_share": ground.share,
            "points_in": result.points_in,
            "points_reduced": result.points_reduced,
            "points_filter": result.points_filter,
            "iterations": registration.iterations,
            "used": registration.used,
            "inliers": registration.inliers,
            "residual_rms": registration.residual_rms,
            "degeneracy": registration.eigenvalues[0] if len(registration.eigenvalues) else np.nan,
            "imu_gap_s": result.imu_gap_s,
            "dropped": result.dropped,
            "speed": np.linalg.norm(state.v_odom_imu),
            "gyro_bias": np.linalg.norm(state.b_gyro),
            "accel_bias": np.linalg.norm(state.b_accel),
            "distance": self._walked,
            "error_m": self.error,
            **dict(zip(("turn_x", "turn_y", "turn_z"), lie.log(state.R_odom_imu), strict=True)),
        } | {f"{stage}_ms": ms for stage, ms in result.timings_ms.items()}
        return [float(values.get(name, np.nan)) for name in SERIES]

    def moved(self, positions: F64) -> None:
        """The walk so far was laid anew: (n, 3) positions of all frames in the map."""
        if self._truth is not None:
            self._ours.go_to(0)
            self._ours.extend(positions[: len(self._theirs)])

    def _error(self, stamp_ns: int, position: F64) -> float:
        """Distance to the truth (m), aligned to all positions so far; nan where there is none."""
        if self._truth is None:
            return float("nan")
        there = self._truth_at(stamp_ns)
        self._theirs.extend(np.full((1, 3), np.nan) if there is None else there[None])
        self._ours.extend(position[None])
        if there is None:
            return float("nan")
        known = np.isfinite(self._theirs.view()[:, 0])
        theirs, ours = self._theirs.view()[known], self._ours.view()[known]
        if np.linalg.norm(np.ptp(theirs, axis=0)) < LEAST_EXTENT_M:
            return float("nan")
        try:
            self.T_map_truth = umeyama(theirs, ours)
        except HemislamError:  # a straight line so far
            return float("nan")
        return float(np.linalg.norm(self.T_map_truth[:3, :3] @ there + self.T_map_truth[:3, 3] - position))

    def _truth_at(self, stamp_ns: int) -> F64 | None:
        """True position (3,), linearly between the poses around; None outside or in a gap."""
        truth = self._truth
        if truth is None or not truth.stamps_ns[0] <= stamp_ns <= truth.stamps_ns[-1]:
            return None
        right = max(1, int(np.searchsorted(truth.stamps_ns, stamp_ns)))
        before, after = int(truth.stamps_ns[right - 1]), int(truth.stamps_ns[right])
        if after - before > MAX_TRUTH_GAP_S * 1e9:
            return None
        fraction = (stamp_ns - before) / (after - before)
        position: F64 = (1 - fraction) * truth.positions[right - 1] + fraction * truth.positions[right]
        return position
