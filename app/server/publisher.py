"""Collects changes for the page in the engine's process, and makes deltas from them.

For most fields, only the newest value is sent. A cursor follows the frames, and clouds are read from disk when they are
sent. So a slow reader never delays the engine and misses nothing, and no data accumulates for it.
"""

import re
from bisect import bisect_left
from dataclasses import replace
from typing import Any, Literal

from app.mapping.session import Session
from app.server.chunks import thinned
from app.server.protocol import Delta, LoopsView, Notice, OpenedRecording, Saved, Transport
from app.server.setup import NOTHING_SEEN, Seen
from app.slam.frames import Frame
from app.slam.log import Cursor, Log
from app.slam.loops.types import LoopEdge, difference
from app.slam.map_frame import MapFrame
from app.slam.params import Params
from app.slam.ply import Keyframes
from app.slam.types import StepResult

CHUNKS_AT_ONCE = 20
"""Most clouds in one delta, so that a reader that is far behind sees the map grow."""
REPEAT_AFTER_S = 10.0
"""Recording time after which a notice of the same kind is shown again."""
SAVED_KEPT = 10


def opened_recording(session: Session) -> OpenedRecording:
    """Describe a session's source. The duration of a source without an end is that of the processed part."""
    info, truth = session.feed.info, session.truth
    newest = session.frames[session.frame] if session.frame >= 0 else None
    so_far_s = (newest.stamp_ns - info.start_ns) * 1e-9 if newest is not None else 0.0
    return OpenedRecording(
        path=info.path,
        start_ns=info.start_ns,
        end_s=so_far_s if info.end_s is None else info.end_s,
        frames=session.frame + 1 if info.frames is None else info.frames,
        findings=session.findings,
        truth_stamps_ns=truth.stamps_ns if truth else None,
        truth_positions=truth.positions if truth else None,
        truth=session.truth_path,
        fixes=info.fixes,
        start_s=info.start_s,
    )


