"""Poses over time, and their TUM text files: `stamp x y z qx qy qz qw` with stamps in seconds."""

from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from app.slam.errors import HemislamError
from app.slam.text_files import beside, is_file
from app.slam.types import F64, I64
from app.slam.user_text import as_numbers, read_rows


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses T_world_imu over time.

    Attributes:
        stamps_ns: (n,) int64, strictly increasing.
        positions: (n, 3) float64, m.
        quaternions: (n, 4) float64, unit, in the order x, y, z, w.
    """

    stamps_ns: I64
    positions: F64
    quaternions: F64

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def distance(self) -> float:
        """Length of the path, m."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

    @property
    def rotations(self) -> Rotation:
        rotations: Rotation = Rotation.from_quat(self.quaternions)
        return rotations

    @property
    def poses(self) -> F64:
        """(n, 4, 4) T_world_imu."""
        poses = np.tile(np.eye(4), (len(self), 1, 1))
        if len(self):
            poses[:, :3, :3] = self.rotations.as_matrix()
        poses[:, :3, 3] = self.positions
        return poses

    def chosen(self, which: npt.NDArray[np.bool_]) -> "Trajectory":
        """Only the poses where `which` (n,) is true."""
        return Trajectory(self.stamps_ns[which], self.positions[which], self.quaternions[which])

    @classmethod
    def from_poses(cls, stamps_ns: npt.ArrayLike, poses: npt.ArrayLike) -> "Trajectory":
        """From (n, 4, 4) matrices T_world_imu."""
        matrices = np.asarray(poses, dtype=np.float64).reshape(-1, 4, 4)
        quaternions = np.zeros((0, 4)) if not len(matrices) else Rotation.from_matrix(matrices[:, :3, :3]).as_quat()
        return cls(np.asarray(stamps_ns, dtype=np.int64), matrices[:, :3, 3].copy(), quaternions)


_LAYOUT = "a trajectory holds lines of `stamp x y z qx qy qz qw`"


def read_tum(path: Path) -> Trajectory:
    """Read `stamp x y z qx qy qz qw` lines; `#` begins a comment. Stamps are exact to the last digit written.

    Raises:
        HemislamError: the file cannot be read, a line is not eight finite numbers, a quaternion has no unit length,
            time does not increase, or there are fewer than 3 poses.
    """
    rows = read_rows(path, _LAYOUT)
    table = as_numbers(path, rows, 8, _LAYOUT)
    if len(rows) < 3:
        raise HemislamError(f"{path} holds {count_text(len(rows))}, but at least 3 are needed to compare a trajectory.")
    if (beyond := np.abs(table[:, 0]) >= 2**63 * 1e-9).any():
        number, words = rows[int(np.argmax(beyond))]
        raise HemislamError(f"{path}, line {number}: the stamp {words[0]} is not in seconds; divide the first column.")
    lengths = np.linalg.norm(table[:, 4:], axis=1, keepdims=True)
    if (odd := np.abs(lengths[:, 0] - 1) > 0.01).any():
        raise HemislamError(
            f"{path}, line {rows[int(np.argmax(odd))][0]}: the last four columns are not a unit quaternion; {_LAYOUT}."
        )
    stamps_ns = np.array([int(Decimal(words[0]).scaleb(9).to_integral_value()) for _, words in rows], dtype=np.int64)
    if (late := np.diff(stamps_ns) <= 0).any():
        number = rows[int(np.argmax(late)) + 1][0]
        raise HemislamError(
            f"{path}, line {number}: the time does not increase; sort the file by time and remove duplicates."
        )
    return Trajectory(stamps_ns, table[:, 1:4].copy(), table[:, 4:] / lengths)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory, stamps and values with 9 decimals; equal trajectories give equal bytes."""
    path.write_text("".join(f"{line}\n" for line in tum_lines(trajectory)), encoding="utf-8")


def tum_lines(trajectory: Trajectory) -> list[str]:
    """One line per pose. w >= 0, so that each rotation is written in one way."""
    quaternions = np.where(trajectory.quaternions[:, 3:] < 0, -trajectory.quaternions, trajectory.quaternions)
    values = np.hstack([trajectory.positions, quaternions]) + 0.0  # no "-0.000000000"
    return [
        f"{stamp_text(int(stamp))} " + " ".join(f"{value:.9f}" for value in row)
        for stamp, row in zip(trajectory.stamps_ns, values, strict=True)
    ]


def stamp_text(stamp_ns: int) -> str:
    """Nanoseconds as seconds with 9 decimals, exactly."""
    sign, value = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    return f"{sign}{value // 1_000_000_000}.{value % 1_000_000_000:09d}"


def truth_beside(recording: Path) -> Path | None:
    """The truth file beside a recording, `<name>_truth.tum`, if there is one."""
    truth = beside(recording, "_truth.tum")
    return truth if is_file(truth) else None


def time_apart(source: Path | str, stamps_ns: I64, begin_ns: int, duration_s: float) -> str:
    """A sentence that says so if poses and a recording do not overlap in time; otherwise "".

    Args:
        source: of the poses, for the sentence. stamps_ns: (n,), increasing.
    """
    first, last = stamps_ns[0] * 1e-9, stamps_ns[-1] * 1e-9
    begin, end = begin_ns * 1e-9, begin_ns * 1e-9 + duration_s
    if begin <= last and first <= end:
        return ""
    return (
        f"{source} covers {first:.1f} s to {last:.1f} s, but the recording {begin:.1f} s to {end:.1f} s;"
        " both must be stamped by the same clock, in seconds."
    )


def count_text(poses: int) -> str:
    """A number of poses in words, for a sentence."""
    return {0: "no pose", 1: "1 pose"}.get(poses, f"{poses} poses")
