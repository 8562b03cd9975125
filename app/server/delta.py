"""What has changed since the reader last heard: collected in the engine's process.

Fields of the snapshot that are replaced as a whole are sent in their newest value only. Frames are followed by a
cursor, and the clouds of keyframes are read from disk when they are sent. So a slow reader never holds up the
engine, misses nothing, and nothing piles up for it.
"""

from bisect import bisect_left
from dataclasses import dataclass, replace
from typing import Any, Literal

from app.mapping.log import Cursor, Log
from app.server.chunks import thinned
from app.server.protocol import Chunk, LoopsView, Notice
from app.slam.frames import Frame
from app.slam.loops.types import LoopChange, LoopEdge, difference
from app.slam.map_frame import MapFrame
from app.slam.params import Params
from app.slam.ply import Keyframes

CHUNKS_AT_ONCE = 20
"""Most clouds in one delta, so that a reader far behind sees the map grow."""


@dataclass(frozen=True, slots=True)
class Delta:
    """Changes since the delta before.

    Attributes:
        replaced: new values of fields of `Snapshot`; `loops` without its edges. With `session`, another session
            begins: the reader drops its edges.
        edges: what has changed of the loops' edges.
        keep: the reader keeps so many of its frames and appends `frames`.
        chunks: of the next keyframes whose cloud the reader does not have.
        notices: new since then.
    """

    replaced: dict[str, Any]
    edges: LoopChange | None
    keep: int
    frames: tuple[Frame, ...]
    chunks: tuple[Chunk, ...]
    notices: tuple[Notice, ...]


class Outbox:
    """Collects changes for the next `Delta`.

    Args:
        chunk_voxel: edge of the voxels (m) in which clouds are thinned.
        session, notices, frames, chunks: how many the reader already has from an earlier process.

    Attributes:
        urgent: asks for the next delta at once, whatever the rate limit.
    """

    def __init__(
        self,
        params: Params,
        *,
        chunk_voxel: float = 0.05,
        session: int = 0,
        notices: int = 0,
        frames: int = 0,
        chunks: int = 0,
    ) -> None:
        self._session, self._notices_given, self._chunk_voxel = session, notices, chunk_voxel
        self._replaced: dict[str, Any] = {"params": params}
        self._edges: tuple[LoopEdge, ...] = ()  # that the reader has
        self._frames: Log[Frame] = Log()
        self._cursor = Cursor(0, frames)
        self._clouds: Keyframes = ()
        self._keyframes: list[int] = []  # their frames, of the frames that the reader has
        self._chunks = chunks  # that the reader has
        self._notices: list[Notice] = []
        self.urgent = True

    def begin(self, frames: Log[Frame], keyframes: Keyframes) -> None:
        """Follow another session, or, if it has frames already, the one that an earlier process began."""
        self._frames, self._clouds, self._edges = frames, keyframes, ()
        self._keyframes = [index for index, frame in enumerate(frames) if frame.keyframe]
        if len(frames):
            self._cursor = Cursor(0, min(self._cursor.length, len(frames)))
            self._chunks = min(self._chunks, len(self._keyframes))
        else:
            self._session += 1
            self._cursor, self._chunks = Cursor(), 0
        self.put(urgent=True, session=self._session, result=None, corrections=MapFrame(), loops=LoopsView())

    def put(self, *, urgent: bool = False, **values: Any) -> None:
        """Set fields of the snapshot. Only the newest value of each is sent."""
        self._replaced |= values
        self.urgent |= urgent

    def notice(self, level: Literal["info", "warning", "error"], text: str) -> None:
        self._notices_given += 1
        self._notices.append(Notice(self._notices_given, level, text))
        self.urgent = True

    @property
    def filled(self) -> bool:
        """Whether there is anything to take."""
        behind = self._frames.cursor != self._cursor or self._chunks < self._chunks_ready
        return bool(self._replaced or self._notices or behind)

    @property
    def _chunks_ready(self) -> int:
        """Keyframes whose cloud can be read. After a seek back, later ones can be read again once they are passed."""
        return min(len(self._keyframes), len(self._clouds))

    def take(self) -> Delta:
        """All changes since the last call."""
        edges = None
        if "loops" in self._replaced:
            loops: LoopsView = self._replaced["loops"]
            edges, self._edges = difference(self._edges, loops.edges), loops.edges
            self._replaced["loops"] = replace(loops, edges=())
        keep, frames, self._cursor = self._frames.since(self._cursor)
        kept = bisect_left(self._keyframes, keep)
        self._keyframes[kept:] = [keep + index for index, frame in enumerate(frames) if frame.keyframe]
        self._chunks = first = min(self._chunks, kept)
        self._chunks = max(first, min(self._chunks_ready, first + CHUNKS_AT_ONCE))
        chunks = tuple(thinned(self._clouds[index], self._chunk_voxel) for index in range(first, self._chunks))
        delta = Delta(self._replaced, edges, keep, frames, chunks, tuple(self._notices))
        self._replaced, self._notices, self.urgent = {}, [], False
        return delta
