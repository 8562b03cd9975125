"""Loops against the truth, by the real program: are they right, are revisits found, and do they help?

    python -m benchmarks.loop_truth walk.mcap other.mcap
    python -m benchmarks.loop_truth walk.mcap --truth walk.tum --drifting

Every recording is run with loops, beside the frame loop as always, and without. Exits with 1 if a loop
was accepted that is false, or if a trajectory is worse with loops than without.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from app.cli.run import process
from app.mapping.opening import open_session
from app.mapping.session import Session
from app.sensors.presets import resolve_params
from app.slam import lie
from app.slam.loops.types import OPEN_M, LoopEdge, Verdict
from app.slam.metrics import ate, interpolate
from app.slam.params import Params
from app.slam.trajectory import Trajectory, read_tum, truth_beside
from app.slam.types import F64, I64
from app.slam.warmup import compile_kernels

DRIFTING = (
    "filter.max_points=100", "filter.plane_tilt=20", "map.spacing=0.6", "map.points_per_voxel=10", "map.radius=12",
    "sensor.max_range=12",
)  # fmt: skip
"""So little of each scan that odometry drifts by decimetres, as it would on a worse sensor or a longer walk."""
FALSE_M, FALSE_DEG = 0.5, 5.0
"""A loop farther than this from the truth is false: it ties another place, and is not merely inexact."""
GOOD_M, GOOD_DEG = 0.10, 0.5
"""A revisit counts as found by a loop this near to the truth."""
HELD_DEG = 1.0
"""A loop tells nothing of a rotation whose standard deviation is greater, as of roll and pitch."""
WITHIN_M, APART_S, ALONG = 2.0, 15.0, 0.7
"""A revisit: so near to where the walk was so long before, heading the same way or the opposite one (cosine)."""
WORSE_M = 0.0005
"""Half of the last digit that is printed."""


@dataclass(frozen=True)
class Walk:
    """Attributes:
    odometry: of all frames. trajectory: in the map. T_odom_imu: (k, 4, 4) of keyframes. stamps_ns: (k,) of them.
    edges: all candidates.
    """

    odometry: Trajectory
    trajectory: Trajectory
    T_odom_imu: F64
    stamps_ns: I64
    edges: tuple[LoopEdge, ...]


@dataclass(frozen=True)
class Score:
    """Attributes:
    metres: walked. end_m: by which odometry's end is off, seen from its beginning. without, beside: ATE, m,
        without loops and with them. revisits: keyframes at which there is something to find; found: those of them
        with a loop that is good. errors: (n, 2) of the accepted loops, m and deg.
    """

    metres: float
    keyframes: int
    candidates: int
    end_m: float
    without: float
    beside: float
    revisits: int
    found: int
    errors: F64

    @property
    def false(self) -> int:
        return int(((self.errors[:, 0] > FALSE_M) | (self.errors[:, 1] > FALSE_DEG)).sum())

    @property
    def good(self) -> int:
        return int(_good(self.errors).sum())

    @property
    def worse(self) -> bool:
        return self.beside > self.without + WORSE_M


def measure(recording: Path, truth_path: Path | None, params: Params) -> Score:
    """Run with and without loops, and hold both against the truth."""
    truth = truth_path or truth_beside(recording)
    if truth is None:
        sys.exit(f"{recording} has no truth beside it; name one with --truth.")
    walk = _run(recording, params)
    without = _run(recording, params.with_values({"loops.enabled": False}))
    if walk.odometry.positions.tobytes() != without.odometry.positions.tobytes():
        sys.exit(f"{recording.stem}: loops have changed the odometry.")
    return score(walk, without.trajectory, read_tum(truth))


def _run(recording: Path, params: Params) -> Walk:
    work = open_session(recording, params)
    try:
        if work.loops:
            work.loops.wait_ready()
        if (stop := process(work)) is not None:
            raise stop
        return _walk(work)
    finally:
        work.close()


def _walk(work: Session) -> Walk:
    found = work.loops.results() if work.loops else None
    odometry = work.log.odometry
    keyframes = [work.engine.keyframes[index] for index in range(len(work.engine.keyframes))]
    return Walk(
        odometry,
        found.frame.trajectory(odometry) if found else odometry,
        np.array([keyframe.T_odom_imu for keyframe in keyframes]),
        np.array([keyframe.stamp_ns for keyframe in keyframes]),
        found.edges if found else (),
    )


def score(walk: Walk, without: Trajectory, truth: Trajectory) -> Score:
    """`without`: the trajectory of a run without loops."""
    true, covered = interpolate(truth, walk.stamps_ns)
    there = np.full(len(walk.stamps_ns), -1)
    there[covered] = np.arange(len(true))
    T = np.tile(np.eye(4), (len(true), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = true.rotations.as_matrix(), true.positions
    loops = [e for e in walk.edges if e.verdict is Verdict.ACCEPTED and min(there[e.older], there[e.newer]) >= 0]
    errors = np.array([_error(e, T[there[e.older]], T[there[e.newer]]) for e in loops]).reshape(-1, 2)
    good = {there[e.newer] for e, fits in zip(loops, _good(errors), strict=True) if fits}
    revisits = _revisits(T, true.stamps_ns)
    ours = walk.T_odom_imu[covered]
    end = lie.inverse(lie.inverse(T[0]) @ T[-1]) @ lie.inverse(ours[0]) @ ours[-1]
    off = ate(without, truth)
    return Score(
        metres=off.distance,
        keyframes=len(walk.stamps_ns),
        candidates=len(walk.edges),
        end_m=float(np.linalg.norm(end[:3, 3])),
        without=off.position.rmse,
        beside=ate(walk.trajectory, truth).position.rmse,
        revisits=len(revisits),
        found=len(good.intersection(revisits)),
        errors=errors,
    )


def _error(edge: LoopEdge, older: F64, newer: F64) -> tuple[float, float]:
    """m and deg between a loop and the true poses (4, 4) of its ends, in the directions that it holds."""
    wrong = lie.inverse(lie.inverse(older) @ newer) @ edge.T_older_newer
    turned = _held(edge.covariance[:3, :3], np.radians(HELD_DEG)) @ lie.log(wrong[:3, :3])
    moved = _held(edge.covariance[3:, 3:], OPEN_M) @ wrong[:3, 3]
    return float(np.linalg.norm(moved)), float(np.degrees(np.linalg.norm(turned)))


def _held(covariance: F64, most: float) -> F64:
    """(n, 3) unit directions in which a covariance (3, 3) has a standard deviation of at most so much."""
    squares, directions = np.linalg.eigh(covariance)
    return np.asarray(directions[:, squares < most**2].T)


def _good(errors: F64) -> np.ndarray:
    return (errors[:, 0] < GOOD_M) & (errors[:, 1] < GOOD_DEG)


def _revisits(T: F64, stamps_ns: I64) -> list[int]:
    """Which of the true poses (n, 4, 4) come back to an earlier one."""
    ahead = _ahead(T)
    out = []
    for k in range(len(T)):
        near = np.linalg.norm(T[:k, :3, 3] - T[k, :3, 3], axis=1) < WITHIN_M
        long_ago = stamps_ns[:k] <= stamps_ns[k] - APART_S * 1e9
        if (near & long_ago & (np.abs(ahead[:k] @ ahead[k]) > ALONG)).any():
            out.append(k)
    return out


def _ahead(T: F64) -> F64:
    """(n, 3) unit, the way the walk goes at each pose."""
    step = np.gradient(T[:, :3, 3], axis=0)
    return np.asarray(step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9))


HEADS = (
    "recording", "m", "kf", "cand.", "acc.", "false", "good", "revis.", "found", "median", "p95", "max m", "max °",
    "end m", "ATE off", "ATE on",
)  # fmt: skip
WIDTHS = (26, 6, 5, 6, 5, 6, 6, 7, 6, 7, 6, 6, 6, 6, 8, 8)


def _line(name: str, s: Score) -> str:
    e = s.errors if len(s.errors) else np.full((1, 2), np.nan)
    cells = (
        name, f"{s.metres:.0f}", s.keyframes, s.candidates, len(s.errors), s.false,
        f"{s.good / max(len(s.errors), 1):.2f}", s.revisits, f"{s.found / s.revisits:.2f}" if s.revisits else "–",
        f"{np.median(e[:, 0]):.3f}", f"{np.percentile(e[:, 0], 95):.3f}", f"{e[:, 0].max():.3f}",
        f"{e[:, 1].max():.2f}", f"{s.end_m:.2f}", f"{s.without:.4f}", f"{s.beside:.4f}" + ("!" if s.worse else ""),
    )  # fmt: skip
    return " ".join(f"{cell:>{width}}" for cell, width in zip(cells, WIDTHS, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path, metavar="RECORDING")
    parser.add_argument("--truth", type=Path, help="of the IMU, TUM; else RECORDING_truth.tum beside it")
    parser.add_argument("--preset")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--drifting", action="store_true", help="odometry from a fraction of each scan")
    options = parser.parse_args()
    compile_kernels()
    print(" ".join(f"{head:>{width}}" for head, width in zip(HEADS, WIDTHS, strict=True)), flush=True)
    bad = []
    for recording in options.recordings:
        settings = [*(DRIFTING if options.drifting else ()), *options.set]
        result = measure(recording, options.truth, resolve_params(recording, options.preset, None, settings))
        print(_line(recording.stem, result), flush=True)
        if result.false or result.worse:
            bad.append(recording.stem)
    if bad:
        sys.exit(f"False loops, or worse with loops than without: {', '.join(bad)}.")


if __name__ == "__main__":
    main()
