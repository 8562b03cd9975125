"""Conditions at which playing pauses, and sentences that say which of them were met.

`BREAKPOINTS` declares them: a new one is one entry and one function. The page, REST and session files read the table.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pydantic import ConfigDict, Field, create_model

from app.slam.loops.types import Origin, Verdict
from app.slam.types import StepResult


@dataclass(frozen=True, slots=True)
class CheckedFrame:
    """A frame as the breakpoints see it: its result, and its distance to the truth (m; nan if unknown)."""

    result: StepResult
    error: float = math.nan


Find = Callable[[CheckedFrame, float], list[str]]
"""Why a condition with this limit is met at a frame, in sentences; none if it is not."""


@dataclass(frozen=True, slots=True)
class Limit:
    """A number that must be exceeded, in `base_unit`. The page shows it times `scale`, in `unit`."""

    unit: str
    default: float
    step: float
    scale: float = 1.0
    base_unit: str = ""


@dataclass(frozen=True, slots=True)
class Breakpoint:
    """A condition.

    Attributes:
        title, hint: for the page. limit: None for a switch.
        event: pauses at every frame that meets it. Other conditions pause only where they begin, so that Play goes on.
    """

    name: str
    title: str
    hint: str
    find: Find
    limit: Limit | None = None
    event: bool = False


def _loops(verdict: Verdict, word: str) -> Find:
    def find(moment: CheckedFrame, _: float) -> list[str]:
        return [
            f"Loop {word} between keyframes {edge.older} and {edge.newer}: {edge.reason}."
            for edge in moment.result.loops
            if edge.verdict is verdict and not edge.edited and edge.origin is not Origin.USER  # the user knows of those
        ]

    return find


def _no_ground(moment: CheckedFrame, _: float) -> list[str]:
    ground = moment.result.ground
    return [] if ground.found else [f"No ground plane: {ground.reason}."]


def _degenerate(moment: CheckedFrame, _: float) -> list[str]:
    update = moment.result.registration
    return [f"Degenerate: {update.reason or 'this scan leaves one direction unobserved'}."] if update.degenerate else []


def _dropped(moment: CheckedFrame, _: float) -> list[str]:
    count = moment.result.dropped
    return [f"{'1 scan was' if count == 1 else f'{count} scans were'} dropped just before this frame."] if count else []


def _over(value: Callable[[CheckedFrame], float], sentence: str, scale: float = 1.0) -> Find:
    """A number of the frame exceeds the limit. sentence: with placeholders for both, times `scale`."""

    def find(moment: CheckedFrame, limit: float) -> list[str]:
        now = value(moment)
        return [sentence.format(scale * now, scale * limit)] if now > limit else []

    return find


BREAKPOINTS: Final = (
    Breakpoint("loop_found", "loop found", "A loop was accepted.", _loops(Verdict.ACCEPTED, "found"), event=True),
    Breakpoint(
        "loop_rejected", "loop rejected", "A loop candidate was rejected.", _loops(Verdict.REJECTED, "rejected"),
        event=True,
    ),
    Breakpoint("no_ground", "no ground", "The seeds gave no plane; the notice says why.", _no_ground),
    Breakpoint("degenerate", "degenerate", "The scan does not constrain one direction.", _degenerate),
    Breakpoint("dropped", "scan dropped", "A scan was not processed.", _dropped, event=True),
    Breakpoint(
        "planarity", "λ3/λ2 over", "The seeds are less flat than this.",
        _over(lambda one: one.result.ground.planarity, "λ3/λ2 of the seeds is {:.3f}, over {:g}."),
        Limit("", 0.3, 0.01),
    ),
    Breakpoint(
        "residual", "residual over", "RMS distance of the points to the map's planes.",
        _over(lambda one: one.result.registration.residual_rms, "The residual is {:.1f} mm, over {:g} mm.", 1e3),
        Limit("mm", 50.0, 1.0, 1000.0, "m"),
    ),
    Breakpoint(
        "frame_ms", "frame over", "Time that the engine took for the frame.",
        _over(lambda one: one.result.timings_ms.get("total", math.nan), "The frame took {:.1f} ms, over {:g} ms."),
        Limit("ms", 100.0, 1.0, base_unit="ms"),
    ),
    Breakpoint(
        "error", "error over", "Distance to the truth, where there is one.",
        _over(lambda one: one.error, "The error to truth is {:.1f} cm, over {:g} cm.", 100.0),
        Limit("cm", 50.0, 1.0, 100.0, "m"),
    ),
)  # fmt: skip
_BY_NAME: Final = {one.name: one for one in BREAKPOINTS}


def _field(one: Breakpoint) -> Any:
    if one.limit is None:
        return bool, Field(False, description=one.hint)
    unit = f" Unit: {one.limit.base_unit}." if one.limit.base_unit else ""
    return float | None, Field(None, ge=0, allow_inf_nan=False, description=one.hint + unit)


_Fields: Any = create_model("_Fields", **{one.name: _field(one) for one in BREAKPOINTS})


class Breakpoints(_Fields):  # type: ignore[misc]  # its fields are those of the table
    """Where playing pauses. A limit pauses when it is exceeded; without a value, or with null, it is off."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @property
    def chosen(self) -> dict[str, float]:
        """Those that are set; a switch has the number 1."""
        return {name: float(value) for name, value in self if value is not None and value is not False}


def reasons(breakpoints: Breakpoints, before: CheckedFrame | None, now: CheckedFrame) -> tuple[str, ...]:
    """Why to pause at `now`, one sentence each; none: go on.

    Args:
        before: the previous frame; None: unknown, so that every condition begins now.
    """
    found: list[str] = []
    for name, limit in breakpoints.chosen.items():
        one = _BY_NAME[name]
        if one.event or before is None or not one.find(before, limit):
            found += one.find(now, limit)
    return tuple(found)
