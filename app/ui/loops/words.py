"""What the page says of one loop, of the graph's residuals and of what a command would change."""

from html import escape
from typing import Final

import numpy as np

from app.slam import lie
from app.slam.loops.types import FactorResidual, LoopEdge, LoopEdit, Pair, Preview, Solve
from app.slam.params import LoopsParams
from app.slam.types import F64
from app.ui.html import BAD, GOOD, box, css, number, tile, tiles
from app.ui.loops.kinds import COLOURS, NEWER, OLDER, kind_of, name, say

_WORST: Final = 12
_COMPARED: Final = 3


def headline(edge: LoopEdge) -> str:
    """Which loop, what became of it and why."""
    colour = css(COLOURS[kind_of(edge)])
    weight = f" · weight {edge.weight:g}" if edge.weight != 1.0 else ""
    return box(
        f'<div class="hs-row"><span>keyframes <b>{name(edge.pair)}</b></span><b style="color:{colour}">'
        f"{escape(edge.verdict)}{escape(weight)}</b></div>",
        f'<div class="hs-item" style="border-color:{colour}">{escape(edge.reason)}{_stead(edge)}</div>',
    )


def _stead(edge: LoopEdge) -> str:
    if edge.represented_by is not None:
        return f"; {name(edge.represented_by)} is in the graph for both"
    if edge.repeats is not None:
        return f"; {name(edge.repeats)}, near it, measured the same; in the graph both are between its keyframes"
    return ""


def evidence(edge: LoopEdge, params: LoopsParams) -> str:
    """The numbers of a loop, green or red by the present limits."""
    e = edge.evidence
    alone = "none" if np.isinf(e.rival_m) and e.rival_m > 0 else f"{number(e.rival_m, 1)}"
    parts = [
        tile("overlap", number(100 * e.overlap, 0), "%", colour=_fits(e.overlap, params.min_overlap, least=True),
             note=f"≥ {100 * params.min_overlap:.0f} %"),
        tile("residual", number(1000 * e.residual_rms, 0), "mm", colour=_fits(e.residual_rms, params.max_residual),
             note=f"≤ {1000 * params.max_residual:.0f} mm"),
        tile("slide", number(100 * e.slide, 1), "cm", colour=_fits(e.slide, params.max_slide),
             note=f"≤ {100 * params.max_slide:.0f} cm"),
        tile("to odometry", number(e.mahalanobis, 1), "σ", colour=_fits(e.mahalanobis, params.max_mahalanobis),
             note=f"≤ {params.max_mahalanobis:g} σ"),
        tile("odometry ±", number(e.gate_m, 2), "m", note="1 σ"),
        tile("support", str(e.support), note="others agree"),
        tile("rival place", alone, "m away" if np.isfinite(e.rival_m) else "", colour=BAD if e.ambiguous else ""),
        tile("condition", number(e.condition, 3), note="0: it slides"),
        tile("contexts", number(e.context_distance), colour=_fits(e.context_distance, params.context_distance),
             note=f"≤ {params.context_distance:g}"),
    ]  # fmt: skip
    return tiles(parts)


def submap_legend(pair: Pair) -> str:
    return box(
        f'<div class="hs-keys hs-note"><span><span class="hs-dot" style="background:{css(OLDER)}"></span>'
        f'keyframe {pair[0]}</span><span><span class="hs-dot" style="background:{css(NEWER)}"></span>'
        f"keyframe {pair[1]}</span></div>"
    )


def worst_factors(residuals: tuple[FactorResidual, ...], most: int = _WORST) -> str:
    """The factors that the graph meets least, worst first; a loop can be clicked."""
    if not residuals:
        return box('<span class="hs-quiet">Worked out whenever a loop is chosen, tried or edited.</span>')
    worst = _worst_first(residuals)[:most]
    top = max(worst[0].sigmas, 1e-9)
    rows = "".join(
        f'<tr{_link(factor)}><td>{_what(factor)}</td><td>{number(factor.rotation, 2)}</td>'
        f"<td>{number(100 * factor.translation, 1)}</td><td>{number(factor.sigmas, 2)}</td>"
        f'<td style="width:24%"><div style="height:7px;border-radius:2px;background:{_paint(factor)};'
        f'width:{100 * factor.sigmas / top:.0f}%"></div></td></tr>'
        for factor in worst
    )  # fmt: skip
    loops = sum(factor.loop for factor in residuals)
    return (
        box(
            f'<span class="hs-note">{len(residuals) - loops} odometry and {loops} loop factors, cost '
            f"{_cost(residuals):.4g}, as of the loop chosen or edited last; the worst:</span>"
        )
        + '<div class="hs-scroll" style="max-height:none"><table class="hs-table"><thead><tr><th>factor</th>'
        f"<th>°</th><th>cm</th><th>σ</th><th></th></tr></thead><tbody>{rows}</tbody></table></div>"
    )


