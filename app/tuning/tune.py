"""The work of `hemislam tune`: try settings on recordings, then check the best of them on a part held back.

Only finished runs are kept. The same search tries the same settings in the same order, whatever the number of
processes. So an interrupted search finds its finished runs and continues from there.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import optuna

from app.evaluation.evaluate import Subject, check_subject
from app.evaluation.job import LEAD_S, Job, read_run
from app.evaluation.measured import load, measure
from app.evaluation.runner import RunJobs
from app.slam.provenance import cores
from app.slam.text_files import make_folder
from app.tuning.objectives import Objective, mean_score
from app.tuning.report import write_results
from app.tuning.space import Dimension, grid
from app.tuning.trial import SearchMethod, Trial, beats, front

BATCH = 8
"""Trials chosen at a time; the same for any number of processes, so that searches can be repeated."""
MOST_CHECKED = 5
"""At most this many settings are run again on the part held back."""


@dataclass(frozen=True, slots=True)
class Part:
    """A part of each recording, in seconds after its first scan.

    Attributes:
        duration_s: None: to the end. lead_s: as in `Job`.
    """

    start_s: float = 0.0
    duration_s: float | None = None
    lead_s: float = LEAD_S

    def next(self, duration_s: float | None = None) -> "Part | None":
        """The part that follows, by default with the same length; None if this part reaches the end.

        Reading begins at the same time as for this part: just before the next part, the scanner may see too little to
        estimate its speed, and then all settings would fail alike.
        """
        if self.duration_s is None:
            return None
        return Part(self.start_s + self.duration_s, duration_s or self.duration_s, self.duration_s + self.lead_s)


@dataclass(frozen=True, slots=True)
class SearchPlan:
    """The plan of a search.

    Attributes:
        subjects: the recordings; the search learns from the given parameters of the first one as from any trial.
        rest: a part held back, on which the best settings are checked. trials: number of settings besides the given.
    """

    subjects: Sequence[Subject]
    dimensions: Sequence[Dimension]
    objectives: Sequence[Objective]
    part: Part = Part()
    rest: Part | None = None
    how: SearchMethod = "bayes"
    trials: int = 100
    seed: int = 0


Scores = tuple[tuple[float | None, ...], str]
"""The scores of a setting by objective, and why it failed ("" if it did not)."""
Score = Callable[[Sequence[Mapping[str, Any]], Part], list[Scores]]
"""Runs settings on a part of the recordings."""


class Runs:
    """Runs settings on the recordings of a plan and scores them.

    Args:
        folder: of the search; finished runs beside it are reused. run: as in `evaluate`.

    Raises:
        HemislamError: a recording cannot be used, or ends before the part.
    """

    def __init__(self, plan: SearchPlan, folder: Path, run: RunJobs) -> None:
        self._plan, self._run = plan, run
        self._folder, self._known = folder / "runs", _known_runs(folder.resolve().parent)
        self.hashes = [check_subject(subject, plan.part.start_s) for subject in plan.subjects]

    def score(self, settings: Sequence[Mapping[str, Any]], part: Part) -> list[Scores]:
        recordings = list(zip(self._plan.subjects, self.hashes, strict=True))
        jobs = [[self._job(*recording, setting, part) for recording in recordings] for setting in settings]
        each = {job.folder: job for of_setting in jobs for job in of_setting}
        errors = self._run(list(each.values()))
        return [self._scored(of_setting, errors) for of_setting in jobs]

    def _job(self, subject: Subject, sha256: str, values: Mapping[str, Any], part: Part) -> Job:
        job = Job(
            recording=subject.recording,
            sha256=sha256,
            name=subject.name,
            variant="",
            params=subject.params.with_values(values),
            folder=self._folder,
            start_s=part.start_s,
            duration_s=part.duration_s,
            lead_s=part.lead_s,
            marks=subject.marks,
        )
        name = job.key[:16]
        return replace(job, variant=name, folder=self._known.get(job.key, self._folder / subject.name / name))

    def _scored(self, jobs: Sequence[Job], errors: Mapping[tuple[str, str], str]) -> Scores:
        objectives = self._plan.objectives
        if failed := [error for job in jobs if (error := errors.get((job.name, job.variant)))]:
            return (None,) * len(objectives), failed[0]
        outcomes = [
            measure([load(job, "")], subject.truth)[0][0]
            for job, subject in zip(jobs, self._plan.subjects, strict=True)
        ]
        return tuple(mean_score(objective, outcomes) for objective in objectives), ""


def parallel_runs(objectives: Sequence[Objective]) -> int:
    """Number of parallel runs: one per core, or a single one if an objective needs its time."""
    return 1 if any(one.name == "frame-time" for one in objectives) else cores()


OnTrials = Callable[[Sequence[Trial], optuna.Study], None]
"""Called with all trials so far after each batch."""


def tune(plan: SearchPlan, folder: Path, run: RunJobs, progress: OnTrials) -> tuple[list[Trial], tuple[Trial, ...]]:
    """Search, check the best settings on the part held back, and write the files of `write_results` into `folder`.

    Returns:
        All trials, and those that were run again on the part held back.

    Raises:
        HemislamError: as `Runs`, or a grid has more points than trials, or the folder cannot be written to.
    """
    runs = Runs(plan, folder, run)
    if plan.how == "grid":
        grid(plan.dimensions, plan.trials)  # fails before anything runs
    make_folder(folder / "runs")
    done, study = search(runs.score, plan, progress)
    checked = check(runs.score, plan, done)
    request = {
        "recordings": [
            {"path": str(one.recording), "sha256": sha256, "parameters": one.params.model_dump(mode="json")}
            for one, sha256 in zip(plan.subjects, runs.hashes, strict=True)
        ],
        "search": plan.how,
        "trials": plan.trials,
        "seed": plan.seed,
        "part_s": [plan.part.start_s, plan.part.duration_s],
    }
    write_results(folder, done, checked, plan.objectives, study, request)
    return done, checked


def search(
    score: Score, plan: SearchPlan, progress: OnTrials = lambda so_far, study: None
) -> tuple[list[Trial], optuna.Study]:
    """Try the given parameters and then the settings. Raises HemislamError as `tune` does for a grid."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(directions=["maximize" if one.greatest else "minimize" for one in plan.objectives])
    ((scores, error),) = score([{}], plan.part)
    done = [Trial(0, {}, scores, error)]
    values = {one.path: plan.subjects[0].params.value(one.path) for one in plan.dimensions}
    if done[0].complete and all(one.holds(values[one.path]) for one in plan.dimensions):
        study.add_trial(
            optuna.trial.create_trial(
                params=values,
                distributions={one.path: one.distribution for one in plan.dimensions},
                values=[value for value in scores if value is not None],
            )
        )
    progress(done, study)
    for batch in _batches(study, plan):
        settings = [setting for _, setting in batch]
        for (asked, setting), (scores, error) in zip(batch, score(settings, plan.part), strict=True):
            trial = Trial(len(done), setting, scores, error)
            done.append(trial)
            if trial.complete:
                study.tell(asked, [value for value in scores if value is not None])
            else:
                study.tell(asked, state=optuna.trial.TrialState.FAIL)
        progress(done, study)
    return done, study


