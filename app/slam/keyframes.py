"""Keyframes: which frames are kept, and their clouds on disk, so that memory does not grow.

Clouds are immutable and only ever appended, so a checkpoint needs no more than their number.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from app.slam import lie
from app.slam.params import Keyframes
from app.slam.types import F64, Cloud, Keyframe

_RECORD = np.dtype(
    [("points", "<f4", 3), ("labels", "u1"), ("intensity", "<f4"), ("ring", "<u2"), ("offsets_ns", "<i4")]
)


def is_due(last: Keyframe | None, T_odom_imu: F64, params: Keyframes) -> bool:
    """Whether the pose is far or turned enough from the last keyframe's."""
    if last is None:
        return True
    delta = lie.inverse(last.T_odom_imu) @ T_odom_imu
    far = np.linalg.norm(delta[:3, 3]) > params.distance
    turned = np.degrees(np.linalg.norm(lie.log(delta[:3, :3]))) > params.angle
    return bool(far or turned)


class KeyframeStore:
    """All keyframes of a walk. Poses are in memory, clouds in an unnamed temporary file.

    `store[i]` reads keyframe i with its cloud; iterating streams all of them in order.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile(prefix="hemislam-keyframes-")  # noqa: SIM115 - closed by close()
        self._heads: list[Keyframe] = []
        self._extents: list[tuple[int, int]] = []
        self._end = 0

    def __len__(self) -> int:
        return len(self._heads)

    def __getitem__(self, index: int) -> Keyframe:
        head = self._heads[index]
        offset, count = self._extents[index]
        self._file.seek(offset)
        data = np.frombuffer(self._file.read(count * _RECORD.itemsize), dtype=_RECORD)
        return replace(head, cloud=Cloud(**{name: np.ascontiguousarray(data[name]) for name in _RECORD.names or ()}))

    def __iter__(self) -> Iterator[Keyframe]:
        return (self[i] for i in range(len(self)))

    def poses(self) -> F64:
        """(k, 4, 4) T_odom_imu of all keyframes."""
        return np.array([head.T_odom_imu for head in self._heads]).reshape(-1, 4, 4)

    def append(self, keyframe: Keyframe) -> None:
        cloud = keyframe.cloud
        data = np.empty(len(cloud), dtype=_RECORD)
        for name in _RECORD.names or ():
            data[name] = getattr(cloud, name)
        self._file.seek(self._end)
        self._file.write(data.tobytes())
        self._extents.append((self._end, len(cloud)))
        self._end += data.nbytes
        self._heads.append(replace(keyframe, cloud=_NO_CLOUD))

    def truncate(self, count: int) -> None:
        """Forget all but the first `count` keyframes."""
        del self._heads[count:], self._extents[count:]
        self._end = self._end_of(count - 1) if count else 0

    def _end_of(self, index: int) -> int:
        offset, count = self._extents[index]
        return offset + count * _RECORD.itemsize

    def close(self) -> None:
        self._file.close()


_NO_CLOUD = Cloud(
    np.empty((0, 3), np.float32),
    np.empty(0, np.uint8),
    np.empty(0, np.float32),
    np.empty(0, np.uint16),
    np.empty(0, np.int32),
)
