"""Reads the files of a finished run and measures them against the truth."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from app.evaluation.job import Job, finished
from app.evaluation.truth import TruePoses
from app.evaluation.truth_match import Matched, match
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.metrics import GroundScore, ate, compare, drift, paired, walked_m
from app.slam.report import spread
from app.slam.trajectory import Trajectory, read_tum
from app.slam.types import F64, I64, TIMINGS, U16

START_S = 5.0
"""Duration of the start: rest and first steps. A slip there moves all later poses against the few of the start."""
PIECES_M = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 400.0, 800.0)
"""Path lengths over which drift is measured; KITTI's begin at 100 m, since cars go farther."""
BUDGETS_MS = (50.0, 100.0)
"""Time available for a frame at 20 Hz and at 10 Hz."""


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Errors against truth.

    Attributes:
        errors: the results of `compare`, ratios of the RMSE to the length of the true path, and `ate_after_start_m`:
            the RMSE of the positions after START_S, aligned without earlier ones; None if there are too few.
        times_s, errors_m: (n,) position error of each pose after the alignment. walked_m: (n,) true path length up to
            each pose.
        aligned: (n, 3) the estimate in the truth's world.
        drift: by length of path pieces, m: the error of each piece in percent of this length.
    """

    errors: dict[str, Any]
    times_s: F64
    errors_m: F64
    walked_m: F64
    aligned: F64
    drift: dict[float, F64] = field(default_factory=dict)


@dataclass(frozen=True)
class Outcome:
    """One variant, or another system's trajectory, on one recording.

    Attributes:
        name: of the variant. missing: why there are no results, in words; "" if there are results.
        run: run.json; None for a trajectory from elsewhere. timings_ms: (n, stages and total).
        accuracy: None without truth. unmeasured: why there is no accuracy although there is a truth.
    """

    name: str
    meaning: str = ""
    missing: str = ""
    trajectory: Trajectory | None = None
    run: dict[str, Any] | None = None
    timings_ms: F64 | None = None
    cpu_ms: F64 | None = None
    accuracy: Accuracy | None = None
    unmeasured: str = ""
    crops: dict[str, U16] = field(default_factory=dict)

    @cached_property
    def results(self) -> dict[str, Any]:
        """The outcome's entry in results.json. Tables and findings read it by `value`."""
        run, scores = self.run or {}, self.ground or []
        return {
            "variant": self.name,
            "meaning": self.meaning,
            "missing": self.missing or None,
            "accuracy": self.accuracy.errors if self.accuracy else None,
            "unmeasured": self.unmeasured or None,
            "runtime_ms": self._runtime(),
            "map_sharpness": run.get("map_sharpness"),
            "ground": [asdict(s) | {"precision": s.precision, "recall": s.recall, "f1": s.f1} for s in scores] or None,
            **{name: run.get(name) for name in ("frames", "lost", "dropped", "distance_m", "ground_share")},
            **{
                name: run.get(name)
                for name in ("key", "hemislam", "code", "machine", "start_s", "duration_s", "parameters")
            },
        }

    def value(self, path: str) -> Any:
        """An entry of `results`, such as `accuracy/ate_m/rmse`; None if any part of the path is missing."""
        tree: Any = self.results
        for name in path.split("/"):
            tree = tree.get(name) if tree else None
        return tree

    def _runtime(self) -> dict[str, Any] | None:
        """Milliseconds per frame by stage, and shares of frames within BUDGETS_MS."""
        if self.timings_ms is None or self.cpu_ms is None or self.run is None or not len(self.timings_ms):
            return None
        named = list(zip(TIMINGS, self.timings_ms.T, strict=True))
        return {
            **{stage: spread(times) for stage, times in (named if self.staged else named[-1:])},
            "cpu": spread(self.cpu_ms),
            **{f"under_{budget:g}_ms": float(np.mean(self.timings_ms[:, -1] < budget)) for budget in BUDGETS_MS},
            **{name: self.run[name] for name in ("peak_memory_mb", "load")},
        }

    @property
    def staged(self) -> bool:
        """Whether the stages of a frame were timed, as for this engine but not for a baseline."""
        return self.run is not None and not self.run.get("baseline")

    @property
    def ground(self) -> list[GroundScore] | None:
        """Scores by range; None if points carry no labels or the variant segments no ground."""
        scores = (self.run or {}).get("ground")
        if self.run is None or scores is None or not self.run["parameters"]["ground"]["enabled"]:
            return None
        return [GroundScore(**score) for score in scores]


