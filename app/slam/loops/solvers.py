"""The solvers of the pose graph. The only place where gtsam is used.

A pose is T_map_imu of a keyframe, whose `KeyframeId` is its key; its error is a right perturbation, rotation then
translation.
"""

import tempfile
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from app.slam import lie
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.chain import Chain
from app.slam.loops.factors import Closing, Factor, PositionPrior, Step
from app.slam.loops.types import LOOP_HUBER, Pair
from app.slam.rows import Rows
from app.slam.types import F64

RELINEARISE = 0.05
"""Change of a pose (rad, m) from which its factors are linearised again."""
MOST_UPDATES = 5
"""After a loop, the update is repeated while the newest pose moves by more than that, at most this many times."""
_HELD = 1e-6
"""Standard deviation (rad, m) with which the first pose is held."""
_FIRST = np.full(6, _HELD)
_FREE = np.repeat((np.radians(1.0), 100.0), 3)
"""The same if position priors determine the position."""


def optimise(first: F64, factors: Sequence[Closing], start: Sequence[F64] | F64, *, free: bool = False) -> F64:
    """(n, 4, 4) the optimum of all factors at once, by Levenberg-Marquardt from (n, 4, 4) `start`.

    Args:
        free: the first pose is held only in rotation, to a degree; position priors determine the rest.

    Raises:
        ArithmeticError: the solver failed.
    """
    graph, values = _start(first, _FREE if free else _FIRST)
    for factor in factors:
        graph.add(_gtsam(factor))
    for key in range(1, len(start)):
        values.insert(key, gtsam.Pose3(start[key]))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setAbsoluteErrorTol(1e-12)
    try:
        return _matrices(gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize())
    except (RuntimeError, ValueError, IndexError) as error:
        raise ArithmeticError(str(error)) from error


def read_g2o(text: str) -> list[Factor]:
    """The factors in the text of a g2o file; loops become robust again. Raises RuntimeError: it cannot be read."""
    with tempfile.TemporaryDirectory(prefix="hemislam-") as folder:  # gtsam reads files only
        path = Path(folder) / "graph.g2o"
        path.write_text(text, encoding="utf-8")
        graph, _ = gtsam.readG2o(str(path), True)
    factors = []
    for index in range(graph.size()):
        factor = graph.at(index)
        if isinstance(factor, gtsam.BetweenFactorPose3):
            first, second = (KeyframeId(0, int(key)) for key in factor.keys())  # noqa: SIM118  # no mapping
            covariance = np.asarray(factor.noiseModel().covariance())  # type: ignore[attr-defined]  # a Gaussian
            measured = np.asarray(factor.measured().matrix())
            factors.append(Factor(first, second, measured, covariance, second - first != 1))
    return factors


