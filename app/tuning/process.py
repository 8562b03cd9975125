"""A search in a process of its own, for the page: it reports trials as they finish and writes what `tune` writes."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from app.child import Link
from app.slam.params import Params
from app.tuning.trial import SearchMethod, Trial, front

if TYPE_CHECKING:
    import optuna


@dataclass(frozen=True, slots=True)
class Wanted:
    """The request for a search.

    Attributes:
        parameters: those that vary, as in `--parameters`. objectives: names. how: as in `--search`.
        start_s, duration_s: the part of the recording; None: to its end.
        folder: for the files that `hemislam tune` writes. marks: as in `Job`.
    """

    recording: Path
    params: Params
    truth: Path | None
    parameters: str
    objectives: tuple[str, ...]
    how: SearchMethod
    trials: int
    start_s: float
    duration_s: float | None
    folder: Path
    marks: tuple[tuple[int, bytes], ...] = ()


@dataclass(frozen=True, slots=True)
class Ended:
    """A run has ended. runs: how many have. ran: False if the run had finished before, which takes no time now."""

    runs: int
    ran: bool


@dataclass(frozen=True, slots=True)
class Tried:
    """The results so far.

    Attributes:
        best: numbers of the trials that no other trial beats.
        importance: each parameter's share in the variation of the first objective.
        held_back: trials run again on a part that the search has not seen. finished: whether the search has ended.
    """

    trials: tuple[Trial, ...] = ()
    best: tuple[int, ...] = ()
    importance: dict[str, float] = field(default_factory=dict)
    held_back: tuple[Trial, ...] = ()
    finished: bool = False


def find(owner: Link, wanted: Wanted) -> None:
    """Send an `Ended` after each run, a `Tried` after each batch of trials. Raises HemislamError if nothing can run."""
    from app.evaluation.evaluate import Subject
    from app.evaluation.runner import run_jobs
    from app.evaluation.truth import read_truth
    from app.tuning.objectives import choose_objectives
    from app.tuning.report import importances
    from app.tuning.space import parse_dimensions
    from app.tuning.tune import Part, SearchPlan, parallel_runs, tune

    truth = read_truth(str(wanted.truth)) if wanted.truth is not None else None
    subject = Subject(wanted.recording.stem, wanted.recording, wanted.params, truth, marks=wanted.marks)
    objectives = choose_objectives(wanted.objectives, [subject])
    part = Part(wanted.start_s, wanted.duration_s)
    rest = part.next() if not wanted.marks else None  # only this part has marks
    dimensions = parse_dimensions(wanted.parameters)
    plan = SearchPlan([subject], dimensions, objectives, part, rest, wanted.how, wanted.trials)
    count, latest = 0, Tried()

    def ended(ran: bool) -> None:
        nonlocal count
        count += 1
        owner.send(Ended(count, ran))

    def progress(so_far: Sequence[Trial], study: "optuna.Study") -> None:
        nonlocal latest
        best = tuple(trial.number for trial in front(so_far, objectives))
        latest = Tried(tuple(so_far), best, importances(study, 0, objectives[0]))
        owner.send(latest)

    run = partial(run_jobs, parallel=parallel_runs(objectives), quiet=True, ended=ended)
    _, checked = tune(plan, wanted.folder, run, progress)
    owner.send(replace(latest, held_back=checked, finished=True))
