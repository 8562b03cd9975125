"""A search tries settings, keeps the best, continues after a stop, and refuses parameters that cannot vary.

Tests app/tuning/space.py, app/tuning/objectives.py, app/tuning/trial.py, app/tuning/tune.py, app/tuning/report.py,
app/tuning/process.py.
"""

import csv
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from click.testing import Result
from typer.testing import CliRunner

from app.__main__ import cli
from app.evaluation.evaluate import Subject
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.tuning.objectives import OBJECTIVES, Objective
from app.tuning.process import Ended, Tried, Wanted, find
from app.tuning.space import grid, parse_dimensions
from app.tuning.trial import Trial, advice, front, proposal
from app.tuning.tune import Part, SearchPlan, check, search
from tests.cli.conftest import write_walk

ATE, F1 = OBJECTIVES["ate"], OBJECTIVES["ground-f1"]
WALK = Subject("walk", Path("walk.mcap"), Params())


class Bowl:
    """Stands for runs: the error is least at α = 40°, σ = 0.05, and nothing comes of α below 5°."""

    def __init__(self) -> None:
        self.asked: list[Mapping[str, Any]] = []

    def score(self, settings: Sequence[Mapping[str, Any]], part: Part) -> list[tuple[tuple[float | None, ...], str]]:
        self.asked += settings
        return [self._one(setting) for setting in settings]

    def _one(self, setting: Mapping[str, Any]) -> tuple[tuple[float | None, ...], str]:
        params = Params().with_values(setting)
        if params.ground.alpha < 5:
            return (None,), "lost"
        off = (params.ground.alpha - 40) / 40, np.log(params.ground.sigma / 0.05)
        return (float(off[0] ** 2 + off[1] ** 2),), ""


def found(how: Any, trials: int = 60, seed: int = 0) -> tuple[list[Trial], Bowl]:
    bowl = Bowl()
    varied = parse_dimensions("ground.alpha,ground.sigma")
    done, _ = search(bowl.score, SearchPlan([WALK], varied, (ATE,), how=how, trials=trials, seed=seed))
    return done, bowl


@pytest.mark.parametrize("how", ["bayes", "random", "grid"])
def test_every_search_comes_near_the_least_error(how: str) -> None:
    done, _ = found(how)
    (best,) = front(done, (ATE,))
    assert done[0].values == {} and best.scores[0] < 0.25 * done[0].scores[0]
    lost = [trial for trial in done if trial.values.get("ground.alpha", 90) < 5]
    assert lost and all(trial.error == "lost" and trial != best for trial in lost)


def test_a_bayesian_search_beats_a_random_one() -> None:
    def least(how: str, seed: int) -> float:
        (best,) = front(found(how, seed=seed)[0], (ATE,))
        assert best.scores[0] is not None
        return best.scores[0]

    seeds = range(5)
    assert np.median([least("bayes", seed) for seed in seeds]) < np.median([least("random", seed) for seed in seeds])


def test_a_search_that_is_repeated_asks_for_the_same_settings() -> None:
    (_, first), (_, again), (_, other) = found("bayes"), found("bayes"), found("bayes", seed=1)
    assert first.asked == again.asked != other.asked


def test_the_front_holds_what_no_other_trial_beats() -> None:
    scores = [(1.0, 0.5), (2.0, 0.9), (1.0, 0.6), (3.0, 0.8), (0.5, None), (1.0, 0.6)]
    trials = [Trial(number, {}, pair) for number, pair in enumerate(scores)]
    assert [trial.number for trial in front(trials, (ATE, F1))] == [2, 1]


def test_a_setting_is_proposed_only_if_it_is_better_on_the_part_held_back() -> None:
    given, worse, better = (Trial(number, {}, (score,)) for number, score in ((0, 1.0), (7, 1.2), (8, 0.9)))
    as_good = Trial(7, {}, (1.0,))

    def proposed(*held_back: Trial, by: Objective = ATE) -> Trial | None:
        assert ("keep them" in advice((given,), held_back, (by,))) == (proposal((given,), held_back, (by,)) == given)
        return proposal((given,), held_back, (by,))

    assert proposed(given, worse) == proposed(given, as_good) == given
    assert proposed(given, better) == better
    assert proposed(given, worse, by=F1) == worse, "a greater F1 is better"
    assert proposal((given, better), (), (ATE,)) == better and advice((given, better), (), (ATE,)) == ""