class Publisher:
    """Turns a session's events into deltas.

    Args:
        seen: counts that the reader already has.

    Attributes:
        urgent: whether the next delta is needed at once, whatever the rate limit.
        transport: as last shown. result: of the shown frame, without its keyframe.
    """

    def __init__(self, params: Params, seen: Seen = NOTHING_SEEN) -> None:
        self.transport = Transport()
        self.result: StepResult | None = None
        self.urgent = True
        self._session, self._notices_given = seen.session, seen.notices
        self._replaced: dict[str, Any] = {"params": params}
        self._corrections = MapFrame()
        self._noticed: dict[str, int] = {}
        self._saved: tuple[Saved, ...] = ()
        self._notices: list[Notice] = []
        self._recording = ""
        self._frames: Log[Frame] = Log()
        self._clouds: Keyframes = ()
        # State of the reader:
        self._edges: tuple[LoopEdge, ...] = ()
        self._cursor = Cursor(0, seen.frames)
        self._keyframes: list[int] = []  # their frames
        self._chunks = seen.chunks
        self._again: set[int] = set()  # chunks to send again

    def put(self, *, urgent: bool = False, **values: Any) -> None:
        """Set fields of the snapshot."""
        self._replaced |= values
        self.urgent |= urgent

    def notice(self, level: Literal["info", "warning", "error"], text: str) -> None:
        self._notices_given += 1
        self._notices.append(Notice(self._notices_given, level, text, self._recording))
        self.urgent = True

    def notice_once(self, text: str, stamp_ns: int | None = None) -> None:
        """Warn, unless the same sentence (numbers aside) was shown a moment before this stamp; None: in the session."""
        kind = re.sub(r"[\d.]+", "#", text)
        last = self._noticed.get(kind)
        if last is None or (stamp_ns is not None and abs(stamp_ns - last) > REPEAT_AFTER_S * 1e9):
            self._noticed[kind] = stamp_ns or 0
            self.notice("warning", text)

    def begin(self, frames: Log[Frame], keyframes: Keyframes) -> None:
        """Follow another session. If it has frames, an earlier process began it."""
        self._frames, self._clouds, self._edges = frames, keyframes, ()
        self._keyframes = [index for index, frame in enumerate(frames) if frame.keyframe]
        if len(frames):
            self._cursor = Cursor(0, min(self._cursor.length, len(frames)))
            self._chunks = min(self._chunks, len(self._keyframes))
        else:
            self._session += 1
            self._cursor, self._chunks = Cursor(), 0
        none = MapFrame()
        self.put(urgent=True, session=self._session, result=None, corrections=none, adjustment=none, loops=LoopsView())

    @property
    def filled(self) -> bool:
        """Whether there are changes to take."""
        again = any(map(self._readable, self._again))
        behind = again or self._frames.cursor != self._cursor or self._chunks < self._chunks_ready
        return bool(self._replaced or self._notices or behind)

    @property
    def _chunks_ready(self) -> int:
        """Number of keyframes whose cloud can be read: after a seek back, only those up to the session's frame."""
        return min(len(self._keyframes), len(self._clouds))

    def _readable(self, keyframe: int) -> bool:
        return keyframe < len(self._clouds)

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
        shown = {index for index in self._again if index < first}
        again = sorted(filter(self._readable, shown))  # others follow when the session reaches their frames again
        chunks = tuple(thinned(self._clouds[index]) for index in (*again, *range(first, self._chunks)))
        delta = Delta(self._replaced, edges, keep, frames, chunks, tuple(self._notices))
        self._replaced, self._notices, self._again, self.urgent = {}, [], shown.difference(again), False
        return delta

    # --- events ----------------------------------------------------------------------------------
    def opened(self, session: Session) -> None:
        """Show another session, from its first frame or from the frame at which an earlier process left it."""
        self.begin(session.frames, session.keyframes)
        self.result, self._corrections, self._noticed = None, MapFrame(), {}
        self._recording = session.feed.info.path.name
        self.put(recording=opened_recording(session))
        stamp_ns = session.frames[session.frame].stamp_ns if session.frame >= 0 else 0
        self.show(
            frame=session.frame, stamp_ns=stamp_ns, finished=False, frames_per_second=0.0, dropped=session.dropped
        )
        if session.frame < 0:
            for finding in session.findings:
                if finding.verdict == "needs you":
                    self.notice("warning", finding.sentence)

    def show(self, *, urgent: bool = True, **changes: Any) -> None:
        """Change fields of the transport."""
        self.transport = replace(self.transport, **changes)
        self.put(transport=self.transport, urgent=urgent)

    def frame(self, session: Session, result: StepResult) -> None:
        """Show the next frame, which was just processed."""
        self._show_frame(session, result)
        self.show(frame=session.frame, stamp_ns=result.stamp_ns, urgent=False)
        for notice in result.notices:
            self.notice_once(notice, result.stamp_ns)

    def arrived(self, session: Session, result: StepResult | None) -> None:
        """Show the frame to which the session has gone."""
        self._show_frame(session, result)
        stamp_ns = result.stamp_ns if result else 0
        self.show(frame=session.frame, stamp_ns=stamp_ns, finished=session.ended, dropped=session.dropped)

    def _show_frame(self, session: Session, result: StepResult | None) -> None:
        self.result = result and replace(result, keyframe=None)
        self.put(result=self.result)
        self.map_moved(session)

    def map_moved(self, session: Session) -> None:
        """Show the corrections by loops and fixes, if they have changed."""
        if session.shown_frame is not self._corrections:
            self._corrections = session.shown_frame
            self.put(corrections=self._corrections, adjustment=session.adjustment)

    def relabelled(self, result: StepResult) -> None:
        """Show new labels of the frame."""
        self.result = result
        self.put(result=result, urgent=True)

    def show_again(self, keyframe: int, *, urgent: bool = True) -> None:
        """Send a keyframe again, since its labels have changed."""
        self._again.add(keyframe)
        self.urgent |= urgent

    def saved(self, saved: Saved) -> None:
        self._saved = (*self._saved, saved)[-SAVED_KEPT:]
        self.put(saved=self._saved, urgent=True)
        if not saved.fetched:
            self.notice("error" if saved.error else "info", saved.error or f"Saved in {saved.folder}.")
