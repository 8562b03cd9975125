"""Numbers of the map's points that depend on the whole map: its density, and its distance from another map."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from app.evaluation.cloud_distance import density
from app.server.protocol import Chunk
from app.slam import lie
from app.slam.types import F32, F64
from app.ui.colours import Limits

_WAITS: Final = 3.0
"""The pause between two counts is this many times the duration of the last count."""
_SHARE: Final = 98.0
"""Percent of the counts that the colours span."""


@dataclass(frozen=True, slots=True, eq=False)
class MapNumbers:
    """A number for each point of the map.

    Attributes:
        by_keyframe: by index, the chunk at that time and (n,) numbers of its points. limits: ends of the colour map.
    """

    by_keyframe: Mapping[int, tuple[Chunk, F32]]
    limits: Limits

    @classmethod
    def split(cls, chunks: tuple[Chunk, ...], numbers: F32, limits: Limits) -> "MapNumbers":
        """Split `numbers`, (n,) of the points of all chunks in order, by chunk."""
        parts = np.split(numbers, np.cumsum([len(chunk.points) for chunk in chunks])[:-1])
        return cls({chunk.index: (chunk, part) for chunk, part in zip(chunks, parts, strict=True)}, limits)

    def of(self, chunk: Chunk) -> F32:
        """(n,) numbers of a chunk's points; NaN if the chunk is new or has changed since."""
        known, numbers = self.by_keyframe.get(chunk.index, (None, None))
        return numbers if known is chunk and numbers is not None else np.full(len(chunk.points), np.nan, np.float32)


class Density:
    """Counts the points around each point of the map in a thread, and again when the map has changed."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._counted: tuple[object, object] = None, None  # chunks and poses that the newest thread counts
        self._thread: threading.Thread | None = None
        self._due = -np.inf
        self._found: MapNumbers | None = None

    def of(self, chunks: tuple[Chunk, ...], poses: F64) -> MapNumbers | None:
        """The last counts; None before the first. poses: (k, 4, 4) T_map_imu of at least these keyframes."""
        same = chunks is self._counted[0] and poses is self._counted[1]
        counting = self._thread is not None and self._thread.is_alive()
        if not (same or counting or not chunks or self._now() < self._due):
            self._counted = chunks, poses
            self._thread = threading.Thread(target=self._count, args=(chunks, poses), name="density", daemon=True)
            self._thread.start()
        return self._found

    def _count(self, chunks: tuple[Chunk, ...], poses: F64) -> None:
        begin = self._now()
        T = (poses[[chunk.index for chunk in chunks]] @ [chunk.T_imu_lidar for chunk in chunks]).astype(np.float32)
        placed = [lie.moved(t, chunk.points) for chunk, t in zip(chunks, T, strict=True)]
        counts = density(np.concatenate(placed))
        high = float(np.percentile(counts, _SHARE)) if len(counts) else 1.0
        self._found = MapNumbers.split(chunks, counts, Limits(0.0, max(high, 1.0)))
        self._due = self._now() + _WAITS * (self._now() - begin)
