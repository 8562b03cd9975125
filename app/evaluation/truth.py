"""True poses from wherever they come, brought into the clock, point and axes of the IMU.

`read_truth` reads and checks what there is, without the estimate; `match` brings it beside one.
What had to be assumed or estimated on the way is said in words, for the report.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from app.evaluation import alignment
from app.slam.errors import HemislamError
from app.slam.metrics import alignment_doubt, interpolate, umeyama
from app.slam.trajectory import Trajectory, read_tum, time_apart
from app.slam.types import F64, I64

JUMP_M, JUMP_M_S, JUMP_TIMES = 1.0, 15.0, 5.0
"""A step over both, and so many times faster than those around it, is no motion of a body but of its frame."""
ODD_AXES_DEG = 10.0


@dataclass(frozen=True, slots=True)
class Truth:
    """True poses as they were read.

    Attributes:
        source: file or topic. kind: what it is, in words.
        stamps_ns: (n,) strictly increasing; None: one pose for each frame of the recording.
        positions: (n, 3) m of the truth's point. quaternions: (n, 4) x y z w, T_world_body; None if unknown.
        own_clock: its stamps are not those of the recording.
        own_axes: the body's axes are not the IMU's; the rotation between them is constant and unknown.
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


@dataclass(frozen=True, slots=True)
class Matched:
    """Truth beside an estimate: T_world_imu in the recording's clock.

    Attributes:
        has_rotation: whether orientations are the truth's own, in known axes; if not they are the
            estimate's, so that motions can be compared, and rotation errors mean nothing.
        offset_s: what was added to the truth's stamps. notes: what was assumed or estimated.
    """

    trajectory: Trajectory
    has_rotation: bool
    offset_s: float
    notes: tuple[str, ...]


def read_truth(text: str, recording: Path | None = None, lever: tuple[float, float, float] | None = None) -> Truth:
    """Read a file, or `topic:/name` in the recording; `lever` overrules what the format implies.

    Raises:
        HemislamError: it can not be read, is not what it should be, or jumps.
    """
    from app.evaluation import truth_files, truth_topics

    if text.startswith("topic:"):
        if recording is None:
            raise HemislamError(f"`--truth {text}` names a topic, but there is no recording to read it from.")
        truth = truth_topics.read_topic(recording, text.removeprefix("topic:"))
    else:
        truth = truth_files.read_file(Path(text))
    if lever is not None:
        truth = replace(truth, lever=lever)
    _check(truth)
    return truth


def read_poses(path: Path) -> Trajectory:
    """Poses of the IMU itself, as TUM, where no other truth is taken. Raises HemislamError as `read_truth`."""
    poses = read_tum(path)
    _check(Truth(f"The truth {path}", "TUM", poses.stamps_ns, poses.positions, poses.quaternions))
    return poses


def match(truth: Truth, estimate: Trajectory, offset_s: float | None = None) -> Matched:
    """Bring the truth into the clock, point and axes of the estimate.

    Args:
        offset_s: to be added to the truth's stamps if its clock is its own; None: find it.

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
        notes.append("It holds no times: its poses were taken one for each frame.")
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
        notes.append("It has no orientations: rotation errors can not be told.")
    if lever.any():
        there = replace(there, positions=there.positions - there.rotations.apply(lever))
        axes = "its body's axes" if truth.quaternions is not None else "the IMU's axes"
        notes.append(f"Its point lies {_vector(lever)} m from the IMU, in {axes}; this lever arm was taken off.")
    has_rotation = truth.quaternions is not None
    if has_rotation:
        there, has_rotation, note = _common_axes(there, estimate, certainly=truth.own_axes)
        notes += [note] if note else []
    return Matched(there, has_rotation, added_s, tuple(notes))


def _check(truth: Truth) -> None:
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


def check_overlap(truth: Truth, begin_ns: int, duration_s: float) -> None:
    """Better now than after a long run. Raises HemislamError if truth and recording share no time."""
    if truth.stamps_ns is None or truth.own_clock:
        return
    if apart := time_apart(truth.source, truth.stamps_ns, begin_ns, duration_s):
        raise HemislamError(apart)


def _borrow_rotation(there: Trajectory, estimate: Trajectory) -> Trajectory:
    """The truth with the estimate's orientations, turned into its world; only where the estimate has some."""
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
    """The truth turned into the IMU's axes by the mean rotation between both, if they are `certainly` others.

    Also whether its orientations are still its own, and what is to be said of it.
    """
    theirs, usable = interpolate(there, estimate.stamps_ns)
    if len(theirs) < 3:
        return there, True, ""  # the metrics will say so
    ours = estimate.chosen(usable)
    T = umeyama(ours.positions, theirs.positions)
    left = ours.positions @ T[:3, :3].T + T[:3, 3] - theirs.positions
    if doubt := alignment_doubt(theirs.positions, float(np.sqrt((left**2).sum(axis=1).mean()))):
        if not certainly:
            return there, True, ""
        why = f"Its axes are not the IMU's, and this walk does not tell the rotation between them. {doubt}"
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
                f"Its orientations differ from ours by a constant {angle:.0f}°; its axes may not be the IMU's, and then"
                " rotation errors and RPE mean little."
                if odd
                else ""
            ),
        )
    return (
        replace(there, quaternions=(there.rotations * R_body_imu).as_quat()),
        True,
        f"Its axes are not the IMU's: the constant rotation between them ({angle:.1f}°) was estimated as the mean"
        f" over the walk (spread {spread:.2f}°) and taken off, so rotation errors do not hold it.",
    )


def _vector(values: F64) -> str:
    return "(" + ", ".join(f"{value:+.3f}" for value in values) + ")"
