"""The kinds of loops that the page distinguishes, and its words for loops, edits and the graph's residuals."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from app.slam import lie
from app.slam.loops.edits import Accept, Add, LoopEdit, Override, Reject, SetWeight, Solve
from app.slam.loops.types import FactorResidual, LoopEdge, Origin, Pair, Preview, Verdict
from app.slam.sections import LoopsParams
from app.slam.types import F64
from app.ui.colours import Rgb
from app.ui.html import BAD, GOOD, Tile, number, panel

_LARGEST: Final = 12
_ODOMETRY: Final = "#5b8def"
_LEAST_MOVE_M: Final = 5e-4
_LEAST_TURN_DEG: Final = 5e-3


@dataclass(frozen=True, slots=True)
class LoopKind:
    """Attributes:
    meaning: a sentence. width: of an arch that is in the graph, px. out_width: of one that is not.
    knob_m: diameter of its knob.
    """

    name: str
    meaning: str
    colour: Rgb
    width: float
    out_width: float
    knob_m: float


BRIDGE: Final = "loops"
"""Name of the bridge for everything about loops that can be clicked."""
EDITED: Final = "edited"
KINDS: Final[dict[str, LoopKind]] = {
    kind.name: kind
    for kind in (
        LoopKind("accepted", "The search accepted them; they correct the map.", (62, 207, 154), 3.0, 1.0, 0.1),
        LoopKind("candidate", "They fit, but wait until other loops agree.", (255, 190, 60), 2.0, 2.0, 0.1),
        LoopKind("rejected", "The search rejected them; they change nothing.", (214, 84, 92), 1.0, 1.0, 0.07),
        LoopKind(
            EDITED,
            "You accepted, rejected, weighed or added them; they are counted here only.",
            (178, 136, 255),
            3.5,
            1.0,
            0.12,
        ),
    )
}
"""Kinds by the search's verdict, or `edited` if the user decided; in the order shown."""
SIGNS: Final = {Verdict.ACCEPTED: "✓", Verdict.CANDIDATE: "?", Verdict.REJECTED: "✕"}
"""Symbol of each verdict in the table, in sorting order."""

OLDER: Final[Rgb] = (70, 170, 255)
NEWER: Final[Rgb] = (255, 150, 60)
"""Colours of the two submaps, wherever they are shown."""


def kind_of(edge: LoopEdge) -> LoopKind:
    return KINDS[EDITED if edge.edited or edge.origin is Origin.USER else edge.verdict.value]


def name(pair: Pair) -> str:
    """`12–340`: older, newer keyframe."""
    return f"{pair[0]}–{pair[1]}"


def describe_edit(command: LoopEdit) -> str:
    if isinstance(command, Solve):
        return "solve all at once"
    if isinstance(command, Override):
        return f"{'accept' if command.accepted else 'reject'} {command.what}"
    pair = name((command.older, command.newer))
    match command:
        case Accept():
            return f"accept {pair}"
        case SetWeight(weight=weight):
            return f"weigh {pair} by {weight:g}"
        case Add(register=register):
            return f"add {pair}" + ("" if register else " without registration")
        case _:
            return f"reject {pair}"


def what_happened(command: LoopEdit, before: F64, after: F64) -> str:
    """A sentence on an applied edit, given the (k, 4, 4) poses before and after it."""
    verb, _, rest = describe_edit(command).partition(" ")
    past = {"add": "Added", "solve": "Solved"}.get(verb, f"{verb.capitalize()}ed")
    return panel("loops.happened", f"{past} {rest}", _moves(after, before))


def what_was_undone(command: LoopEdit, edges: tuple[LoopEdge, ...], before: F64, after: F64) -> str:
    """A sentence on an undone edit. edges: the loops without the edit."""
    verdicts = {edge.pair: edge.verdict for edge in edges}
    what = f"Undone: {describe_edit(command)}"
    if isinstance(command, Accept | Reject) and command.pair in verdicts:
        what = f"Loop {name(command.pair)} is {verdicts[command.pair]} again"
    return panel("loops.happened", what, _moves(after, before), "back ")


def evidence(edge: LoopEdge, params: LoopsParams) -> str:
    """The numbers of a loop, coloured green or red by the present limits."""
    e = edge.evidence
    elsewhere = "no" if np.isinf(e.alternative_m) and e.alternative_m > 0 else f"{number(e.alternative_m, 1)}"
    tiles = [
        Tile("overlap", number(100 * e.overlap, 0), "%", f"≥ {100 * params.min_overlap:.0f} %",
             _judged(e.overlap, params.min_overlap, least=True)),
        Tile("residual", number(1000 * e.residual_rms, 0), "mm", f"≤ {1000 * params.max_residual:.0f} mm",
             _judged(e.residual_rms, params.max_residual)),
        Tile("slide", number(1000 * e.slide, 0), "mm", f"≤ {1000 * params.max_slide:.0f} mm",
             _judged(e.slide, params.max_slide)),
        Tile("to odometry", number(e.mahalanobis, 1), "σ", f"≤ {params.max_mahalanobis:g} σ",
             _judged(e.mahalanobis, params.max_mahalanobis)),
        Tile("odometry ±", number(e.gate_m, 2), "m", "1 σ"),
        Tile("support", str(e.support), "", "others agree"),
        Tile("fits elsewhere", elsewhere, "m away" if np.isfinite(e.alternative_m) else "", "",
             BAD if e.ambiguous else ""),
        Tile("weakest hold", number(100 * e.condition, 0), "%", "0 %: can slide"),
        Tile("difference", number(e.context_distance), "", f"≤ {params.context_distance:g}",
             _judged(e.context_distance, params.context_distance)),
    ]  # fmt: skip
    return panel("macros.tiles", tiles)


