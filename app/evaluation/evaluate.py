"""The work of `hemislam evaluate`: plan the runs, run them, measure them, and write the report."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from app.evaluation.job import Job
from app.evaluation.measured import Evaluated, Outcome, load, measure
from app.evaluation.report import write_report
from app.evaluation.runner import RunJobs
from app.evaluation.truth import TruePoses, check_overlap
from app.evaluation.variants import Variant
from app.sensors.recording import open_recording
from app.slam.errors import HemislamError
from app.slam.params import Params
from app.slam.provenance import sha256_of
from app.slam.text_files import make_folder
from app.slam.trajectory import Trajectory

HALF_A_SCAN_NS = 50_000_000
"""Another system may stamp its poses a little differently."""


@dataclass(frozen=True, slots=True)
class Subject:
    """A recording to evaluate.

    Attributes:
        name: in tables, without `/`. params: to which variants apply their changes. truth: to measure errors against.
        compared: other systems' trajectories by name, in the recording's clock. marks: as in `Job`.
    """

    name: str
    recording: Path
    params: Params
    truth: TruePoses | None = None
    compared: tuple[tuple[str, Trajectory], ...] = ()
    marks: tuple[tuple[int, bytes], ...] = ()


def check_subject(subject: Subject, start_s: float = 0.0) -> str:
    """Check that it can be evaluated; returns the hash of its recording. start_s: start of the requested part.

    Raises:
        HemislamError: the recording cannot be used or ends before that part, or its truth is from another time.
    """
    with open_recording(subject.recording, subject.params) as recording:
        if start_s >= recording.duration_s:
            raise HemislamError(recording.nothing_usable(Counter(), start_s, None))
        if subject.truth is not None:
            check_overlap(subject.truth, recording.start_ns, recording.duration_s)
    return sha256_of(subject.recording)


def evaluate(
    subjects: Sequence[Subject],
    variants: Sequence[Variant],
    folder: Path,
    *,
    run: RunJobs,
    start_s: float = 0.0,
    duration_s: float | None = None,
) -> tuple[list[str], dict[tuple[str, str], str]]:
    """Run the unfinished jobs and write the report.

    Args:
        folder: for the report and the runs. run: runs the jobs.
        start_s, duration_s: the part of each recording to use.

    Returns:
        The findings, and why runs failed, by (recording, variant).

    Raises:
        HemislamError: a recording, truth, parameter or the folder cannot be used. This is checked before anything runs.
    """
    jobs: dict[tuple[str, str], Job] = {}
    hashes: dict[str, str] = {}
    for subject in subjects:
        hashes[subject.name] = digest = check_subject(subject, start_s)
        for variant in variants:
            jobs[subject.name, variant.name] = Job(
                recording=subject.recording,
                sha256=digest,
                name=subject.name,
                variant=variant.name,
                params=variant.applied(subject.params),
                folder=folder / "runs" / subject.name / variant.name,
                start_s=start_s,
                duration_s=duration_s,
                baseline=variant.baseline,
                marks=subject.marks,
            )
    make_folder(folder / "runs")
    failures = run(list(jobs.values()))
    evaluated = []
    for subject in subjects:
        outcomes = [
            Outcome(variant.name, variant.meaning, missing=failures[subject.name, variant.name])
            if (subject.name, variant.name) in failures
            else load(jobs[subject.name, variant.name], variant.meaning)
            for variant in variants
        ]
        part = outcomes if start_s or duration_s is not None else []
        outcomes += [_elsewhere(name, other, part) for name, other in subject.compared]
        outcomes, notes, truth_path = measure(outcomes, subject.truth)
        truth = subject.truth.description if subject.truth else ""
        sha256 = hashes[subject.name]
        evaluated.append(Evaluated(subject.name, subject.recording, sha256, tuple(outcomes), truth, notes, truth_path))
    return write_report(folder, evaluated), failures


def _elsewhere(name: str, other: Trajectory, part: list[Outcome]) -> Outcome:
    """Another system's trajectory, within the time of these outcomes: only that part is measured."""
    meaning = "a trajectory from elsewhere"
    if measured := [outcome.trajectory.stamps_ns for outcome in part if outcome.trajectory is not None]:
        stamps = np.concatenate(measured)
        begin, end = stamps.min() - HALF_A_SCAN_NS, stamps.max() + HALF_A_SCAN_NS
        other = other.chosen((begin <= other.stamps_ns) & (other.stamps_ns <= end))
    if len(other) < 3:
        return Outcome(name, meaning, missing="it has fewer than 3 poses in this part of the recording")
    return Outcome(name, meaning, trajectory=other)
