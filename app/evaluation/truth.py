"""True poses as they were read, and the checks that every one of them passes."""

from dataclasses import dataclass

import numpy as np

from app.slam.errors import HemislamError
from app.slam.trajectory import time_apart
from app.slam.types import F64, I64

JUMP_M, JUMP_M_S, JUMP_TIMES = 1.0, 15.0, 5.0
"""A step over both limits, and so many times faster than those around it, is a jump of the frame, not a motion."""


@dataclass(frozen=True, slots=True)
class TruePoses:
    """True poses as they were read.

    Attributes:
        source: file or topic. kind: what it is, in words.
        stamps_ns: (n,) strictly increasing; None: one pose for each frame of the recording.
        positions: (n, 3) m of the truth's point. quaternions: (n, 4) x y z w, T_world_body; None if unknown.
        own_clock: its stamps are not in the recording's clock.
        own_axes: the body's axes differ from the IMU's by a constant, unknown rotation.
        lever: (3,) m from the IMU to the truth's point, in the body's axes.
    """

    source: str
    kind: str
    stamps_ns: I64 | None
    positions: F64
    quaternions: F64 | None
    own_clock: bool = False
    own_axes: bool = False
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __len__(self) -> int:
        return len(self.positions)


def check(truth: TruePoses) -> None:
    """Raises HemislamError if it is too short, not finite, out of order, or jumps."""
    if len(truth) < 3:
        raise HemislamError(f"{truth.source} holds {len(truth)} poses; at least 3 are needed.")
    if not np.isfinite(truth.positions).all():
        raise HemislamError(f"{truth.source} holds NaN or infinity; remove those poses.")
    if truth.stamps_ns is None:
        return
    steps_s = np.diff(truth.stamps_ns) * 1e-9
    if (steps_s <= 0).any():
        row = int(np.argmax(steps_s <= 0)) + 1
        raise HemislamError(f"Time does not increase at pose {row + 1} of {truth.source}; sort it by time.")
    steps_m = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1)
    speeds = steps_m / steps_s
    around = np.lib.stride_tricks.sliding_window_view(np.pad(speeds, 3), 7)[:, [0, 1, 2, 4, 5, 6]].max(axis=1)
    jumps = np.flatnonzero((steps_m > JUMP_M) & (speeds > JUMP_M_S) & (speeds > JUMP_TIMES * around))
    if len(jumps):
        at, since = int(jumps[0]), (truth.stamps_ns - truth.stamps_ns[0]) * 1e-9
        raise HemislamError(
            f"The frame of {truth.source} jumps by {steps_m[at]:.1f} m within {steps_s[at]:.3g} s,"
            f" {since[at]:.1f} s after its start; cut it there and use one part."
        )


def check_overlap(truth: TruePoses, begin_ns: int, duration_s: float) -> None:
    """Raises HemislamError if truth and recording do not overlap in time."""
    if truth.stamps_ns is None or truth.own_clock:
        return
    if apart := time_apart(truth.source, truth.stamps_ns, begin_ns, duration_s):
        raise HemislamError(apart)