def largest_factors(residuals: tuple[FactorResidual, ...]) -> str:
    """The factors with the largest residuals, largest first; a loop can be clicked."""
    if not residuals:
        return panel("quiet", "Computed whenever a loop is chosen, tried or edited.")
    largest = _largest_first(residuals)[:_LARGEST]
    top = max(largest[0].sigmas, 1e-9)
    rows = [
        (
            factor,
            _what(factor),
            (number(factor.rotation, 2), number(100 * factor.translation, 1), number(factor.sigmas, 2)),
            GOOD if factor.loop else _ODOMETRY,
            f"{100 * factor.sigmas / top:.0f}",
        )
        for factor in largest
    ]
    loops = sum(factor.loop for factor in residuals)
    cost = f"{_cost(residuals):.4g}"
    return panel("loops.factors", len(residuals) - loops, loops, cost, rows)


def forecast(
    command: LoopEdit, preview: Preview | None, poses: F64, residuals: tuple[FactorResidual, ...], problem: str = ""
) -> str:
    """The effect of an edit: how far keyframes move, and the largest residual if that changes.

    Args:
        preview: None while the engine computes it. poses: (k, 4, 4), present poses; residuals: present ones.
        problem: why the engine refuses the edit.
    """
    what = describe_edit(command).capitalize()
    if preview is None:
        working = problem or "Computing what would change …"
        return panel("loops.forecast", what, working)
    worst = [_worst(side) for side in (residuals, preview.residuals)]
    change = _cost_change(residuals, preview.residuals) if isinstance(command, Solve) else None
    return panel("loops.forecast", what, "", _moves(preview.poses, poses), change, worst if len({*worst}) > 1 else [])


def _moves(after: F64, before: F64) -> dict[str, Any] | None:
    """How far keyframes would move and rotate; `far` is empty if none would."""
    k = min(len(after), len(before))
    if not k:
        return None
    moved = np.linalg.norm(after[:k, :3, 3] - before[:k, :3, 3], axis=1)
    turns = lie.log(np.swapaxes(before[:k, :3, :3], -1, -2) @ after[:k, :3, :3])
    turned = float(np.degrees(np.linalg.norm(turns, axis=-1)).max())
    index = int(moved.argmax())
    if moved[index] < _LEAST_MOVE_M and turned < _LEAST_TURN_DEG:
        return {"far": ""}
    turn = f"{turned:.2f}" if turned >= _LEAST_TURN_DEG else ""
    return {"far": _length(moved[index]), "index": index, "mean": _length(moved.mean()), "turn": turn}


def _cost_change(before: tuple[FactorResidual, ...], after: tuple[FactorResidual, ...]) -> dict[str, Any] | None:
    """The change in the cost of the same factors; None until it is known."""
    if not before:
        return None
    now, then = _cost(before), _cost(after)
    same = abs(now - then) < 1e-4 * max(now, then)
    less = (
        "" if same else f"{100 * (1 - then / now):.2g} % less" if then < now else f"{100 * (then / now - 1):.2g} % more"
    )
    return {"same": same, "before": f"{now:.4g}", "after": f"{then:.4g}", "change": less}


def _worst(residuals: tuple[FactorResidual, ...]) -> str:
    return next((f"{number(f.sigmas, 1)} σ ({_what(f)})" for f in _largest_first(residuals)), "none")


def _largest_first(residuals: tuple[FactorResidual, ...]) -> list[FactorResidual]:
    return sorted(residuals, key=lambda factor: -factor.sigmas)


def _cost(residuals: tuple[FactorResidual, ...]) -> float:
    return float(sum(factor.cost for factor in residuals))


def _length(metres: float) -> str:
    if metres >= 1.0:
        return f"{metres:.2f} m"
    return f"{100 * metres:.1f} cm" if metres >= 0.01 else f"{1000 * metres:.1f} mm"


def _what(factor: FactorResidual) -> str:
    return f"{'loop' if factor.loop else 'step'} {name(factor.pair)}"


def _judged(value: float, limit: float, *, least: bool = False) -> str:
    if not np.isfinite(value):
        return ""
    return GOOD if (value >= limit if least else value <= limit) else BAD
