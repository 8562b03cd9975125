"""`hemislam evaluate`: the paper's tables, on any recordings."""

from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.cli.options import MOST_S, Duration, Imperfect, ParamsFor, Short, Suite, make_suite, with_params
from app.slam.errors import HemislamError
from app.slam.provenance import cores

if TYPE_CHECKING:
    from app.evaluation.evaluate import Subject
    from app.evaluation.job import Job
    from app.evaluation.runner import RunJobs
    from app.slam.arrays import Vector
    from app.slam.trajectory import Trajectory

ClusterAddress = Annotated[
    str | None,
    typer.Option(
        "--cluster", metavar="ADDRESS", help="Run on the Dask cluster of this scheduler, e.g. tcp://host:8786."
    ),
]
ClusterData = Annotated[
    str,
    typer.Option(
        "--cluster-data",
        metavar="URL",
        help="Where the workers find the recordings, e.g. s3://bucket/walks. Default: the same path, or a copy.",
    ),
]
PartStart = Annotated[
    float,
    typer.Option(
        "--start",
        min=0,
        max=MOST_S,
        metavar="SECONDS",
        help="Measure from this time after the first scan; every system starts 5 s earlier.",
    ),
]
Out = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Where to write. Finished runs found there are reused.")
]
Truths = Annotated[
    list[str] | None,
    typer.Option(
        "--truth",
        metavar="TRUTH",
        help="True poses: a TUM or KITTI file, the GNSS/INS table of H2LID, or topic:/NAME in the recording; `none` for"
        " none. Repeatable, in the order of the recordings. Default: RECORDING_truth.tum beside the recording.",
    ),
]
Jobs = Annotated[int | None, typer.Option("--jobs", min=1, metavar="N", help="Parallel runs. Default: one per core.")]


@with_params
def evaluate(
    params_for: ParamsFor,
    recordings: Annotated[
        list[Path] | None, typer.Argument(metavar="RECORDING...", help="One or more recordings.")
    ] = None,
    out: Out = Path("runs/evaluation"),
    truths: Truths = None,
    lever_arm: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            "--lever-arm", metavar="X Y Z", help="Metres from the IMU to the point of the truth, in its body's axes."
        ),
    ] = None,
    variants: Annotated[
        list[str] | None,
        typer.Option("--variant", metavar="NAME:PARAM=VALUE,...", help="Add a variant as a column. Repeatable."),
    ] = None,
    baselines: Annotated[
        list[str] | None,
        typer.Option(
            "--baseline",
            metavar="SYSTEM",
            help="Add another system as a column: loam, liom, kiss-icp, rko-lio or genz-icp. Repeatable.",
        ),
    ] = None,
    ablation: Annotated[
        bool, typer.Option("--ablation/--no-ablation", help="With the paper's four variants, or with your own only.")
    ] = True,
    compare: Annotated[
        list[str] | None,
        typer.Option(
            "--compare",
            metavar="NAME=FILE.tum",
            help="Add another system's trajectory as a column; with several recordings: NAME@RECORDING=FILE.",
        ),
    ] = None,
    suite: Suite = None,
    short: Short = False,
    seeds: Annotated[list[int] | None, typer.Option("--seed", min=0, help="Seed of the suite. Repeatable.")] = None,
    imperfect: Imperfect = False,
    jobs: Jobs = None,
    cluster: ClusterAddress = None,
    cluster_data: ClusterData = "",
    start: PartStart = 0.0,
    duration: Duration = None,
) -> None:
    """Measure accuracy, time and map sharpness: the paper's ablation and your own.

    Each recording is processed with FAST-LIO (no ground downsampling, no loops), FAST-LIO-GD, FAST-LIO-L
    and Ours, and with each --variant and --baseline. Finished runs are reused, so an interrupted evaluation
    continues where it stopped.

    \b
    Writes into DIR:
      report.html      tables, trajectories, errors, times and extracts of the maps, in one file
      report.md, *.csv the same tables; tables.tex for LaTeX
      results.json     everything, with parameters, input hashes and the machine
      runs/            trajectory and times of every run

    \b
    Examples:
      hemislam evaluate walk.mcap --truth walk.tum --out results
      hemislam evaluate outdoor3.bag --preset h2lid --truth outdoor3_gnss.txt --out results
      hemislam evaluate walk.mcap --variant fine:scan.voxel_size=0.2 --compare FAST-LIO2=theirs.tum
      hemislam evaluate walk.mcap --baseline loam --baseline liom --out results
      hemislam evaluate --suite paper --short --out results
    """
    from app.evaluation.evaluate import evaluate as run_evaluation
    from app.evaluation.variants import choose_variants, parse_variant
    from app.sensors.simulator.imperfections import IMPERFECT, NONE

    if suite is None and (short or seeds or imperfect):
        raise HemislamError(
            "--short, --seed and --imperfect belong to --suite; with a RECORDING, --duration shortens it."
        )
    chosen = choose_variants(
        [parse_variant(text) for text in variants or []], ablation=ablation, baselines=baselines or []
    )
    paths = list(recordings or [])
    if suite is not None:
        paths += make_suite(
            suite, out / "recordings", seeds or [0], short=short, imperfections=IMPERFECT if imperfect else NONE
        )
    if not paths:
        raise HemislamError("Nothing to evaluate; name a RECORDING or use --suite paper.")
    subjects = read_subjects(paths, params_for, truths or [], lever_arm)
    if lever_arm is not None and all(subject.truth is None for subject in subjects):
        raise HemislamError("--lever-arm belongs to a truth, and no recording has one; add --truth, or leave it out.")
    others = _compared(compare or [], [subject.name for subject in subjects], [variant.name for variant in chosen])
    subjects = [replace(subject, compared=tuple(others[subject.name])) for subject in subjects]
    for variant in chosen:
        variant.applied(subjects[0].params)  # raises for a misspelt parameter before anything runs
    run = runner(max(1, min(jobs or cores(), len(chosen) * len(subjects))), cluster, cluster_data)
    findings, failures = run_evaluation(
        subjects,
        chosen,
        out,
        run=run,
        start_s=start,
        duration_s=duration,
    )
    for finding in findings:
        typer.echo(finding)
    typer.echo(f"report     {out / 'report.html'}")
    if failures:
        (recording, name), why = next(iter(failures.items()))
        raise HemislamError(f"{len(failures)} of {len(chosen) * len(subjects)} runs failed; {recording}, {name}: {why}")