def test_the_best_are_checked_even_where_the_parameters_as_given_failed() -> None:
    trials = [Trial(0, {"ground.alpha": 3.0}, (None,), "lost"), Trial(1, {"ground.alpha": 40.0}, (0.0,))]
    plan = SearchPlan([WALK], parse_dimensions("ground.alpha"), (ATE,), rest=Part(20.0, 20.0))
    given, best = check(Bowl().score, plan, trials)
    assert not given.complete and best.complete and proposal(trials, (given, best), (ATE,)) == best
    assert check(Bowl().score, plan, trials[:1]) == (), "no trial gave a result"


def test_when_no_setting_gives_a_result_held_back_the_advice_says_so() -> None:
    given, other = Trial(0, {}, (1.0,)), Trial(5, {}, (0.5,))
    failed = (Trial(0, {}, (None,), "lost"), Trial(5, {}, (None,), "lost"))
    assert proposal((given, other), failed, (ATE,)) == failed[0]
    assert "no setting gives a result" in advice((given, other), failed, (ATE,))


def test_what_gives_up_one_objective_for_another_is_not_proposed() -> None:
    given, other = Trial(0, {}, (1.0, 0.8)), Trial(5, {}, (0.5, 0.7))
    assert proposal((given, other), (given, other), (ATE, F1)) == given


def test_the_search_learns_from_the_parameters_as_given() -> None:
    plan = SearchPlan([WALK], parse_dimensions("ground.alpha"), (ATE,), trials=4)
    done, study = search(Bowl().score, plan)
    assert study.trials[0].params == {"ground.alpha": Params().ground.alpha}
    assert study.trials[0].values == list(done[0].scores)
    _, narrow = search(Bowl().score, replace(plan, dimensions=parse_dimensions("ground.alpha=50:60")))
    assert len(narrow.trials) == 4, "what is given lies outside the range"


def test_whole_numbers_vary_on_their_step_wherever_the_range_and_the_given_value_lie() -> None:
    (points,) = parse_dimensions("filter.max_points=150:1960")
    assert (points.low, points.high, points.grid(4)) == (200, 1900, [200, 800, 1300, 1900])
    for value, learned in ((1000, 1), (1050, 0)):
        given = Params().with_values({"filter.max_points": value})
        done, study = search(Bowl().score, SearchPlan([replace(WALK, params=given)], (points,), (ATE,), trials=4))
        assert all(trial.values["filter.max_points"] % 100 == 0 for trial in done[1:])
        assert len(study.trials) == 4 + learned, "what is given is learned from where it lies on the step"


def test_the_part_held_back_is_reached_without_a_start_in_between() -> None:
    rest = Part(30.0, 20.0).next()
    assert rest is not None and (rest.start_s, rest.duration_s) == (50.0, 20.0)
    assert rest.start_s - rest.lead_s == 30.0 - Part(30.0, 20.0).lead_s


def test_ranges_come_from_the_declaration_or_are_narrowed() -> None:
    alpha, lines, loops = parse_dimensions("ground.alpha=10:40, ground.scan_lines ,loops.enabled")
    assert (alpha.low, alpha.high, lines.low, lines.high) == (10, 40, 1, 128)
    assert loops.grid(5) == [False, True]
    assert all(isinstance(value, int) for value in lines.grid(6))
    assert alpha.rounded(12.3456) == 12.0


def test_a_grid_has_at_most_as_many_points_as_trials() -> None:
    dimensions = parse_dimensions("ground.alpha,ground.sigma,loops.enabled")
    assert len(grid(dimensions, 20)) == 3 * 3 * 2
    with pytest.raises(HemislamError, match="more than 7 trials"):
        grid(dimensions, 7)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("ground.alfa", "alpha"),
        ("recording.lidar_topic", "cannot vary"),
        ("sensor.translation", "cannot vary"),
        ("ground.alpha=40:10", "not a range"),
        ("ground.alpha=0:1000", "not a range"),
        ("loops.support=1.2:1.8", "not a range"),
        ("filter.max_points=110:190", "in steps of 100"),
        ("filter.max_points=-inf:inf", "not a range"),
        ("ground.alpha=fast", "LEAST:GREATEST"),
        ("loops.enabled=0:1", "no range"),
        ("ground.alpha,ground.alpha", r"^ground\.alpha is named twice"),
        (" , ", "^Nothing is named that varies"),
    ],
)
def test_what_cannot_vary_is_refused_in_a_sentence(text: str, complaint: str) -> None:
    with pytest.raises(HemislamError, match=complaint):
        parse_dimensions(text)


# --- the command ---------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "walk.mcap"
    write_walk(path)
    return path


def tune(recording: Path, out: Path, *words: str) -> Result:
    options = ["--parameters", "filter.max_iterations=1:5", "--search", "grid", "--trials", "3", "--duration", "1.5"]
    return CliRunner().invoke(cli, ["tune", str(recording), *options, "--out", str(out), *words])


