"""The report of a run: report.json, and a summary of a few lines."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from app import __version__
from app.slam.doubts import doubts
from app.slam.errors import HemislamError
from app.slam.map_frame import NO_PAUSES
from app.slam.metrics import compare
from app.slam.provenance import describe_machine, peak_memory_mb
from app.slam.run_log import RunInfo, RunLog
from app.slam.trajectory import Trajectory
from app.slam.types import F64, I64, TIMINGS, FrameStatus

MOST_NOTED = 5
"""Kinds of notices that the summary lists; report.json has all notices."""


def make_report(
    log: RunLog, trajectory: Trajectory, info: RunInfo, sha256: str | None, tied_ns: I64 = NO_PAUSES
) -> dict[str, Any]:
    """The content of report.json for a trajectory; numbers that do not exist are NaN or None.

    Args:
        sha256: of the recording, as `hash_input`. tied_ns: as in `doubts`.
    """
    score = log.ground_score
    return {
        "hemislam": __version__,
        "stopped_early": info.stopped or None,
        "doubts": list(doubts(log, tied_ns)),
        "calibration": info.calibration or None,
        "recording": {
            "path": str(info.recording),
            "sha256": sha256,
            "start_s": info.start_s,
            "duration_s": info.duration_s,
        },
        "frames": {
            "processed": len(log),
            **{status.value: log.statuses[status] for status in FrameStatus},
            "dropped": log.dropped.total(),
            "dropped_reasons": dict(log.dropped.most_common()),
        },
        "imu_gaps_s": log.imu_gaps_s(info.params.imu.max_gap),
        "distance_m": trajectory.distance,
        "ground": {
            "share": log.ground_share,
            "precision": score.precision if score else None,
            "recall": score.recall if score else None,
            "f1": score.f1 if score else None,
        },
        "accuracy": accuracy(trajectory, info),
        "timings_ms": {
            stage: spread(times) for stage, times in zip(TIMINGS, log.timings_ms.T, strict=True) if len(times)
        },
        "peak_memory_mb": peak_memory_mb(),
        "notices": dict(log.notices.most_common()),
        "machine": describe_machine(),
        "parameters": info.params.model_dump(mode="json"),
    }


def accuracy(trajectory: Trajectory, info: RunInfo) -> dict[str, Any] | None:
    """Errors against the truth, or the reason why they cannot be measured; None without a truth."""
    if info.truth is None:
        return None
    truth = {"truth": str(info.truth_path) if info.truth_path else None}
    try:
        return truth | compare(trajectory, info.truth)
    except HemislamError as error:
        return truth | {"error": str(error)}


def spread(values: F64) -> dict[str, float]:
    """Mean, median, 95th percentile and maximum of (n,) numbers."""
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "p95": float(np.percentile(values, 95)),
        "max": float(values.max()),
    }


def finite(value: Any) -> Any:
    """The same tree with NaN and infinity as None, which JSON can hold."""
    if isinstance(value, dict):
        return {name: finite(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def summarise(report: dict[str, Any], folder: Path) -> str:
    """The report in a few lines; reasons to doubt the result come first and last."""
    warning = [("WARNING", f"the result is doubtful: {' '.join(report['doubts'])}")] if report["doubts"] else []
    frames, ground, loops, accuracy = (report[name] for name in ("frames", "ground", "loops", "accuracy"))
    total, points = report["timings_ms"]["total"], report["map"]
    counts = f"{frames['processed']} processed, {frames['dropped']} dropped, {frames['lost']} lost"
    share = 100 * (ground["share"] or 0)
    moving = f", {points['moving']:,} moving" if points["moving"] else ""
    lines = [
        ("frames", f"{counts}; {report['distance_m']:.1f} m walked"),
        (
            "frame time",
            f"{total['median']:.1f} ms (median), {total['p95']:.1f} ms (95 %), {total['max']:.1f} ms (max)",
        ),
        ("map", f"{points['points']:,} points in {points['keyframes']} keyframes; {share:.0f} % ground{moving}"),
    ]
    if loops:
        lines.append(
            ("loops", f"{loops['accepted']} accepted, {loops['candidate']} candidates, {loops['rejected']} rejected")
        )
    lines += [("dropped", f"{count} x {reason}") for reason, count in frames["dropped_reasons"].items()]
    if gaps := report["imu_gaps_s"]:
        lines.append(("IMU", f"missing for {sum(gaps):.1f} s, at most {max(gaps):.1f} s at a time"))
    if ground["f1"] is not None:
        scores = f"precision {ground['precision'] or 0:.3f}, recall {ground['recall'] or 0:.3f}, F1 {ground['f1']:.3f}"
        lines.append(("ground", f"{scores} against the recording's labels"))
    if accuracy and "error" in accuracy:
        lines.append(("error", f"not measured: {accuracy['error']}"))
    elif accuracy:
        metres, degrees = accuracy["ate_m"], accuracy["ate_deg"]
        turned = f", {degrees['rmse']:.3f}°" if degrees else ""
        ate = f"ATE {metres['rmse']:.4f} m (max {metres['max']:.4f}){turned} over {accuracy['poses']} poses"
        lines.append(("error", ate))
        if accuracy["ate_deg_withheld"]:
            lines.append(("", f"no rotation error: {accuracy['ate_deg_withheld']}"))
        if (before := report.get("accuracy_odometry")) and "ate_m" in before:
            lines.append(("", f"without loops ATE {before['ate_m']['rmse']:.4f} m"))
    if report["calibration"]:
        lines.append(("calibrated", report["calibration"]))
    lines += [("noted", text) for text in _noted(report["notices"])[:MOST_NOTED]]
    lines += [("memory", f"{report['peak_memory_mb']:.0f} MB at most"), ("saved in", str(folder))]
    return "\n".join(f"{name:<10} {text}" for name, text in (*warning, *lines, *warning))


def _noted(notices: dict[str, int]) -> list[str]:
    """Notices with their counts, the most frequent first. Of those that differ only in numbers, the first is shown."""
    alike: dict[str, list[str]] = {}
    for notice in notices:
        alike.setdefault(re.sub(r"\d+", "", notice), []).append(notice)
    counted = [(sum(notices[one] for one in same), same) for same in alike.values()]
    counted.sort(key=lambda entry: -entry[0])
    return [f"{count} x {same[0]}{' and similar' if len(same) > 1 else ''}" for count, same in counted]
