"""What `hemislam tune` does: settings are tried on recordings, and the best of them once more on a part held back.

Nothing but finished runs is kept. The same search asks for the same settings in the same order, whatever the number
of processes, so one that was interrupted finds its finished runs and goes on where it was.
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
from app.slam.params import Params
from app.slam.provenance import cores
from app.slam.text_files import make_folder
from app.tuning.objectives import Objective, score
from app.tuning.report import write_results
from app.tuning.space import Dimension, grid
from app.tuning.trial import SearchMethod, Trial, beats, front

BATCH = 8
"""Trials between two looks at the results; the same for any number of processes, so that trials repeat."""
MOST_CHECKED = 5
"""Settings that are run again on the part held back, at most."""


@dataclass(frozen=True, slots=True)
class Part:
    """Of each recording, in seconds after its first scan.

    Attributes:
        duration_s: None for all the rest. lead_s: as `Job` has it.
    """

    start_s: float = 0.0
    duration_s: float | None = None
    lead_s: float = LEAD_S

    def next(self, duration_s: float | None = None) -> "Part | None":
        """The part right after it, as long if nothing else is said; None if it goes to the end.

        Reading begins where it begins for this part: a start just before the next one may fall on a place where the
        scanner sees too little to find its speed, and all settings would then be lost alike.
        """
        if self.duration_s is None:
            return None
        return Part(self.start_s + self.duration_s, duration_s or self.duration_s, self.duration_s + self.lead_s)


@dataclass(frozen=True, slots=True)
class SearchPlan:
    """What is tried.

    Attributes:
        given: the parameters as given, of the first recording; the search learns from them as from any trial.
        rest: a part held back, on which the best are checked. trials: settings besides the parameters as given.
    """

    dimensions: Sequence[Dimension]
    objectives: Sequence[Objective]
    part: Part
    given: Params
    rest: Part | None = None
    how: SearchMethod = "bayes"
    trials: int = 100
    seed: int = 0


class Runs:
    """Runs settings on all recordings and scores them.

    Args:
        folder: of the search; finished runs beside it are found again. run: as `evaluate`. start_s: of the part.

    Raises:
        HemislamError: a recording cannot be used, or ends before the part.
    """

    def __init__(
        self,
        subjects: Sequence[Subject],
        objectives: Sequence[Objective],
        folder: Path,
        run: RunJobs,
        start_s: float = 0.0,
    ) -> None:
        self._subjects, self._objectives, self._run = subjects, objectives, run
        self._folder, self._known = folder / "runs", _known_runs(folder.resolve().parent)
        self.hashes = [check_subject(subject, start_s) for subject in subjects]

    def asked(self, wanted: SearchPlan) -> dict[str, Any]:
        """What a search was asked for, as its report keeps it."""
        return {
            "recordings": [
                {"path": str(one.recording), "sha256": sha256, "parameters": one.params.model_dump(mode="json")}
                for one, sha256 in zip(self._subjects, self.hashes, strict=True)
            ],
            "search": wanted.how,
            "trials": wanted.trials,
            "seed": wanted.seed,
            "part_s": [wanted.part.start_s, wanted.part.duration_s],
        }

    def score(self, settings: Sequence[Mapping[str, Any]], part: Part) -> list[tuple[tuple[float | None, ...], str]]:
        """For each setting its scores by objective, and why it failed ("" if it did not)."""
        jobs = [[self._job(index, setting, part) for index in range(len(self._subjects))] for setting in settings]
        each = {job.folder: job for of_setting in jobs for job in of_setting}
        errors = self._run(list(each.values()))
        return [self._scored(of_setting, errors) for of_setting in jobs]

    def _job(self, index: int, values: Mapping[str, Any], part: Part) -> Job:
        subject = self._subjects[index]
        job = Job(
            recording=subject.recording,
            sha256=self.hashes[index],
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

    def _scored(
        self, jobs: Sequence[Job], errors: Mapping[tuple[str, str], str]
    ) -> tuple[tuple[float | None, ...], str]:
        failed = [error for job in jobs if (error := errors.get((job.name, job.variant)))]
        if failed:
            return (None,) * len(self._objectives), failed[0]
        outcomes = [
            measure([load(job, "")], subject.truth)[0][0] for job, subject in zip(jobs, self._subjects, strict=True)
        ]
        return tuple(score(objective, outcomes) for objective in self._objectives), ""


def parallel_runs(objectives: Sequence[Objective]) -> int:
    """How many runs go on at once: one for each core, but one alone where its time is wanted."""
    return 1 if any(one.name == "frame-time" for one in objectives) else cores()


OnTrials = Callable[[Sequence[Trial], optuna.Study], None]
"""Called with all trials so far after each batch."""


def tune(runs: Runs, wanted: SearchPlan, folder: Path, progress: OnTrials) -> tuple[list[Trial], tuple[Trial, ...]]:
    """Search, check the best on the part held back, and write the files that `write_results` names into `folder`.

    Returns:
        All trials, and those of them that were run again on the part held back.

    Raises:
        HemislamError: a grid has more points than trials, or the folder cannot be written to.
    """
    if wanted.how == "grid":
        grid(wanted.dimensions, wanted.trials)  # refused before anything runs
    make_folder(folder / "runs")
    done, study = search(runs, wanted, progress)
    checked = check(runs, done, wanted.objectives, wanted.rest)
    write_results(folder, done, checked, wanted.objectives, study, runs.asked(wanted))
    return done, checked


def search(
    runs: Runs, wanted: SearchPlan, progress: OnTrials = lambda so_far, study: None
) -> tuple[list[Trial], optuna.Study]:
    """Try the parameters as given and then the settings. Raises HemislamError as `tune` does for a grid."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    study = optuna.create_study(directions=["maximize" if one.greatest else "minimize" for one in wanted.objectives])
    ((scores, error),) = runs.score([{}], wanted.part)
    done = [Trial(0, {}, scores, error)]
    values = {one.path: wanted.given.value(one.path) for one in wanted.dimensions}
    if done[0].complete and all(one.holds(values[one.path]) for one in wanted.dimensions):
        study.add_trial(
            optuna.trial.create_trial(
                params=values,
                distributions={one.path: one.distribution for one in wanted.dimensions},
                values=[value for value in scores if value is not None],
            )
        )
    progress(done, study)
    for batch in _batches(study, wanted):
        settings = [setting for _, setting in batch]
        for (asked, setting), (scores, error) in zip(batch, runs.score(settings, wanted.part), strict=True):
            trial = Trial(len(done), setting, scores, error)
            done.append(trial)
            if trial.complete:
                study.tell(asked, [value for value in scores if value is not None])
            else:
                study.tell(asked, state=optuna.trial.TrialState.FAIL)
        progress(done, study)
    return done, study


