"""Makes snapshots from deltas, in the reader's process.

Some values are computed here instead of being sent: positions of frames and keyframes in the map, the distance
travelled, and the error to the truth.
"""

from collections.abc import Iterable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from app.mapping.truth import compared
from app.server.chunks import as_thin, within_budget
from app.server.protocol import Chunk, Delta, Notice, OpenedRecording, Snapshot
from app.server.setup import POINT_BUDGET
from app.slam.frames import FRAME, READOUTS, as_table
from app.slam.loops.types import changed_by
from app.slam.map_frame import MapFrame
from app.slam.metrics import walked_m
from app.slam.rows import Rows
from app.slam.trajectory import Trajectory
from app.slam.types import F64, I64

NOTICES_KEPT = 50


class Fold:
    """Applies deltas to a snapshot. One thread writes; any thread may read `snapshot`, whose arrays never change.

    It also keeps frames, keyframes and chunks beyond the shown frame. point_budget: most points of all chunks.
    """

    def __init__(self, snapshot: Snapshot | None = None, point_budget: int = POINT_BUDGET) -> None:
        self.snapshot = snapshot or Snapshot()
        self._point_budget = point_budget
        self._frames = Rows((), FRAME)
        self._positions = Rows((3,), np.float64)  # of frames, in the map
        self._corrections = MapFrame()
        self._keyframes: I64 = np.empty(0, np.int64)  # frame of each
        self._poses: F64 = np.empty((0, 4, 4))  # of keyframes, T_map_imu
        self._chunks: tuple[Chunk, ...] = ()

    def apply(self, delta: Delta) -> Snapshot:
        before = self.snapshot
        now = replace(before, **read_only(delta.replaced))
        if delta.edges is not None:
            edges = before.loops.edges if "session" not in delta.replaced else ()
            if any(delta.edges):
                edges = changed_by(delta.edges, edges)
            now = replace(now, loops=replace(now.loops, edges=edges))
        if now.result is not None and now.corrections is not before.corrections:
            now = replace(now, result=replace(now.result, T_map_odom=now.corrections.newest))
        moved = self._take_frames(delta, now.corrections)
        self._take_chunks(delta, now)
        shown = min(now.transport.frame + 1, len(self._frames))
        keyframes = int(np.searchsorted(self._keyframes, shown))
        poses = before.keyframe_poses  # the same object tells the page that none has moved
        if moved or keyframes != len(poses):
            poses = self._poses[:keyframes]
        T_map_truth, series = self._series(shown, now.recording)
        self.snapshot = replace(
            now,
            revision=before.revision + 1,
            notices=(*before.notices, *delta.notices)[-NOTICES_KEPT:],
            chunks=self._chunks[:keyframes],
            keyframe_poses=poses,
            trajectory=self._positions.view()[:shown],
            series=series,
            known_ns=self._frames.view()["stamp_ns"],
            T_map_truth=T_map_truth,
        )
        return self.snapshot

    def edit(self, *, notices: Iterable[Notice] = (), **values: Any) -> Snapshot:
        """Make the next revision, with replaced fields and added notices."""
        before = self.snapshot
        kept = (*before.notices, *notices)[-NOTICES_KEPT:]
        self.snapshot = replace(before, revision=before.revision + 1, notices=kept, **values)
        return self.snapshot

    def _take_frames(self, delta: Delta, corrections: MapFrame) -> bool:
        """Add new frames and corrections. Returns whether a keyframe is new or may have moved."""
        moved, cut = corrections is not self._corrections, delta.keep < len(self._frames)
        self._corrections = corrections
        self._frames.truncate(delta.keep)
        self._frames.extend(as_table(delta.frames))
        self._positions.truncate(0 if moved else delta.keep)
        frames = self._frames.view()
        new = _odometry(frames[len(self._positions) :])
        self._positions.extend(corrections.trajectory(new).positions)
        if not (moved or cut or any(frame.keyframe for frame in delta.frames)):
            return False
        self._keyframes = np.flatnonzero(frames["keyframe"])
        self._poses = read_only(corrections.poses(_odometry(frames[self._keyframes]).poses))
        return True

    def _take_chunks(self, delta: Delta, now: Snapshot) -> None:
        held = self._chunks[: int(np.searchsorted(self._keyframes, delta.keep))]
        if delta.chunks:
            known = {chunk.index: chunk for chunk in held}
            again = {chunk.index: as_thin(chunk, known.get(chunk.index)) for chunk in read_only(delta.chunks)}
            held = tuple((known | again).values())
            sensor = self._poses[len(held) - 1] if now.result is None else now.result.T_map_imu
            held = within_budget(held, self._poses, sensor[:3, 3], self._point_budget)
        self._chunks = held

    def _series(self, shown: int, recording: OpenedRecording | None) -> tuple[F64 | None, dict[str, F64]]:
        """T_map_truth, if the first `shown` frames determine it, and their arrays by SERIES name."""
        frames, positions = self._frames.view()[:shown], self._positions.view()[:shown]
        start_ns = recording.start_ns if recording is not None else 0
        T_map_truth, error = None, np.full(shown, np.nan)
        if recording is not None and recording.truth_stamps_ns is not None and recording.truth_positions is not None:
            T_map_truth, error = compared(
                recording.truth_stamps_ns, recording.truth_positions, frames["stamp_ns"], positions
            )
        series = {
            "stamp_s": (frames["stamp_ns"] - start_ns) * 1e-9,
            "distance": walked_m(positions),
            "error_m": error,
            **{name: frames["readouts"][:, column] for column, name in enumerate(READOUTS)},
        }
        return T_map_truth, read_only(series)


def _odometry(frames: np.ndarray) -> Trajectory:
    return Trajectory(frames["stamp_ns"], frames["position"], frames["quaternion"])


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
