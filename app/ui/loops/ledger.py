"""All candidates in a table: what is shown of them, in which order, and the chips above that hide kinds."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from typing import Final

from app.slam.loops.types import LoopEdge, Pair
from app.ui.html import box, css, number
from app.ui.keys import ONE_PIXEL
from app.ui.loops.kinds import COLOURS, Kind, kind_of, name

MOST_ROWS: Final = 300

STYLE: Final = """<style>
.hs-chips{display:flex;flex-wrap:wrap;gap:5px;padding:4px 10px 6px}
.hs-toggle{cursor:pointer;border:1px solid;border-radius:10px;padding:0 8px;font-size:11px;line-height:19px;
user-select:none;white-space:nowrap}.hs-toggle[aria-pressed=false]{opacity:.45;border-style:dashed}
.hs-scroll{position:relative;max-height:270px;overflow-y:auto;margin:0 8px 6px;
border:1px solid rgba(127,140,160,.25);border-radius:5px}
.hs-table{border-collapse:collapse;width:100%;font-size:11px;font-variant-numeric:tabular-nums;line-height:1.2}
.hs-table th{position:sticky;top:0;background:#262b33;font-weight:600;color:#aeb8c6;text-align:right;padding:4px 5px;
cursor:pointer;user-select:none;white-space:nowrap}
.hs-table td{text-align:right;padding:3px 5px;white-space:nowrap}
.hs-table th:first-child,.hs-table td:first-child{text-align:left}.hs-table th:first-child{min-width:18px}
.hs-table tr[data-hs]{cursor:pointer}.hs-table tr[data-hs]:hover{background:rgba(127,140,160,.16)}
.hs-table tr[aria-selected=true]{background:rgba(38,166,154,.35)!important}
.hs-table :focus-visible,.hs-toggle:focus-visible{outline:2px solid #26a69a;outline-offset:-2px}
</style>"""


_KEEP: Final = """
const box = this.parentNode, row = box.querySelector('[aria-selected=true]');
box.scrollTop = window.hemislamLedger || 0;
if (row && row.dataset.hs !== window.hemislamRow) {
  const low = row.offsetTop - 26, high = row.offsetTop + row.offsetHeight - box.clientHeight;
  if (box.scrollTop > low) box.scrollTop = low; else if (box.scrollTop < high) box.scrollTop = high;
}
window.hemislamRow = row ? row.dataset.hs : '';
"""
"""The page puts in the whole table anew at every change: it stays where it was scrolled to, but for showing
a row that was newly chosen."""


@dataclass(frozen=True, slots=True)
class Column:
    """Attributes:
    title: with its unit, as short as can be. meaning: the long of it. key: sorts (nan goes last). text: of a cell.
    """

    title: str
    meaning: str
    key: Callable[[LoopEdge], float]
    text: Callable[[LoopEdge], str]


COLUMNS: Final[dict[str, Column]] = {
    "verdict": Column(
        "", "What became of it", lambda e: list(Kind).index(kind_of(e)) + 0.1 * _rank(e), lambda e: _sign(e)
    ),
    "keyframe": Column(
        "loop", "Older and newer keyframe", lambda e: e.newer + e.older * 1e-7, lambda e: name(e.pair)
    ),
    "context": Column(
        "ctx", "Distance of the Scan Contexts, 0 (same) to 1",
        lambda e: e.evidence.context_distance, lambda e: number(e.evidence.context_distance),
    ),
    "overlap": Column(
        "over %", "Share of points near both that have a partner in the other submap",
        lambda e: e.evidence.overlap, lambda e: number(100 * e.evidence.overlap, 0),
    ),
    "residual": Column(
        "res mm", "Residual (RMS), point to plane",
        lambda e: e.evidence.residual_rms, lambda e: number(1000 * e.evidence.residual_rms, 0),
    ),
    "mahalanobis": Column(
        "odo σ", "Mahalanobis distance to what odometry expects, in standard deviations",
        lambda e: e.evidence.mahalanobis, lambda e: number(e.evidence.mahalanobis, 1),
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Order:
    column: str = "keyframe"
    descending: bool = True

    def clicked(self, column: str) -> "Order":
        """By that column; the other way round if it was by that column."""
        return Order(column, not self.descending if column == self.column else column == "keyframe")


def counts(edges: tuple[LoopEdge, ...]) -> dict[Kind, int]:
    found = dict.fromkeys(Kind, 0)
    for edge in edges:
        found[kind_of(edge)] += 1
    return found


def listed(edges: tuple[LoopEdge, ...], shown: frozenset[Kind], order: Order) -> list[LoopEdge]:
    """The edges of the kinds shown in their order; those without a value last, equal ones by keyframes."""
    key = COLUMNS[order.column].key
    sign = -1.0 if order.descending else 1.0

    def rank(edge: LoopEdge) -> tuple[bool, float, Pair]:
        value = key(edge)
        return math.isnan(value), 0.0 if math.isnan(value) else sign * value, edge.pair

    return sorted((edge for edge in edges if kind_of(edge) in shown), key=rank)


def chips(edges: tuple[LoopEdge, ...], shown: frozenset[Kind]) -> str:
    """How many there are of each kind; a click shows or hides them. The legend of the scene as well."""
    parts = [
        f'<span class="hs-toggle" role="button" tabindex="0" aria-pressed="{str(kind in shown).lower()}"'
        f' data-hs="show {kind}" style="border-color:{css(COLOURS[kind])}"><span class="hs-dot"'
        f' style="background:{css(COLOURS[kind])}"></span>{escape(kind)} {count}</span>'
        for kind, count in counts(edges).items()
    ]
    return f'<div class="hs-chips">{"".join(parts)}</div>'


def table(rows: list[LoopEdge], order: Order, chosen: Pair | None) -> str:
    """The ledger; rows and column heads can be clicked."""
    arrow = "▾" if order.descending else "▴"
    heads = "".join(
        f'<th tabindex="0" data-hs="sort {column}" title="{escape(entry.meaning)}">'
        f"{escape(entry.title)}{arrow if column == order.column else '' if entry.title else '•'}</th>"
        for column, entry in COLUMNS.items()
    )
    body = "".join(_row(edge, edge.pair == chosen) for edge in rows[:MOST_ROWS])
    keep = f'<img src="{ONE_PIXEL}" hidden onload="{escape(_KEEP)}">'
    return (
        f'<div class="hs-scroll" onscroll="window.hemislamLedger=this.scrollTop"><table class="hs-table"><thead><tr>'
        f"{heads}</tr></thead><tbody>{body}</tbody></table>{keep}</div>{_remark(rows)}"
    )


def _remark(rows: list[LoopEdge]) -> str:
    if not rows:
        return box('<span class="hs-note">None of the kinds chosen above.</span>')
    if len(rows) > MOST_ROWS:
        text = f"The first {MOST_ROWS} of {len(rows):,}; sort by another column or hide a kind to see others."
        return box(f'<span class="hs-note">{text}</span>')
    return ""


def _row(edge: LoopEdge, is_chosen: bool) -> str:
    cells = "".join(f"<td>{column.text(edge)}</td>" for column in COLUMNS.values())
    return (
        f'<tr tabindex="0" data-hs="choose {edge.older} {edge.newer}" aria-selected="{str(is_chosen).lower()}"'
        f' title="{escape(edge.reason)}">{cells}</tr>'
    )


def _rank(edge: LoopEdge) -> int:
    return ("accepted", "candidate", "rejected").index(edge.verdict.value)


def _sign(edge: LoopEdge) -> str:
    sign = ("✓", "?", "✕")[_rank(edge)] + ("✎" if kind_of(edge) is Kind.USER else "")
    return f'<b style="color:{css(COLOURS[kind_of(edge)])}">{sign}</b>'
