"""The loop back end: keyframes in, loops and corrected poses out. Synchronous and deterministic.

Two layers. What was FOUND comes from the keyframes, and stays: candidates, their evidence, their
verdicts. Over it lies the list of the user's COMMANDS, of which any number can be undone and done
again. The graph is a function of both, solved in the order in which keyframes and loops came, so
that undoing is the same as never having done.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.keyframes import KeyframeStore
from app.slam.loops import scan_context
from app.slam.loops.detection import Detector, Memory
from app.slam.loops.drift import Drift, expect
from app.slam.loops.judgement import by_hand, judge
from app.slam.loops.odometry import odometry_factor
from app.slam.loops.pose_graph import Factor, PoseGraph, Step, optimise, whitened, write_g2o
from app.slam.loops.support import settle
from app.slam.loops.types import (
    Accept,
    Add,
    Command,
    FactorResidual,
    LoopDetail,
    LoopEdge,
    Pair,
    Preview,
    Reject,
    SetWeight,
    Verdict,
)
from app.slam.params import Loops
from app.slam.types import F64, Keyframe

SURE_M = 0.3
"""Where odometry is surer than this of its position, one place that fits is enough."""


@dataclass(frozen=True, slots=True)
class Done:
    """A command, and for Add the loop that it came to when it was given."""

    command: Command
    added: LoopEdge | None = None


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """All that the back end's future depends on."""

    memory: Memory
    found: dict[Pair, LoopEdge]
    done: tuple[Done, ...]
    undone: tuple[Done, ...]
    steps: tuple[Step, ...]
    broken: frozenset[Pair]
    notices: tuple[str, ...]


