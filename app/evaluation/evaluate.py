"""Everything that `hemislam evaluate` does: plan the runs, run them, measure them, report."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from app.evaluation.job import Job
from app.evaluation.measured import Column, Evaluated, load, measure
from app.evaluation.report import write_report
from app.evaluation.runner import run_jobs
from app.evaluation.truth import Truth, check_overlap
from app.evaluation.variants import Variant
from app.sensors.recording import open_recording
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.provenance import hash_input
from app.slam.trajectory import Trajectory
from app.slam.types import F64


@dataclass(frozen=True, slots=True)
class Subject:
    """One recording to be evaluated.

    Attributes:
        name: in tables, without `/`. params: before the variants. truth: to measure against.
        compared: other systems' trajectories by name, in the recording's clock.
    """

    name: str
    recording: Path
    params: Params
    truth: Truth | None = None
    compared: tuple[tuple[str, Trajectory], ...] = ()


@dataclass(frozen=True, slots=True)
class Plan:
    """Attributes:
    parallel: runs at a time; each has cores / parallel threads. start_s, duration_s: the part to use.
    """

    subjects: tuple[Subject, ...]
    variants: tuple[Variant, ...]
    folder: Path
    parallel: int
    threads: int
    start_s: float = 0.0
    duration_s: float | None = None


def evaluate(plan: Plan) -> tuple[list[str], dict[tuple[str, str], str]]:
    """Run what is not finished and write the report.

    Returns:
        The findings, and why runs failed, by (recording, variant).

    Raises:
        HemislamError: a recording, truth or parameter can not be used; found out before anything runs.
    """
    jobs: dict[tuple[str, str], Job] = {}
    hashes: dict[str, str] = {}
    for subject in plan.subjects:
        with open_recording(subject.recording, subject.params) as recording:
            if subject.truth is not None:
                check_overlap(subject.truth, recording.start_ns, recording.duration_s)
        digest = hash_input(subject.recording)
        if digest is None:
            raise HemislamError(f"{subject.recording} can not be read; check its permissions.")
        hashes[subject.name] = digest
        for variant in plan.variants:
            jobs[subject.name, variant.name] = Job(
                recording=subject.recording,
                sha256=digest,
                name=subject.name,
                variant=variant.name,
                params=variant.applied(subject.params),
                folder=plan.folder / "runs" / subject.name / variant.name,
                threads=plan.threads,
                start_s=plan.start_s,
                duration_s=plan.duration_s,
            )
    failures = run_jobs(list(jobs.values()), plan.parallel, plan.folder / "runs")
    evaluated = [_evaluated(plan, subject, jobs, failures, hashes[subject.name]) for subject in plan.subjects]
    return write_report(plan.folder, evaluated), failures


def _evaluated(
    plan: Plan,
    subject: Subject,
    jobs: dict[tuple[str, str], Job],
    failures: dict[tuple[str, str], str],
    sha256: str,
) -> Evaluated:
    columns: list[Column] = []
    for variant in plan.variants:
        which = (subject.name, variant.name)
        if missing := failures.get(which, ""):
            columns.append(Column(variant.name, variant.meaning, missing=missing))
        else:
            columns.append(load(jobs[which], variant.meaning))
    columns += [Column(name, "a trajectory from elsewhere", trajectory=other) for name, other in subject.compared]
    columns, matched, problem = measure(columns, subject.truth)
    truth = subject.truth
    notes = () if truth is None else (matched.notes if matched else (problem,))
    return Evaluated(
        name=subject.name,
        recording=subject.recording,
        sha256=sha256,
        columns=tuple(columns),
        truth="" if truth is None else _described(truth),
        notes=notes,
        truth_path=_path(matched.trajectory, columns) if matched else None,
    )


def _described(truth: Truth) -> str:
    """What it is; where a lever arm is taken off, the notes tell it."""
    point = "" if any(truth.lever) else " of a point taken as the IMU's own (no lever arm)"
    return f"{truth.source}: {truth.kind}, {len(truth)} poses{point}."


def _path(truth: Trajectory, columns: Sequence[Column]) -> F64:
    """The truth from above, (n, 2), while something was measured against it."""
    stamps = np.concatenate([c.trajectory.stamps_ns for c in columns if c.accuracy and c.trajectory is not None])
    inside = (truth.stamps_ns >= stamps.min()) & (truth.stamps_ns <= stamps.max())
    return np.asarray(truth.positions[inside, :2])
