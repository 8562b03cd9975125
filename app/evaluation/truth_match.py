"""True poses brought into the clock, point and axes of the IMU.

What had to be assumed or estimated for that is returned in words, for the report.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from app.evaluation import alignment
from app.evaluation.truth import TruePoses
from app.slam.errors import HemislamError
from app.slam.metrics import alignment_doubt, interpolate, umeyama
from app.slam.trajectory import Trajectory
from app.slam.types import F64

ODD_AXES_DEG = 10.0
"""Orientations that differ from ours by a constant angle over this may be in other axes."""


@dataclass(frozen=True, slots=True)
class Matched:
    """Truth beside an estimate: T_world_imu in the recording's clock.

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
    """Bring the truth into the clock, point and axes of the estimate.

    Args:
        offset_s: time to add to the truth's stamps if its clock is its own; None: find it.

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
        notes.append("It holds no times: one pose was assigned to each frame.")
    stamps_ns = truth.stamps_ns
    assert stamps_ns is not None
    quaternions = truth.quaternions if truth.quaternions is not None else np.tile([0.0, 0.0, 0.0, 1.0], (len(truth), 1))
    there = Trajectory(stamps_ns, truth.positions, quaternions)

    if truth.own_clock and offset_s is not None:
        added_s = offset_s
    elif truth.own_clock:
        found = alignment.find_offset(estimate, there, by_rotation=truth.quaternions is not None)
        added_s = found.offset_s
        notes.append(
            f"Its clock is not the recording's: {added_s:+.3f} s were added, found by aligning the"
            f" {found.what} of both (correlation {found.correlation:.3f})."
        )
    there = replace(there, stamps_ns=stamps_ns + round(added_s * 1e9))
    lever = np.array(truth.lever)
    if truth.quaternions is None:
        there = _borrow_rotation(there, estimate)
        notes.append("It has no orientations: rotation errors cannot be measured.")
    if lever.any():
        there = replace(there, positions=there.positions - there.rotations.apply(lever))
        axes = "its body's axes" if truth.quaternions is not None else "the IMU's axes"
        notes.append(f"Its point lies {_vector(lever)} m from the IMU, in {axes}; this lever arm was subtracted.")
    has_rotation = truth.quaternions is not None
    if has_rotation:
        there, has_rotation, note = _common_axes(there, estimate, certainly=truth.own_axes)
        notes += [note] if note else []
    return Matched(there, has_rotation, added_s, tuple(notes))


def _borrow_rotation(there: Trajectory, estimate: Trajectory) -> Trajectory:
    """The truth with the orientations of the estimate, in the world of the truth, where both overlap in time."""
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


def _common_axes(there: Trajectory, estimate: Trajectory, *, certainly: bool) -> tuple[Trajectory, bool, str]:
    """The truth in the IMU's axes, by the mean rotation between both, if its axes `certainly` differ.

    Also returns whether the orientations are still the truth's own, and a note for the report.
    """
    theirs, usable = interpolate(there, estimate.stamps_ns)
    if len(theirs) < 3:
        return there, True, ""  # the metrics report it
    ours = estimate.chosen(usable)
    T = umeyama(ours.positions, theirs.positions)
    left = ours.positions @ T[:3, :3].T + T[:3, 3] - theirs.positions
    if doubt := alignment_doubt(theirs.positions, float(np.sqrt((left**2).sum(axis=1).mean()))):
        if not certainly:
            return there, True, ""
        why = f"Its axes are not the IMU's, and this trajectory does not determine the rotation between them. {doubt}"
        return _borrow_rotation(there, estimate), False, why
    R_truth_estimate = Rotation.from_matrix(T[:3, :3])
    between = theirs.rotations.inv() * R_truth_estimate * ours.rotations
    R_body_imu = between.mean()
    angle = float(np.degrees(R_body_imu.magnitude()))
    spread = float(np.degrees(np.median((R_body_imu.inv() * between).magnitude())))
    if not certainly:
        odd = angle > ODD_AXES_DEG and spread < angle / 3
        return (
            there,
            True,
            (
                f"Its orientations differ from ours by a constant {angle:.0f}°. Its axes may not be the IMU's; rotation"
                " errors and RPE then mean little."
                if odd
                else ""
            ),
        )
    return (
        replace(there, quaternions=(there.rotations * R_body_imu).as_quat()),
        True,
        f"Its axes are not the IMU's: the constant rotation between them ({angle:.1f}°) was estimated as the mean"
        f" over the trajectory (spread {spread:.2f}°) and removed, so rotation errors do not contain it.",
    )


def _vector(values: F64) -> str:
    return "(" + ", ".join(f"{value:+.3f}" for value in values) + ")"
