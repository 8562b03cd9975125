"""Conditions at which playing pauses, and the sentence that says which one held.

`BREAKPOINTS` declares them: a new one is one entry and one function. The page, REST and session files read
the table. Pure: two frames in, sentences out.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from app.slam.errors import HemislamError
from app.slam.loops.types import Origin, Verdict
from app.slam.types import StepResult

Value = bool | float | None


@dataclass(frozen=True, slots=True)
class CheckedFrame:
    """A frame as the breakpoints see it: its result, and its error to the truth (m; nan)."""

    result: StepResult
    error: float = math.nan


@dataclass(frozen=True, slots=True)
class Limit:
    """A number that must be exceeded.

    Attributes:
        unit, default, step: as on the page, which shows `scale` times the breakpoint's own number.
        base_unit: of that number.
    """

    unit: str
    default: float
    step: float
    scale: float = 1.0
    base_unit: str = ""


@dataclass(frozen=True, slots=True)
class Breakpoint:
    """A condition.

    Attributes:
        title, hint: for the page. find: why it holds at a frame, in sentences; none if it does not.
        limit: of what must be exceeded; None: it is a switch.
        event: counts at every frame. Other conditions count where they begin, so that Play goes on from there.
    """

    name: str
    title: str
    hint: str
    find: Callable[[CheckedFrame, float], list[str]]
    limit: Limit | None = None
    event: bool = False


def _loops(moment: CheckedFrame, verdict: Verdict, word: str) -> list[str]:
    return [
        f"Loop {word} between keyframes {edge.older} and {edge.newer}: {edge.reason}."
        for edge in moment.result.loops
        if edge.verdict is verdict and not edge.edited and edge.origin is not Origin.USER  # the user knows of those
    ]


def _loop_found(moment: CheckedFrame, _: float) -> list[str]:
    return _loops(moment, Verdict.ACCEPTED, "found")


def _loop_rejected(moment: CheckedFrame, _: float) -> list[str]:
    return _loops(moment, Verdict.REJECTED, "rejected")


def _no_ground(moment: CheckedFrame, _: float) -> list[str]:
    ground = moment.result.ground
    return [] if ground.found else [f"No ground plane: {ground.reason}."]


def _degenerate(moment: CheckedFrame, _: float) -> list[str]:
    update = moment.result.registration
    return [f"Degenerate: {update.reason or 'this scan leaves one direction unobserved'}."] if update.degenerate else []


def _dropped(moment: CheckedFrame, _: float) -> list[str]:
    count = moment.result.dropped
    return [f"{'1 scan was' if count == 1 else f'{count} scans were'} dropped just before this frame."] if count else []


def _planarity(moment: CheckedFrame, limit: float) -> list[str]:
    value = moment.result.ground.planarity
    return [f"λ3/λ2 of the seeds is {value:.3f}, over {limit:g}."] if value > limit else []


def _residual(moment: CheckedFrame, limit: float) -> list[str]:
    value = moment.result.registration.residual_rms
    return [f"The residual is {1e3 * value:.1f} mm, over {1e3 * limit:g} mm."] if value > limit else []


def _frame_ms(moment: CheckedFrame, limit: float) -> list[str]:
    value = moment.result.timings_ms.get("total", math.nan)
    return [f"The frame took {value:.1f} ms, over {limit:g} ms."] if value > limit else []


def _error(moment: CheckedFrame, limit: float) -> list[str]:
    value = moment.error
    return [f"The error to truth is {100 * value:.1f} cm, over {100 * limit:g} cm."] if value > limit else []


BREAKPOINTS: Final = (
    Breakpoint("loop_found", "loop found", "A loop was accepted.", _loop_found, event=True),
    Breakpoint("loop_rejected", "loop rejected", "A loop candidate was rejected.", _loop_rejected, event=True),
    Breakpoint("no_ground", "no ground", "The seeds gave no plane; the notice says why.", _no_ground),
    Breakpoint("degenerate", "degenerate", "The scan does not constrain one direction.", _degenerate),
    Breakpoint("dropped", "scan dropped", "A scan was not processed.", _dropped, event=True),
    Breakpoint("planarity", "λ3/λ2 over", "The seeds are less flat than this.", _planarity, Limit("", 0.3, 0.01)),
    Breakpoint(
        "residual", "residual over", "RMS distance of the points to the map's planes.", _residual,
        Limit("mm", 50.0, 1.0, 1000.0, "m"),
    ),
    Breakpoint(
        "frame_ms", "frame over", "Time that the engine took for the frame.", _frame_ms,
        Limit("ms", 100.0, 1.0, base_unit="ms"),
    ),
    Breakpoint(
        "error", "error over", "Distance to the truth, where there is one.", _error, Limit("cm", 50.0, 1.0, 100.0, "m")
    ),
)  # fmt: skip
_BY_NAME: Final = {one.name: one for one in BREAKPOINTS}


class Breakpoints(Mapping[str, Value]):
    """Where to pause, by name: True or False for a switch, a number or None for a limit. A value.

    Raises:
        HemislamError: there is no such breakpoint, or a limit is negative or not a number.
    """

    __slots__ = ("_chosen",)

    def __init__(self, **chosen: Value) -> None:
        for name, value in chosen.items():
            if name not in _BY_NAME:
                raise HemislamError(f"There is no breakpoint `{name}`; there are {', '.join(_BY_NAME)}.")
            if _BY_NAME[name].limit is not None and value is not None and not 0.0 <= value < math.inf:
                raise HemislamError(f"The breakpoint `{name}` cannot be {value}; give a number from 0 on.")
        self._chosen = {
            name: float(value) for name, value in chosen.items() if value is not None and value is not False
        }

    def __getitem__(self, name: str) -> Value:
        value = self._chosen.get(name)
        return value if _BY_NAME[name].limit is not None else value is not None

    def __iter__(self) -> Iterator[str]:
        return iter(_BY_NAME)

    def __len__(self) -> int:
        return len(_BY_NAME)

    def __repr__(self) -> str:
        return f"Breakpoints({', '.join(f'{name}={value}' for name, value in self._chosen.items())})"

    @property
    def chosen(self) -> dict[str, float]:
        """Those that are set; a switch has the number 1."""
        return self._chosen.copy()


def reasons(breakpoints: Breakpoints, before: CheckedFrame | None, now: CheckedFrame) -> tuple[str, ...]:
    """Why to pause at `now`, one sentence each; none: go on.

    Args:
        before: the frame before; None: unknown, so that every condition begins now.
    """
    found: list[str] = []
    for name, limit in breakpoints.chosen.items():
        one = _BY_NAME[name]
        if one.event or before is None or not one.find(before, limit):
            found += one.find(now, limit)
    return tuple(found)
