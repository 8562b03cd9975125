"""`hemislam tune`: which parameters fit a sensor and a place."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from app.cli.evaluate import ClusterAddress, ClusterData, Jobs, Out, PartStart, Truths, read_subjects, runner
from app.cli.options import MOST_S, Duration, ParamsFor, with_params
from app.slam.errors import HemislamError


@with_params
def tune(
    params_for: ParamsFor,
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING...", help="One or more recordings.")],
    parameters: Annotated[
        str,
        typer.Option(
            "--parameters",
            metavar="NAME,NAME=LEAST:GREATEST,...",
            help="Parameters to vary, each over its full range or a narrower one.",
        ),
    ] = "ground.alpha,ground.sigma",
    objectives: Annotated[
        list[str] | None,
        typer.Option(
            "--objective",
            metavar="NAME",
            help="Objective: ate, rpe, loop-drift, ground-f1, entropy, thickness or frame-time. Repeatable."
            " Default: ate with a truth, else entropy.",
        ),
    ] = None,
    search: Annotated[
        Literal["bayes", "random", "grid"], typer.Option("--search", help="How the next settings are chosen.")
    ] = "bayes",
    trials: Annotated[
        int, typer.Option("--trials", min=1, metavar="N", help="Settings to try besides the given one, at most.")
    ] = 100,
    held_back: Annotated[
        float | None,
        typer.Option(
            "--held-back",
            min=0,
            max=MOST_S,
            metavar="SECONDS",
            help="Length of the part after --duration on which the best setting is checked. Default: as long; 0: none.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the search.")] = 0,
    truths: Truths = None,
    labels: Annotated[
        Path | None,
        typer.Option(
            "--labels",
            metavar="FILE",
            help="Frames labelled in the page, for ground-f1: a session file or NAME.labels.json. For one recording.",
        ),
    ] = None,
    out: Out = Path("runs/tuning"),
    jobs: Jobs = None,
    cluster: ClusterAddress = None,
    cluster_data: ClusterData = "",
    start: PartStart = 0.0,
    duration: Duration = None,
) -> None:
    """Find the parameters that fit a sensor and a place.

    Tries settings on the recordings, the given parameters first. Then compares the best settings with the given ones on
    a part that the search has not seen. With several objectives, reports the Pareto front. An interrupted search
    continues if it is started again with the same options; runs that `evaluate` has finished in a folder next to DIR
    are reused.

    \b
    Writes into DIR:
      best.params.yaml  the proposed setting; use it with --config
      tuning.html       the best settings and the plots, in one file
      trials.csv        every trial
      tuning.json       the best settings with all parameters, input hashes and the machine

    \b
    Examples:
      hemislam tune walk.mcap --parameters ground.alpha,ground.sigma --objective ground-f1 --duration 20
      hemislam tune walk.mcap --objective ground-f1 --labels runs/sessions/walk-20261121-101500.hemislam
      hemislam tune walk.mcap --parameters scan.voxel_size=0.1:0.6 --objective entropy --objective frame-time
    """
    from tqdm import tqdm

    from app.mapping.session_file import read_marks
    from app.tuning.objectives import choose_objectives
    from app.tuning.report import BEST
    from app.tuning.space import parse_dimensions
    from app.tuning.trial import Trial, advice, front
    from app.tuning.tune import Part, SearchPlan, parallel_runs
    from app.tuning.tune import tune as find

    dimensions = parse_dimensions(parameters)
    if labels is not None and len(recordings) > 1:
        raise HemislamError("--labels belong to one recording; give only that one.")
    marks = read_marks(labels) if labels else ()
    subjects = [replace(one, marks=marks) for one in read_subjects(recordings, params_for, truths or [])]
    usual = "ate" if all(subject.truth is not None for subject in subjects) else "entropy"
    wanted = choose_objectives(objectives or [usual], subjects)
    if held_back and duration is None:
        raise HemislamError("--held-back needs --duration: without it the search sees the whole recording.")
    part = Part(start, duration)
    rest = part.next(held_back) if held_back != 0 and not marks else None
    run = runner(jobs or parallel_runs(wanted), cluster, cluster_data, quiet=True)
    plan = SearchPlan(subjects, dimensions, wanted, part, rest, search, trials, seed)
    with tqdm(total=trials + 1, desc="Tuning", unit=" trials", disable=None) as bar:

        def progress(so_far: Sequence[Trial], _: object) -> None:
            bar.update(len(so_far) - bar.n)
            if best := front(so_far, wanted):
                bar.set_postfix_str(f"best {wanted[0].text(best[0].scores[0])}")

        done, checked = find(plan, out, run, progress)
    best = front(done, wanted)
    if not best:
        raise HemislamError(f"No trial gave a result: {done[0].error or 'no run has a value for the objective'}")
    for label, shown in (("as given", done[:1]), ("best", best[:5]), ("held back", checked)):
        for trial in shown:
            scores = ", ".join(f"{one.title} {one.text(v)}" for one, v in zip(wanted, trial.scores, strict=True))
            typer.echo(f"{label:<10} {scores}  ({trial.name}){' ' + trial.error if trial.error else ''}")
    if words := advice(done, checked, wanted):
        typer.echo(words)
    failed = [trial for trial in done if trial.error]
    if failed:
        typer.echo(f"{len(failed)} of {len(done)} trials failed; the first: {failed[0].error}")
    typer.echo(f"saved in   {out / BEST}, {out / 'tuning.html'}")
