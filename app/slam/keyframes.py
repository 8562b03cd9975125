"""Keyframes: which frames become one, and their store on disk, so that memory does not grow.

They are immutable and only ever appended, so a checkpoint needs no more than their number. After
going back, the later ones stay until others replace them, so going forward again is possible.
"""

import os
import tempfile
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np

from app.slam.errors import writing_to
from app.slam.sections import KeyframeParams
from app.slam.types import F64, Cloud, Keyframe

_HEAD = np.dtype(
    [
        ("frame", "<i8"),
        ("stamp_ns", "<i8"),
        ("T_odom_imu", "<f8", (4, 4)),
        ("T_imu_lidar", "<f8", (4, 4)),
        ("covariance", "<f8", (6, 6)),
        ("drift", "<f8", (6, 6)),
        ("resumed_ns", "<i8"),
        ("astray", "<f8"),
        ("points", "<i8"),
    ]
)
_COLUMNS = {
    "points": np.dtype(("<f4", 3)),
    "intensity": np.dtype("<f4"),
    "offsets_ns": np.dtype("<i4"),
    "ring": np.dtype("<u2"),
    "labels": np.dtype("u1"),
}
"""What follows a head, column by column; the names are attributes of `Cloud`."""
_POINT_BYTES = sum(column.itemsize for column in _COLUMNS.values())


def is_due(T_odom_last: F64 | None, T_odom_imu: F64, params: KeyframeParams) -> bool:
    """Whether the pose is far or turned enough from the last keyframe's, if there is one."""
    if T_odom_last is None:
        return True
    far = np.linalg.norm(T_odom_imu[:3, 3] - T_odom_last[:3, 3]) > params.distance
    cosine = (np.sum(T_odom_last[:3, :3] * T_odom_imu[:3, :3]) - 1.0) / 2.0  # of the angle, by the trace
    turned = cosine < np.cos(np.radians(params.angle))
    return bool(far or turned)


class KeyframeStore:
    """All keyframes of a session, in an unnamed temporary file or in one that outlives the process.

    `store[i]` reads keyframe i, from any thread; iterating streams all of them in order.

    Args:
        path: of the file; complete keyframes that it already holds are kept. None: a temporary file.
    """

    def __init__(self, path: Path | None = None) -> None:
        self._ends = array("q")  # file offset after each keyframe, including later ones after going back
        self._path = path
        self._file: IO[bytes]
        if path is None:
            self._file = tempfile.TemporaryFile(prefix="hemislam-keyframes-")  # noqa: SIM115 - closed by close()
        else:
            path.touch()
            self._file = path.open("r+b")
            self._find(path.stat().st_size)
        self._count = len(self._ends)

    def _find(self, size: int) -> None:
        """Find the keyframes of a file of `size` bytes; an incomplete one at the end is ignored."""
        end = 0
        while end + _HEAD.itemsize <= size:
            raw = os.pread(self._file.fileno(), _HEAD.itemsize, end)
            end += _HEAD.itemsize + int(np.frombuffer(raw, dtype=_HEAD)[0]["points"]) * _POINT_BYTES
            if end > size:
                return
            self._ends.append(end)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: int) -> Keyframe:
        if not 0 <= index < len(self):
            raise IndexError(f"keyframe {index} of {len(self)}")
        begin = self._ends[index - 1] if index else 0
        raw = os.pread(self._file.fileno(), self._ends[index] - begin, begin)
        head = np.frombuffer(raw, dtype=_HEAD, count=1)[0]
        columns, at, points = {}, _HEAD.itemsize, int(head["points"])
        for name, column in _COLUMNS.items():
            columns[name] = np.frombuffer(raw, column, points, at)
            at += points * column.itemsize
        return Keyframe(
            index=index,
            frame=int(head["frame"]),
            stamp_ns=int(head["stamp_ns"]),
            T_odom_imu=head["T_odom_imu"].copy(),
            T_imu_lidar=head["T_imu_lidar"].copy(),
            covariance=head["covariance"].copy(),
            cloud=Cloud(**columns),
            drift=head["drift"].copy(),
            resumed_ns=int(head["resumed_ns"]),
            astray=float(head["astray"]),
        )

    def when(self, index: int) -> tuple[int, int, int]:
        """Frame, stamp and `resumed_ns` of a keyframe, without reading its cloud."""
        begin = self._ends[index - 1] if index else 0
        head = np.frombuffer(os.pread(self._file.fileno(), _HEAD.itemsize, begin), dtype=_HEAD)[0]
        return int(head["frame"]), int(head["stamp_ns"]), int(head["resumed_ns"])

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[i] for i in range(len(self)))

    def append(self, keyframe: Keyframe) -> None:
        cloud = keyframe.cloud
        head = np.zeros((), dtype=_HEAD)
        for name in _HEAD.names or ():
            head[name] = len(cloud) if name == "points" else getattr(keyframe, name)
        begin = self._ends[self._count - 1] if self._count else 0
        end = begin + head.nbytes + len(cloud) * _POINT_BYTES
        with writing_to(self._path):
            self._file.seek(begin)
            self._file.write(head.tobytes())
            for name, column in _COLUMNS.items():
                self._file.write(np.ascontiguousarray(getattr(cloud, name), column.base).data)
            self._file.flush()
        if self._count == len(self._ends) or self._ends[self._count] != end:  # else what follows is still whole
            del self._ends[self._count :]
            self._ends.append(end)
        self._count += 1

    def truncate(self, count: int) -> None:
        """Go back to the first `count` keyframes, or forward again to at most as many as there were.

        A store that never held any stays empty.

        After going back, append the same keyframes as before; otherwise, going forward beyond them
        would mix keyframes of two different runs.

        Raises:
            IndexError: there is no such keyframe, or another one has replaced it since.
        """
        if not self._ends:
            return  # a new engine continues from another engine's checkpoint, which still holds the earlier map
        if not 0 <= count <= len(self._ends):
            raise IndexError(f"{count} of {len(self._ends)} keyframes")
        self._count = count

    def close(self) -> None:
        """Release the disk space."""
        self._file.close()
