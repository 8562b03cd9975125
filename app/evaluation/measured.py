"""What a finished run achieved: its files read back and measured against the truth."""

import csv
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from app.evaluation.job import Job, finished
from app.evaluation.truth import TruePoses
from app.evaluation.truth_match import Matched, match
from app.slam.errors import HemislamError
from app.slam.metrics import GroundScore, ate, compare, paired
from app.slam.report import spread
from app.slam.trajectory import Trajectory, read_tum
from app.slam.types import F64, TIMINGS, U16

START_S = 5.0
"""The start: rest and the first steps. A slip there moves all later poses against the few of the start."""
BUDGETS_MS = (50.0, 100.0)
"""Time for a frame at 20 Hz and at 10 Hz."""


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Errors against truth. Errors of rotation are None if the truth has no orientations or does not fix them.

    Attributes:
        ate_m, ate_deg, rpe[over]["m" | "deg"]: {"rmse", "mean", "max"}. distance_m: true length.
        times_s, errors_m: (n,) position error of each pose after the alignment.
        aligned: (n, 3) the estimate in the truth's world. poses: compared.
        later_m: RMSE of the positions after START_S, aligned without those before; None if there are too few.
        doubt: why the rotation error is withheld, in a sentence; "" if it is not.
    """

    ate_m: dict[str, float]
    ate_deg: dict[str, float] | None
    rpe: dict[str, dict[str, Any] | None]
    poses: int
    distance_m: float
    times_s: F64
    errors_m: F64
    aligned: F64
    later_m: float | None
    doubt: str = ""

    def errors(self) -> dict[tuple[str, str], dict[str, float] | None]:
        """All errors by ("ATE" | "RPE over ...", "m" | "deg"), each {"rmse", "mean", "max"}."""
        found: dict[tuple[str, str], dict[str, float] | None] = {("ATE", "m"): self.ate_m, ("ATE", "deg"): self.ate_deg}
        for over, error in self.rpe.items():
            found |= {(f"RPE over {over}", unit): error[unit] if error else None for unit in ("m", "deg")}
        return found


@dataclass(frozen=True, slots=True)
class Outcome:
    """One variant, or another system's trajectory, on one recording.

    Attributes:
        name: of the variant. missing: why there are no results, in words; "" if there are.
        run: run.json; None for a trajectory from elsewhere. timings_ms: (n, stages and total).
        accuracy: None without truth. unmeasured: why there is none although there is a truth.
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

    @property
    def runtime(self) -> dict[str, Any] | None:
        """Milliseconds per frame by stage, and shares of frames within BUDGETS_MS."""
        if self.timings_ms is None or self.cpu_ms is None or self.run is None or not len(self.timings_ms):
            return None
        total = self.timings_ms[:, -1]
        return {
            **{stage: spread(self.timings_ms[:, index]) for index, stage in enumerate(TIMINGS)},
            "cpu": spread(self.cpu_ms),
            **{f"under_{budget:g}_ms": float(np.mean(total < budget)) for budget in BUDGETS_MS},
            "peak_memory_mb": self.run["peak_memory_mb"],
            "threads": self.run["threads"],
            "load": self.run["load"],
        }

    @property
    def ground(self) -> list[GroundScore] | None:
        """Scores by range; None if points carry no labels or the variant segments no ground."""
        if self.run is None or self.run["ground"] is None or not self.run["parameters"]["ground"]["enabled"]:
            return None
        return [GroundScore(**score) for score in self.run["ground"]]


@dataclass(frozen=True, slots=True)
class Evaluated:
    """One recording with all that was run on it.

    Attributes:
        truth: what it is, in words; "" without one. notes: what was assumed about it.
        truth_path: (n, 2) m from above, of the poses that were compared.
    """

    name: str
    recording: Path
    sha256: str
    outcomes: tuple[Outcome, ...]
    truth: str = ""
    notes: tuple[str, ...] = ()
    truth_path: F64 | None = None


