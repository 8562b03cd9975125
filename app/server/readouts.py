"""The numbers the page plots for every frame, and the error to the truth while walking."""

from dataclasses import dataclass

import numpy as np

from app.server.protocol import SERIES
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.metrics import MAX_TRUTH_GAP_S, umeyama
from app.slam.rows import table
from app.slam.trajectory import Trajectory
from app.slam.types import F64, I64, StepResult

LEAST_EXTENT_M = 0.5
"""Truth is aligned once the walk spans this much; before, any noise would fit."""


@dataclass(frozen=True, slots=True)
class ReadoutsState:
    """What `Readouts.restore` needs beside the positions, which the readouts keep."""

    walked: float
    last: F64 | None


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
        self._theirs, self._ours = table(3), table(3)  # row by frame; theirs is nan where there is no truth
        self.T_map_truth: F64 | None = None
        self.error = float("nan")

    def checkpoint(self) -> ReadoutsState:
        return ReadoutsState(self._walked, self._last)

    def restore(self, state: ReadoutsState, frames: int) -> None:
        """Go back to a checkpoint at so many frames, or forth again to one whose frames were not replaced since."""
        self._walked, self._last = state.walked, state.last
        if self._truth is not None:
            self._theirs.go_to(frames)
            self._ours.go_to(frames)
            self.T_map_truth = None
            self._align()

    def compare(self, truth: Trajectory | None, walk: Trajectory, frames: int) -> F64:
        """Take another truth, or none, from now on.

        Args:
            walk: in the map, of all frames that are known. frames: how many of them there are now; the truth is
                aligned to these.

        Returns:
            (n,) m, distance of every known frame to it; nan where there is none.
        """
        self._truth = truth
        self._theirs, self._ours = table(3), table(3)
        self.T_map_truth, self.error = None, float("nan")
        if truth is None:
            return np.full(len(walk), np.nan)
        self._theirs.extend(self._truth_at(walk.stamps_ns))
        self._ours.extend(walk.positions)
        for rows in (self._theirs, self._ours):
            rows.go_to(frames)
        self._align()
        for rows in (self._theirs, self._ours):
            rows.go_to(len(walk))
        errors = self._distances()
        for rows in (self._theirs, self._ours):
            rows.go_to(frames)
        self.error = float(errors[frames - 1]) if frames else float("nan")
        return errors

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
        self._theirs.extend(self._truth_at(np.array([stamp_ns])))
        self._ours.extend(position[None])
        return float(self._distances(len(self._ours) - 1)[0]) if self._align() else float("nan")

    def _align(self) -> bool:
        """Lay the truth over the positions so far, if they determine how."""
        known = np.isfinite(self._theirs.view()[:, 0])
        theirs, ours = self._theirs.view()[known], self._ours.view()[known]
        if not len(theirs) or np.linalg.norm(np.ptp(theirs, axis=0)) < LEAST_EXTENT_M:
            return False
        try:
            self.T_map_truth = umeyama(theirs, ours)
        except HemislamError:  # a straight line so far
            return False
        return True

    def _distances(self, first: int = 0) -> F64:
        """(n - first,) m, of the frames from `first` on to the truth as it lies; nan where there is none."""
        theirs, ours = self._theirs.view()[first:], self._ours.view()[first:]
        if self.T_map_truth is None:
            return np.full(len(ours), np.nan)
        laid = theirs @ self.T_map_truth[:3, :3].T + self.T_map_truth[:3, 3]
        return np.asarray(np.linalg.norm(laid - ours, axis=1))

    def _truth_at(self, stamps_ns: I64) -> F64:
        """(n, 3) true positions, linearly between the poses around; nan outside of them and in gaps."""
        truth = self._truth
        assert truth is not None
        right = np.searchsorted(truth.stamps_ns, stamps_ns).clip(1, len(truth) - 1)
        before, after = truth.stamps_ns[right - 1], truth.stamps_ns[right]
        fraction = ((stamps_ns - before) / (after - before))[:, None]
        positions: F64 = (1 - fraction) * truth.positions[right - 1] + fraction * truth.positions[right]
        outside = (stamps_ns < truth.stamps_ns[0]) | (stamps_ns > truth.stamps_ns[-1])
        positions[outside | (after - before > MAX_TRUTH_GAP_S * 1e9)] = np.nan
        return positions
