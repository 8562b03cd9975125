"""Truth from text files: TUM, KITTI, and the GNSS/INS table of H2LID."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from app.evaluation.truth import Truth
from app.slam.errors import HemislamError
from app.slam.trajectory import read_tum
from app.slam.types import F64, I64

GNSS_COLUMNS = 13
H2LID_LEVER = (-0.034, -0.283, 0.342)
"""m from the IMU to the GNSS antenna; x right, y forward, z up (README of the data set)."""
_FORMATS = (
    "TUM has 8 columns (stamp x y z qx qy qz qw), KITTI 12 (a 3x4 matrix), the GNSS/INS table of H2LID 13"
    " (GPSTime Easting Northing Height Heading Pitch Roll Latitude Longitude VEast VNorth VUp Q)"
)


def read_file(path: Path) -> Truth:
    """Read a truth file; its format is told by the number of columns.

    Raises:
        HemislamError: it can not be read, or is none of the formats, or holds NaN.
    """
    rows = _rows(path, _FORMATS)
    if rows and rows[0][1][0].lower().startswith("gpstime"):
        rows = rows[1:]  # the table's heading
    if not rows:
        raise HemislamError(f"The truth {path} holds no poses; {_FORMATS}.")
    columns = len(rows[0][1])
    if columns == 8:
        trajectory = read_tum(path)
        return Truth(f"The truth {path}", "TUM", trajectory.stamps_ns, trajectory.positions, trajectory.quaternions)
    if columns == 12:
        return _kitti(path, _numbers(path, rows, 12))
    if columns == GNSS_COLUMNS:
        return _gnss(path, _numbers(path, rows, GNSS_COLUMNS))
    raise HemislamError(f"{path}, line {rows[0][0]} has {columns} columns; {_FORMATS}.")


def _rows(path: Path, should: str) -> list[tuple[int, list[str]]]:
    """Number and words of each line that is not empty, less comments.

    Args:
        should: how such a file is to be, for the sentence about one that is no text.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise HemislamError(f"The truth {path} is not a text file; {should}.") from None
    except OSError as error:
        raise HemislamError(f"The truth {path} can not be read: {error.strerror}; check the path.") from None
    rows = [(number, line.partition("#")[0].split()) for number, line in enumerate(lines, 1)]
    return [(number, words) for number, words in rows if words]


def _numbers(path: Path, rows: list[tuple[int, list[str]]], columns: int) -> F64:
    """(n, columns). Raises HemislamError naming the line that is not so many finite numbers."""
    table = np.empty((len(rows), columns))
    for index, (number, words) in enumerate(rows):
        if len(words) != columns:
            raise HemislamError(f"{path}, line {number} has {len(words)} columns, the first has {columns}; mend it.")
        try:
            table[index] = [float(word) for word in words]
        except ValueError:
            raise HemislamError(f"{path}, line {number} holds something that is not a number; remove it.") from None
        if not np.isfinite(table[index]).all():
            raise HemislamError(f"{path}, line {number} holds NaN or infinity; remove the line.")
    return table


def _kitti(path: Path, table: F64) -> Truth:
    """Rows of a 3x4 matrix T_world_body; their times from `times.txt` or `<stem>_times.txt` beside, if there."""
    poses = table.reshape(-1, 3, 4)
    rotations = poses[:, :, :3]
    odd = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) > 0.01
    odd |= np.linalg.det(rotations) < 0
    if odd.any():
        raise HemislamError(
            f"{path}, pose {int(np.argmax(odd)) + 1}: the left 3x3 of its 3x4 matrix is no rotation; KITTI's rows are"
            " r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz."
        )
    stamps = None
    for beside in (path.with_name(f"{path.stem}_times.txt"), path.with_name("times.txt")):
        if beside.is_file():
            stamps = _times(beside, len(poses))
            break
    quaternions = Rotation.from_matrix(rotations).as_quat()
    # Times that count from zero are no date: the clock is the truth's own.
    own = stamps is not None and bool(stamps[0] < 1e17)
    return Truth(f"The truth {path}", "KITTI", stamps, poses[:, :, 3].copy(), quaternions, own_clock=own)


def _times(path: Path, poses: int) -> I64:
    should = "it holds one time a line, in seconds"
    rows = _rows(path, should)
    if odd := next((number for number, words in rows if len(words) != 1), None):
        raise HemislamError(f"{path}, line {odd} is no time; {should}.")
    seconds = _numbers(path, rows, 1)[:, 0]
    if len(seconds) != poses:
        raise HemislamError(f"{path} holds {len(seconds)} times for {poses} poses; there must be one a pose.")
    return np.rint(seconds * 1e9).astype(np.int64)


def _gnss(path: Path, table: F64) -> Truth:
    """Seconds of the GPS week, grid coordinates, and heading (clockwise from north), pitch, roll in degrees.

    The body has x right, y forward, z up; the world is east, north, up.
    """
    seconds, positions, (heading, pitch, roll) = table[:, 0], table[:, 1:4], table[:, 4:7].T
    if (seconds < 0).any() or (seconds > 604_800).any():
        raise HemislamError(f"The first column of {path} is not in seconds of the GPS week (0 to 604800).")
    rotations = Rotation.from_euler("ZXY", np.column_stack([-heading, pitch, roll]), degrees=True)
    return Truth(
        f"The truth {path}",
        "GNSS/INS (seconds of the GPS week, grid coordinates)",
        np.rint(seconds * 1e9).astype(np.int64),
        positions - positions[0],  # grid coordinates are millions of metres
        rotations.as_quat(),
        own_clock=True,
        own_axes=True,
        lever=H2LID_LEVER,
    )
