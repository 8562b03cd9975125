"""How far odometry is off on imperfect sensors, whether it slips, and whether its covariance says so.

On the short imperfect twins of the paper's sequences, with and among people, without loops. The NEES (normalised
estimation error squared) of a keyframe is the square of its error in units of the covariance that the filter gives it;
its mean for each degree of freedom is 1 if the covariance is right, and larger if the filter believes itself too much.
Errors count from the first keyframe, whose pose defines the odometry frame.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.sensors.simulator.imperfections import IMPERFECT
from app.sensors.simulator.suite import PAPER, make_twin
from app.slam import lie
from app.slam.engine import Engine
from app.slam.metrics import ate, paired
from app.slam.params import Params
from app.slam.trajectory import Trajectory, read_tum, truth_beside
from app.slam.types import F64, I64, Measurement
from app.slam.warmup import compile_kernels
from benchmarks.record import Line
from benchmarks.scenes import FOLDER

SEEDS = (0, 1)
SLIP_S, SLIP_DEG, SLIP_M = 5.0, 0.5, 0.2
"""A slip: so much of an error gained within so many seconds, and kept."""
KEPT = 10
"""Frames over which errors are averaged for that: a wrong mounting and a late clock make them swing with every step."""


@dataclass(frozen=True, slots=True)
class Score:
    """Attributes:
    ate_m: RMSE. metres: walked. slips: how often within SLIP_S more than SLIP_DEG or SLIP_M were gained.
    yaw, position: (k,) NEES of the keyframes for each degree of freedom.
    """

    ate_m: float
    metres: float
    slips: int
    yaw: F64
    position: F64


def run() -> list[Line]:
    compile_kernels()
    FOLDER.mkdir(parents=True, exist_ok=True)
    twins = [
        make_twin(twin, FOLDER, seed=seed, short=True, imperfections=IMPERFECT).recording
        for seed in SEEDS
        for twin in tqdm(PAPER, desc="Simulating twins", leave=False, disable=None)
    ]
    scores = [measure(path) for path in twins]
    on = f"{len(twins)} imperfect twins of a minute"
    return [
        Line.of("ATE", on, "m", [score.ate_m for score in scores]),
        Line.of("ATE over distance", on, "%", [100 * score.ate_m / score.metres for score in scores]),
        Line.of("slips", on, "", [score.slips for score in scores]),
        Line.of("NEES of yaw", on, "a degree of freedom", [score.yaw.mean() for score in scores]),
        Line.of("NEES of position", on, "a degree of freedom", [score.position.mean() for score in scores]),
        Line.of("NEES of yaw, mean", on, "a degree of freedom", [np.mean([s.yaw.mean() for s in scores])]),
        Line.of("NEES of position, mean", on, "a degree of freedom", [np.mean([s.position.mean() for s in scores])]),
    ]


def measure(path: Path, params: Params | None = None) -> Score:
    """Odometry on a recording with its truth beside it."""
    params = params or resolve_params(path, None, None, [])
    truth = truth_beside(path)
    assert truth is not None
    engine = Engine(params)
    with open_recording(path, params) as source, tqdm(desc=path.stem, unit=" frames", leave=False, disable=None) as bar:
        states = []
        for entry in source.measurements():
            if isinstance(entry, Measurement):
                states.append(engine.step(entry.scan, entry.imu).state)
                bar.update()
    covariances = {keyframe.stamp_ns: keyframe.covariance for keyframe in engine.keyframes}
    engine.close()
    walk = Trajectory.from_poses([x.stamp_ns for x in states], [x.T_odom_imu for x in states])
    off = ate(walk, read_tum(truth))
    ours, theirs = paired(walk, read_tum(truth))
    kept = np.isin(ours.stamps_ns, list(covariances))
    believed = np.array([covariances[stamp] for stamp in ours.stamps_ns[kept]])
    turned, moved = _errors(ours.poses, off.T_truth_estimate[:3, :3].T @ theirs.poses[:, :3], kept)
    yaw, position = _nees(turned[kept], moved[kept], ours.poses[kept], believed)
    return Score(off.position.rmse, off.distance, _slips(ours.stamps_ns, turned, moved), yaw, position)


def _errors(ours: F64, theirs: F64, kept: npt.NDArray[np.bool_]) -> tuple[F64, F64]:
    """Errors in yaw (n,) rad and position (n, 3) m since the first keyframe, of poses (n, 4, 4) in odom.

    theirs (n, 3, 4): true poses, turned into odom by the alignment of all positions. The first pose alone would not
    do: an error of the mounting turns the whole walk about it.
    """
    begin = int(np.argmax(kept))
    turn = ours[:, :3, :3] @ np.swapaxes(theirs[:, :3, :3], 1, 2)
    moved = ours[:, :3, 3] - theirs[:, :, 3]
    return lie.log(turn @ turn[begin].T)[:, 2], moved - moved[begin]


def _nees(turned: F64, moved: F64, poses: F64, covariances: F64) -> tuple[F64, F64]:
    """Of yaw and of position, for each degree of freedom, without the first keyframe."""
    up = poses[:, 2, :3]
    yaw = turned**2 / np.einsum("ni,nij,nj->n", up, covariances[:, :3, :3], up)
    position = np.einsum("ni,nij,nj->n", moved, np.linalg.inv(covariances[:, 3:, 3:]), moved) / 3
    return yaw[1:], position[1:]


def _slips(stamps_ns: I64, turned: F64, moved: F64) -> int:
    """How many stretches of SLIP_S, one after the other, hold a slip."""
    mean = np.full(KEPT, 1 / KEPT)
    turned, stamps_ns = np.convolve(turned, mean, "valid"), stamps_ns[KEPT - 1 :]
    moved = np.stack([np.convolve(axis, mean, "valid") for axis in moved.T], axis=1)
    slips, k = 0, 0
    earlier = np.searchsorted(stamps_ns, stamps_ns - round(SLIP_S * 1e9))
    gained = np.degrees(np.abs(turned - turned[earlier])) > SLIP_DEG
    gained |= np.linalg.norm(moved - moved[earlier], axis=1) > SLIP_M
    while gained[k:].any():
        k += int(np.argmax(gained[k:]))
        slips, k = slips + 1, int(np.searchsorted(stamps_ns, stamps_ns[k] + round(SLIP_S * 1e9)))
    return slips
