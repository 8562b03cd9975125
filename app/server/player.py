"""Moves the open session through its frames: playing at a speed, stepping and seeking in both directions."""

import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

from app.mapping.breakpoints import Breakpoints, CheckedFrame, reasons
from app.mapping.feed import Quiet
from app.mapping.session import EFFECT, Session
from app.server.protocol import Progress
from app.server.publisher import Publisher, opened_recording
from app.slam.doubts import IN_DOUBT, doubts
from app.slam.errors import HemislamError, refusal
from app.slam.map_frame import NO_PAUSES
from app.slam.types import DroppedScan, StepResult

log = logging.getLogger(__name__)

SOURCE_PERIOD_S = 0.5
SLOWEST = 0.1
LONGEST_LAG_S = 0.5
"""s: if playback lags by more than this, it does not catch up but continues from the present moment."""
LONG_SEEK = 20
"""Progress is shown if at least this many frames must be processed on the way to a frame."""
ONLY_ON = "A live source cannot go back; record it, then open the recording."
FIRST_DOUBT = 100
"""A run is first checked for doubts after this many frames, then each time this number has doubled, and at the end."""
_WARNINGS = ("disconnected", "silent", "recording", "units", "restarted")
"""Kinds of `Status` that are always told, as warnings. A jump of a clock is a warning too, but told less often."""


