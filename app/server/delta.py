"""What changed between two snapshots: collected in the engine's process, folded in the reader's.

`Outbox` gathers changes until somebody takes them, however long that takes: fields that are
replaced as a whole coalesce to their newest value, rows and chunks queue up. So a slow reader never
holds up the engine and never misses anything, and nothing is kept here once it was taken.
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal

import numpy as np

from app.server.chunks import room, with_same_mounting, within_budget
from app.server.edges import EdgesChange, EdgesReceiver, EdgesSender
from app.server.protocol import SERIES, Chunk, LoopsView, Notice, Snapshot
from app.server.setup import POINT_BUDGET
from app.server.transforms import Transforms
from app.slam.params import Params
from app.slam.rows import table
from app.slam.types import F64

NOTICES_KEPT = 50


@dataclass(frozen=True, slots=True)
class Delta:
    """Changes since the delta before.

    Attributes:
        session: of all that follows; a new number empties the scene first.
        kept: how many frames are left of those that there were, before those that follow; None: all.
        moved: frame and (m, 3) positions from it on, in place of those that there were.
        replaced: new values of fields of `Snapshot`; `loops` without its edges.
        edges: what has changed of those.
        positions: (m, 3) and series: (m, len(SERIES)), rows of the frames since then.
        chunks: new since then, each in place of the one that the reader has of its keyframe.
        shown: how many of all these there are now; the reader keeps the others, since they come again
            when one goes forth again.
        notices: new since then.
    """

    session: int
    kept: int | None
    moved: tuple[int, F64] | None
    replaced: dict[str, Any]
    edges: EdgesChange | None
    positions: F64
    series: F64
    chunks: tuple[Chunk, ...]
    shown: int
    notices: tuple[Notice, ...]


class Outbox:
    """Collects changes for the next `Delta`.

    Args:
        session, notices, frames, chunks: what the reader has already, of a process before this one.

    Attributes:
        urgent: asks for the next one at once, whatever the rate limit.
        frames, chunks: how many the reader shows of this session once it has taken everything.
    """

    def __init__(self, params: Params, *, session: int = 0, notices: int = 0, frames: int = 0, chunks: int = 0) -> None:
        self._session = session
        self._notices_given = notices
        self._replaced: dict[str, Any] = {"params": params}
        self._positions: list[F64] = []
        self._rows: list[list[float]] = []
        self._chunks: dict[int, Chunk] = {}  # by keyframe
        self._held = chunks  # that the reader has once it has taken everything, shown or not
        self._edges = EdgesSender()
        self._kept: int | None = None
        self._moved: tuple[int, F64] | None = None
        self.frames = frames
        self.chunks = chunks
        self._notices: list[Notice] = []
        self.urgent = True

    def begin(self) -> None:
        """Start a new session: what belonged to the old one and was not taken is dropped."""
        self._session += 1
        self.urgent = True
        self._positions, self._rows, self._chunks, self._held = [], [], {}, 0
        self._kept, self._moved, self.frames, self.chunks = None, None, 0, 0
        self._replaced |= {"result": None, "keyframe_poses": None, "T_map_truth": None, "loops": LoopsView()}

    def put(self, *, urgent: bool = False, **values: Any) -> None:
        """Set fields of the snapshot. Only the newest value of each is sent."""
        self._replaced |= values
        self.urgent |= urgent

    def frame(self, position: F64, readouts: list[float]) -> None:
        """Add a frame: its position (3,) in the map and its readouts in the order of SERIES."""
        self._positions.append(position)
        self._rows.append(readouts)
        self.frames += 1

    def chunk(self, chunk: Chunk) -> None:
        """Add the next chunk, in place of the one that may have been gone back over."""
        self._chunks[self.chunks] = chunk
        self.chunks += 1
        self._held = max(self._held, self.chunks)

    def move(self, first: int, positions: F64) -> None:
        """The frames from `first` on lie elsewhere now.

        Args:
            positions: (frames, 3) of all frames.
        """
        taken = self.frames - len(self._positions)
        if first < taken:
            first = min(first, self._moved[0]) if self._moved else first
            self._moved = first, positions[first:taken]
        self._positions = list(positions[taken:])

    def go_to(self, frames: int, chunks: int) -> None:
        """Show so many: frames are taken back, the newest first; chunks also come again that there were."""
        frames, taken_frames = min(frames, self.frames), self.frames - len(self._rows)
        if frames < taken_frames:
            self._kept = frames
        if self._moved:
            first, moved = self._moved
            self._moved = (first, moved[: frames - first]) if first < frames else None
        del self._positions[max(frames - taken_frames, 0) :], self._rows[max(frames - taken_frames, 0) :]
        self.frames, self.chunks = frames, min(chunks, self._held)

    def notice(self, level: Literal["info", "warning", "error"], text: str) -> None:
        self._notices_given += 1
        self._notices.append(Notice(self._notices_given, level, text))
        self.urgent = True

    @property
    def filled(self) -> bool:
        """Whether there is anything to take."""
        return bool(self._replaced or self._rows or self._chunks or self._notices or self._kept or self._moved)

    def take(self) -> Delta:
        """All changes since the last call."""
        edges = None
        if "loops" in self._replaced:
            loops: LoopsView = self._replaced["loops"]
            edges = self._edges.change(loops.edges)
            self._replaced["loops"] = replace(loops, edges=())
        delta = Delta(
            session=self._session,
            kept=self._kept,
            moved=self._moved,
            replaced=self._replaced,
            edges=edges,
            positions=np.array(self._positions, dtype=np.float64).reshape(-1, 3),
            series=np.array(self._rows, dtype=np.float64).reshape(-1, len(SERIES)),
            chunks=tuple(self._chunks[index] for index in sorted(self._chunks)),
            shown=self.chunks,
            notices=tuple(self._notices),
        )
        self._replaced, self._positions, self._rows, self._chunks, self._notices = {}, [], [], {}, []
        self._kept = self._moved = None
        self.urgent = False
        return delta


class Fold:
    """Lays deltas over a snapshot, in their order. One thread writes; anybody may read `snapshot`.

    Args:
        point_budget: most points that all chunks together may have; fewer, as a long walk leaves less room.
    """

    def __init__(self, snapshot: Snapshot | None = None, point_budget: int = POINT_BUDGET) -> None:
        self.snapshot = snapshot or Snapshot()
        self._point_budget = point_budget
        self._positions, self._series = table(3), table(len(SERIES))
        self._chunks: tuple[Chunk, ...] = ()  # also those that were gone back over
        self._points = 0  # of those that are shown
        self._edges = EdgesReceiver()
        self._poses = Transforms()

    def apply(self, delta: Delta) -> Snapshot:
        before, delta = self.snapshot, read_only(delta)
        if delta.session != before.session:
            self._positions, self._series, self._chunks = table(3), table(len(SERIES)), ()
        if delta.kept is not None:
            self._positions, self._series = self._positions.rewound(delta.kept), self._series.rewound(delta.kept)
        if delta.moved is not None:
            first, positions = delta.moved
            self._positions = self._positions.rewound(first)
            self._positions.extend(positions)
        self._positions.extend(delta.positions)
        self._series.extend(delta.series)
        series = self._series.view()
        if delta.edges is not None:
            self._edges.take(delta.edges)
        chunks = before.chunks
        others = delta.chunks or delta.shown != len(chunks) or delta.session != before.session
        if others or self._points > self._room(len(chunks)):
            chunks = self._shown(delta)
            self._points = sum(len(chunk.points) for chunk in chunks)
        replaced = delta.replaced
        if replaced.get("keyframe_poses") is not None:
            replaced = {**replaced, "keyframe_poses": self._poses.hold(replaced["keyframe_poses"])}
        if delta.edges is not None:
            replaced = {**replaced, "loops": replace(replaced["loops"], edges=self._edges.edges)}
        return self.edit(
            session=delta.session,
            chunks=chunks,
            trajectory=self._positions.view(),
            series={name: series[:, column] for column, name in enumerate(SERIES)},
            notices=delta.notices,
            **replaced,
        )

    def _shown(self, delta: Delta) -> tuple[Chunk, ...]:
        """The chunks that there are with this delta, within the budget."""
        poses = delta.replaced.get("keyframe_poses", self.snapshot.keyframe_poses)
        result = delta.replaced.get("result", self.snapshot.result)
        held = list(self._chunks)
        for chunk in delta.chunks:
            held[chunk.index : chunk.index + 1] = [with_same_mounting(chunk, held[chunk.index - 1]) if held else chunk]
        shown, others = tuple(held[: delta.shown]), held[delta.shown :]
        if poses is None or len(poses) < len(shown):
            self._chunks = tuple(held)
            return shown
        sensor = result.T_map_imu[:3, 3] if result is not None else poses[-1, :3, 3]
        shown = within_budget(shown, poses, sensor, self._room(len(shown)))
        self._chunks = (*shown, *others)
        return shown

    def _room(self, keyframes: int) -> int:
        """Most points that all chunks together may have now."""
        return room(self._point_budget, len(self._positions), keyframes, len(self._edges.edges))

    def edit(self, *, notices: Iterable[Notice] = (), **values: Any) -> Snapshot:
        """Replace fields and add notices: the next revision."""
        before = self.snapshot
        kept = (*before.notices, *notices)[-NOTICES_KEPT:]
        self.snapshot = replace(before, revision=before.revision + 1, notices=kept, **values)
        return self.snapshot


def read_only(value: Any) -> Any:
    """The same value, with every array in it made read-only, through dataclasses, tuples and dictionaries."""
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif isinstance(value, tuple):
        for entry in value:
            read_only(entry)
    elif isinstance(value, dict):
        for entry in value.values():
            read_only(entry)
    elif is_dataclass(value):
        for field in fields(value):
            read_only(getattr(value, field.name))
    return value
