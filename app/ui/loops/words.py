"""What the page says of one loop, of the graph's residuals and of what an edit would change."""

from typing import Any, Final

import numpy as np

from app.slam import lie
from app.slam.loops.types import FactorResidual, LoopEdge, LoopEdit, Preview, Solve
from app.slam.params import LoopsParams
from app.slam.types import F64
from app.ui.html import BAD, GOOD, Tile, number, panel
from app.ui.loops.kinds import describe_edit, kind_of, name

_LARGEST: Final = 12
_COMPARED: Final = 3
_ODOMETRY: Final = "#5b8def"
_LEAST_MOVE_M: Final = 5e-4
_LEAST_TURN_DEG: Final = 5e-3
_NOTHING: Final = ("", "")


def headline(edge: LoopEdge) -> str:
    """Which loop, its verdict and why."""
    return panel("loops.headline", edge, kind_of(edge).colour)


def evidence(edge: LoopEdge, params: LoopsParams) -> str:
    """The numbers of a loop, green or red by the present limits."""
    e = edge.evidence
    alone = "none" if np.isinf(e.alternative_m) and e.alternative_m > 0 else f"{number(e.alternative_m, 1)}"
    tiles = [
        Tile("overlap", number(100 * e.overlap, 0), "%", f"≥ {100 * params.min_overlap:.0f} %",
             _judged(e.overlap, params.min_overlap, least=True)),
        Tile("residual", number(1000 * e.residual_rms, 0), "mm", f"≤ {1000 * params.max_residual:.0f} mm",
             _judged(e.residual_rms, params.max_residual)),
        Tile("slide", number(100 * e.slide, 1), "cm", f"≤ {100 * params.max_slide:.0f} cm",
             _judged(e.slide, params.max_slide)),
        Tile("to odometry", number(e.mahalanobis, 1), "σ", f"≤ {params.max_mahalanobis:g} σ",
             _judged(e.mahalanobis, params.max_mahalanobis)),
        Tile("odometry ±", number(e.gate_m, 2), "m", "1 σ"),
        Tile("support", str(e.support), "", "others agree"),
        Tile("other place", alone, "m away" if np.isfinite(e.alternative_m) else "", "", BAD if e.ambiguous else ""),
        Tile("condition", number(e.condition, 3), "", "0: it slides"),
        Tile("contexts", number(e.context_distance), "", f"≤ {params.context_distance:g}",
             _judged(e.context_distance, params.context_distance)),
    ]  # fmt: skip
    return panel("tile_grid", tiles)


def largest_factors(residuals: tuple[FactorResidual, ...], most: int = _LARGEST) -> str:
    """The factors with the largest residuals, largest first; a loop can be clicked."""
    if not residuals:
        return panel("quiet", "Computed whenever a loop is chosen, tried or edited.")
    largest = _largest_first(residuals)[:most]
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
    """What an edit would change: how far keyframes move, and the factors with the largest residuals now and then.

    Args:
        preview: None while the engine computes it. poses: (k, 4, 4) of the present; residuals: likewise.
        problem: why the engine refuses the edit.
    """
    what = describe_edit(command).capitalize()
    if preview is None:
        working = problem or "The engine computes what it would change …"
        return panel("loops.forecast", what, working, None, None, [], [], ())
    before, after = (_rows(side) for side in (residuals, preview.residuals))
    lines = max(len(before), len(after))
    before, after = (side + [_NOTHING] * (lines - len(side)) for side in (before, after))
    costs = tuple(f"{_cost(side):.4g}" for side in (residuals, preview.residuals))
    change = _cost_change(residuals, preview.residuals) if isinstance(command, Solve) else None
    moves = _moves(preview.poses, poses)
    return panel("loops.forecast", what, "", moves, change, before, after, costs)


def _moves(after: F64, before: F64) -> dict[str, Any] | None:
    """How far keyframes would move and turn; `far` is empty when none would."""
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
    """How the cost of the same factors changes; None until they are known."""
    if not before:
        return None
    now, then = _cost(before), _cost(after)
    same = abs(now - then) < 1e-4 * max(now, then)
    less = (
        "" if same else f"{100 * (1 - then / now):.2g} % less" if then < now else f"{100 * (then / now - 1):.2g} % more"
    )
    return {"same": same, "before": f"{now:.4g}", "after": f"{then:.4g}", "change": less}


def _rows(residuals: tuple[FactorResidual, ...]) -> list[tuple[str, str]]:
    return [(_what(factor), number(factor.sigmas, 2)) for factor in _largest_first(residuals)[:_COMPARED]]


def _largest_first(residuals: tuple[FactorResidual, ...]) -> list[FactorResidual]:
    return sorted(residuals, key=lambda factor: -factor.sigmas)


def _cost(residuals: tuple[FactorResidual, ...]) -> float:
    """What the solver minimises."""
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
