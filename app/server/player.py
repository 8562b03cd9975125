"""The way of the open run through its frames: playing at a pace, stepping and seeking, both ways."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from app.server.breakpoints import Breakpoints, Moment, reasons
from app.server.checkpoints import NEAR
from app.server.delta import Outbox
from app.server.live import tells
from app.server.pacing import Pacer
from app.server.protocol import Progress
from app.server.publisher import Publisher
from app.server.run import EFFECT, Quiet, Run
from app.server.saver import Saver
from app.slam.errors import HemislamError
from app.slam.types import DroppedScan, StepResult

log = logging.getLogger(__name__)

SLOWEST = 0.1
LONG_SEEK = 20
"""Frames to process on the way to a frame, from which on progress is shown."""


@dataclass(frozen=True, slots=True)
class Journey:
    """The way to a frame that was asked for.

    Attributes:
        target: the frame. origin: where it began, for progress.
        again_to: frames up to this one are taken as they were, unseen until its end; later ones anew.
        stepping: asked for step by step; further steps add up.
        back: first to the checkpoint before `again_to`, which may be later than here.
    """

    target: int
    again_to: int
    stepping: bool
    back: bool
    origin: int


class Player:
    """Takes a run from frame to frame and has the page show where it is.

    What is asked for is only noted; `work` does it, a short piece a call.

    Args:
        saver: whose saves must end before keyframes are gone back over.
        clock: monotonic seconds.

    Attributes:
        run: the open one, or None. breakpoints: where playing pauses.
        page_behind: whether the page does not show the frame that the run is at.
        relabelling: whether the ground of the frame shown is to be found again, with the present parameters.
    """

    def __init__(
        self, outbox: Outbox, page: Publisher, saver: Saver, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._outbox = outbox
        self._page = page
        self._saver = saver
        self._pacer = Pacer(clock)
        self.run: Run | None = None
        self.breakpoints = Breakpoints()
        self.page_behind = self.relabelling = False
        self._journey: Journey | None = None
        self._unseen: StepResult | None = None
        self._moment: Moment | None = None  # the frame that the page shows

    # --- what is asked for -----------------------------------------------------------------------
    def take(self, run: Run) -> None:
        """Begin with another run, at its first frame, or at the one that it is at."""
        self.run = run
        self.relabelling = self.page_behind = False
        self._moment = self._unseen = None
        run.remember()
        self._page.opened(run)
        self._pacer.release()
        if run.frame < 0:
            self.go_to(0, -1)

    def play(self) -> None:
        self._pacer.release()
        self._page.show(playing=True)

    def halt(self) -> None:
        """Stay at the present frame, also if one was being sought."""
        if self._journey is not None:
            self._journey = None
            self._outbox.put(progress=None)
        self._catch_up()
        self._page.show(playing=False, frames_per_second=0.0)

    def set_speed(self, factor: float) -> None:
        """Raises HemislamError: it is slower than `SLOWEST`, or no number."""
        if not factor >= SLOWEST:
            raise HemislamError(f"The speed can not be {factor}; choose one from {SLOWEST} to inf.")
        self._pacer.speed = factor
        self._page.show(speed=factor)

    def step(self, run: Run, frames: int) -> None:
        """Steps asked for while the last one is not done yet add up. Raises HemislamError: back in a live run."""
        journey = self._journey
        if run.live and frames < 0:
            raise HemislamError("A live source can only go on; record it, and open the recording to go back in it.")
        if journey is not None and journey.stepping:
            self._page.show(playing=False, frames_per_second=0.0)
            start, again_to = journey.target, journey.again_to
            if not journey.back:
                again_to = max(again_to, run.frame)  # what was passed on the way is not gone back over
        else:
            self.halt()
            start = again_to = run.frame
        frame = max(start + frames, 0)
        self.go_to(frame, min(again_to, frame), stepping=True)

    def seek(self, run: Run, frame: int) -> None:
        """Raises HemislamError: the run is live."""
        if run.live:
            raise HemislamError("A live source can only go on; record it, and open the recording to go back in it.")
        frame = max(0, min(frame, run.opened.frames - 1))
        self.go_to(frame, min(frame, run.known))

    def go_to(self, frame: int, again_to: int, *, stepping: bool = False) -> None:
        """Go to a frame as fast as possible, then go on as before; see `Journey`."""
        run = self.run
        assert run is not None
        nearest = run.checkpoints.before(again_to)
        back = again_to < run.frame or (nearest is not None and run.frame < nearest)
        self._journey = Journey(frame, again_to, stepping, back, run.frame)
        if not back and run.frame >= frame:
            self._catch_up()
            self._approach(run.frame)

    def last_known(self, run: Run) -> int:
        """The last frame that stays as it is if what comes after is to be different."""
        if self._journey is None:
            return run.frame
        return max(run.frame, self._journey.again_to, min(self._journey.target, run.followed_to))

    # --- work ------------------------------------------------------------------------------------
    def work(self) -> float | None:
        """Do the next piece of due work; returns as `Session.work`."""
        if self.run is None:
            return None
        if self.relabelling:
            self._relabel(self.run)
            return 0.0
        if self._journey is not None and self._journey.back:
            self._go_back(self.run, self._journey)
            return 0.0
        moving = self._page.transport.playing or self._journey is not None
        return self._advance(self.run) if moving else None

    def fail(self, what: str, error: Exception) -> None:
        """Tell the user, pause, and go on living."""
        if isinstance(error, HemislamError):
            reason = str(error)
        else:
            log.error("%s", what, exc_info=error)
            reason = f"{type(error).__name__}: {error}"
        self.halt()
        self._outbox.notice("error", f"{what}. {reason}")

    def _go_back(self, run: Run, journey: Journey) -> None:
        """To the checkpoint, and on by a frame: there is something to show then, should that be the end of it."""
        self._saver.wait()  # it may read keyframes that are about to be replaced
        try:
            run.go_before(journey.again_to)
        except Exception as error:
            self.fail("The frames before can not be gone back to", error)
            return
        self._journey = replace(journey, back=False, origin=run.frame)
        self.page_behind, self._unseen = True, None
        self._pacer.release()
        while self._journey is not None and self.page_behind and self._unseen is None:
            self._advance(run)

    def _advance(self, run: Run) -> float | None:
        """Process the next frame if it is due."""
        journey = self._journey
        try:
            entry = run.peek()
        except Exception as error:  # what was processed stays; the rest can not be read
            self.fail("The recording can not be read on from here", error)
            self._page.show(finished=True)
            return None
        again = journey is not None and run.frame < journey.again_to
        if entry is None:
            self.halt()
            self._page.show(finished=True)
            return None
        if isinstance(entry, Quiet):
            if entry.status is not None:
                level: Literal["warning", "info"] = "warning" if tells(entry.status) else "info"
                self._outbox.notice(level, f"Live: {entry.status.text}.")
            return 0.0
        if isinstance(entry, DroppedScan):
            if again:
                return 0.0
            self._page.show(dropped=run.log.dropped.total(), urgent=False)
            self._page.notice_once(f"A scan was left out: {entry.reason}.", entry.stamp_ns)
            return 0.0
        if journey is None and not run.live and (wait := self._pacer.wait(entry.scan.stamp_ns)) > 0:
            return wait
        try:
            result = run.step(again=again, sought=journey is not None and not journey.stepping)
        except Exception as error:
            if again:  # as it did then
                return 0.0
            self.fail(f"The frame after frame {run.frame} could not be processed and is left out", error)
            return None
        if again and journey is not None:
            self.page_behind, self._unseen = True, result
            run.remember(near=journey.again_to - run.frame <= NEAR)
            if run.frame >= journey.again_to:
                self._catch_up()
        else:
            self._page.frame(run, result)
            self._page.show(frames_per_second=self._pacer.tick(), urgent=False)
            run.remember()
            self._passed(run, result, played=journey is None)
        self._approach(run.frame)
        return 0.0

    def _passed(self, run: Run, result: StepResult, *, played: bool) -> None:
        """Pause where a breakpoint holds, unless the frame is one on the way to another."""
        before, self._moment = self._moment, Moment(result)
        if self.breakpoints.error is not None and before is not None and run.frame > 0:
            errors = run.errors()
            before, self._moment = replace(before, error=errors[-2]), replace(self._moment, error=errors[-1])
        if played and (why := reasons(self.breakpoints, before, self._moment)):
            self.halt()
            self._outbox.notice("info", f"Paused at frame {run.frame:,}. {' '.join(why)}")

    def _catch_up(self) -> None:
        """Show the frame that was gone to, if the page does not."""
        if self.page_behind and self.run is not None:
            run, result = self.run, self._unseen
            self.page_behind, self._unseen = False, None
            self._page.arrived(run, result)
            self._moment = Moment(result) if result is not None else None
            self.settle_labels(run)

    def settle_labels(self, run: Run) -> None:
        """Have the frame shown with the present ground parameters, if it was processed with others."""
        then = run.params_of(run.frame)
        changed = then.changed(run.params) if then is not None else {}
        self.relabelling = any(EFFECT[path] == "now" for path in changed)

    def _approach(self, frame: int) -> None:
        """At a frame of the journey, if there is one: end it there or say how far it is."""
        journey = self._journey
        if journey is None:
            return
        if frame >= journey.target:
            self._journey = None
            self._pacer.release()
            self._outbox.put(progress=None, urgent=True)
        elif journey.target - journey.origin > LONG_SEEK:
            fraction = (frame - journey.origin) / (journey.target - journey.origin)
            self._outbox.put(progress=Progress(f"Going to frame {journey.target}", fraction))

    def _relabel(self, run: Run) -> None:
        self.relabelling = False
        if self._page.result is None:
            return
        try:
            self._page.relabelled(run.engine.relabel(self._page.result))
        except Exception as error:
            self.fail("The ground of this frame could not be found again", error)
