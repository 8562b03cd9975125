"""The frames of a session up to some moment, as reports and result files need them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from app.slam.frames import READOUTS, Frame, as_table
from app.slam.metrics import GroundScore
from app.slam.params import Params
from app.slam.trajectory import Trajectory
from app.slam.types import F64, I64, TIMINGS, FrameStatus

MOST_NOTICES = 200


@dataclass(frozen=True, slots=True)
class RunInfo:
    """What a run was made from.

    Attributes:
        recording: the input. params: as used last. start_s, duration_s: the part asked for.
        truth: to compare with. truth_path: its file.
        stopped: why the run ended before the recording did, in a sentence; "" if it did not.
        calibration: what the recording shows about its mounting, in a sentence; "" if nothing.
    """

    recording: Path
    params: Params
    start_s: float = 0.0
    duration_s: float | None = None
    truth: Trajectory | None = None
    truth_path: Path | None = None
    stopped: str = ""
    calibration: str = ""


@dataclass(frozen=True)
class RunLog:
    """The frames of a session up to some moment, as results need them. Arrays are read-only.

    Attributes:
        frames: in order. dropped_since: why scans after the last of them were dropped.
    """

    frames: Sequence[Frame]
    dropped_since: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.frames)

    @cached_property
    def _table(self) -> np.ndarray:
        table = as_table(self.frames)
        table.setflags(write=False)
        return table

    @property
    def stamps_ns(self) -> I64:
        """(n,) scan ends."""
        stamps_ns: I64 = self._table["stamp_ns"]
        return stamps_ns

    @property
    def timings_ms(self) -> F64:
        """(n, len(TIMINGS)) milliseconds; 0 for a stage that a frame did not have."""
        columns = [READOUTS.index(f"{stage}_ms") for stage in TIMINGS]
        return np.asarray(np.nan_to_num(self._table["readouts"][:, columns]))

    def readout(self, name: str) -> F64:
        """(n,) one of `READOUTS`; nan where there is none."""
        return np.asarray(self._table["readouts"][:, READOUTS.index(name)])

    def imu_gaps_s(self, least_s: float) -> list[float]:
        """s, how long each gap in the IMU lasted, of those longer than `least_s`; gaps in adjacent frames count as one,
        as long as the longest."""
        gaps = self.readout("imu_gap_s")
        inside = gaps > least_s
        begins = np.flatnonzero(inside & ~np.r_[False, inside[:-1]])
        return np.maximum.reduceat(np.where(inside, gaps, 0.0), begins).tolist() if len(begins) else []

    @property
    def odometry(self) -> Trajectory:
        """T_odom_imu at every scan's end; the origin while the filter waits at rest to start."""
        return Trajectory(self.stamps_ns, self._table["position"], self._table["quaternion"])

    @cached_property
    def statuses(self) -> Counter[FrameStatus]:
        return Counter(frame.status for frame in self.frames)

    @cached_property
    def dropped(self) -> Counter[str]:
        """Scans that were not processed, by reason."""
        return Counter([*(reason for frame in self.frames for reason in frame.dropped), *self.dropped_since])

    @cached_property
    def notices(self) -> Counter[str]:
        """How often each notice was given, of the first `MOST_NOTICES` different ones."""
        notices = Counter[str]()
        for notice in (notice for frame in self.frames for notice in frame.notices):
            if notice in notices or len(notices) < MOST_NOTICES:
                notices[notice] += 1
        return notices

    @property
    def ground_share(self) -> float | None:
        """Share of all points that are ground, 0-1; None without a point."""
        points = sum(frame.points for frame in self.frames)
        return sum(frame.ground_points for frame in self.frames) / points if points else None

    @property
    def ground_score(self) -> GroundScore | None:
        """Of all frames whose true labels are known."""
        scores = [frame.ground_score for frame in self.frames if frame.ground_score is not None]
        return sum(scores[1:], scores[0]) if scores else None
