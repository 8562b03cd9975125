"""What the page is told while frames are processed."""

import re
from dataclasses import replace
from typing import Any

import numpy as np

from app.server.chunks import thinned
from app.server.delta import Outbox
from app.server.live import LiveRun
from app.server.protocol import SERIES, Saved, Transport
from app.server.run import Run
from app.slam.map_frame import MapFrame
from app.slam.params import Params
from app.slam.rows import table
from app.slam.types import F64, Keyframe, StepResult

REPEAT_AFTER_S = 10.0
"""The same kind of notice is shown again only after so much of the recording's time."""
SAVED_KEPT = 10
SAME = 1e-6
"""Corrections (m, and of rotation matrices) closer than this are not told to the page."""


class Publisher:
    """Turns a session's events into changes in its outbox.

    Attributes:
        transport: as last shown. result: newest frame, without its keyframe, as last shown.
    """

    def __init__(self, outbox: Outbox, chunk_voxel: float) -> None:
        self.outbox = outbox
        self.transport = Transport()
        self.result: StepResult | None = None
        self._chunk_voxel = chunk_voxel
        self._begin_history()
        self._noticed: dict[str, int] = {}
        self._saved: tuple[Saved, ...] = ()

    def _begin_history(self) -> None:
        """Of all frames that are known, also those that the page was taken back over."""
        self._rows, self._odometry = table(len(SERIES)), table(16)  # the latter: T_odom_imu of keyframes
        self._positions, self._frame = table(3), MapFrame()  # as the page has them
        self._poses_changed = True

    def opened(self, run: Run) -> None:
        """A new session begins."""
        self.outbox.begin()
        self.result = None
        self._begin_history()
        self._noticed = {}
        self.outbox.put(recording=run.opened)
        self.show(frame=-1, stamp_ns=0, finished=False, frames_per_second=0.0, dropped=0)
        for finding in run.opened.findings:
            if finding.verdict == "needs you":
                self.outbox.notice("warning", " ".join(filter(None, (finding.text, finding.option))))

    def taken_over(self, run: LiveRun) -> None:
        """A run that another process began goes on; the page keeps what it has of it, and is sent what that process
        had kept, but not told, when it died. There is no going back."""
        frames, keyframes = run.frame + 1, run.engine.keyframes
        self._positions.extend(run.log.odometry.positions)
        for keyframe in keyframes:
            self._odometry.extend(keyframe.T_odom_imu.reshape(1, 16))
        self.outbox.go_to(frames, len(keyframes))
        told = self.outbox.frames
        for position, row in zip(self._positions.view()[told:], run.readouts_from(told), strict=True):
            self.outbox.frame(position, row)
        for index in range(self.outbox.chunks, len(keyframes)):
            self.outbox.chunk(thinned(keyframes[index], self._chunk_voxel))
        self.outbox.put(recording=run.opened)
        self.show(frame=run.frame, finished=False, frames_per_second=0.0, dropped=run.log.dropped.total())

    def show(self, *, urgent: bool = True, **changes: Any) -> None:
        """Change fields of the transport."""
        self.transport = replace(self.transport, **changes)
        self.outbox.put(transport=self.transport, urgent=urgent)

    def frame(self, run: Run, result: StepResult) -> None:
        """A frame was processed, the one after that which the page shows."""
        frame, position, row = run.frame, result.T_map_imu[:3, 3].copy(), run.readout(result)
        if not run.live:  # nobody goes back there
            self._rows.go_to(frame)
            self._rows.extend(np.array([row]))
        self._positions.extend(position[None])
        self.outbox.frame(position, row)
        if result.keyframe is not None:
            self._keyframe(len(run.engine.keyframes) - 1, result.keyframe)
        self._lay_anew(run)
        self._newest(run, result)
        self.show(frame=frame, stamp_ns=result.stamp_ns, urgent=False)
        for notice in result.notices:
            self.notice_once(notice, result.stamp_ns)

    def arrived(self, run: Run, result: StepResult | None) -> None:
        """The run went to another frame, one that is known, with this result: show all as it was there."""
        frames, chunks = run.frame + 1, len(run.engine.keyframes)
        self.outbox.go_to(frames, chunks)
        self._rows.go_to(frames)
        self._odometry.go_to(chunks)
        self._frame, self._poses_changed = run.engine.map_frame, True
        positions, rows = self._frame.trajectory(run.log.odometry).positions, self._rows.view()
        sent = self.outbox.frames
        apart = np.abs(positions[:sent] - self._positions.view()[:sent]).max(axis=1, initial=0.0)
        first = int(np.argmax(apart > SAME)) if (apart > SAME).any() else sent
        self._positions.go_to(first)
        self._positions.extend(positions[first:])
        for index in range(sent, frames):
            self.outbox.frame(positions[index], rows[index].tolist())
        if first < sent:
            self.outbox.move(first, positions)
        run.readouts.moved(positions)
        self._newest(run, result)
        self.show(
            frame=run.frame,
            stamp_ns=result.stamp_ns if result else 0,
            finished=run.finished,
            dropped=run.log.dropped.total(),
        )

    def compared(self, run: Run, errors: F64) -> None:
        """The walk is held against another trajectory: `errors` (n,) m, of all frames that are known."""
        told = min(self.outbox.frames, len(errors))  # on the way back, those told that are not known any more go
        self._rows.go_to(len(errors))
        rows = self._rows.view().copy()
        rows[:, SERIES.index("error_m")] = errors
        self._rows.go_to(0)
        self._rows.extend(rows)
        self._rows.go_to(told)
        self._positions.go_to(told)
        self.outbox.go_to(0, self.outbox.chunks)
        for position, row in zip(self._positions.view()[:told], rows[:told], strict=True):
            self.outbox.frame(position, row.tolist())
        self.outbox.put(recording=run.opened, T_map_truth=run.readouts.T_map_truth, urgent=True)

    def _newest(self, run: Run, result: StepResult | None) -> None:
        self.result = result and replace(result, keyframe=None)
        self.outbox.put(result=self.result, T_map_truth=run.readouts.T_map_truth)
        if self._poses_changed:
            self._poses_changed = False
            poses = self._frame.poses(self._odometry.view().reshape(-1, 4, 4))
            self.outbox.put(keyframe_poses=poses if len(poses) else None)

    def map_moved(self, run: Run) -> None:
        """Loops have moved keyframes: show them, the walk and the sensor where they are now."""
        self._lay_anew(run)
        self._newest(run, self.result and replace(self.result, T_map_odom=run.engine.T_map_odom))

    def _lay_anew(self, run: Run) -> None:
        """Send the part of the walk whose corrections are others than those that the page has."""
        before, frame = self._frame, run.engine.map_frame
        if frame is before:
            return
        self._frame, self._poses_changed = frame, True
        first = _first_stamp(before, frame)
        if first is None:
            return
        walk = run.log.odometry
        begin = int(np.searchsorted(walk.stamps_ns, first))
        positions = self._positions.view().copy()
        positions[begin:] = frame.trajectory(walk.since(begin)).positions
        run.readouts.moved(positions)
        self._positions.go_to(begin)
        self._positions.extend(positions[begin:])
        self.outbox.move(begin, positions)

    def _keyframe(self, index: int, keyframe: Keyframe) -> None:
        self.outbox.chunk(thinned(keyframe, self._chunk_voxel))
        self._poses_changed = True
        self._odometry.go_to(index)
        self._odometry.extend(keyframe.T_odom_imu.reshape(1, 16))

    def relabelled(self, result: StepResult) -> None:
        """The newest frame got other labels."""
        self.result = result
        self.outbox.put(result=result, urgent=True)

    def params(self, params: Params, pending_restart: tuple[str, ...]) -> None:
        self.outbox.put(params=params, pending_restart=pending_restart, urgent=True)

    def saved(self, saved: Saved) -> None:
        self._saved = (*self._saved, saved)[-SAVED_KEPT:]
        self.outbox.put(saved=self._saved, urgent=True)
        if saved.error:
            self.outbox.notice("error", saved.error)

    def notice_once(self, text: str, stamp_ns: int) -> None:
        """Warn, unless the same sentence but for its numbers was shown a moment ago."""
        kind = re.sub(r"[\d.]+", "#", text)
        last = self._noticed.get(kind)
        if last is None or abs(stamp_ns - last) > REPEAT_AFTER_S * 1e9:
            self._noticed[kind] = stamp_ns
            self.outbox.notice("warning", text)


def _first_stamp(before: MapFrame, after: MapFrame) -> int | None:
    """From when on two corrections of the same walk differ; None if they do not."""
    count = max(len(before.T_map_odom), len(after.T_map_odom))
    if not count:
        return None
    differ = np.abs(_padded(before, count) - _padded(after, count)).max(axis=(1, 2)) > SAME
    if not differ.any():
        return None
    index = int(np.argmax(differ))
    longer = max(before, after, key=lambda frame: len(frame.stamps_ns))
    return int(longer.stamps_ns[index - 1]) if index else 0


def _padded(frame: MapFrame, count: int) -> F64:
    """(count, 4, 4) corrections; later ones are the last."""
    missing = count - len(frame.T_map_odom)
    return np.concatenate([frame.T_map_odom, np.broadcast_to(frame.at(count), (missing, 4, 4))])
