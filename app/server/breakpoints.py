"""Conditions at which playing pauses, and the sentence that says which one held.

Pure: two frames in, sentences out. A state (no ground, a residual over its limit) counts where it begins,
so that Play goes on from there; an event (a loop, a dropped scan) counts every time.
"""

import math
from dataclasses import dataclass, fields

from app.slam.errors import HemislamError
from app.slam.loops.types import Origin, Verdict
from app.slam.types import StepResult


@dataclass(frozen=True, slots=True)
class Breakpoints:
    """Where to pause. A number is a limit that is to be exceeded; None is off.

    Attributes:
        planarity: λ3/λ2 of the seeds. residual: RMS of the filter's update, m.
        frame_ms: time that the engine took for the frame. error: to the truth, m.

    Raises:
        HemislamError: a limit is negative or no number.
    """

    loop_found: bool = False
    loop_rejected: bool = False
    no_ground: bool = False
    degenerate: bool = False
    dropped: bool = False
    planarity: float | None = None
    residual: float | None = None
    frame_ms: float | None = None
    error: float | None = None

    def __post_init__(self) -> None:
        for name in LIMITS:
            value = getattr(self, name)
            if value is not None and not 0.0 <= value < math.inf:
                raise HemislamError(f"The breakpoint `{name}` can not be {value}; give a number from 0 on.")

    @property
    def any(self) -> bool:
        return any(getattr(self, field.name) not in (None, False) for field in fields(self))


LIMITS = ("planarity", "residual", "frame_ms", "error")
"""Those of `Breakpoints` that are numbers; the others are switches."""


@dataclass(frozen=True, slots=True)
class Moment:
    """A frame as the breakpoints see it: its result, and its error to the truth (m; nan)."""

    result: StepResult
    error: float = math.nan


def reasons(breakpoints: Breakpoints, before: Moment | None, now: Moment) -> tuple[str, ...]:
    """Why to pause at `now`, in one sentence each; none: go on.

    Args:
        before: the frame before; None: unknown, so that every state begins now.
    """
    held = _states(breakpoints, before) if before is not None else {}
    begun = (text for name, text in _states(breakpoints, now).items() if name not in held)
    return (*begun, *_events(breakpoints, now.result))


def _states(limits: Breakpoints, moment: Moment) -> dict[str, str]:
    """Conditions that hold at a frame, by name, in words."""
    result, held = moment.result, {}
    ground, update = result.ground, result.registration
    took = result.timings_ms.get("total", math.nan)
    if limits.no_ground and not ground.found:
        held["no_ground"] = f"No ground plane: {ground.reason}."
    if limits.planarity is not None and ground.planarity > limits.planarity:
        held["planarity"] = f"λ3/λ2 of the seeds is {ground.planarity:.3f}, over {limits.planarity:g}."
    if limits.residual is not None and update.residual_rms > limits.residual:
        held["residual"] = f"The residual is {1e3 * update.residual_rms:.1f} mm, over {1e3 * limits.residual:g} mm."
    if limits.degenerate and update.degenerate:
        held["degenerate"] = f"Degenerate: {update.reason or 'this scan leaves one direction unobserved'}."
    if limits.frame_ms is not None and took > limits.frame_ms:
        held["frame_ms"] = f"The frame took {took:.1f} ms, over {limits.frame_ms:g} ms."
    if limits.error is not None and moment.error > limits.error:
        held["error"] = f"The error to truth is {100 * moment.error:.1f} cm, over {100 * limits.error:g} cm."
    return held


def _events(wanted: Breakpoints, result: StepResult) -> list[str]:
    texts = []
    if wanted.dropped and result.dropped:
        scans = "1 scan was" if result.dropped == 1 else f"{result.dropped} scans were"
        texts.append(f"{scans} left out just before this frame.")
    for edge in result.loops:
        if edge.edited or edge.origin is Origin.USER:  # that is no news to the user
            continue
        between = f"between keyframes {edge.older} and {edge.newer}"
        if wanted.loop_found and edge.verdict is Verdict.ACCEPTED:
            texts.append(f"Loop found {between}: {edge.reason}.")
        if wanted.loop_rejected and edge.verdict is Verdict.REJECTED:
            texts.append(f"Loop rejected {between}: {edge.reason}.")
    return texts
