"""The files of a search: trials.csv, tuning.json, the proposed parameters as YAML, and tuning.html with its plots."""

import json
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import optuna
import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined

from app import __version__
from app.slam.params import nested
from app.slam.provenance import describe_machine
from app.slam.text_files import csv_text, write_texts
from app.tuning.objectives import Objective
from app.tuning.trial import Trial, advice, front, proposal

BEST = "best.params.yaml"


def write_results(
    folder: Path,
    trials: Sequence[Trial],
    held_back: Sequence[Trial],
    objectives: Sequence[Objective],
    study: optuna.Study,
    inputs: dict[str, Any],
) -> None:
    """Write all files, each whole or not at all.

    Args:
        held_back: trials run again on the part held back; empty if there is no such part.
        inputs: the request for the search.

    Raises:
        HemislamError: the folder cannot be written to.
    """
    best, proposed = front(trials, objectives), proposal(trials, held_back, objectives)
    texts = {
        "trials.csv": _csv(trials, objectives),
        "tuning.json": json.dumps(
            {
                "hemislam": __version__,
                "machine": describe_machine(),
                **inputs,
                "best": [_entry(trial, objectives) for trial in best],
                "held_back": [_entry(trial, objectives) for trial in held_back],
                "proposed": proposed.number if proposed else None,
            },
            indent=2,
            ensure_ascii=False,
        )
        + "\n",
        "tuning.html": _html(trials, best, held_back, objectives, study),
    }
    if proposed is not None:
        texts[BEST] = yaml.safe_dump(nested(proposed.values), sort_keys=False)  # applies to every recording
    write_texts(folder, texts)


def pictures(study: optuna.Study, objectives: Sequence[Objective]) -> dict[str, Any]:
    """Plotly figures by title, as far as the trials allow: history, importance, parallel coordinates, Pareto front."""
    from optuna import visualization as draw
    from plotly.graph_objects import Bar, Figure  # type: ignore[import-untyped]

    done = [trial for trial in study.trials if trial.state == optuna.trial.TrialState.COMPLETE]
    if len(done) < 2:
        return {}
    figures: dict[str, Any] = {}
    for index, objective in enumerate(objectives):
        title = f"{objective.title} ({objective.unit})" if objective.unit else objective.title

        def target(trial: optuna.trial.FrozenTrial, index: int = index) -> float:
            return float(trial.values[index])

        figures[f"{title} over trials"] = draw.plot_optimization_history(study, target=target, target_name=title)
        figures[f"{title} by parameters"] = draw.plot_parallel_coordinate(study, target=target, target_name=title)
        if shares := importances(study, index, objective):
            bar = Bar(x=list(shares.values()), y=list(shares), orientation="h")
            figures[f"What {title} depends on"] = Figure(bar)
    if len(objectives) in (2, 3):
        figures["Pareto front"] = draw.plot_pareto_front(study, target_names=[one.title for one in objectives])
    for title, figure in figures.items():
        figure.update_layout(title=title)
    return figures


def importances(study: optuna.Study, index: int, objective: Objective) -> dict[str, float]:
    """Each parameter's share in the variation of the objective with this index, largest first; empty while unknown."""
    from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances

    sign = -1.0 if objective.greatest else 1.0  # importance is computed for low values
    done = [trial for trial in study.trials if trial.state == optuna.trial.TrialState.COMPLETE]
    if len({trial.values[index] for trial in done}) < 2 or len(done[0].params) < 2:
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # it warns about a case that `sign` handles
        return get_param_importances(
            study, evaluator=PedAnovaImportanceEvaluator(), target=lambda trial: sign * float(trial.values[index])
        )


def _entry(trial: Trial, objectives: Sequence[Objective]) -> dict[str, Any]:
    scores = {one.name: value for one, value in zip(objectives, trial.scores, strict=True)}
    return {"trial": trial.number, "values": dict(trial.values), "scores": scores, "error": trial.error or None}


def _csv(trials: Sequence[Trial], objectives: Sequence[Objective]) -> str:
    paths = list(dict.fromkeys(path for trial in trials for path in trial.values))
    rows: list[list[Any]] = [["trial", *paths, *(f"{one.name}_{one.unit}".rstrip("_") for one in objectives), "error"]]
    for trial in trials:
        scores = ["" if value is None else f"{value:.9g}" for value in trial.scores]
        rows.append([trial.number, *(trial.values.get(path, "") for path in paths), *scores, trial.error])
    return csv_text(*rows)


def _html(
    trials: Sequence[Trial],
    best: Sequence[Trial],
    held_back: Sequence[Trial],
    objectives: Sequence[Objective],
    study: optuna.Study,
) -> str:
    figures = [
        figure.to_html(full_html=False, include_plotlyjs=index == 0)
        for index, figure in enumerate(pictures(study, objectives).values())
    ]
    page = Environment(loader=PackageLoader("app.tuning"), autoescape=True, undefined=StrictUndefined)
    return page.get_template("tuning.html").render(
        version=__version__,
        trials=trials,
        best=best,
        held_back=held_back,
        advice=advice(trials, held_back, objectives),
        objectives=objectives,
        figures=figures,
    )
