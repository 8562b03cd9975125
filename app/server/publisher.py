"""What the page is told while frames are processed."""

import contextlib
import re
from dataclasses import replace
from typing import Any

import numpy as np

from app.server import wire
from app.server.chunks import thinned
from app.server.delta import Outbox, Rows
from app.server.protocol import SERIES, Chunk, Saved, Transport
from app.server.run import Run
from app.server.spill import Slot, Spill
from app.slam.params import Params
from app.slam.types import F64, Keyframe, StepResult

REPEAT_AFTER_S = 10.0
"""The same kind of notice is shown again only after so much of the recording's time."""
SAVED_KEPT = 10


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
        self._positions, self._rows, self._poses = Rows(3), Rows(len(SERIES)), Rows(16)
        self._chunks: list[Slot | Chunk] = []  # on disk, while that has room
        self._spill = Spill()

    def close(self) -> None:
        """Give the disk space of the chunks back."""
        self._spill.close()

    def opened(self, run: Run) -> None:
        """A new session begins."""
        self.outbox.begin()
        self.result = None
        self.close()
        self._begin_history()
        self._noticed = {}
        self.outbox.put(recording=run.opened)
        self.show(frame=-1, stamp_ns=0, finished=False, frames_per_second=0.0, dropped=0)
        for finding in run.opened.findings:
            if finding.verdict == "needs you":
                self.outbox.notice("warning", " ".join(filter(None, (finding.text, finding.option))))

    def show(self, *, urgent: bool = True, **changes: Any) -> None:
        """Change fields of the transport."""
        self.transport = replace(self.transport, **changes)
        self.outbox.put(transport=self.transport, urgent=urgent)

    def frame(self, run: Run, result: StepResult) -> None:
        """A frame was processed, the one after that which the page shows."""
        frame, position, row = run.frame, result.T_map_imu[:3, 3].copy(), run.readouts.row(result)
        self._positions.go_to(frame)
        self._positions.extend(position[None])
        self._rows.go_to(frame)
        self._rows.extend(np.array([row]))
        self.outbox.frame(position, row)
        if result.keyframe is not None:
            self._keyframe(len(run.engine.keyframes) - 1, result.T_map_odom, result.keyframe)
        self._newest(run, result)
        self.show(frame=frame, stamp_ns=result.stamp_ns, urgent=False)
        for notice in result.notices:
            self.notice_once(notice, result.stamp_ns)

    def arrived(self, run: Run, result: StepResult | None) -> None:
        """The run went to another frame, one that is known, with this result: show all as it was there."""
        frames, chunks = run.frame + 1, len(run.engine.keyframes)
        self.outbox.rewind(frames, chunks)
        self._positions.go_to(frames)
        self._rows.go_to(frames)
        self._poses.go_to(chunks)
        positions, rows = self._positions.view(), self._rows.view()
        for index in range(self.outbox.frames, frames):
            self.outbox.frame(positions[index].copy(), rows[index].tolist())
        for kept in self._chunks[self.outbox.chunks : chunks]:
            self.outbox.chunk(kept if isinstance(kept, Chunk) else wire.unpack(self._spill.get(kept)))
        self._newest(run, result)
        self.show(
            frame=run.frame,
            stamp_ns=result.stamp_ns if result else 0,
            finished=run.finished,
            dropped=run.log.dropped.total(),
        )

    def _newest(self, run: Run, result: StepResult | None) -> None:
        self.result = result and replace(result, keyframe=None)
        poses = self._poses.view().reshape(-1, 4, 4).copy()
        self.outbox.put(
            result=self.result,
            T_map_truth=run.readouts.T_map_truth,
            keyframe_poses=poses if len(poses) else None,
        )

    def _keyframe(self, index: int, T_map_odom: F64, keyframe: Keyframe) -> None:
        chunk = thinned(keyframe, self._chunk_voxel)
        self.outbox.chunk(chunk)
        self._poses.go_to(index)
        self._poses.extend((T_map_odom @ keyframe.T_odom_imu).reshape(1, 16))
        for replaced in self._chunks[index : index + 1]:
            if isinstance(replaced, Slot):
                self._spill.release(replaced)
        kept: Slot | Chunk = chunk
        with contextlib.suppress(OSError):
            kept = self._spill.put(wire.pack(chunk))
        self._chunks[index : index + 1] = [kept]

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