class LoopBackend:
    """Finds loops among the keyframes of one walk and straightens their poses (paper 2.4).

    Args:
        params: of loops.
        keyframes: where the clouds are; a keyframe must be in it when it is given to `add`.

    Attributes:
        notices: what went wrong on the way, in sentences.
    """

    def __init__(self, params: Loops, keyframes: KeyframeStore) -> None:
        self.params = params
        self.notices: list[str] = []
        self._drift = Drift(self.params.drift_translation / 100, np.radians(self.params.drift_rotation))
        self._detector = Detector(self.params, keyframes)
        self._graph = PoseGraph(np.eye(4), self.params.window)
        self._odometry: list[Factor] = []
        self._found: dict[Pair, LoopEdge] = {}
        self._done: list[Done] = []
        self._undone: list[Done] = []
        self._broken: frozenset[Pair] = frozenset()

    def __len__(self) -> int:
        return len(self._detector)

    # --- the walk --------------------------------------------------------------------------------
    def add(self, keyframe: Keyframe) -> tuple[LoopEdge, ...]:
        """Take the next keyframe; look for loops of the newest one whose surroundings are complete.

        Returns:
            Candidates that are new or whose verdict has changed.
        """
        self._detector.add(keyframe)
        if len(self) == 1:
            self._graph = PoseGraph(keyframe.T_odom_imu, self.params.window)
        else:
            heads = self._detector.heads
            self._odometry.append(odometry_factor(len(self) - 1, heads[-2], heads[-1], self._drift))
            self._report(self._graph.extend(self._odometry[-1]))
        complete = len(self) - 1 - self.params.submap_keyframes
        return self._look(complete) if self.params.enabled and complete >= self._detector.described else ()

    def finish(self) -> tuple[LoopEdge, ...]:
        """At the end of the walk: look for loops of the last keyframes too. Returns as `add`."""
        if not self.params.enabled:
            return ()
        return tuple(edge for index in range(self._detector.described, len(self)) for edge in self._look(index))

    def _look(self, newer: int) -> tuple[LoopEdge, ...]:
        self._detector.describe(newer)
        accepted = [edge for edge in self.edges if edge.verdict is Verdict.ACCEPTED]
        expectation = expect(newer, self._graph.poses, accepted, self._drift)
        seen = []
        for sighting in self._detector.look(newer, expectation):
            seen.append(judge(sighting, self._detector, expectation, self.params))
            if seen[-1].verdict is Verdict.CANDIDATE and seen[-1].evidence.gate_m < SURE_M:
                break
        changed = settle(seen, self.edges, self._detector.poses, self._drift, self.params, len(self) - 1)
        self._found.update((edge.pair, replace(edge, overruled=False, weight=1.0)) for edge in changed)
        fresh = {edge.pair for edge in changed}
        loops = [edge for edge in self.edges if edge.pair in fresh and edge.verdict is Verdict.ACCEPTED]
        self._report(self._graph.close([_factor(edge) for edge in loops]))
        return tuple(edge for edge in self.edges if edge.pair in fresh)

    # --- what there is ---------------------------------------------------------------------------
    @property
    def poses(self) -> F64:
        """(k, 4, 4) T_map_imu of all keyframes."""
        return self._graph.poses if len(self) else np.empty((0, 4, 4))

    @property
    def T_map_odom(self) -> F64:
        """(4, 4) the correction at the newest keyframe."""
        if not len(self):
            return np.eye(4)
        return np.asarray(self._graph.newest @ lie.inverse(self._detector.heads[-1].T_odom_imu))

    @property
    def edges(self) -> tuple[LoopEdge, ...]:
        """All candidates ever, as they count now, by keyframes."""
        return self._edges(self._done)

    def _edges(self, done: list[Done]) -> tuple[LoopEdge, ...]:
        edges = dict(self._found)
        for entry in done:
            pair = entry.command.older, entry.command.newer
            if isinstance(entry.command, Add) and entry.added is not None:
                edges[pair] = entry.added
            elif pair in edges:
                edges[pair] = _overruled(edges[pair], entry.command)
        for pair in self._broken & edges.keys():
            edges[pair] = replace(edges[pair], verdict=Verdict.REJECTED, reason="the solver failed with it")
        return tuple(edges[pair] for pair in sorted(edges))

    def factor_residuals(self) -> tuple[FactorResidual, ...]:
        """Of every factor of the graph, odometry first."""
        return _residuals(self._factors(self.edges), self.poses)

    def optimised(self) -> F64:
        """(k, 4, 4) T_map_imu by Levenberg-Marquardt over all factors at once, from the present poses."""
        return self._batch(self.edges)

    def detail(self, older: int, newer: int) -> LoopDetail:
        """What the inspector shows of a candidate. Raises HemislamError if there is none of these keyframes."""
        edge = self._edge(older, newer)
        detector = self._detector
        T = detector.T_level_imu(older) @ edge.T_older_newer @ lie.inverse(detector.T_level_imu(newer))
        a, b = detector.context(older), detector.context(newer)
        return LoopDetail(
            older=detector.submap(older).submap.points,
            newer=detector.submap(newer).submap.points,
            T_imu_level=lie.inverse(detector.T_level_imu(older)),
            T_guess=detector.guess(older, newer, self.poses),
            T_registered=T,
            older_context=np.where(a.seen, a.cells, np.float32(np.nan)),
            newer_context=np.where(b.seen, b.cells, np.float32(np.nan)),
            shift_distances=scan_context.shift_distances(a, b),
            residuals=detector.assess(older, newer, T).residuals,
        )

    def write_g2o(self, path: Path) -> None:
        """The graph as a g2o file. Raises HemislamError if it can not be written."""
        try:
            write_g2o(path, self.poses, self._factors(self.edges))
        except OSError as error:
            raise HemislamError(f"{path} can not be written ({error.strerror}); choose another place.") from error

    # --- overruling ------------------------------------------------------------------------------
    def apply(self, command: Command) -> LoopEdge:
        """Overrule. What was undone before can no longer be redone. Returns the loop as it is now.

        Raises:
            HemislamError: there is no such candidate or keyframe, or the weight is not positive.
        """
        self._done.append(self._resolve(command))
        self._undone.clear()
        self._solve()
        return self._edge(command.older, command.newer)

    def undo(self) -> Command | None:
        """Take the last command back; None if there is none."""
        if not self._done:
            return None
        self._undone.append(self._done.pop())
        self._solve()
        return self._undone[-1].command

    def redo(self) -> Command | None:
        """Do the command again that was last undone; None if there is none."""
        if not self._undone:
            return None
        self._done.append(self._undone.pop())
        self._solve()
        return self._done[-1].command

    @property
    def commands(self) -> tuple[Command, ...]:
        """The commands in force, in order."""
        return tuple(entry.command for entry in self._done)

    @property
    def undone(self) -> tuple[Command, ...]:
        """The commands that `redo` would do again, the next one last."""
        return tuple(entry.command for entry in self._undone)

    def preview(self, command: Command) -> Preview:
        """What the graph would become by a command, without doing it. Raises as `apply`."""
        edges = self._edges([*self._done, self._resolve(command)])
        poses = self._batch(edges)
        return Preview(poses, _residuals(self._factors(edges), poses))

    def _resolve(self, command: Command) -> Done:
        older, newer = command.older, command.newer
        if not isinstance(command, Add):
            self._edge(older, newer)
            if isinstance(command, SetWeight) and not (np.isfinite(command.weight) and command.weight > 0):
                raise HemislamError(f"A loop's weight can not be {command.weight:g}; it must be greater than 0.")
            return Done(command)
        if not 0 <= older < newer < len(self):
            raise HemislamError(
                f"Keyframes {older} and {newer} can not be tied together; choose an older and a newer one"
                f" of the {len(self)} there are."
            )
        poses = self.poses
        present = lie.inverse(poses[older]) @ poses[newer]
        guess = present if command.guess is None else np.array(command.guess, dtype=np.float64)
        if guess.shape != (4, 4) or not np.isfinite(guess).all():
            raise HemislamError("The guess of a loop must be a 4x4 matrix T_older_newer of finite numbers.")
        return Done(command, by_hand(older, newer, self._detector, guess, register=command.register))

    def _edge(self, older: int, newer: int) -> LoopEdge:
        for edge in self.edges:
            if edge.pair == (older, newer):
                return edge
        raise HemislamError(f"There is no loop candidate of keyframes {older} and {newer}; loops.csv lists them.")

    # --- the graph -------------------------------------------------------------------------------
    def _solve(self) -> None:
        """Solve again, in the order in which keyframes and loops came."""
        self._broken = frozenset()
        arrivals: dict[int, list[Factor]] = {}
        for edge in self.edges:
            if edge.verdict is Verdict.ACCEPTED:
                arrivals.setdefault(edge.decided_at, []).append(_factor(edge))
        steps = []
        for index in range(len(self)):
            if index:
                steps.append(Step(self._odometry[index - 1]))
            if index in arrivals:
                steps.append(Step(None, tuple(arrivals[index])))
        self._report(self._graph.replay(steps))

    def _report(self, failed: tuple[Factor, ...]) -> None:
        for factor in failed:
            pair = factor.first, factor.second
            if factor.robust:
                self._broken |= {pair}
                self.notices.append(f"The solver failed with the loop {pair[0]}-{pair[1]}; the graph goes on without.")
            else:
                self._odometry[factor.second - 1] = self._graph.steps[-1].odometry or factor
                self.notices.append(f"The solver failed with the step to keyframe {pair[1]}; it now says little.")

    def _factors(self, edges: tuple[LoopEdge, ...]) -> list[Factor]:
        return self._odometry + [_factor(edge) for edge in edges if edge.verdict is Verdict.ACCEPTED]

    def _batch(self, edges: tuple[LoopEdge, ...]) -> F64:
        poses = self.poses
        if len(poses) < 2:
            return poses
        try:
            return optimise(poses[0], self._factors(edges), poses)
        except ArithmeticError as error:
            raise HemislamError(f"The solver fails with this graph ({error}); reject the loop added last.") from error

    # --- going back ------------------------------------------------------------------------------
    def checkpoint(self) -> Checkpoint:
        return Checkpoint(
            memory=self._detector.memory(),
            found=dict(self._found),
            done=tuple(self._done),
            undone=tuple(self._undone),
            steps=self._graph.steps,
            broken=self._broken,
            notices=tuple(self.notices),
        )

    def restore(self, checkpoint: Checkpoint) -> None:
        """Go back to (or, in another back end of the same walk, on from) a checkpoint, exactly."""
        self._detector.restore(checkpoint.memory)
        self._found = dict(checkpoint.found)
        self._done, self._undone = list(checkpoint.done), list(checkpoint.undone)
        self._odometry = [step.odometry for step in checkpoint.steps if step.odometry is not None]
        heads = self._detector.heads
        self._graph = PoseGraph(heads[0].T_odom_imu if heads else np.eye(4), self.params.window)
        self._graph.replay(checkpoint.steps)
        self._broken, self.notices = checkpoint.broken, list(checkpoint.notices)


def _factor(edge: LoopEdge) -> Factor:
    return Factor(edge.older, edge.newer, edge.T_older_newer, edge.covariance / edge.weight, robust=True)


def _overruled(edge: LoopEdge, command: Command) -> LoopEdge:
    if isinstance(command, SetWeight):
        return replace(edge, weight=command.weight)
    verdict = Verdict.ACCEPTED if isinstance(command, Accept) else Verdict.REJECTED
    if isinstance(command, Accept | Reject) and verdict is not edge.verdict:
        reason = f"{verdict} by hand; found {edge.verdict}: {edge.reason}"
        return replace(edge, verdict=verdict, overruled=True, reason=reason)
    return replace(edge, overruled=True)


def _residuals(factors: list[Factor], poses: F64) -> tuple[FactorResidual, ...]:
    out = []
    for factor in factors:
        error, sigmas = whitened(factor, poses)
        turned, moved = float(np.degrees(np.linalg.norm(error[:3]))), float(np.linalg.norm(error[3:]))
        out.append(FactorResidual((factor.first, factor.second), factor.robust, turned, moved, sigmas))
    return tuple(out)