def g2o_text(poses: F64, factors: Iterable[Closing]) -> str:
    """Poses (n, 4, 4) and factors as the text of a g2o file, whose format has no robust loss and no priors."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for factor in factors:
        if isinstance(factor, Factor):
            graph.add(_gtsam(replace(factor, robust=False)))
    for key, pose in enumerate(poses):
        values.insert(key, gtsam.Pose3(pose))
    with tempfile.TemporaryDirectory(prefix="hemislam-") as folder:  # gtsam writes files only
        path = Path(folder) / "graph.g2o"
        gtsam.writeG2o(graph, values, str(path))
        return path.read_text(encoding="utf-8")


class Incremental:
    """Every pose is solved for (iSAM2; Kaess et al. 2012).

    The solver holds only the poses that loops tie; odometry between two of these is one factor. All other poses follow
    from them (`Chain`), so the cost grows with the loops, not with the length of the session. Loops between the same
    two poses are merged into one factor, their mean.

    Attributes:
        count: of poses. newest: (4, 4), the last of them.
    """

    def __init__(self, first: F64) -> None:
        self.count, self.newest = 1, first
        self._isam = gtsam.ISAM2(_params())
        self._isam.update(*_start(first))
        self._factors = 1  # number given to the solver so far
        self._chain = Chain(first)
        self._tied = [KeyframeId(0, 0)]
        self._odometry: dict[Pair, int] = {}  # number of the factor between two of these
        self._loops: dict[tuple[KeyframeId, ...], _Mean] = {}
        self._poses: Rows[np.float64] | None = Rows((4, 4), np.float64, [first])  # None: loops have moved them since
        self._ahead: list[F64] = []  # poses after these

    def update(self, step: Step) -> None:
        """Raises what gtsam raises, IndexError, ValueError and ArithmeticError; the solver is broken then."""
        if isinstance(step, Factor):
            if not np.isfinite(np.linalg.cholesky(step.covariance)).all():
                raise ArithmeticError("a covariance is not finite")  # or the next loop would fail, and be blamed
            self._chain.append(step.T_first_second, step.covariance)
            self.newest = self.newest @ step.T_first_second
            self.count += 1
            (self._ahead if self._poses is None else self._poses).append(self.newest)
            return
        if not all(0 <= keyframe < self.count for factor in step for keyframe in factor.keyframes):
            raise IndexError("a factor ties a pose that does not exist")
        self._poses, self._ahead = None, []
        T_last, odometry = self._tie(step), self._chain.poses
        self.newest = T_last @ lie.inverse(odometry[self._tied[-1]]) @ odometry[-1]

    def poses(self) -> F64:
        if self._poses is None:
            ends = np.array(self._tied)
            T_ends = _matrices(self._isam.calculateEstimate())
            self._poses = Rows((4, 4), np.float64)
            self._poses.extend(self._chain.bent(ends, T_ends, self.count - len(self._ahead)))
            for pose in self._ahead:
                self._poses.append(pose)
        return self._poses.view()

    def _tie(self, factors: Sequence[Closing]) -> F64:
        """Solve with more factors. Returns the last pose (4, 4) that one ties."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        new = sorted({keyframe for factor in factors for keyframe in factor.keyframes}.difference(self._tied))
        expected = {key: self._expected(key) for key in new}
        removed, added = [], dict[Pair, None]()
        for key, pose in expected.items():
            values.insert(key, gtsam.Pose3(pose))
            at = bisect_left(self._tied, key)
            before, after = self._tied[at - 1], self._tied[at : at + 1]
            self._tied.insert(at, key)
            added[before, key] = None
            for end in after:  # odometry from `before` to `end` becomes two factors
                added[key, end] = None
                if (before, end) in added:
                    del added[before, end]
                else:
                    removed.append(self._odometry.pop((before, end)))
        for first, second in added:
            self._odometry[first, second] = self._factors + graph.size()
            graph.add(_gtsam(Factor(first, second, *self._chain.between(first, second))))
        means: dict[_Mean, None] = {}  # in the order of their first loops
        for factor in factors:
            if isinstance(factor, PositionPrior):
                graph.add(_gtsam(factor))
            elif (mean := self._loops.get(factor.keyframes)) is not None:
                mean.take(factor)
                means[mean] = None
            else:
                means[self._loops.setdefault(factor.keyframes, _Mean(factor))] = None
        for mean in means:
            if mean.number is not None:
                removed.append(mean.number)
            mean.number = self._factors + graph.size()
            graph.add(_gtsam(mean.factor, mean.times))
        self._factors += graph.size()
        last = self._tied[-1]
        T_last = expected[last] if last in expected else _estimate(self._isam, last)
        self._isam.update(graph, values, removed)
        return _settled(self._isam, last, T_last)

    def _expected(self, key: int) -> F64:
        """(4, 4) of a pose that no loop has tied so far."""
        at = bisect_left(self._tied, key)
        ends = self._tied[at - 1 : at + 1]
        T_ends = np.array([_estimate(self._isam, end) for end in ends])
        return np.asarray(self._chain.bent(np.array(ends), T_ends, max(key, ends[-1]) + 1)[key - ends[0]])


class _Mean:
    """Loops between the same two poses as one factor: their squared errors add up to that of the mean, plus a constant.

    Attributes:
        factor: their mean, weighted by information. times: number of loops. number: of the factor in the solver.
    """

    def __init__(self, loop: Factor) -> None:
        self.factor, self.times = loop, 1
        self.number: int | None = None

    def take(self, loop: Factor) -> None:
        """Add one more loop."""
        before, own = np.linalg.inv(self.factor.covariance), np.linalg.inv(loop.covariance)
        covariance = np.linalg.inv(before + own)
        T = self.factor.T_first_second
        step = covariance @ own @ lie.log_se3(lie.inverse(T) @ loop.T_first_second)
        covariance = (covariance + covariance.T) / 2
        self.factor = replace(self.factor, T_first_second=T @ lie.exp_se3(step), covariance=covariance)
        self.times += 1