def load(job: Job, meaning: str) -> Outcome:
    """The files of a finished job."""
    run = finished(job)
    assert run is not None
    with (job.folder / "timings.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))[1:]
    table = np.array([row[2:] for row in rows], dtype=np.float64).reshape(-1, len(TIMINGS) + 1)
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


def measure(outcomes: list[Outcome], truth: TruePoses | None) -> tuple[list[Outcome], Matched | None, str]:
    """The outcomes with their errors; the truth as matched to the first of them; why none could be matched."""
    if truth is None:
        return outcomes, None, ""
    first: Matched | None = None
    problem, measured = "", []
    for outcome in outcomes:
        if outcome.trajectory is not None:
            try:
                matched = match(truth, outcome.trajectory, first.offset_s if first else None)
                outcome = replace(outcome, accuracy=_accuracy(outcome.trajectory, matched))
                first = first or matched
            except HemislamError as error:
                problem = problem or str(error)
                outcome = replace(outcome, unmeasured=str(error))
        measured.append(outcome)
    return measured, first, "" if first else problem


def _accuracy(estimate: Trajectory, matched: Matched) -> Accuracy:
    truth = matched.trajectory
    errors = compare(estimate, truth, rotations=matched.has_rotation)
    doubt = errors.pop("ate_deg_withheld")
    ours, theirs = paired(estimate, truth)
    T = ate(estimate, truth).T_truth_estimate
    aligned = ours.positions @ T[:3, :3].T + T[:3, 3]
    return Accuracy(
        **errors,
        times_s=(ours.stamps_ns - estimate.stamps_ns[0]) * 1e-9,
        errors_m=np.linalg.norm(aligned - theirs.positions, axis=1),
        aligned=aligned,
        later_m=_later(estimate, truth),
        doubt=doubt or "",
    )


def _later(estimate: Trajectory, truth: Trajectory) -> float | None:
    later = estimate.stamps_ns - estimate.stamps_ns[0] > START_S * 1e9
    try:
        return ate(estimate.chosen(later), truth).position.rmse
    except HemislamError:
        return None


def as_json(outcome: Outcome) -> dict[str, Any]:
    """What results.json holds of an outcome."""
    run, scores = outcome.run or {}, outcome.ground
    return {
        "variant": outcome.name,
        "meaning": outcome.meaning,
        "missing": outcome.missing or None,
        "accuracy": _accuracy_json(outcome.accuracy) if outcome.accuracy else None,
        "unmeasured": outcome.unmeasured or None,
        "runtime_ms": outcome.runtime,
        "map_sharpness": run.get("map_sharpness"),
        "ground": [
            {**asdict(score), "precision": score.precision, "recall": score.recall, "f1": score.f1} for score in scores
        ]
        if scores
        else None,
        **{name: run.get(name) for name in ("frames", "lost", "dropped", "distance_m", "ground_share", "parameters")},
    }


def _accuracy_json(accuracy: Accuracy) -> dict[str, Any]:
    """Errors, and their RMSE as ratios to the length of the true path."""

    def ratio(error: dict[str, float] | None) -> float | None:
        return error["rmse"] / accuracy.distance_m if error else None

    return {
        "ate_m": accuracy.ate_m,
        "ate_deg": accuracy.ate_deg,
        "ate_deg_withheld": accuracy.doubt or None,
        "ate_after_start_m": accuracy.later_m,
        "ate_ratio": ratio(accuracy.ate_m),
        "rpe": accuracy.rpe,
        "ate_ratio_deg_per_m": ratio(accuracy.ate_deg),
        "rpe_ratio": {over: error and ratio(error["m"]) for over, error in accuracy.rpe.items()},
        "rpe_ratio_deg_per_m": {over: error and ratio(error["deg"]) for over, error in accuracy.rpe.items()},
        "poses": accuracy.poses,
        "distance_m": accuracy.distance_m,
    }
