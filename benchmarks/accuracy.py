"""Compare odometry and loops of the real program with the truth: errors, consistency of covariances, benefit of loops.

    python -m benchmarks.accuracy walks/*.mcap
    python -m benchmarks.accuracy walk.mcap --truth walk.tum --drifting

`hemislam simulate --suite revisits --imperfect --every-block 6 --out walks` makes such walks; `--suite paper` makes
others. The exit code is 1 if a false loop was accepted, or if a trajectory is worse with loops than without by more
than WORSE_M.

The NEES (normalised estimation error squared) of a keyframe is its squared error, normalised by the filter's
covariance. Its mean per degree of freedom is 1 if the covariance is right, and larger if the filter is overconfident.
Errors count from the first keyframe, whose pose defines the odometry frame.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from app.cli.run import process
from app.mapping.opening import open_session
from app.mapping.session import Session
from app.sensors.presets import resolve_params
from app.slam import lie
from app.slam.loops.types import LoopEdge, Verdict
from app.slam.metrics import ate, interpolate, paired
from app.slam.params import Params
from app.slam.trajectory import Trajectory, read_tum, truth_beside
from app.slam.types import F64, I64
from app.slam.warmup import compile_kernels

DRIFTING = (
    "filter.max_points=100", "filter.plane_tilt=20", "map.spacing=0.6", "map.points_per_voxel=10", "map.radius=12",
    "sensor.max_range=12",
)  # fmt: skip
"""Uses so little of each scan that odometry drifts by decimetres, as with a worse sensor or on a longer walk."""
SLIP_S, SLIP_DEG, SLIP_M = 5.0, 0.5, 0.2
"""A slip: an error that grows by this much within this many seconds, and stays."""
KEPT = 10
"""Errors are averaged over this many frames to detect slips: a wrong mounting or clock makes them swing every step."""
FALSE_M, FALSE_DEG = 0.5, 5.0
"""A loop farther than this from the truth is false: it ties a different place and is not merely inaccurate."""
GOOD_M, GOOD_DEG = 0.10, 0.5
"""A loop this close to the truth counts as having found a revisit."""
CLAIMED_M, CLAIMED_DEG = 0.2, 1.0
"""A loop claims a direction or axis if its standard deviation there is at most this. Along a bare corridor, its own
covariance admits errors of decimetres; roll and pitch are left to gravity."""
WITHIN_M, APART_S, ALONG = 2.0, 15.0, 0.7
"""A revisit: this near to an earlier position, this long after it, in the same or the opposite direction (cosine)."""
WORSE_M = 0.002


@dataclass(frozen=True)
class Walk:
    """Attributes:
    odometry: of all frames. trajectory: in the map. T_odom_imu, T_imu_lidar: (k, 4, 4) of keyframes. covariances:
        (k, 6, 6), rotation first. stamps_ns: (k,). edges: all candidates.
    """

    odometry: Trajectory
    trajectory: Trajectory
    T_odom_imu: F64
    T_imu_lidar: F64
    covariances: F64
    stamps_ns: I64
    edges: tuple[LoopEdge, ...]


@dataclass(frozen=True)
class Score:
    """Attributes:
    metres: walked. without, beside: ATE, m, without and with loops.
    gained_m, gained_deg: the largest growth of the error within SLIP_S.
    yaw, position: mean NEES per degree of freedom.
    revisits: number of keyframes with a revisit. found: number of these with a good loop.
    errors: (n, 2) of the accepted loops, m and deg. candidates: number of all loops.
    """

    metres: float
    without: float
    beside: float
    gained_m: float
    gained_deg: float
    yaw: float
    position: float
    candidates: int
    revisits: int
    found: int
    errors: F64

    @property
    def slipped(self) -> bool:
        return self.gained_m > SLIP_M or self.gained_deg > SLIP_DEG

    @property
    def false(self) -> int:
        return int(((self.errors[:, 0] > FALSE_M) | (self.errors[:, 1] > FALSE_DEG)).sum())

    @property
    def good(self) -> float:
        return float(_good(self.errors).mean()) if len(self.errors) else np.nan

    @property
    def worse(self) -> bool:
        return self.beside > self.without + WORSE_M


def measure(recording: Path, truth_path: Path | None, params: Params) -> Score:
    """Run with loops, and compare odometry and loops with the truth. Loops do not change the odometry."""
    truth = truth_path or truth_beside(recording)
    if truth is None:
        sys.exit(f"{recording} has no truth beside it; name one with --truth.")
    work = open_session(recording, params)
    try:
        if (stop := process(work)) is not None:
            raise stop
        walk = _walk(work)
    finally:
        work.close()
    return score(walk, read_tum(truth))


def _walk(work: Session) -> Walk:
    found = work.loops.results() if work.loops else None
    odometry = work.log.odometry
    keyframes = [work.engine.keyframes[index] for index in range(len(work.engine.keyframes))]
    return Walk(
        odometry,
        found.frame.trajectory(odometry) if found else odometry,
        np.array([keyframe.T_odom_imu for keyframe in keyframes]),
        np.array([keyframe.T_imu_lidar for keyframe in keyframes]),
        np.array([keyframe.covariance + keyframe.drift for keyframe in keyframes]),
        np.array([keyframe.stamp_ns for keyframe in keyframes]),
        found.edges if found else (),
    )


def score(walk: Walk, truth: Trajectory) -> Score:
    off = ate(walk.odometry, truth)
    R_truth_odom = off.T_truth_estimate[:3, :3]
    gained_m, gained_deg = _gains(*_errors(_by_the_last_mounting(walk), truth, walk.stamps_ns[0], R_truth_odom))
    stamps_ns, turned, moved = _errors(walk.odometry, truth, walk.stamps_ns[0], R_truth_odom)
    _, at, of = np.intersect1d(stamps_ns, walk.stamps_ns, return_indices=True)
    yaw, position = _nees(turned[at], moved[at], walk.T_odom_imu[of], walk.covariances[of])

    true, covered = interpolate(truth, walk.stamps_ns)
    there = np.full(len(walk.stamps_ns), -1)
    there[covered] = np.arange(len(true))
    T = np.tile(np.eye(4), (len(true), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = true.rotations.as_matrix(), true.positions
    loops = [e for e in walk.edges if e.verdict is Verdict.ACCEPTED and min(there[e.older], there[e.newer]) >= 0]
    lasting = [_by_the_last_mounting_between(walk, edge) for edge in loops]
    errors = np.array([_loop_error(e, T[there[e.older]], T[there[e.newer]]) for e in lasting]).reshape(-1, 2)
    good = {there[e.newer] for e, fits in zip(loops, _good(errors), strict=True) if fits}
    revisits = _revisits(T, true.stamps_ns)
    return Score(
        metres=off.distance,
        without=off.position.rmse,
        beside=ate(walk.trajectory, truth).position.rmse,
        gained_m=gained_m,
        gained_deg=gained_deg,
        yaw=yaw,
        position=position,
        candidates=len(walk.edges),
        revisits=len(revisits),
        found=len(good.intersection(revisits)),
        errors=errors,
    )


def _by_the_last_mounting(walk: Walk) -> Trajectory:
    """Odometry of the IMU, with the final estimate of the mounting.

    While the mounting is estimated, the IMU's pose rotates with it, but no point of the map moves.
    """
    last = np.searchsorted(walk.stamps_ns, walk.odometry.stamps_ns, side="right") - 1
    T_imu_lidar = walk.T_imu_lidar[np.maximum(last, 0)]
    T = walk.odometry.poses @ T_imu_lidar @ lie.inverse(walk.T_imu_lidar[-1])
    return Trajectory.from_poses(walk.odometry.stamps_ns, T)


def _by_the_last_mounting_between(walk: Walk, edge: LoopEdge) -> LoopEdge:
    """The loop between IMU poses with the final mounting. Scans measure the LiDAR's motion, whatever the mounting."""
    T_lidars = lie.inverse(walk.T_imu_lidar[edge.older]) @ edge.T_older_newer @ walk.T_imu_lidar[edge.newer]
    return replace(edge, T_older_newer=walk.T_imu_lidar[-1] @ T_lidars @ lie.inverse(walk.T_imu_lidar[-1]))