def runner(parallel: int, address: str | None, url: str, *, quiet: bool = False) -> "RunJobs":
    """A function that runs jobs, on this machine or on a cluster. It compiles the kernels when it is called first.

    Raises:
        HemislamError: Dask is not installed, or an option is there without the one it belongs to.
    """
    from app.cli.run import compile_behind_bar
    from app.evaluation.cluster import run_on_cluster
    from app.evaluation.runner import run_jobs

    if address is None and url:
        raise HemislamError("--cluster-data belongs to --cluster; give both.")
    if address is not None and find_spec("distributed") is None:
        raise HemislamError("--cluster needs Dask; install it with `pip install 'hemislam[cluster]'`.")
    compile_once = cache(compile_behind_bar)

    def run(jobs: "list[Job]") -> dict[tuple[str, str], str]:
        compile_once()
        if address is None:
            return run_jobs(jobs, parallel=parallel, quiet=quiet)
        return run_on_cluster(jobs, address=address, url=url)

    return run


def read_subjects(
    paths: list[Path], params_for: ParamsFor, truths: list[str], lever: "Vector | None" = None
) -> "list[Subject]":
    """The recordings with their parameters and truths, numbered where two have the same name.

    Args:
        truths: of the first recordings, `none` for none; the others have the one beside them, if there is one.

    Raises:
        HemislamError: there are more truths than recordings, or one cannot be read.
    """
    from app.evaluation.evaluate import Subject
    from app.evaluation.truth import read_truth
    from app.slam.trajectory import truth_beside

    if len(truths) > len(paths):
        raise HemislamError(
            f"{len(truths)} --truth options for {len(paths)} recordings; give at most one for each, in order."
        )
    texts = truths + [str(truth_beside(path) or "none") for path in paths[len(truths) :]]
    subjects: list[Subject] = []
    for path, text in zip(paths, texts, strict=True):
        stem = path.resolve().stem
        taken = [one.name for one in subjects]
        name = next(name for name in chain([stem], (f"{stem}~{n}" for n in count(2))) if name not in taken)
        params = params_for(path)
        subjects.append(
            Subject(name, path, params, read_truth(text, path, lever) if text not in ("", "none") else None)
        )
    return subjects


def _compared(texts: list[str], names: list[str], variants: list[str]) -> dict[str, list[tuple[str, "Trajectory"]]]:
    """By recording: the names of the further columns and their trajectories."""
    from app.slam.trajectory import read_tum

    found: dict[str, list[tuple[str, Trajectory]]] = {name: [] for name in names}
    for text in texts:
        who, equals, file = text.partition("=")
        system, at, recording = who.partition("@")
        if not (system and equals and file):
            raise HemislamError(f"`--compare {text}` is malformed; write it as --compare NAME=FILE.tum.")
        if not at and len(names) > 1:
            raise HemislamError(f"`--compare {text}` does not name a recording; write {system}@{names[0]}={file}.")
        recording = recording if at else names[0]
        if recording not in found:
            raise HemislamError(
                f"`--compare {text}`: there is no recording {recording}; choose from {', '.join(names)}."
            )
        if system in variants or any(system == name for name, _ in found[recording]):
            raise HemislamError(f"`--compare {text}`: a column {system} exists already; choose another name.")
        found[recording].append((system, read_tum(Path(file))))
    return found
