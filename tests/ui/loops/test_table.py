"""The table of all candidates, and the effect of clicks in it."""

from dataclasses import replace

import numpy as np
import pytest

from app.server.protocol import InspectLoop, LoopsView
from app.ui.loops.words import KINDS
from tests.ui.conftest import SOMEONE
from tests.ui.loops.conftest import GOOD, Page, rejected


def test_the_table_counts_and_lists_what_is_shown(page: Page) -> None:
    assert page.says("accepted 6", "candidate 3", "rejected 20", "12–89")
    hidden = "–".join(str(index) for index in rejected(page))
    assert not page.says(hidden)
    page.loops._act("show rejected", SOMEONE)  # type: ignore[arg-type]
    page.draw()
    assert page.says(hidden)


@pytest.mark.parametrize("column", ["overlap", "residual", "mahalanobis", "context"])
def test_a_column_s_head_sorts_by_it_and_again_the_other_way_with_what_is_unknown_last(page: Page, column: str) -> None:
    page.loops._shown = frozenset(KINDS)
    value = {
        "overlap": lambda e: e.overlap,
        "residual": lambda e: e.residual_rms,
        "mahalanobis": lambda e: e.mahalanobis,
        "context": lambda e: e.context_distance,
    }[column]
    evidence = {edge.pair: edge.evidence for edge in page.engine.snapshot.loops.edges}
    for up in (True, False):
        page.loops._act(f"sort {column}", SOMEONE)  # type: ignore[arg-type]
        page.draw()
        content = page.loops._table.content
        words = [part.split('"')[0].split() for part in content.split('data-hs="choose ')[1:]]
        values = np.array([value(evidence[int(a), int(b)]) for a, b in words])
        known = values[np.isfinite(values)]
        assert len(values) == 29 and np.isnan(values[len(known) :]).all()
        assert (np.diff(known) >= 0).all() if up else (np.diff(known) <= 0).all()


def test_a_row_shows_its_loop_and_hides_it_again(page: Page) -> None:
    page.loops._act("choose 12 89", SOMEONE)  # type: ignore[arg-type]
    page.draw()
    assert page.loops.chosen == GOOD and page.says('data-hs="choose 12 89" aria-selected="true"')
    page.loops._act("choose 12 89", SOMEONE)  # type: ignore[arg-type]
    page.draw()
    assert page.loops.chosen is None
    inspected = [sent for sent in page.engine.sent if isinstance(sent, InspectLoop)]
    assert inspected == [InspectLoop(GOOD), InspectLoop(None)]


def test_unknown_words_from_a_click_do_nothing(page: Page) -> None:
    page.choose(GOOD)
    page.engine.sent.clear()
    for word in ("", "show everything", "sort colour", "choose", "choose x y", "choose 1", "choose 0 1", "fly"):
        page.loops._act(word, SOMEONE)  # type: ignore[arg-type]
    page.draw()
    assert page.engine.sent == [] and page.loops.chosen == GOOD


def test_the_engine_s_words_are_text_and_never_html(page: Page) -> None:
    edge = replace(page.edge(GOOD), reason="<script>alert(1)</script>")
    page.engine.publish(loops=LoopsView(edges=(edge,)))
    page.choose(GOOD)
    assert "<script>" not in page.loops._table.content + page.loops._verdict._reason.content
    assert "&lt;script&gt;" in page.loops._verdict._reason.content
