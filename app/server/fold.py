"""Puts deltas together to snapshots, in the reader's process.

What follows from other values is not sent but computed here: where frames and keyframes lie in the map, by the
odometry and the newest corrections; the distance walked; and the error to the truth.
"""

from collections.abc import Iterable
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from app.mapping import truth
from app.server.chunks import within_budget
from app.server.delta import Delta
from app.server.protocol import Chunk, Notice, OpenedRecording, Snapshot
from app.server.setup import POINT_BUDGET
from app.slam.frames import FRAME, READOUTS, as_table
from app.slam.loops.types import changed_by
from app.slam.map_frame import MapFrame
from app.slam.rows import Rows
from app.slam.trajectory import Trajectory
from app.slam.types import F64, I64

NOTICES_KEPT = 50


class Fold:
    """Applies deltas, in their order, to a snapshot. One thread writes; any thread may read `snapshot`.

    Args:
        point_budget: most points that all chunks together may have.
    """

    def __init__(self, snapshot: Snapshot | None = None, point_budget: int = POINT_BUDGET) -> None:
        self.snapshot = snapshot or Snapshot()
        self._point_budget = point_budget
        self._frames = _Frames()
        self._chunks: tuple[Chunk, ...] = ()  # of all known keyframes, also those after the present frame

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
        frames = self._frames
        moved = frames.follow(delta, now.corrections)
        shown = min(now.transport.frame + 1, len(frames))
        keyframes = int(np.searchsorted(frames.keyframes, shown))
        if moved or before.keyframe_poses is None or keyframes != len(before.keyframe_poses):
            poses = frames.keyframe_poses[:keyframes]
        else:
            poses = before.keyframe_poses  # the same object tells the page that none has moved
        self._take_chunks(delta, now)
        T_map_truth, series = frames.series(shown, now.recording)
        self.snapshot = replace(
            now,
            revision=before.revision + 1,
            chunks=self._chunks[:keyframes],
            keyframe_poses=poses,
            trajectory=frames.positions[:shown],
            series=series,
            T_map_truth=T_map_truth,
            notices=(*before.notices, *delta.notices)[-NOTICES_KEPT:],
        )
        return self.snapshot

    def _take_chunks(self, delta: Delta, now: Snapshot) -> None:
        held = self._chunks[: int(np.searchsorted(self._frames.keyframes, delta.keep))]
        if not delta.chunks and len(held) == len(self._chunks):
            return
        held = (*held, *(read_only(chunk) for chunk in delta.chunks))
        poses = self._frames.keyframe_poses
        if held:
            sensor = now.result.T_map_imu[:3, 3] if now.result is not None else poses[len(held) - 1, :3, 3]
            held = within_budget(held, poses, sensor, self._point_budget)
        self._chunks = held

    def edit(self, *, notices: Iterable[Notice] = (), **values: Any) -> Snapshot:
        """Replace fields and add notices: the next revision."""
        before = self.snapshot
        kept = (*before.notices, *notices)[-NOTICES_KEPT:]
        self.snapshot = replace(before, revision=before.revision + 1, notices=kept, **values)
        return self.snapshot


class _Frames:
    """The reader's copy of the frames, laid into the map. Arrays that were handed out stay as they are.

    Attributes:
        positions: (n, 3) in the map. keyframes: (k,) their frames. keyframe_poses: (k, 4, 4) T_map_imu.
    """

    def __init__(self) -> None:
        self._rows = Rows((), FRAME)
        self._positions = Rows((3,), np.dtype(np.float64))
        self._corrections = MapFrame()
        self._T_odom_imu: F64 = np.empty((0, 4, 4))  # of keyframes
        self.keyframes: I64 = np.empty(0, np.int64)
        self.keyframe_poses: F64 = np.empty((0, 4, 4))

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def positions(self) -> F64:
        return self._positions.view()

    def follow(self, delta: Delta, corrections: MapFrame) -> bool:
        """Take in the frames of a delta and the newest corrections. Returns whether a keyframe is new or has moved."""
        moved = corrections is not self._corrections
        self._rows.truncate(delta.keep)
        self._rows.extend(as_table(delta.frames))
        self._positions.truncate(delta.keep)
        if moved:
            self._positions.truncate(self._first_moved(corrections))
        new_rows = self._rows.view()[len(self._positions) :]
        self._positions.extend(corrections.trajectory(_odometry(new_rows)).positions)
        self._corrections = corrections
        kept = int(np.searchsorted(self.keyframes, delta.keep))
        new = [delta.keep + index for index, frame in enumerate(delta.frames) if frame.keyframe]
        if new or kept < len(self.keyframes):
            rows = _odometry(self._rows.view()[new])
            self.keyframes = np.concatenate((self.keyframes[:kept], np.array(new, np.int64)))
            self._T_odom_imu = np.concatenate((self._T_odom_imu[:kept], rows.poses))
            moved = True
        if moved:
            self.keyframe_poses = corrections.poses(self._T_odom_imu)
            self.keyframe_poses.setflags(write=False)
        return moved

    def _first_moved(self, corrections: MapFrame) -> int:
        """The first frame that may lie elsewhere by these corrections."""
        keyframe = corrections.first_change(self._corrections)
        if keyframe == 0:
            return 0
        return int(np.searchsorted(self._rows.view()["stamp_ns"], corrections.stamps_ns[keyframe - 1]))

    def series(self, shown: int, recording: OpenedRecording | None) -> tuple[F64 | None, dict[str, F64]]:
        """T_map_truth, if the first `shown` frames determine it, and their arrays by SERIES name."""
        rows, positions = self._rows.view()[:shown], self.positions[:shown]
        start_ns = recording.start_ns if recording is not None else 0
        steps = np.linalg.norm(np.diff(positions, axis=0, prepend=positions[:1]), axis=1)
        T_map_truth, error = None, np.full(shown, np.nan)
        if recording is not None and recording.truth_stamps_ns is not None and recording.truth_positions is not None:
            there = truth.interpolated(recording.truth_stamps_ns, recording.truth_positions, rows["stamp_ns"])
            T_map_truth = truth.align(there, positions)
            error = truth.distances(T_map_truth, there, positions)
        series = {
            "stamp_s": (rows["stamp_ns"] - start_ns) * 1e-9,
            "distance": np.cumsum(steps),
            "error_m": error,
            **{name: rows["readouts"][:, column] for column, name in enumerate(READOUTS)},
        }
        return T_map_truth, read_only(series)


def _odometry(rows: np.ndarray) -> Trajectory:
    return Trajectory(rows["stamp_ns"], rows["position"], rows["quaternion"])


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
