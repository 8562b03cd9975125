"""The table of all candidates: its columns, its order, and the chips above it that hide kinds."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from app.slam.loops.types import LoopEdge, Pair
from app.ui.hints import HINTS
from app.ui.html import number, panel, source
from app.ui.loops.words import EDITED, KINDS, SIGNS, kind_of, name

MOST_ROWS: Final = 300


@dataclass(frozen=True, slots=True)
class TableColumn:
    """Attributes:
    title: its name. unit: of its numbers. meaning: a sentence. key: to sort by (NaN goes last). text: of a cell.
    """

    title: str
    unit: str
    meaning: str
    key: Callable[[LoopEdge], float]
    text: Callable[[LoopEdge], str]


COLUMNS: Final[dict[str, TableColumn]] = {
    "verdict": TableColumn(
        "", "", "Verdict: ✓ accepted, ? candidate, ✕ rejected, ✎ by hand.",
        lambda e: list(KINDS).index(kind_of(e).name) + 0.1 * list(SIGNS).index(e.verdict),
        lambda e: SIGNS[e.verdict] + ("✎" if kind_of(e).name == EDITED else ""),
    ),
    "keyframe": TableColumn(
        "loop", "keyframes", "Numbers of the older and the newer keyframe that the loop connects.",
        lambda e: e.newer + e.older * 1e-7, lambda e: name(e.pair),
    ),
    "context": TableColumn(
        "difference", "0–1", HINTS["difference"],
        lambda e: e.evidence.context_distance, lambda e: number(e.evidence.context_distance),
    ),
    "overlap": TableColumn(
        "overlap", "%", HINTS["overlap"],
        lambda e: e.evidence.overlap, lambda e: number(100 * e.evidence.overlap, 0),
    ),
    "residual": TableColumn(
        "residual", "mm", "RMS distance of the points to the other submap's planes, in mm.",
        lambda e: e.evidence.residual_rms, lambda e: number(1000 * e.evidence.residual_rms, 0),
    ),
    "mahalanobis": TableColumn(
        "odometry", "σ", HINTS["to odometry"],
        lambda e: e.evidence.mahalanobis, lambda e: number(e.evidence.mahalanobis, 1),
    ),
}  # fmt: skip
"""The first column is drawn in the colour of the loop's kind."""


@dataclass(frozen=True, slots=True)
class Order:
    column: str = "keyframe"
    descending: bool = True

    def clicked(self, column: str) -> "Order":
        """The order after a click: by that column, reversed if the table was sorted by it already."""
        return Order(column, not self.descending if column == self.column else column == "keyframe")


def listed(edges: tuple[LoopEdge, ...], shown: frozenset[str], order: Order) -> list[LoopEdge]:
    """The edges of the kinds shown, sorted; edges without a value come last, and ties are sorted by keyframes."""
    key = COLUMNS[order.column].key
    sign = -1.0 if order.descending else 1.0

    def rank(edge: LoopEdge) -> tuple[bool, float, Pair]:
        value = key(edge)
        return math.isnan(value), 0.0 if math.isnan(value) else sign * value, edge.pair

    return sorted((edge for edge in edges if kind_of(edge).name in shown), key=rank)


def chips(edges: tuple[LoopEdge, ...], shown: frozenset[str]) -> str:
    """The number of loops of each kind; a click shows or hides a kind. Also the legend of the scene."""
    names = [kind_of(edge).name for edge in edges]
    return panel("loops.chips", [(kind, names.count(key), key in shown) for key, kind in KINDS.items() if key in names])


def table(edges: list[LoopEdge], order: Order, chosen: Pair | None) -> str:
    """The table of these edges; rows and column headers can be clicked."""
    arrow = "▾" if order.descending else "▴"
    signs = {key: "" if column.title else "•" for key, column in COLUMNS.items()} | {order.column: arrow}
    heads = [(key, column, signs[key]) for key, column in COLUMNS.items()]
    first, *others = COLUMNS.values()
    rows = [
        (edge, first.text(edge), kind_of(edge).colour, [column.text(edge) for column in others], edge.pair == chosen)
        for edge in edges[:MOST_ROWS]
    ]
    remark = "" if edges else "All loops are hidden; click a kind above to show it."
    if len(edges) > MOST_ROWS:
        remark = f"The first {MOST_ROWS} of {len(edges):,}; sort by another column or hide a kind to see others."
    return panel("loops.table", heads, rows, source("loop_table.js"), remark)