def _errors(odometry: Trajectory, truth: Trajectory, first_ns: int, R_truth_odom: F64) -> tuple[I64, F64, F64]:
    """Stamps (n,) and errors in yaw (n,) rad and position (n, 3) m since the first keyframe.

    The truth is rotated into odom by aligning all positions. Aligning only the first pose would not suffice: an error
    of the mounting rotates the whole walk about it.
    """
    ours, theirs = paired(odometry, truth)
    true = R_truth_odom.T @ theirs.poses[:, :3]
    begin = int(np.argmax(ours.stamps_ns >= first_ns))
    turn = ours.poses[:, :3, :3] @ np.swapaxes(true[:, :, :3], 1, 2)
    moved = ours.poses[:, :3, 3] - true[:, :, 3]
    return ours.stamps_ns, lie.log(turn @ turn[begin].T)[:, 2], moved - moved[begin]


def _nees(turned: F64, moved: F64, poses: F64, covariances: F64) -> tuple[float, float]:
    """Mean NEES of yaw and of position per degree of freedom, without the first keyframe."""
    up = poses[:, 2, :3]
    yaw = turned**2 / np.einsum("ni,nij,nj->n", up, covariances[:, :3, :3], up)
    position = np.einsum("ni,nij,nj->n", moved, np.linalg.inv(covariances[:, 3:, 3:]), moved) / 3
    return float(yaw[1:].mean()), float(position[1:].mean())


