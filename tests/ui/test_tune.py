"""Tests app/ui/tune.py, app/ui/tune_maths.py: the Tune tab starts a search, draws its trials, and opens one as B."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import viser

from app.server.protocol import OpenedRecording, Snapshot, StepFrame, Transport
from app.tuning.objectives import OBJECTIVES
from app.tuning.process import Ended, Tried
from app.tuning.trial import Trial
from app.ui import background, widgets
from app.ui import tune_maths as maths
from app.ui.compare import Sides
from app.ui.tune import TunePanel
from tests.ui.conftest import Clock, page_of, user_clicks, user_sets
from tests.ui.fake_engine import FakeEngine
from tests.ui.fake_forks import workspace
from tests.ui.test_calibration import Process

OPEN = Snapshot(
    recording=OpenedRecording(Path("walk.mcap"), 1_000_000_000, 60.0, 600, ()),
    transport=Transport(frame=100, stamp_ns=11_000_000_000),
)
ENTROPY, F1 = OBJECTIVES["entropy"], OBJECTIVES["ground-f1"]
TRIALS = (
    Trial(0, {}, (2.0,)),
    Trial(1, {"ground.alpha": 20.0, "ground.sigma": 0.02}, (1.5,)),
    Trial(2, {"ground.alpha": 70.0, "ground.sigma": 0.05}, (None,), "lost"),
    Trial(3, {"ground.alpha": 30.0, "ground.sigma": 0.03}, (1.2,)),
)


class Tuning:
    def __init__(self, server: viser.ViserServer, engine: FakeEngine, folder: Path) -> None:
        self.clock, self.now = Clock(), OPEN
        engine.send(StepFrame(5))
        self.forks = workspace(engine, folder)
        page = page_of(server, snapshot=lambda: self.now, now=self.clock)
        self.sides = Sides(server.gui, self.forks)
        self.panel = TunePanel(page, self.forks, self.sides, folder / "tuning")
        self.draw()

    def draw(self, *messages: Any) -> None:
        self.clock.now += 10.0
        if messages:
            self.process.messages += messages
        self.panel.draw(self.now)

    @property
    def process(self) -> Any:
        return self.panel._work._child

    def says(self, words: str) -> bool:
        return words in self.panel._why.content


@pytest.fixture
def tuning(server: viser.ViserServer, engine: FakeEngine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Tuning:
    monkeypatch.setattr(background, "Child", Process)
    monkeypatch.setattr(widgets, "notify_error", lambda client, error: told.append(str(error)))
    told.clear()
    return Tuning(server, engine, tmp_path)


told: list[str] = []


def test_before_a_search_the_tab_says_what_to_do(tuning: Tuning) -> None:
    assert tuning.says("press Start") and "hs-plot" not in tuning.panel._plots.content
    tuning.now = Snapshot()
    tuning.draw()
    assert tuning.says("Open a recording first") and tuning.panel._start.disabled


def test_a_search_is_of_the_part_that_is_looked_at_and_shows_its_trials_and_the_time_left(tuning: Tuning) -> None:
    panel = tuning.panel
    user_clicks(panel._start)
    (wanted,) = tuning.process.arguments
    assert (wanted.start_s, wanted.duration_s, wanted.objectives) == (10.0, 20.0, ("entropy",))
    tuning.draw(Ended(1, True))
    tuning.draw(Ended(5, True))
    tuning.draw(Ended(9, True), Tried(TRIALS, (3,), {"ground.sigma": 0.8, "ground.alpha": 0.2}))
    assert tuning.says("4 of 49 trials · 100 s left") or tuning.says("4 of 49 trials · 2 min left")
    assert panel._work._bar.visible and panel._work._bar.value == pytest.approx(100 * 9 / 49)
    html = panel._plots.content
    assert html.count('data-hs="trial 3"') == 3  # in the table, over trials, and as a line
    assert 'data-hs="trial 2"' not in html, "a trial without a score lies nowhere"
    assert "80 %" in html


def test_a_search_that_is_stopped_goes_on_with_the_same_settings(tuning: Tuning) -> None:
    user_clicks(tuning.panel._start)
    first = tuning.process
    tuning.draw(Tried(TRIALS, (3,)))
    user_clicks(tuning.panel._work._stop)
    tuning.draw()
    assert first.closed and tuning.says("stopped") and tuning.panel._go_on.visible
    tuning.now = replace(OPEN, params=OPEN.params.with_values({"ground.alpha": 11.0}))
    user_clicks(tuning.panel._go_on)
    assert tuning.process is not first and tuning.process.arguments == first.arguments
    tuning.draw(*(Ended(runs, False) for runs in range(1, 10)), Tried(TRIALS, (3,)))
    assert tuning.says("not known yet"), "what was finished before tells nothing of the pace"
    tuning.draw(Ended(10, True))
    assert tuning.says("6 min left"), "39 runs of 10 s"
    tuning.draw(Tried(TRIALS, (3,), held_back=(replace(TRIALS[0], scores=(2.1,)),), finished=True))
    assert tuning.process is None and not tuning.panel._go_on.visible
    assert tuning.says(
        f"4 of 49 trials · saved in {first.arguments[0].folder} · On the part held back nothing is better"
    )
    assert "held back" in tuning.panel._plots.content


def test_a_click_on_a_trial_opens_it_as_b_with_its_values_on_the_sliders(tuning: Tuning) -> None:
    user_clicks(tuning.panel._start)
    tuning.draw(Tried(TRIALS, (3,)))
    tuning.panel._clicked("trial 1", None)  # type: ignore[arg-type]
    tuning.panel._clicked("trial 3", None)  # type: ignore[arg-type]
    b = tuning.forks.other
    assert b is not None and b.params.ground.alpha == 30.0 and tuning.forks.snapshot.params.ground.alpha != 30.0
    assert tuning.sides.tuned(tuning.forks.snapshot) is b and tuning.forks.names[1] == "trial 3"
    tuning.draw()
    assert "ground.alpha = 30.0" in tuning.panel._plots.content
    assert not told


def test_a_click_never_discards_a_fork_that_was_made_by_hand(tuning: Tuning) -> None:
    user_clicks(tuning.panel._start)
    tuning.draw(Tried(TRIALS, (3,)))
    tuning.forks.fork("trial of mine")
    user_sets(tuning.panel._bridge._field, "trial 3 #1")
    assert tuning.forks.names[1] == "trial of mine" and "already" in told[0]


def test_a_click_never_discards_a_trial_that_was_worked_on_as_a(tuning: Tuning) -> None:
    user_clicks(tuning.panel._start)
    tuning.draw(Tried(TRIALS, (3,)))
    user_sets(tuning.panel._bridge._field, "trial 1 #1")
    for names in (("trial 1", "main"), ("main", "trial 1")):
        tuning.forks.swap()
        tuning.draw()
        assert tuning.forks.names == names
    user_sets(tuning.panel._bridge._field, "trial 3 #2")
    assert tuning.forks.names[1] == "trial 1" and "already" in told[0]


def test_why_a_search_has_failed_stays_on_the_page_until_the_next_one(tuning: Tuning) -> None:
    """A notification is lost on a page that is reloaded meanwhile."""
    user_clicks(tuning.panel._start)
    tuning.draw("There is no parameter ground.alfa; did you mean ground.alpha?")
    tuning.draw()
    assert tuning.process is None and tuning.says("0 of 49 trials · stopped · There is no parameter ground.alfa")
    user_clicks(tuning.panel._start)
    tuning.draw()
    assert not tuning.says("ground.alfa")


def test_what_cannot_be_measured_is_refused_in_a_sentence(tuning: Tuning) -> None:
    user_sets(tuning.panel._first, OBJECTIVES["ate"].title)
    user_clicks(tuning.panel._start)
    assert tuning.process is None and "needs true poses" in told[0]


def test_a_search_does_not_begin_where_the_recording_ends(tuning: Tuning) -> None:
    tuning.now = replace(OPEN, transport=Transport(frame=599, stamp_ns=60_900_000_000))
    user_clicks(tuning.panel._start)
    assert tuning.process is None and "Only 0.1 s of the recording are left" in told[0]
    user_sets(tuning.panel._part, "the whole recording")
    user_clicks(tuning.panel._start)
    assert tuning.process.arguments[0].start_s == 0.0


def test_why_every_trial_failed_stays_on_the_page(tuning: Tuning) -> None:
    user_clicks(tuning.panel._start)
    tuning.draw(Tried((Trial(0, {}, (None,), "no ground"), Trial(1, {}, (None,), "lost"))), "No trial gave a result.")
    tuning.draw()
    assert tuning.process is None and tuning.says("2 of 49 trials · stopped · all failed: no ground")


def test_another_recording_ends_the_search_and_forgets_its_trials(tuning: Tuning) -> None:
    user_clicks(tuning.panel._start)
    process = tuning.process
    tuning.draw(Tried(TRIALS, (3,)))
    assert OPEN.recording is not None
    tuning.now = replace(OPEN, recording=replace(OPEN.recording, path=Path("other.mcap")))
    tuning.draw()
    assert process.closed and tuning.says("press Start") and "hs-plot" not in tuning.panel._plots.content


# --- where trials lie ----------------------------------------------------------------------------
def test_a_better_score_lies_towards_the_good_end_and_the_line_follows_the_best() -> None:
    numbers = maths.number_axis("trial", [0, 3])
    drawn, _ = maths.dots(Tried(TRIALS, (3,)), (ENTROPY,), (numbers, lambda trial: trial.number), 0, -1)
    assert [dot.number for dot in drawn] == [0, 1, 3]
    assert drawn[0].x < drawn[1].x < drawn[2].x
    assert drawn[0].y < drawn[1].y < drawn[2].y, "entropy falls, and y points down"
    heights = [float(pair.split(",")[1]) for pair in maths.best_so_far(drawn, greatest=False).split()]
    assert heights == sorted(heights)


def test_one_wild_score_does_not_press_all_others_together() -> None:
    wild = (*(Trial(number, {}, (1.0 + 0.01 * number,)) for number in range(40)), Trial(40, {}, (900.0,)))
    axis = maths.score_axis(wild, 0, ENTROPY)
    assert axis.share(1.2) > 0.3 and axis.share(900.0) == 1.0


def test_the_ends_of_an_axis_can_be_distinguished() -> None:
    axis = maths.number_axis("entropy", [-5.2413, -5.2401])
    assert (axis.low, axis.high) == ("-5.2413", "-5.2401")


def test_switches_and_choices_have_places_of_their_own_on_an_axis() -> None:
    trials = tuple(
        Trial(number, {"loops.enabled": number % 2 == 0, "ground.alpha": 10.0 * number}, (float(number),))
        for number in range(4)
    )
    html = maths.parallel(Tried(trials, (0,)), (ENTROPY,), -1)
    heights = {re.split("[ ,]", points)[1] for points in re.findall(r'points="([^"]+)"', html)}
    assert heights == {"16.0", "120.0"} and "False" in html and "True" in html


def test_two_objectives_show_their_front() -> None:
    both = tuple(Trial(number, {"ground.alpha": number}, (float(number), 0.1 * number)) for number in range(3))
    html = maths.plots(Tried(both, (0, 1, 2)), (ENTROPY, F1), -1)
    assert "Pareto front" in html and html.count('data-hs="trial 2"') == 5


@pytest.mark.parametrize(("seconds", "words"), [(0.2, "1 s left"), (89, "89 s left"), (600, "10 min left")])
def test_a_time_left_is_reported_in_its_unit(seconds: float, words: str) -> None:
    assert maths.left(seconds) == words
