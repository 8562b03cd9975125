"""What the session keeps of every processed frame, and the numbers that are plotted of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from app.slam import lie
from app.slam.metrics import GroundScore
from app.slam.types import F64, NON_GROUND, FrameStatus, StepResult

READOUTS = (
    "planarity", "seeds", "ground_share", "points_in", "points_reduced", "points_filter",
    "propagate_ms", "deskew_ms", "ground_ms", "downsample_ms", "update_ms", "insert_ms", "keyframe_ms", "loops_ms",
    "total_ms",
    "iterations", "used", "inliers", "residual_rms", "degeneracy", "predicted_change", "correction",
    "surprise", "imu_gap_s", "dropped", "clock_late_s", "position_sigma", "speed", "gyro_bias", "accel_bias",
    "turn_x", "turn_y", "turn_z",
)  # fmt: skip
"""Numbers of one frame, nan where there is none. `used` points were looked up in the map. `degeneracy` is the smallest
eigenvalue of the pose information. `predicted_change` and `correction`, of the velocity by the IMU and by the update,
are in m/s. `surprise` is as in `Registration`; `imu_gap_s`, `dropped`, `clock_late_s` and `position_sigma` are as in
`StepResult`. `speed` is in m/s. The biases are norms. `turn_*` is the rotation vector (rad) of R_odom_imu."""

FRAME = np.dtype(
    [
        ("stamp_ns", "i8"),
        ("keyframe", "?"),
        ("position", "f8", 3),
        ("quaternion", "f8", 4),
        ("readouts", "f8", len(READOUTS)),
    ]
)
"""The numbers of a `Frame` as a row of a table."""


@dataclass(frozen=True, slots=True)
class Frame:
    """A processed frame, without its points.

    Attributes:
        stamp_ns: end of its scan. keyframe: whether it became a keyframe.
        position: (3,) and quaternion: (4,), x, y, z, w, of T_odom_imu. readouts: (len(READOUTS),).
        status, notices: as in `StepResult`. points, ground_points: of its cloud.
        ground_score: of its labels, if the true ones are known.
        dropped: why scans between the frame before and this one were dropped, one reason each.
    """

    stamp_ns: int
    keyframe: bool
    position: F64
    quaternion: F64
    readouts: F64
    status: FrameStatus = FrameStatus.TRACKING
    notices: tuple[str, ...] = ()
    points: int = 0
    ground_points: int = 0
    ground_score: GroundScore | None = None
    dropped: tuple[str, ...] = ()

    @classmethod
    def of(cls, result: StepResult, dropped: tuple[str, ...] = ()) -> "Frame":
        T_odom_imu, labels, true_labels = result.state.T_odom_imu, result.cloud.labels, result.truth_ground
        return cls(
            stamp_ns=result.stamp_ns,
            keyframe=result.keyframe is not None,
            position=T_odom_imu[:3, 3].copy(),
            quaternion=lie.quaternion(T_odom_imu[:3, :3]),
            readouts=_readouts(result),
            status=result.status,
            notices=result.notices,
            points=len(labels),
            ground_points=int(np.count_nonzero(labels != NON_GROUND)),
            ground_score=None if true_labels is None else GroundScore.of(labels, true_labels),
            dropped=dropped,
        )


def as_table(frames: Sequence[Frame]) -> np.ndarray:
    """(n,) of type `FRAME`."""
    return np.array([(f.stamp_ns, f.keyframe, f.position, f.quaternion, f.readouts) for f in frames], dtype=FRAME)


def _readouts(result: StepResult) -> F64:
    state, ground, registration = result.state, result.ground, result.registration
    values = {
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
        "predicted_change": registration.predicted_change,
        "correction": registration.correction,
        "surprise": registration.surprise,
        "degeneracy": registration.eigenvalues[0] if len(registration.eigenvalues) else np.nan,
        "imu_gap_s": result.imu_gap_s,
        "dropped": result.dropped,
        "clock_late_s": result.clock_late_s,
        "position_sigma": result.position_sigma,
        "speed": np.linalg.norm(state.v_odom_imu),
        "gyro_bias": np.linalg.norm(state.b_gyro),
        "accel_bias": np.linalg.norm(state.b_accel),
        **dict(zip(("turn_x", "turn_y", "turn_z"), lie.log(state.R_odom_imu), strict=True)),
    } | {f"{stage}_ms": ms for stage, ms in result.timings_ms.items()}
    return np.array([values.get(name, np.nan) for name in READOUTS], dtype=np.float64)