def _gains(stamps_ns: I64, turned: F64, moved: F64) -> tuple[float, float]:
    """The largest growth of the error within SLIP_S, in m and deg. A change towards the truth is a correction."""
    mean = np.full(KEPT, 1 / KEPT)
    errors = [np.stack([np.convolve(axis, mean, "valid") for axis in e.T], axis=1) for e in (moved, turned[:, None])]
    stamps_ns = stamps_ns[KEPT - 1 :]
    earlier = np.searchsorted(stamps_ns, stamps_ns - round(SLIP_S * 1e9))
    gained_m, gained = (
        float(np.where(off > off[earlier], np.linalg.norm(e - e[earlier], axis=1), 0.0).max())
        for e, off in ((e, np.linalg.norm(e, axis=1)) for e in errors)
    )
    return gained_m, float(np.degrees(gained))


def _loop_error(edge: LoopEdge, older: F64, newer: F64) -> tuple[float, float]:
    """Error (m and deg) of a loop given the true poses (4, 4) of its ends, in the directions that it claims."""
    wrong = lie.inverse(lie.inverse(older) @ newer) @ edge.T_older_newer
    turned = _claimed(edge.covariance[:3, :3], np.radians(CLAIMED_DEG)) @ lie.log(wrong[:3, :3])
    moved = _claimed(edge.covariance[3:, 3:], CLAIMED_M) @ wrong[:3, 3]
    return float(np.linalg.norm(moved)), float(np.degrees(np.linalg.norm(turned)))


def _claimed(covariance: F64, most: float) -> F64:
    """(n, 3) unit directions in which a covariance (3, 3) has at most this standard deviation."""
    squares, directions = np.linalg.eigh(covariance)
    return np.asarray(directions[:, squares < most**2].T)


def _good(errors: F64) -> npt.NDArray[np.bool_]:
    return (errors[:, 0] < GOOD_M) & (errors[:, 1] < GOOD_DEG)


