"""Graph residuals, and solving for all factors at once."""

import numpy as np

from app.server.protocol import EditLoop, TryLoop, UndoLoop
from app.slam.loops.edits import Accept, Solve
from app.slam.loops.types import LOOP_HUBER, FactorResidual, Preview
from app.ui.loops.words import forecast
from tests.ui.conftest import user_clicks
from tests.ui.fake_loops import KEYFRAMES
from tests.ui.loops.conftest import GOOD, WAITING, Page


def test_the_graph_s_worst_factors_are_listed_worst_first(page: Page) -> None:
    content = page.loops._factors.content
    shown = [float(row.split("</td><td>")[3].split("<")[0]) for row in content.split("<tr")[2:]]
    every = sorted((f.sigmas for f in page.engine.snapshot.loops.residuals), reverse=True)
    assert np.allclose(shown, every[: len(shown)], atol=0.006) and len(shown) >= 5
    assert f"{KEYFRAMES - 1} odometry and 6 loop factors" in content


def test_all_is_solved_at_once_in_two_steps_with_cost_and_change_said_between(page: Page) -> None:
    solve, proposal = page.loops._solve, page.loops._proposal
    page.choose(GOOD)
    before = page.engine.snapshot.keyframe_poses
    page.engine.sent.clear()
    user_clicks(solve)
    page.draw()
    page.draw()
    assert page.engine.sent == [TryLoop(Solve())]
    preview = page.engine.snapshot.loops.tried
    assert preview is not None and before is not None
    moved = 100 * np.linalg.norm(preview[1].poses[:, :3, 3] - before[:, :3, 3], axis=1).max()
    costs = [sum(f.cost for f in side) for side in (page.engine.snapshot.loops.residuals, preview[1].residuals)]
    assert page.loops._solving.visible, "the panel is long"
    words = proposal._words.content
    assert "Solve all at once" in words
    assert f"move by up to <b>{moved:.1f} cm</b>" in words
    assert f"cost goes from <b>{costs[0]:.4g}</b> to <b>{costs[1]:.4g}</b>" in words and "% less" in words
    assert page.node("/map/ghost/path") is not None
    user_clicks(proposal._apply)
    page.draw()
    assert EditLoop(Solve()) in page.engine.sent
    assert page.loops.chosen == GOOD, "it is of no loop in particular"
    assert solve.disabled
    assert page.loops._edits._undo.label == "Undo: solve all at once"
    user_clicks(page.loops._edits._undo)
    page.draw()
    assert UndoLoop() in page.engine.sent and not solve.disabled


def test_poses_at_the_optimum_are_said_to_be_there() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    factors = (FactorResidual((0, 1), False, 0.1, 0.02, 1.5), FactorResidual((0, 1), True, 0.1, 0.02, 4.0))
    words = forecast(Solve(), Preview(poses, factors), poses, factors)
    assert "No keyframe would move" in words
    assert f"cost stays at <b>{1.5**2 + 2 * LOOP_HUBER * 4.0 - LOOP_HUBER**2:.4g}</b>" in words
    assert "cost stays" not in forecast(Accept(*WAITING), Preview(poses, factors), poses, factors)


def test_a_graph_without_loops_has_nothing_to_be_solved(page: Page) -> None:
    assert not page.loops._solve.disabled
    page.engine.publish(loops=type(page.engine.snapshot.loops)())
    page.draw()
    assert page.loops._solve.disabled
