"""True poses from files (TUM, KITTI, the GNSS/INS table of H2LID) and from topics of a recording, checked."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from app.sensors.navsat import NAVSAT, fix_of
from app.sensors.source import Source
from app.slam.errors import HemislamError
from app.slam.trajectory import read_tum, time_apart
from app.slam.types import F64, I64
from app.slam.user_text import as_numbers, read_rows

JUMP_M, JUMP_M_S, JUMP_TIMES = 1.0, 15.0, 5.0
"""A step beyond both limits, and this many times faster than its neighbours, is a jump of the frame, not motion."""
GNSS_COLUMNS = 13
H2LID_LEVER = (-0.034, -0.283, 0.342)
"""m from the IMU to the GNSS antenna; x right, y forward, z up (README of the data set)."""
_FORMATS = (
    "TUM has 8 columns (stamp x y z qx qy qz qw), KITTI 12 (a 3x4 matrix), the GNSS/INS table of H2LID 13"
    " (GPSTime Easting Northing Height Heading Pitch Roll Latitude Longitude VEast VNorth VUp Q)"
)

_POSES: dict[str, Callable[[Any], Any]] = {
    "nav_msgs/msg/Odometry": lambda message: message.pose.pose,
    "geometry_msgs/msg/PoseStamped": lambda message: message.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: message.pose.pose,
}
TYPES = (*_POSES, NAVSAT)


@dataclass(frozen=True, slots=True)
class TruePoses:
    """True poses as read from a file or topic.

    Attributes:
        source: file or topic. kind: a description.
        stamps_ns: (n,) strictly increasing; None: one pose for each frame of the recording.
        positions: (n, 3) m of the truth's point. quaternions: (n, 4) x y z w, T_world_body; None if unknown.
        own_clock: whether its stamps are in a clock other than the recording's.
        own_axes: whether the body's axes differ from the IMU's by a constant, unknown rotation.
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

    @property
    def description(self) -> str:
        """In a sentence; whether a lever arm was removed, the notes of `match` say."""
        point = "" if any(self.lever) else " of a point taken as the IMU's own (no lever arm)"
        return f"{self.source}: {self.kind}, {len(self)} poses{point}."


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


def read_truth(text: str, recording: Path | None = None, lever: tuple[float, float, float] | None = None) -> TruePoses:
    """Read a file, or `topic:/name` in the recording; `lever` replaces the lever arm that the format implies.

    Raises:
        HemislamError: it cannot be read, has the wrong format, or jumps; or the lever arm is not finite.
    """
    if text.startswith("topic:"):
        if recording is None:
            raise HemislamError(
                f"`{text}` names a topic, but there is no recording to read it from; give a file of poses."
            )
        truth = _read_topic(recording, text.removeprefix("topic:"))
    else:
        truth = _read_file(Path(text))
    if lever is not None:
        if not np.isfinite(lever).all():
            raise HemislamError(f"The lever arm cannot be {lever}; give three numbers in metres.")
        truth = replace(truth, lever=lever)
    check(truth)
    return truth


def check_poses(path: Path) -> None:
    """Raises HemislamError like `read_truth` if this is not a TUM file with plausible poses."""
    check(_tum(path))


def _read_file(path: Path) -> TruePoses:
    """Read a truth file. Its number of columns determines its format.

    Raises:
        HemislamError: it cannot be read, has none of the formats, or holds NaN.
    """
    rows = read_rows(path, _FORMATS)
    if rows and rows[0][1][0].lower().startswith("gpstime"):
        rows = rows[1:]  # the table's heading
    if not rows:
        raise HemislamError(f"The truth {path} holds no poses; {_FORMATS}.")
    columns = len(rows[0][1])
    if columns == 8:
        return _tum(path)
    if columns == 12:
        return _kitti(path, as_numbers(path, rows, 12, _FORMATS))
    if columns == GNSS_COLUMNS:
        return _gnss(path, as_numbers(path, rows, GNSS_COLUMNS, _FORMATS))
    raise HemislamError(f"{path}, line {rows[0][0]} has {columns} columns; {_FORMATS}.")


def _tum(path: Path) -> TruePoses:
    poses = read_tum(path)
    return TruePoses(f"The truth {path}", "TUM", poses.stamps_ns, poses.positions, poses.quaternions)