def _revisits(T: F64, stamps_ns: I64) -> list[int]:
    """Mask of the true poses (n, 4, 4) that return to an earlier one."""
    ahead = _ahead(T)
    out = []
    for k in range(len(T)):
        near = np.linalg.norm(T[:k, :3, 3] - T[k, :3, 3], axis=1) < WITHIN_M
        long_ago = stamps_ns[:k] <= stamps_ns[k] - APART_S * 1e9
        if (near & long_ago & (np.abs(ahead[:k] @ ahead[k]) > ALONG)).any():
            out.append(k)
    return out


def _ahead(T: F64) -> F64:
    """(n, 3) unit, walking direction at each pose."""
    step = np.gradient(T[:, :3, 3], axis=0)
    return np.asarray(step / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-9))


HEADS = (
    "recording", "m", "ATE off", "ATE on", "gain m", "gain °", "NEES yaw", "NEES pos", "cand.", "acc.", "false", "good",
    "revis.", "found", "median m", "p95 m", "max m", "max °",
)  # fmt: skip
WIDTHS = (34, 6, 8, 9, 7, 7, 9, 9, 6, 5, 6, 6, 7, 6, 9, 6, 6, 6)


def _line(name: str, s: Score) -> str:
    e = s.errors if len(s.errors) else np.full((1, 2), np.nan)
    cells = (
        name, f"{s.metres:.0f}", f"{s.without:.4f}", f"{s.beside:.4f}" + ("!" if s.worse else ""),
        f"{s.gained_m:.3f}", f"{s.gained_deg:.2f}" + ("!" if s.slipped else ""), f"{s.yaw:.2f}", f"{s.position:.2f}",
        s.candidates, len(s.errors), s.false, f"{s.good:.2f}", s.revisits,
        f"{s.found / s.revisits:.2f}" if s.revisits else "–", f"{np.median(e[:, 0]):.3f}",
        f"{np.percentile(e[:, 0], 95):.3f}", f"{e[:, 0].max():.3f}", f"{e[:, 1].max():.2f}",
    )  # fmt: skip
    return " ".join(f"{cell:>{width}}" for cell, width in zip(cells, WIDTHS, strict=True))


def _summary(scores: Sequence[Score]) -> str:
    without, beside = (np.array([getattr(s, name) for s in scores]) for name in ("without", "beside"))
    metres = np.array([s.metres for s in scores])
    revisits = sum(s.revisits for s in scores)
    return (
        f"{len(scores)} walks: ATE {np.median(without):.3f} m in the median, at most {(without / metres).max():.3%} of"
        f" the distance; with loops {np.median(beside):.3f} m, {(beside / metres).max():.3%};"
        f" {sum(s.slipped for s in scores)} slip, {sum(s.worse for s in scores)} are worse with loops;"
        f" NEES of yaw {np.mean([s.yaw for s in scores]):.2f}, of position {np.mean([s.position for s in scores]):.2f};"
        f" {sum(s.false for s in scores)} false loops, {sum(s.found for s in scores) / max(revisits, 1):.2f} of"
        f" {revisits} revisits found."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path, metavar="RECORDING")
    parser.add_argument("--truth", type=Path, help="TUM file of the IMU; default: RECORDING_truth.tum beside it")
    parser.add_argument("--preset")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--drifting", action="store_true", help="odometry from a fraction of each scan")
    options = parser.parse_args()
    compile_kernels()
    print(" ".join(f"{head:>{width}}" for head, width in zip(HEADS, WIDTHS, strict=True)), flush=True)
    scores = []
    for recording in options.recordings:
        settings = [*(DRIFTING if options.drifting else ()), *options.set]
        scores.append(measure(recording, options.truth, resolve_params(recording, options.preset, None, settings)))
        print(_line(recording.stem, scores[-1]), flush=True)
    print(_summary(scores))
    if any(s.false or s.worse for s in scores):
        sys.exit("False loops, or worse with loops than without.")


if __name__ == "__main__":
    main()