class Pacer:
    """Computes when the next frame is due at a chosen speed."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.speed = 1.0
        self._anchor: tuple[float, int] | None = None
        self._processed: deque[float] = deque(maxlen=100)

    def release(self) -> None:
        """Make the next frame due at once, after a pause, a jump or a change of speed."""
        self._anchor = None

    def wait(self, stamp_ns: int) -> float:
        """Seconds until a frame of this stamp is due; 0 if it is."""
        now = self._clock()
        started, first_ns = self._anchor or (now, stamp_ns)
        due = started + (stamp_ns - first_ns) * 1e-9 / self.speed
        late = due < now - LONGEST_LAG_S
        self._anchor = (now, stamp_ns) if late else (started, first_ns)
        return max(0.0, due - now)

    def tick(self) -> None:
        """Count a processed frame."""
        self._processed.append(self._clock())

    def rate(self) -> float:
        """Frames per second over about the last second."""
        now = self._clock()
        while len(self._processed) > 2 and self._processed[0] < now - 1.0:
            self._processed.popleft()
        elapsed = now - self._processed[0] if self._processed else 0.0
        return (len(self._processed) - 1) / elapsed if 0 < elapsed < 10 else 0.0


@dataclass(frozen=True, slots=True)
class SeekTarget:
    """A frame to go to. origin: where the seek began. stepping: whether further steps add to it."""

    frame: int
    origin: int
    stepping: bool = False


class Player:
    """Moves a session from frame to frame and shows it on the page. Each call of `work` does a short piece.

    Args:
        clock: monotonic seconds.

    Attributes:
        session: the open session, or None. breakpoints: conditions at which playback pauses.
        page_behind: whether the page does not show the session's frame yet.
        relabelling: whether the ground of the frame shown must be segmented again, with the present parameters.
    """

    def __init__(self, page: Publisher, clock: Callable[[], float] = time.monotonic) -> None:
        self._page = page
        self._pacer = Pacer(clock)
        self._clock, self._looked_at_source = clock, -1e9
        self.session: Session | None = None
        self.breakpoints = Breakpoints()
        self.page_behind = self.relabelling = False
        self._target: SeekTarget | None = None
        self._moment: CheckedFrame | None = None  # the frame that the page shows

    # --- requests --------------------------------------------------------------------------------
    def take(self, session: Session) -> None:
        """Begin with another session, at its present frame or at its first one."""
        self.session = session
        self.relabelling = self.page_behind = False
        self._moment = None
        self._page.opened(session)
        if session.feed.repeatable:
            self._page.put(live=None)
        self._pacer.release()
        self._target = SeekTarget(0, -1) if session.frame < 0 else None

    @property
    def still(self) -> bool:
        """Whether the session stays at its frame."""
        return self._target is None and not self._page.transport.playing and not self.page_behind

    def aim(self, session: Session) -> int:
        """The frame that the session goes to, or where it is; one after the last frame: the end."""
        return self._target.frame if self._target is not None else session.frame + session.ended

    def play(self) -> None:
        self._pacer.release()
        self._page.show(playing=True)

    def halt(self) -> None:
        """Stay at the present frame; end a seek."""
        if self._target is not None:
            self._target = None
            self._page.put(progress=None)
        if self.session is not None:
            self.session.stay()
        self._catch_up()
        self._page.show(playing=False, frames_per_second=0.0)

    def set_speed(self, factor: float) -> None:
        """Raises HemislamError: it is slower than `SLOWEST`, or not a number."""
        if not factor >= SLOWEST:
            raise HemislamError(f"The speed cannot be {factor}; choose one from {SLOWEST} to inf.")
        self._pacer.speed = factor
        self._pacer.release()
        self._page.show(speed=factor)

    def step(self, session: Session, frames: int) -> None:
        """Go this many frames forward, or back; pending steps add up. Raises HemislamError: back on a live source."""
        if frames < 0 and not session.feed.repeatable:
            raise HemislamError(ONLY_ON)
        if self._target is not None and self._target.stepping:
            self._page.show(playing=False, frames_per_second=0.0)
            start = self._target.frame
        else:
            self.halt()
            start = session.frame
        frame = max(start + frames, 0)
        self._aim(session, frame, frame if frame < max(session.heading, session.frame) else None, stepping=True)

    def seek(self, session: Session, frame: int) -> None:
        """Go to a frame as fast as possible, then continue as before. If it is the last frame, continue to the end of
        the recording, where loops are searched once more. Raises HemislamError: the source is live.
        """
        if not session.feed.repeatable:
            raise HemislamError(ONLY_ON)
        frame, frames = max(0, frame), session.feed.info.frames
        self._aim(session, frame + (frame + 1 == frames), frame)

    def resume(self, session: Session, frame: int, *, to_end: bool) -> None:
        """Go to the frame of a session file. to_end: then on to the end of the recording."""
        self._aim(session, max(frame, 0) + to_end, frame)

    def _aim(self, session: Session, frame: int, as_it_was: int | None, *, stepping: bool = False) -> None:
        """Aim at a frame. as_it_was: the last frame to repeat; later ones are processed anew. None: repeat all."""
        if as_it_was is not None:
            try:
                session.go_to(as_it_was)
                while session.result is None and session.revisits:  # when paused, there must be a frame to show
                    session.advance()
            except Exception as error:
                self.fail("Cannot go back", error)
                return
            self.page_behind |= self._page.transport.frame != session.frame
        self._target = SeekTarget(frame, session.frame, stepping)
        self._pacer.release()
        self._arrive(session)

    # --- work ------------------------------------------------------------------------------------
    def work(self) -> float | None:
        """Do the next piece of work. Returns as `Controller.work`."""
        session, target = self.session, self._target
        if session is None:
            return None
        if self.relabelling:
            self.relabel()
            return 0.0
        if target is None and not self._page.transport.playing:
            return None
        return self._advance(session, target)

    def look_at_source(self, session: Session) -> float | None:
        """Show the state of a live source periodically. Returns seconds until the next time."""
        if self._page.transport.finished or session.feed.info.duration_s is not None:
            return None
        now = self._clock()
        if now - self._looked_at_source >= SOURCE_PERIOD_S:
            self._looked_at_source = now
            try:
                state = session.feed.live_state()
            except HemislamError as error:
                self.fail("The live source has ended", error)
                self._page.show(finished=True)
                return None
            self._page.put(live=state, recording=opened_recording(session))
            if self._page.transport.playing:  # even if it no longer sends anything
                self._page.show(frames_per_second=self._pacer.rate(), urgent=False)
        return SOURCE_PERIOD_S

    def fail(self, what: str, error: Exception) -> None:
        """Report an error and pause."""
        if isinstance(error, HemislamError):
            reason = str(error)
        elif isinstance(error, OSError):
            reason = refusal(error)
        else:
            log.error("%s", what, exc_info=error)
            reason = f"{type(error).__name__}: {error}"
        self.halt()
        self._page.notice("error", f"{what}. {reason}")

    def _advance(self, session: Session, target: SeekTarget | None) -> float | None:
        revisited = session.revisits
        try:
            entry = session.peek()
        except Exception as error:  # frames processed so far stay
            repeatable = session.feed.repeatable
            self.fail("The recording cannot be read any further" if repeatable else "The live source has ended", error)
            self._page.show(finished=True)
            return None
        if entry is None:
            self.halt()
            self._page.show(finished=True)
            self._doubt(session)
            return None
        if isinstance(entry, Quiet):
            status = entry.status
            if status is not None and status.kind == "jump":  # two senders on one port cause hundreds
                self._page.notice_once(f"Live: {status.text}.", round(self._clock() * 1e9))
            elif status is not None:
                self._page.notice("warning" if status.kind in _WARNINGS else "info", f"Live: {status.text}.")
            return 0.0
        if isinstance(entry, DroppedScan):
            if not revisited:
                self._page.show(dropped=session.dropped, urgent=False)
                self._page.notice_once(f"A scan was dropped: {entry.reason}.", entry.stamp_ns)
            return 0.0
        paced = target is None and session.feed.repeatable  # a live source keeps its own pace
        if paced and (wait := self._pacer.wait(entry.scan.stamp_ns)) > 0:
            return wait
        try:
            result = session.advance()
        except Exception as error:
            self.fail(f"The frame after frame {session.frame} could not be processed and is left out", error)
            return None
        if not isinstance(result, StepResult):  # it failed the first time too
            return 0.0
        if revisited:
            self.page_behind = True
        else:
            self._page.frame(session, result)
            self._pacer.tick()
            self._page.show(frames_per_second=self._pacer.rate(), urgent=False)
            self._passed(session, result, played=target is None)
            checks, rest = divmod(session.frame, FIRST_DOUBT)
            if not rest and checks.bit_count() == 1:
                self._doubt(session)
        self._arrive(session)
        return 0.0

    def _doubt(self, session: Session) -> None:
        """Report why the run may be wrong, each reason once."""
        for doubt in doubts(session.log, session.loops.tied_ns if session.loops else NO_PAUSES):
            self._page.notice_once(f"{IN_DOUBT} {doubt}")

    def _passed(self, session: Session, result: StepResult, *, played: bool) -> None:
        """Pause if a breakpoint is met, unless a seek only passes the frame."""
        before, self._moment = self._moment, CheckedFrame(result)
        if "error" in self.breakpoints.chosen and before is not None and session.frame > 0:
            errors = session.errors()
            before, self._moment = replace(before, error=errors[-2]), replace(self._moment, error=errors[-1])
        if played and (why := reasons(self.breakpoints, before, self._moment)):
            self.halt()
            self._page.notice("info", f"Paused at frame {session.frame:,}. {' '.join(why)}")

    def _catch_up(self) -> None:
        """Show the session's frame if the page does not show it yet."""
        session = self.session
        if self.page_behind and session is not None:
            self.page_behind = False
            self._page.arrived(session, session.result)
            self._moment = CheckedFrame(session.result) if session.result is not None else None
            self.settle_labels(session)

    def settle_labels(self, session: Session) -> None:
        """Relabel the frame if it was processed with different ground parameters."""
        then = session.params_of(session.frame)
        changed = then.changed(session.params) if then is not None else {}
        self.relabelling = any(EFFECT[path] == "now" for path in changed)

    def _arrive(self, session: Session) -> None:
        """Show the frame unless it is revisited; end a seek at its target, or show its progress."""
        if not session.revisits:
            self._catch_up()
        target, frame = self._target, session.frame
        if target is None:
            return
        if frame >= target.frame:
            self._target = None
            self._pacer.release()
            self._page.put(progress=None, urgent=True)
        elif target.frame - target.origin > LONG_SEEK:
            fraction = (frame - target.origin) / (target.frame - target.origin)
            self._page.put(progress=Progress(f"Going to frame {target.frame}", fraction, target.frame))

    def relabel(self) -> None:
        """Segment the ground of the frame shown again, if needed."""
        session, result, due = self.session, self._page.result, self.relabelling
        self.relabelling = False
        if not due or session is None or result is None:
            return
        try:
            self._page.relabelled(session.engine.relabel(result))
        except Exception as error:
            self.fail("The ground of this frame could not be segmented again", error)