def trials_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "trials.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_search_on_a_recording_leaves_its_results_and_is_not_run_twice(recording: Path, tmp_path: Path) -> None:
    out, both = tmp_path / "first", ("--objective", "entropy", "--objective", "frame-time")
    result = tune(recording, out, *both)
    assert result.exit_code == 0, result.output
    rows = trials_of(out)
    assert [row["filter.max_iterations"] for row in rows] == ["", "1", "3", "5"]
    assert all(float(row["frame-time_ms"]) > 0 for row in rows)
    best = yaml.safe_load((out / "best.params.yaml").read_text())
    told = json.loads((out / "tuning.json").read_text())
    (proposed,) = (one for one in told["held_back"] if one["trial"] == told["proposed"])
    assert Params().merged(best) == Params().with_values(proposed["values"])
    assert "Pareto front" in (out / "tuning.html").read_text()

    stamps = {path: path.stat().st_mtime_ns for path in out.glob("runs/*/*/run.json")}
    shutil.rmtree(min(stamps).parent)  # as if stopped in the middle
    assert tune(recording, out, *both).exit_code == 0
    again = {path: path.stat().st_mtime_ns for path in out.glob("runs/*/*/run.json")}
    assert sum(stamps[path] != again[path] for path in stamps) == 1
    other = tmp_path / "second"
    assert tune(recording, other, *both).exit_code == 0
    assert not list(other.glob("runs/*/*/run.json")), "what the first search ran is used"
    assert [row["entropy_nats"] for row in trials_of(other)] == [row["entropy_nats"] for row in rows]


class Owner:
    """Stands for the page."""

    def __init__(self) -> None:
        self.told: list[Any] = []

    def send(self, message: object) -> None:
        self.told.append(message)


def wanted(recording: Path, out: Path, objective: str) -> Wanted:
    varied = "filter.max_iterations=1:5"
    return Wanted(recording, Params(), None, varied, (objective,), "grid", 3, 0.0, 1.5, out)


def test_a_search_for_the_page_shows_each_run_and_its_trials_and_leaves_the_same_files(
    recording: Path, tmp_path: Path
) -> None:
    owner = Owner()
    find(owner, wanted(recording, tmp_path / "tuning", "entropy"))  # type: ignore[arg-type]
    runs = [message.runs for message in owner.told if isinstance(message, Ended)]
    found = [message for message in owner.told if isinstance(message, Tried)]
    assert runs[:4] == [1, 2, 3, 4] and [len(one.trials) for one in found] == [1, 4, 4]
    assert found[-1].finished and found[-1].held_back[0].number == 0
    assert {file.name for file in (tmp_path / "tuning").iterdir()} >= {"best.params.yaml", "tuning.html", "trials.csv"}


def test_a_search_for_the_page_that_cannot_be_says_why(recording: Path, tmp_path: Path) -> None:
    owner = Owner()
    for objectives, why in ((("ate",), "needs true poses"), (("entropy", "entropy"), "named twice")):
        with pytest.raises(HemislamError, match=why):
            find(owner, replace(wanted(recording, tmp_path, "ate"), objectives=objectives))  # type: ignore[arg-type]
    assert not owner.told


def test_an_objective_without_truth_is_refused(recording: Path, tmp_path: Path) -> None:
    result = tune(recording, tmp_path / "out", "--truth", "none", "--objective", "ate")
    assert result.exit_code == 2
    assert "needs true poses" in result.output


def test_a_recording_that_is_not_there_is_named(tmp_path: Path) -> None:
    result = tune(tmp_path / "gone.mcap", tmp_path / "out")
    assert result.exit_code == 2
    assert "There is no recording" in result.output


def test_without_a_part_to_search_on_nothing_is_held_back(recording: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(cli, ["tune", str(recording), "--out", str(tmp_path / "out"), "--held-back", "5"])
    assert result.exit_code == 2
    assert "needs --duration" in result.output


@pytest.mark.parametrize(
    ("words", "complaint"), [(("--start", "100"), "no scan after 100 s"), (("--trials", "1"), "more than 1 trials")]
)
def test_what_cannot_be_searched_is_refused_before_anything_runs(
    recording: Path, tmp_path: Path, words: tuple[str, ...], complaint: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.evaluation.runner.run_jobs", lambda *_, **__: pytest.fail("it runs"))
    result = tune(recording, tmp_path / "out", *words)
    assert result.exit_code == 2 and complaint in result.output and not (tmp_path / "out").exists()