def _kitti(path: Path, table: F64) -> TruePoses:
    """Rows of a 3x4 matrix T_world_body. Their times are in `<stem>_times.txt` or `times.txt` beside it, if any."""
    poses = table.reshape(-1, 3, 4)
    rotations = poses[:, :, :3]
    odd = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) > 0.01
    odd |= np.linalg.det(rotations) < 0
    if odd.any():
        raise HemislamError(
            f"{path}, pose {int(np.argmax(odd)) + 1}: the left 3x3 of its 3x4 matrix is not a rotation; KITTI's rows"
            " are r11 r12 r13 tx r21 r22 r23 ty r31 r32 r33 tz."
        )
    stamps = None
    for beside in (path.with_name(f"{path.stem}_times.txt"), path.with_name("times.txt")):
        if beside.is_file():
            stamps = _times(beside, len(poses))
            break
    quaternions = Rotation.from_matrix(rotations).as_quat()
    # Times that count from zero are not dates: the truth has its own clock.
    own = stamps is not None and bool(stamps[0] < 1e17)
    return TruePoses(f"The truth {path}", "KITTI", stamps, poses[:, :, 3].copy(), quaternions, own_clock=own)


def _times(path: Path, poses: int) -> I64:
    layout = "it holds one time per line, in seconds"
    seconds = as_numbers(path, read_rows(path, layout), 1, layout)[:, 0]
    if len(seconds) != poses:
        raise HemislamError(f"{path} holds {len(seconds)} times for {poses} poses; there must be one per pose.")
    if (np.abs(seconds) >= 2**63 * 1e-9).any():
        raise HemislamError(f"{path} holds a time that is not in seconds; divide them all.")
    return np.rint(seconds * 1e9).astype(np.int64)


def _gnss(path: Path, table: F64) -> TruePoses:
    """Seconds of the GPS week, grid coordinates, and heading (clockwise from north), pitch, roll in degrees.

    The body has x right, y forward, z up; the world is east, north, up.
    """
    seconds, positions, (heading, pitch, roll) = table[:, 0], table[:, 1:4], table[:, 4:7].T
    if (seconds < 0).any() or (seconds > 604_800).any():
        raise HemislamError(f"The first column of {path} is not in seconds of the GPS week (0 to 604800).")
    rotations = Rotation.from_euler("ZXY", np.column_stack([-heading, pitch, roll]), degrees=True)
    return TruePoses(
        f"The truth {path}",
        "GNSS/INS (seconds of the GPS week, grid coordinates)",
        np.rint(seconds * 1e9).astype(np.int64),
        positions - positions[0],  # grid coordinates are millions of metres
        rotations.as_quat(),
        own_clock=True,
        own_axes=True,
        lever=H2LID_LEVER,
    )


def _read_topic(recording: Path, topic: str) -> TruePoses:
    """All poses of a topic.

    Raises:
        HemislamError: there is no such topic, or it holds no poses.
    """
    with Source(recording) as source:
        kinds = {entry.name: entry.type for entry in source.topics}
        if topic not in kinds:
            usable = [name for name, kind in kinds.items() if kind in TYPES]
            hint = f"it has {', '.join(usable)}" if usable else "none of its topics holds poses or fixes"
            raise HemislamError(f"{recording} has no topic {topic} to take as truth; {hint}.")
        kind = kinds[topic]
        if kind not in TYPES:
            raise HemislamError(
                f"Topic {topic} is of type {kind}, which is not a truth; use one of type {', '.join(TYPES)}."
            )
        stamps, rows = [], []
        for _, message in source.readable(topic):
            row = fix_of(message).places[0] if kind == NAVSAT else _pose(_POSES[kind](message))
            if kind != NAVSAT or np.isfinite(row).all():
                stamps.append(message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec)
                rows.append(row)
    table = np.array(rows, dtype=np.float64)
    stamps_ns = np.array(stamps, dtype=np.int64)
    name = f"Topic {topic}"
    if not len(table):
        raise HemislamError(f"Topic {topic} of {recording} holds no usable pose.")
    if kind == NAVSAT:
        return TruePoses(name, "satellite fixes", stamps_ns, _east_north_up(table), None)
    lengths = np.linalg.norm(table[:, 3:], axis=1)
    if not (np.abs(lengths - 1) <= 0.01).all():  # also refuses nan
        raise HemislamError(
            f"Topic {topic} holds orientations that are not unit quaternions; it cannot be used as truth."
        )
    return TruePoses(name, "poses of a topic", stamps_ns, table[:, :3], table[:, 3:], own_axes=True)


def _pose(pose: Any) -> list[float]:
    p, q = pose.position, pose.orientation
    return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]


def _east_north_up(fixes: F64) -> F64:
    """Convert geodetic (n, 3) degrees, degrees, m on WGS84 to metres east, north, up from the first position."""
    latitude, longitude, height = fixes[0].tolist()
    local = f"+proj=topocentric +ellps=WGS84 +lat_0={latitude!r} +lon_0={longitude!r} +h_0={height!r}"
    import pyproj

    pipeline = pyproj.Transformer.from_pipeline(f"+proj=pipeline +step +proj=cart +ellps=WGS84 +step {local}")
    return np.column_stack(pipeline.transform(fixes[:, 1], fixes[:, 0], fixes[:, 2]))