def forecast(
    command: LoopEdit, preview: Preview | None, poses: F64, residuals: tuple[FactorResidual, ...], working: str = ""
) -> str:
    """What a command would change: how far keyframes move, and the factors that are met worst, before and after.

    Args:
        preview: None while the engine works it out. poses: (k, 4, 4) of the present; residuals: likewise.
    """
    title = f"<div><b>{escape(say(command).capitalize())}</b>?</div>"
    if preview is None:
        return box(title, f'<span class="hs-quiet">{escape(working or "The engine works out what it would change …")}'
                   "</span>")  # fmt: skip
    costs = _costs(residuals, preview.residuals) if isinstance(command, Solve) else ""
    return box(title, _moves(preview.poses, poses), costs, _comparison(residuals, preview.residuals))


def _moves(after: F64, before: F64) -> str:
    k = min(len(after), len(before))
    if not k:
        return ""
    moved = np.linalg.norm(after[:k, :3, 3] - before[:k, :3, 3], axis=1)
    turned = [np.degrees(np.linalg.norm(lie.log(b[:3, :3].T @ a[:3, :3]))) for a, b in zip(after, before, strict=False)]
    far = int(moved.argmax())
    if moved[far] < 5e-4 and max(turned) < 5e-3:
        return "<div>No keyframe would move.</div>"
    turn = f", and turn by up to <b>{max(turned):.2f}°</b>" if max(turned) >= 5e-3 else ""
    return (
        f"<div>Keyframes would move by up to <b>{_length(moved[far])}</b> (keyframe {far}), {_length(moved.mean())} on "
        f"average{turn}.</div>"
    )


def _costs(before: tuple[FactorResidual, ...], after: tuple[FactorResidual, ...]) -> str:
    """What all factors at once make of the cost, which is of the same factors then as before."""
    if not before:  # they come a moment later
        return ""
    now, then = _cost(before), _cost(after)
    if abs(now - then) < 1e-4 * max(now, then):
        return f"<div>The cost stays at <b>{then:.4g}</b>: the poses are those of the optimum already.</div>"
    way = f"{100 * (1 - then / now):.2g} % less" if then < now else f"{100 * (then / now - 1):.2g} % more"
    return f"<div>The cost goes from <b>{now:.4g}</b> to <b>{then:.4g}</b>, {way}.</div>"


def _comparison(before: tuple[FactorResidual, ...], after: tuple[FactorResidual, ...]) -> str:
    heads = "<tr><th>worst now</th><th>σ</th><th>worst then</th><th>σ</th></tr>"
    pairs = [_worst_first(side)[:_COMPARED] for side in (before, after)]
    rows = ""
    for index in range(max(len(side) for side in pairs)):
        cells = [
            f"<td>{_what(side[index])}</td><td>{number(side[index].sigmas, 2)}</td>"
            if index < len(side)
            else "<td></td><td></td>"
            for side in pairs
        ]
        rows += f"<tr>{''.join(cells)}</tr>"
    sums = f"<tr><td>all, cost</td><td>{_cost(before):.4g}</td><td></td><td>{_cost(after):.4g}</td></tr>"
    return f'<table class="hs-table" style="margin-top:4px"><thead>{heads}</thead><tbody>{rows}{sums}</tbody></table>'


def _worst_first(residuals: tuple[FactorResidual, ...]) -> list[FactorResidual]:
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


def _link(factor: FactorResidual) -> str:
    return f' tabindex="0" data-hs="choose {factor.pair[0]} {factor.pair[1]}"' if factor.loop else ""


def _paint(factor: FactorResidual) -> str:
    return GOOD if factor.loop else "#5b8def"


def _fits(value: float, limit: float, *, least: bool = False) -> str:
    if not np.isfinite(value):
        return ""
    return GOOD if (value >= limit if least else value <= limit) else BAD
