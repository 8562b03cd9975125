"""What a finished run is worth: its files read back and measured against the truth."""

import csv
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from app.evaluation.job import Job, finished
from app.evaluation.truth import Matched, Truth, match
from app.slam.errors import HemislamError
from app.slam.metrics import GroundScore, ate, compare, paired
from app.slam.report import spread
from app.slam.trajectory import Trajectory, read_tum
from app.slam.types import F64, TIMINGS, U16

START_S = 5.0
"""The start: standing and walking off. A slip there moves all later poses against the few of the start."""
BUDGETS_MS = (50.0, 100.0)
"""A frame at 20 Hz and at 10 Hz."""


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Errors against truth; those of rotation are None where the truth has no orientations or they mean nothing.

    Attributes:
        ate_m, ate_deg, rpe[over]["m" | "deg"]: {"rmse", "mean", "max"}. distance_m: true length.
        times_s, errors_m: (n,) the position error of each pose after the alignment.
        aligned: (n, 3) the estimate in the truth's world. poses: compared.
        later_m: RMSE of the positions after START_S, aligned without those before; None if there are too few.
        doubt: why the ATE of rotation is withheld, in a sentence; "" if it is not.
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
        """All of them by ("ATE" | "RPE over ...", "m" | "deg"), each {"rmse", "mean", "max"}."""
        found: dict[tuple[str, str], dict[str, float] | None] = {("ATE", "m"): self.ate_m, ("ATE", "deg"): self.ate_deg}
        for over, error in self.rpe.items():
            found |= {(f"RPE over {over}", unit): error[unit] if error else None for unit in ("m", "deg")}
        return found


@dataclass(frozen=True, slots=True)
class Column:
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
        """Milliseconds a frame by stage, and shares of frames within BUDGETS_MS."""
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
        """By range; None where points carry no label or this variant segments no ground."""
        if self.run is None or self.run["ground"] is None or not self.run["parameters"]["ground"]["enabled"]:
            return None
        return [GroundScore(**score) for score in self.run["ground"]]


@dataclass(frozen=True, slots=True)
class Evaluated:
    """One recording with all that was run on it.

    Attributes:
        truth: what it is, in words; "" without. notes: what was assumed of it. truth_path: (n, 2),
            from above, where the truth was measured.
    """

    name: str
    recording: Path
    sha256: str
    columns: tuple[Column, ...]
    truth: str = ""
    notes: tuple[str, ...] = ()
    truth_path: F64 | None = None


def load(job: Job, meaning: str) -> Column:
    """The files of a finished job."""
    run = finished(job)
    assert run is not None
    with (job.folder / "timings.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))[1:]
    table = np.array([row[2:] for row in rows], dtype=np.float64).reshape(-1, len(TIMINGS) + 1)
    with np.load(job.folder / "crops.npz") as stored:
        crops = {name: stored[name] for name in stored.files}
    return Column(
        name=job.variant,
        meaning=meaning,
        trajectory=_trajectory(job.folder / "trajectory.tum"),
        run=run,
        timings_ms=table[:, :-1],
        cpu_ms=table[:, -1],
        crops=crops,
    )


def _trajectory(path: Path) -> Trajectory | None:
    """None where there are too few poses to compare anything."""
    try:
        return read_tum(path)
    except HemislamError:
        return None


def measure(columns: list[Column], truth: Truth | None) -> tuple[list[Column], Matched | None, str]:
    """The columns with their errors; the truth as matched to the first; why it could not be, in words."""
    if truth is None:
        return columns, None, ""
    first: Matched | None = None
    problem = ""
    measured = []
    for column in columns:
        if column.trajectory is None:
            measured.append(column)
            continue
        try:
            matched = match(truth, column.trajectory, first.offset_s if first else None)
            accuracy = _accuracy(column.trajectory, matched)
            first = first or matched
            measured.append(replace(column, accuracy=accuracy))
        except HemislamError as error:
            problem = problem or str(error)
            measured.append(replace(column, unmeasured=str(error)))
    return measured, first, problem if first is None else ""


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


def as_json(column: Column) -> dict[str, Any]:
    """What results.json holds of a column."""
    accuracy = column.accuracy
    run = column.run or {}
    scores = column.ground
    return {
        "variant": column.name,
        "meaning": column.meaning,
        "missing": column.missing or None,
        "accuracy": None
        if accuracy is None
        else {
            "ate_m": accuracy.ate_m,
            "ate_deg": accuracy.ate_deg,
            "ate_deg_withheld": accuracy.doubt or None,
            "ate_after_start_m": accuracy.later_m,
            "ate_ratio": accuracy.ate_m["rmse"] / accuracy.distance_m,
            "rpe": accuracy.rpe,
            "ate_ratio_deg_per_m": accuracy.ate_deg["rmse"] / accuracy.distance_m if accuracy.ate_deg else None,
            "rpe_ratio": {
                over: error["m"]["rmse"] / accuracy.distance_m if error else None
                for over, error in accuracy.rpe.items()
            },
            "rpe_ratio_deg_per_m": {
                over: error["deg"]["rmse"] / accuracy.distance_m if error and error["deg"] else None
                for over, error in accuracy.rpe.items()
            },
            "poses": accuracy.poses,
            "distance_m": accuracy.distance_m,
        },
        "unmeasured": column.unmeasured or None,
        "runtime_ms": column.runtime,
        "fineness": run.get("fineness"),
        "ground": [
            {**asdict(score), "precision": score.precision, "recall": score.recall, "f1": score.f1} for score in scores
        ]
        if scores
        else None,
        **{name: run.get(name) for name in ("frames", "lost", "dropped", "distance_m", "ground_share", "parameters")},
    }
