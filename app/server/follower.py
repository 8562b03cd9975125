"""How one engine is kept at the frame of another."""

from app.server.protocol import Command, Seek, Snapshot, StepFrame

STUCK_S = 1.0
"""B is told again where to go if nothing has happened for so long: a process that dies loses its commands."""


def same_recording(a: Snapshot, b: Snapshot) -> bool:
    """Whether frames of one can be compared with those of the other."""
    if a.recording is None or b.recording is None:
        return False
    return a.recording.path.resolve() == b.recording.path.resolve() and a.recording.start_ns == b.recording.start_ns


class Follower:
    """Says what brings B to A's frame: one seek at a time, except that going back is immediate.

    Args:
        frame: that B goes to at first.
    """

    def __init__(self, frame: int) -> None:
        self._target = frame
        self._revision, self._since = -1, 0.0
        self._ended = False

    def next(self, a: Snapshot, b: Snapshot, now: float) -> Command | None:
        """What to send B now (monotonic s), if anything."""
        if b.revision != self._revision:
            self._revision, self._since = b.revision, now
        wanted, here = a.transport.frame, b.transport.frame
        if wanted < 0 or not same_recording(a, b):
            return None
        if wanted == here == self._target:
            return self._end(a, b)
        self._ended = False
        stuck = here != wanted and b.progress is None and now - self._since >= STUCK_S
        arrived = here == self._target
        back = wanted < max(here, self._target)
        if not stuck and (wanted == self._target or not (arrived or back)):
            return None
        self._since = now
        self._target = wanted
        last = b.recording.frames - 1 if b.recording else wanted
        if wanted > last:  # the number of frames is an estimate, which a seek keeps to
            self._target = wanted if here >= last else last
            return StepFrame(wanted - here) if here >= last else Seek(last)
        return Seek(wanted)

    def _end(self, a: Snapshot, b: Snapshot) -> Command | None:
        """At A's frame: to the end with it, beyond the last frame, where the last loops are found."""
        if self._ended or not a.transport.finished or b.transport.finished:
            return None
        self._ended = True
        return StepFrame()