def check(score: Score, plan: SearchPlan, trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """The given parameters and the best settings, run on the part held back; empty without such a part or results."""
    if plan.rest is None or not any(trial.complete for trial in trials):
        return ()
    best = [trial for trial in front(trials, plan.objectives) if trial.number]
    best.sort(key=lambda trial: not beats(trial, trials[0], plan.objectives))  # those worse in no objective first
    chosen = [trials[0], *best[:MOST_CHECKED]]
    results = score([trial.values for trial in chosen], plan.rest)
    return tuple(
        Trial(one.number, one.values, scores, error) for one, (scores, error) in zip(chosen, results, strict=True)
    )


Batch = list[tuple[optuna.trial.Trial, Mapping[str, Any]]]


def _batches(study: optuna.Study, plan: SearchPlan) -> Iterator[Batch]:
    distributions = {dimension.path: dimension.distribution for dimension in plan.dimensions}
    if plan.how == "grid":
        settings = grid(plan.dimensions, plan.trials)
        for setting in settings:
            study.enqueue_trial(dict(setting))
        for first in range(0, len(settings), BATCH):
            yield [(study.ask(distributions), setting) for setting in settings[first : first + BATCH]]
        return
    for first in range(0, plan.trials, BATCH):
        study.sampler = _sampler(plan.how, plan.seed * 10_000 + first)
        asked = [study.ask(distributions) for _ in range(min(BATCH, plan.trials - first))]
        yield [(trial, {one.path: one.rounded(trial.params[one.path]) for one in plan.dimensions}) for trial in asked]


def _sampler(how: SearchMethod, seed: int) -> optuna.samplers.BaseSampler:
    if how == "random":
        return optuna.samplers.RandomSampler(seed=seed)
    return optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True)


def _known_runs(folder: Path) -> dict[str, Path]:
    """Folders of finished runs below `folder`, by their key, so that `tune` runs nothing that `evaluate` ran."""
    runs = [(path.parent, read_run(path.parent)) for path in sorted(folder.glob("*/runs/*/*/run.json"))]
    return {str(run.get("key")): where for where, run in runs if run is not None}