def check(runs: Runs, trials: Sequence[Trial], objectives: Sequence[Objective], rest: Part | None) -> tuple[Trial, ...]:
    """The parameters as given and the best settings, on a part that the search has not seen; nothing without either."""
    if rest is None or not any(trial.complete for trial in trials):
        return ()
    best = [trial for trial in front(trials, objectives) if trial.number]
    best.sort(key=lambda trial: not beats(trial, trials[0], objectives))  # those first that give nothing up
    chosen = [trials[0], *best[:MOST_CHECKED]]
    results = runs.score([trial.values for trial in chosen], rest)
    return tuple(
        Trial(one.number, one.values, scores, error) for one, (scores, error) in zip(chosen, results, strict=True)
    )


Batch = list[tuple[optuna.trial.Trial, Mapping[str, Any]]]


def _batches(study: optuna.Study, wanted: SearchPlan) -> Iterator[Batch]:
    distributions = {dimension.path: dimension.distribution for dimension in wanted.dimensions}
    if wanted.how == "grid":
        settings = grid(wanted.dimensions, wanted.trials)
        for setting in settings:
            study.enqueue_trial(dict(setting))
        for first in range(0, len(settings), BATCH):
            yield [(study.ask(distributions), setting) for setting in settings[first : first + BATCH]]
        return
    for first in range(0, wanted.trials, BATCH):
        study.sampler = _sampler(wanted.how, wanted.seed * 10_000 + first)
        asked = [study.ask(distributions) for _ in range(min(BATCH, wanted.trials - first))]
        yield [(trial, {one.path: one.rounded(trial.params[one.path]) for one in wanted.dimensions}) for trial in asked]


def _sampler(how: SearchMethod, seed: int) -> optuna.samplers.BaseSampler:
    if how == "random":
        return optuna.samplers.RandomSampler(seed=seed)
    return optuna.samplers.TPESampler(seed=seed, multivariate=True, constant_liar=True)


def _known_runs(folder: Path) -> dict[str, Path]:
    """Folders of finished runs below `folder`, by their key, so that `tune` runs nothing that `evaluate` ran."""
    runs = [(path.parent, read_run(path.parent)) for path in sorted(folder.glob("*/runs/*/*/run.json"))]
    return {str(run.get("key")): where for where, run in runs if run is not None}
