"""What the page is told while frames are processed."""

import re
from dataclasses import replace
from typing import Any

from app.mapping.session import Session
from app.server.delta import Outbox
from app.server.protocol import OpenedRecording, Saved, Transport
from app.slam.map_frame import MapFrame
from app.slam.params import Params
from app.slam.types import StepResult

REPEAT_AFTER_S = 10.0
"""The same kind of notice is shown again only after so much of the recording's time."""
SAVED_KEPT = 10


class Publisher:
    """Turns a session's events into changes in its outbox.

    Attributes:
        transport: as last shown. result: of the frame that is shown, without its keyframe.
    """

    def __init__(self, outbox: Outbox) -> None:
        self.outbox = outbox
        self.transport = Transport()
        self.result: StepResult | None = None
        self._corrections = MapFrame()
        self._noticed: dict[str, int] = {}
        self._saved: tuple[Saved, ...] = ()

    def opened(self, session: Session) -> None:
        """Show another session, from its first frame on, or from where an earlier process left it."""
        self.outbox.begin(session.frames, session.engine.keyframes)
        self.result, self._corrections, self._noticed = None, MapFrame(), {}
        self.outbox.put(recording=OpenedRecording.of(session))
        self.show(frame=session.frame, stamp_ns=0, finished=False, frames_per_second=0.0, dropped=session.dropped)
        if session.frame < 0:
            for finding in session.findings:
                if finding.verdict == "needs you":
                    self.outbox.notice("warning", " ".join(filter(None, (finding.text, finding.option))))

    def show(self, *, urgent: bool = True, **changes: Any) -> None:
        """Change fields of the transport."""
        self.transport = replace(self.transport, **changes)
        self.outbox.put(transport=self.transport, urgent=urgent)

    def frame(self, session: Session, result: StepResult) -> None:
        """Show the next frame, which was just processed."""
        self._show_frame(session, result)
        self.show(frame=session.frame, stamp_ns=result.stamp_ns, urgent=False)
        for notice in result.notices:
            self.notice_once(notice, result.stamp_ns)

    def arrived(self, session: Session, result: StepResult | None) -> None:
        """Show the known frame that the session went to."""
        self._show_frame(session, result)
        self.show(
            frame=session.frame,
            stamp_ns=result.stamp_ns if result else 0,
            finished=session.ended,
            dropped=session.dropped,
        )

    def _show_frame(self, session: Session, result: StepResult | None) -> None:
        self.result = result and replace(result, keyframe=None)
        self.outbox.put(result=self.result)
        self.map_moved(session)

    def map_moved(self, session: Session) -> None:
        """Loops may have moved keyframes."""
        if session.map_frame is not self._corrections:
            self._corrections = session.map_frame
            self.outbox.put(corrections=self._corrections)

    def compared(self, session: Session) -> None:
        """The session is compared with another trajectory."""
        self.outbox.put(recording=OpenedRecording.of(session), urgent=True)

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
        """Warn, unless the same sentence, apart from its numbers, was shown a moment ago."""
        kind = re.sub(r"[\d.]+", "#", text)
        last = self._noticed.get(kind)
        if last is None or abs(stamp_ns - last) > REPEAT_AFTER_S * 1e9:
            self._noticed[kind] = stamp_ns
            self.outbox.notice("warning", text)