@dataclass(frozen=True, slots=True)
class Evaluated:
    """One recording with the outcomes of all its runs.

    Attributes:
        truth: its description; "" without one. notes: what was assumed about it.
        truth_path: (n, 3) m, true positions of the compared poses.
    """

    name: str
    recording: Path
    sha256: str
    outcomes: tuple[Outcome, ...]
    truth: str = ""
    notes: tuple[str, ...] = ()
    truth_path: F64 | None = None

    def values(self, names: Sequence[str], path: str) -> list[Any]:
        """`Outcome.value` of the outcomes with these names; None where there is none."""
        outcomes = {outcome.name: outcome for outcome in self.outcomes}
        return [outcomes[name].value(path) if name in outcomes else None for name in names]


def load(job: Job, meaning: str) -> Outcome:
    """Read the files of a finished job."""
    run = finished(job)
    assert run is not None
    columns = range(2, len(TIMINGS) + 3)
    table = np.loadtxt(job.folder / "timings.csv", delimiter=",", skiprows=1, usecols=columns, ndmin=2)
    with np.load(job.folder / "crops.npz") as stored:
        crops = {name: stored[name] for name in stored.files}
    return Outcome(
        name=job.variant,
        meaning=meaning,
        trajectory=_trajectory(job.folder / "trajectory.tum"),
        run=run,
        timings_ms=table[:, :-1],
        cpu_ms=table[:, -1],
        crops=crops,
    )


def _trajectory(path: Path) -> Trajectory | None:
    """None if there are too few poses to compare anything."""
    try:
        return read_tum(path)
    except HemislamError:
        return None


def measure(outcomes: list[Outcome], truth: TruePoses | None) -> tuple[list[Outcome], tuple[str, ...], F64 | None]:
    """The outcomes with their errors, notes on the truth, and (n, 3) m, the true path over the compared time.

    Notes and path are those of the first outcome that matches. If none does, the note says why, and there is no path.
    """
    first: Matched | None = None
    problems, measured, stamps = list[str](), list[Outcome](), list[I64]()
    for outcome in outcomes:
        if truth is not None and (estimate := outcome.trajectory) is not None:
            try:
                matched = match(truth, estimate, first.offset_s if first else None)
                outcome = replace(outcome, accuracy=_accuracy(estimate, matched))
                first = first or matched
                stamps.append(estimate.stamps_ns)
            except HemislamError as error:
                problems.append(str(error))
                outcome = replace(outcome, unmeasured=str(error))
        measured.append(outcome)
    if first is None:
        return measured, tuple(problems[:1]), None
    path, compared = first.trajectory, np.concatenate(stamps)
    return (
        measured,
        first.notes,
        path.positions[(path.stamps_ns >= compared.min()) & (path.stamps_ns <= compared.max())],
    )


def _accuracy(estimate: Trajectory, matched: Matched) -> Accuracy:
    truth = matched.trajectory
    errors = compare(estimate, truth, rotations=matched.has_rotation)
    ours, theirs = paired(estimate, truth)
    T = ate(estimate, truth).T_truth_estimate
    aligned = lie.moved(T, ours.positions)
    return Accuracy(
        errors=errors | ratios(errors) | {"ate_after_start_m": _later(estimate, truth)},
        times_s=(ours.stamps_ns - estimate.stamps_ns[0]) * 1e-9,
        errors_m=np.linalg.norm(aligned - theirs.positions, axis=1),
        walked_m=walked_m(theirs.positions),
        aligned=aligned,
        drift={metres: found for metres in PIECES_M if len(found := drift(estimate, truth, metres))},
    )


def ratios(errors: dict[str, Any]) -> dict[str, Any]:
    """RMSE of all errors that `compare` found, divided by the length of the true path."""

    def ratio(error: dict[str, float] | None) -> float | None:
        return error["rmse"] / errors["distance_m"] if error else None

    return {
        "ate_ratio": ratio(errors["ate_m"]),
        "ate_ratio_deg_per_m": ratio(errors["ate_deg"]),
        "rpe_ratio": {over: error and ratio(error["m"]) for over, error in errors["rpe"].items()},
        "rpe_ratio_deg_per_m": {over: error and ratio(error["deg"]) for over, error in errors["rpe"].items()},
    }


def _later(estimate: Trajectory, truth: Trajectory) -> float | None:
    later = estimate.stamps_ns - estimate.stamps_ns[0] > START_S * 1e9
    try:
        return ate(estimate.chosen(later), truth).position.rmse
    except HemislamError:
        return None