class Windowed:
    """Only the newest poses are solved for; older ones are marginalised (the paper's fixed number of nodes)."""

    def __init__(self, first: F64, size: int) -> None:
        self.count, self.newest = 1, first
        self._size = size
        self._left: list[F64] = []  # the poses that are no longer solved for
        self._smoother = gtsam.IncrementalFixedLagSmoother(float(size - 1), _params())
        self._smoother.update(*_start(first), {0: 0.0})

    def update(self, step: Step) -> None:
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        stamps: dict[Any, Any] = {}
        closing: tuple[Closing, ...] = ()
        if isinstance(step, Factor):
            self.newest = self.newest @ step.T_first_second
            values.insert(step.second, gtsam.Pose3(self.newest))
            graph.add(_gtsam(step))
            stamps[self.count] = float(self.count)
            if self.count - len(self._left) == self._size:
                self._left.append(_estimate(self._smoother, len(self._left)))
            self.count += 1
        else:
            closing = step
        for factor in closing:
            first, last = factor.keyframes[0], factor.keyframes[-1]
            if first >= len(self._left):
                graph.add(_gtsam(factor))
            elif isinstance(factor, Factor) and last >= len(self._left):  # the older pose stays where it was left
                where = gtsam.Pose3(self._left[first] @ factor.T_first_second)
                graph.add(gtsam.PriorFactorPose3(last, where, _noise(factor)))
        self._smoother.update(graph, values, stamps)
        if closing:
            self.newest = _settled(self._smoother, self.count - 1, self.newest)

    def poses(self) -> F64:
        return np.array(self._left + [_estimate(self._smoother, key) for key in range(len(self._left), self.count)])


def _settled(solver: Any, newest: int, before: F64) -> F64:
    """The newest pose, after repeating the update while it moves so far that it has to be linearised again."""
    for _ in range(MOST_UPDATES):
        after = _estimate(solver, newest)
        if not np.abs(after - before).max() > RELINEARISE:
            return after
        before = after
        solver.update()
    return _estimate(solver, newest)


def _estimate(solver: Any, key: int) -> F64:
    return np.asarray(solver.calculateEstimatePose3(key).matrix())


def _start(first: F64, sigmas: F64 = _FIRST) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(first), gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
    values.insert(0, gtsam.Pose3(first))
    return graph, values


def _params() -> gtsam.ISAM2Params:
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(RELINEARISE)
    params.relinearizeSkip = 1
    exact = gtsam.ISAM2GaussNewtonParams()
    exact.setWildfireThreshold(0.0)  # otherwise reading an estimate would change the next one
    params.setOptimizationParams(exact)
    return params


def _noise(factor: Closing, times: int = 1) -> gtsam.noiseModel.Base:
    """times: number of loops in the mean. Huber's limit grows so that together they pull as far as each would alone."""
    noise = gtsam.noiseModel.Gaussian.Covariance(factor.covariance)
    if not factor.robust:
        return noise
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(LOOP_HUBER * times**0.5), noise)


def _gtsam(factor: Closing, times: int = 1) -> gtsam.NonlinearFactor:
    """The factor as a gtsam object."""
    if isinstance(factor, PositionPrior):
        return gtsam.GPSFactorArm(factor.keyframe, factor.p_map_imu, factor.arm, _noise(factor))
    T = gtsam.Pose3(factor.T_first_second)
    return gtsam.BetweenFactorPose3(factor.first, factor.second, T, _noise(factor, times))


def _matrices(values: Any) -> F64:
    """(n, 4, 4) poses in the order of their keys."""
    flat = np.asarray(gtsam.utilities.extractPose3(values))
    out = np.tile(np.eye(4), (len(flat), 1, 1))
    out[:, :3, :3] = flat[:, :9].reshape(-1, 3, 3)
    out[:, :3, 3] = flat[:, 9:]
    return out
