"""What the page is told while frames are processed."""

import re
from dataclasses import replace
from typing import Any

import numpy as np

from app.server.chunks import thinned
from app.server.delta import Outbox
from app.server.protocol import Saved, Transport
from app.server.run import Run
from app.slam.params import Params
from app.slam.types import F64, StepResult

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
        self._poses: list[F64] = []
        self._noticed: dict[str, int] = {}
        self._saved: tuple[Saved, ...] = ()

    def opened(self, run: Run) -> None:
        """A new session begins."""
        self.outbox.begin()
        self.result = None
        self._poses, self._noticed = [], {}
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
        """A frame was processed."""
        self.result = replace(result, keyframe=None)
        self.outbox.put(result=self.result)
        self.outbox.frame(result.T_map_imu[:3, 3].copy(), run.readouts.row(result))
        if run.readouts.T_map_truth is not None:
            self.outbox.put(T_map_truth=run.readouts.T_map_truth)
        if result.keyframe is not None:
            self._poses.append(result.T_map_odom @ result.keyframe.T_odom_imu)
            self.outbox.chunk(thinned(result.keyframe, self._chunk_voxel))
            self.outbox.put(keyframe_poses=np.array(self._poses))
        for notice in result.notices:
            self.notice_once(notice, result.stamp_ns)

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
