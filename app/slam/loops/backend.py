"""The loop back end: keyframes in, loops and corrected poses out. Synchronous and deterministic.

There are two layers. What was found is history: each keyframe appends to it, and going back means reading less of
it. The user's edits lie over the history and belong to the present. The graph is a function of both, solved in the
order in which keyframes and loops came, so undoing an edit is the same as never having made it. Later keyframes are
looked at with the loops as they count then, and again when an edit that counted then is undone.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.detection import Detector
from app.slam.loops.drift import Drift
from app.slam.loops.edits import Add, Edits, LoopEdit, Solve, check, in_words, lay_over, loses, rows
from app.slam.loops.factors import Closing, Factor, PositionPrior, loop_factors, odometry_factor, residuals
from app.slam.loops.messages import Target
from app.slam.loops.pose_graph import PoseGraph
from app.slam.loops.search import Found, search
from app.slam.loops.solvers import g2o_text, optimise
from app.slam.loops.types import FactorResidual, LoopDetail, LoopEdge, Pair, Preview, Verdict
from app.slam.loops.verdicts import by_hand, worth_correcting
from app.slam.sections import LoopsParams
from app.slam.types import F64, Keyframe


@dataclass(slots=True)
class _Record:
    """What came with one keyframe.

    Attributes:
        odometry: to it; None for the first. priors: measured of it alone. found: None until loops were looked for.
    """

    params: LoopsParams
    odometry: Factor | None
    priors: tuple[PositionPrior, ...]
    found: Found | None = None


class LoopBackend:
    """Finds loops among the keyframes of one session and corrects their poses (paper 2.4).

    It keeps a thinned cloud of every keyframe on disk until `close`.
    """

    def __init__(self) -> None:
        self._history: list[_Record] = []
        self._ends: dict[int, Found] = {}  # found in addition where the session ended, by the number of keyframes
        self._edits = Edits()
        self._made: dict[Add, LoopEdge] = {}  # the loops by hand among them
        self._reached = 0  # keyframes that the session ever had, one more after its end; later edits do not act yet
        self._start = LoopsParams()  # for what acts on restart
        self._detector = Detector(self._start)
        self._graph = PoseGraph(np.eye(4))
        self._broken: frozenset[Pair] = frozenset()  # loops that the solver failed with; they are not in the graph
        self._found: dict[Pair, LoopEdge] = {}
        self._by_pair: dict[Pair, LoopEdge] | None = None  # as they count; None: not up to date
        self._finished = False
        self._notices: list[str] = []
        self._said: set[str] = set()  # all notices ever

    def __len__(self) -> int:
        return len(self._detector)

    @property
    def known(self) -> int:
        """Keyframes of the history, including those beyond the present one."""
        return len(self._history)

    @property
    def finished(self) -> bool:
        return self._finished

    def close(self) -> None:
        self._detector.close()

    # --- the session -----------------------------------------------------------------------------
    def add(self, keyframe: Keyframe, params: LoopsParams, priors: tuple[PositionPrior, ...] = ()) -> None:
        """Take the next keyframe, and look for loops of the newest one whose surroundings are complete.

        If the history has the same keyframe next, nothing is computed again. Raises HemislamError if one is missing.

        Args:
            priors: what was measured of this keyframe alone.
        """
        index = len(self)
        if keyframe.index != index:
            raise HemislamError(f"Keyframe {keyframe.index} cannot follow on {index} keyframes; one is missing.")
        self.go_to(index)
        if self._is_known(keyframe, params):
            self.go_to(index + 1)
            return
        self.forget()
        if not index:
            self._detector.close()
            self._start, self._detector = params, Detector(params)
            self._graph = PoseGraph(keyframe.T_odom_imu, params.window)
        self._detector.take(keyframe)
        before, after = self._detector.head(max(index - 1, 0)), self._detector.head(index)
        odometry = odometry_factor(index, before, after, Drift.of(params)) if index else None
        self._history.append(_Record(params, odometry, priors))
        self._next()
        self._reach(self.known)

    def finish(self) -> None:
        """The session ends here: look for loops of the last keyframes too. `add` and `go_to` take that back."""
        if self._finished or not len(self):
            return
        count = len(self)
        if count not in self._ends:
            self._ends[count] = self._look(self._detector.described, count)
        self._finished = True
        self._stand(count)
        sinces = [edit.since for edit in (*self._edits.done, *self._edits.undone)]  # may lie beyond the end
        self._reach(max([self.known + 1, *sinces]) if count == self.known else 0)
        for edit in self._edits.done:
            if edit.pair and edit.pair not in self.by_pair:
                self._say(f"{in_words(edit)} has no effect: there is no such loop; loops.csv lists all.")

    def go_to(self, count: int) -> None:
        """Go to the state after `count` keyframes of the history. Raises HemislamError if it has fewer."""
        if not 0 <= count <= self.known:
            raise HemislamError(f"The loop search knows {self.known} keyframes and cannot go to {count}.")
        if self._finished or not len(self) <= count <= len(self) + 1:
            self._finished = False
            self._stand(count)
        elif count == len(self) + 1:
            self._next()
        self._resolve()

    def forget(self) -> None:
        """Forget the history beyond the present keyframe."""
        count = len(self)
        if count == self.known:
            return
        del self._history[count:]
        self._ends = {end: found for end, found in self._ends.items() if end <= count}
        self._detector.forget()
        half = self._start.submap_keyframes
        self._edits, self._reached = self._edits.cut(count, half), count
        self._made = {edit: edge for edit, edge in self._made.items() if not loses(edit, count, half)}
        self._stand(count)

    def stand(self, target: Target) -> None:
        """Go to a state. Raises as `load`, and then nothing has changed."""
        self.load(target.edits)
        count = min(target.count, self.known)
        if (count, target.finished) != (len(self), self._finished):
            self.go_to(count)
            if target.finished:
                self.finish()

    def _reach(self, reached: int) -> None:
        """The session has come this far: edits that were made here act from now on."""
        before, self._reached = self._reached, max(self._reached, reached)
        if any(before < edit.since <= reached for edit in self._edits.done):
            self._solve()
        self._resolve()

    def _is_known(self, keyframe: Keyframe, params: LoopsParams) -> bool:
        """Whether the history has this keyframe next, with the same parameters."""
        index = len(self)
        if index == self.known or self._history[index].params != params:
            return False
        known = self._detector.head(index)
        return (
            known.stamp_ns == keyframe.stamp_ns
            and np.array_equal(known.T_odom_imu, keyframe.T_odom_imu)
            and np.array_equal(known.covariance, keyframe.covariance, equal_nan=True)
        )

    def _stand(self, count: int) -> None:
        """Read from the history what was found with the first `count` keyframes, and solve."""
        found = [record.found for record in self._history[:count] if record.found is not None]
        found += [self._ends[count]] if self._finished else []
        self._detector.stand(count, [context for one in found for context in one.contexts])
        self._found = {edge.pair: edge for one in found for edge in one.updates}
        self._solve()

    def _next(self) -> None:
        """Go to the next keyframe of the history, as `_stand` would, and look for loops if nobody has yet."""
        record = self._history[len(self)]
        self._detector.go_on()
        self._by_pair = None
        if record.odometry is not None:
            self._report(self._graph.extend(record.odometry))
        self._report(self._graph.close(record.priors))
        if record.found is None:
            complete = len(self) - 1 - self._start.submap_keyframes
            record.found = self._look(max(complete, self._detector.described), complete + 1)
        else:
            self._detector.learn(record.found.contexts)
        self._found.update((edge.pair, edge) for edge in record.found.updates)
        self._by_pair = None
        decided = [edge for edge in self.edges if edge.decided_at == len(self) - 1]
        if self._report(self._graph.close(self._loops(decided, self.by_pair))):
            self._by_pair = None

    def _look(self, first: int, end: int) -> Found:
        """Look for loops of the keyframes `first` to `end` - 1, without changing the graph."""
        params = self._history[len(self) - 1].params
        if not params.enabled:
            return Found()
        return search(self._detector, range(first, max(end, 0)), self._found, self._counting, self._solved, params)

    # --- results --------------------------------------------------------------------------------
    @property
    def poses(self) -> F64:
        """(k, 4, 4) T_map_imu of all keyframes."""
        if self._solving:
            try:
                return self._optimum(self.edges)
            except HemislamError as error:
                self._say(str(error))
        return self._solved

    @property
    def corrections(self) -> F64:
        """(k, 4, 4) T_map_odom at each keyframe; identity while odometry agrees with the loops."""
        odometry = self._detector.poses
        measured = any(record.priors for record in self._history[: len(self)])
        if measured or self._solving or worth_correcting(self.edges, odometry):
            return np.asarray(self.poses @ lie.inverse(odometry))
        return np.tile(np.eye(4), (len(self), 1, 1))

    @property
    def edges(self) -> tuple[LoopEdge, ...]:
        """All candidates as they count now, in the order of their keyframes."""
        return tuple(self.by_pair.values())

    @property
    def by_pair(self) -> Mapping[Pair, LoopEdge]:
        """The same, by pair. It is not changed later."""
        if self._by_pair is None:
            self._by_pair = self._counting(self._found)
        return self._by_pair

    def take_notices(self) -> tuple[str, ...]:
        """What went wrong since the last call, in sentences. Each is said once."""
        notices, self._notices = self._notices, []
        return tuple(notices)

    def factor_residuals(self) -> tuple[FactorResidual, ...]:
        """The residual of every factor of the graph, odometry first."""
        return residuals(self._factors(self.edges), self.poses)

    def detail(self, older: KeyframeId, newer: KeyframeId) -> LoopDetail:
        """What the inspector shows of two keyframes. Raises HemislamError if one does not exist."""
        self._check_there(older, newer)
        edge = self.by_pair.get((older, newer))
        measured = None if edge is None else edge.T_older_newer
        counts = edge is not None and edge.verdict is Verdict.ACCEPTED
        poses = self._detector.poses if counts else self.poses  # the graph already includes it
        return self._detector.detail(older, newer, poses, measured)

    def g2o(self) -> str:
        """The graph as the text of a g2o file."""
        return g2o_text(self.poses, self._factors(self.edges))

    # --- edits -----------------------------------------------------------------------------------
    @property
    def edits(self) -> Edits:
        """The user's edits, in force and undone."""
        return self._edits

    @property
    def acting(self) -> tuple[LoopEdit, ...]:
        """Those in force that act already."""
        return tuple(edit for edit in self._edits.done if edit.since <= self._reached)

    @property
    def _solving(self) -> bool:
        """Whether poses are those of all factors solved at once."""
        return any(isinstance(edit, Solve) for edit in self.acting)

    def apply(self, edit: LoopEdit) -> None:
        """Add an edit. Those undone before can no longer be redone. Raises HemislamError if it makes no sense."""
        check(edit)
        if isinstance(edit, Add):
            there = edit.newer < len(self)
            if there and edit.guess is None:  # as it is now, so that it is the same when repeated
                edit = replace(edit, guess=rows(self._present(edit.older, edit.newer)))
        else:
            there = edit.pair is None or edit.pair in self.by_pair
        self._made |= self._made_by(edit)
        self._edits = Edits((*self._edits.done, replace(edit, since=self._reached if there else 0)))
        self._solve()
        if not there:
            self._notices.append(f"{in_words(edit)} waits until there is such a loop.")

    def load(self, edits: Edits) -> None:
        """Replace all edits. Raises HemislamError if one makes no sense, and then nothing has changed."""
        for edit in (*edits.done, *edits.undone):
            check(edit)
        known, before, self._edits = {*edits.done, *edits.undone}, self._edits.done, edits
        self._made = {edit: edge for edit, edge in self._made.items() if edit in known}
        then, now = ([(edit, edit.since) for edit in done] for done in (before, edits.done))
        if then != now:
            changed = [max(since, edit.pair[1]) for edit, since in {*then} ^ {*now} if edit.pair]
            self._look_again(min(changed, default=self.known + 1))
            self._solve()
            self._resolve()

    def _look_again(self, first: int) -> None:
        """Look for loops again from a keyframe of the history on, as if the present edits had always been there."""
        if first > self.known or not (self._ends or first < self.known):
            return
        count, finished, reached = len(self), self._finished, self._reached
        for record in self._history[first:]:
            record.found = None
        self._ends = {end: found for end, found in self._ends.items() if end < first}
        complete = first - self._start.submap_keyframes
        self._made = {
            edit: edge for edit, edge in self._made.items() if (0 < edit.since <= first) or edit.newer < complete
        }
        self._finished, self._reached = False, first
        self._stand(first)
        while len(self) < self.known:
            self._next()
            self._reach(len(self))
        self.go_to(count)
        if finished:
            self.finish()
        self._reach(reached)

    def preview(self, edit: LoopEdit) -> Preview:
        """What the graph would become by a edit, without doing it.

        Raises:
            HemislamError: it makes no sense, or there is no such loop or keyframe yet.
        """
        check(edit)
        if not isinstance(edit, Solve):
            self._check_there(edit.older, edit.newer)
            if not isinstance(edit, Add) and edit.pair not in self.by_pair:
                raise HemislamError(f"There is no loop candidate of keyframes {edit.older} and {edit.newer}.")
        edits, made = (*self.acting, edit), self._made | self._made_by(edit)
        edges = tuple(self._in_graph(lay_over(self._found, edits, made, len(self))).values())
        poses = self._optimum(edges)
        return Preview(poses, residuals(self._factors(edges), poses))

    def _made_by(self, edit: LoopEdit) -> dict[Add, LoopEdge]:
        """The loop that an edit adds, if any. Raises HemislamError if its registration found nothing in common."""
        if not isinstance(edit, Add) or edit.newer >= len(self):
            return {}
        edge = self._make(edit)
        if edit.register and not edge.evidence.overlap:
            raise HemislamError(
                f"The surroundings of keyframes {edge.older} and {edge.newer} have nothing in common from there;"
                " nudge one nearer to where it belongs, or tie them without registration."
            )
        return {edit: edge}

    def _make(self, edit: Add) -> LoopEdge:
        older, newer = edit.older, edit.newer
        guess = self._present(older, newer) if edit.guess is None else np.array(edit.guess, dtype=np.float64)
        return by_hand(older, newer, self._detector, guess, register=edit.register)

    def _present(self, older: int, newer: int) -> F64:
        """(4, 4) T_older_newer as the graph has it."""
        poses = self.poses
        return np.asarray(lie.inverse(poses[older]) @ poses[newer])

    def _resolve(self) -> None:
        """Make the loops by hand whose keyframes now exist; those given from the start wait for their surroundings."""
        count = len(self)
        complete = count if self._finished else count - self._start.submap_keyframes
        waiting = [edit for edit in self.acting if isinstance(edit, Add) and edit not in self._made]
        made = {edit: self._make(edit) for edit in waiting if edit.newer < (count if edit.since else complete)}
        if made:
            self._made |= made
            self._solve()

    def _check_there(self, older: int, newer: int) -> None:
        if not 0 <= older < newer < len(self):
            raise HemislamError(
                f"Keyframes {older} and {newer} cannot be compared; choose an older and a newer one of the"
                f" {len(self)} there are."
            )

    # --- the graph -------------------------------------------------------------------------------
    @property
    def _solved(self) -> F64:
        """(k, 4, 4) T_map_imu by the incremental solver."""
        return self._graph.poses[: len(self)]

    def _counting(self, found: Mapping[Pair, LoopEdge]) -> dict[Pair, LoopEdge]:
        """What was found, as it counts with the edits."""
        return self._in_graph(lay_over(found, self.acting, self._made, len(self)))

    def _in_graph(self, edges: dict[Pair, LoopEdge]) -> dict[Pair, LoopEdge]:
        """The same, without those that the solver failed with."""
        for pair in self._broken & edges.keys():
            edges[pair] = replace(edges[pair], verdict=Verdict.REJECTED, reason="the solver failed with it")
        return edges

    def _solve(self) -> None:
        """Solve the graph again, in the order in which keyframes and loops came."""
        self._by_pair, self._broken = None, frozenset()
        edges = self._counting(self._found)
        arrivals: dict[int, list[LoopEdge]] = {}
        for edge in edges.values():
            arrivals.setdefault(edge.decided_at, []).append(edge)
        loops = {index: self._loops(arrived, edges) for index, arrived in arrivals.items()}
        steps = [
            step
            for index, record in enumerate(self._history[: len(self)])
            for step in (record.odometry, record.priors, tuple(loops.get(index, ())))
            if step
        ]
        self._report(self._graph.replay(steps))

    def _factors(self, edges: Iterable[LoopEdge]) -> list[Closing]:
        """All of the graph: odometry, priors, loops."""
        records = self._history[: len(self)]
        odometry = [record.odometry for record in records if record.odometry is not None]
        priors = [prior for record in records for prior in record.priors]
        return [*odometry, *priors, *self._loops(edges, {edge.pair: edge for edge in edges})]

    def _loops(self, edges: Iterable[LoopEdge], by_pair: Mapping[Pair, LoopEdge]) -> list[Factor]:
        return loop_factors(edges, by_pair, self._detector.poses, window=self._start.window)

    def _optimum(self, edges: tuple[LoopEdge, ...]) -> F64:
        """(k, 4, 4) T_map_imu by all factors at once. Raises HemislamError if the solver fails."""
        poses = self._solved
        if len(poses) < 2:
            return poses
        try:
            return optimise(poses[0], self._factors(edges), poses)
        except ArithmeticError as error:
            raise HemislamError(f"The solver fails with this graph ({error}); reject the loop added last.") from error

    def _report(self, failed: Iterable[Closing]) -> bool:
        """Say which factors the solver failed with. Returns whether there are loops among them."""
        loops = {factor.name for factor in failed if isinstance(factor, Factor) and factor.robust}
        self._broken |= loops
        for factor in failed:
            if isinstance(factor, PositionPrior):
                self._say(f"The solver failed with the position of keyframe {factor.keyframe}; it is left out.")
            elif factor.robust:
                self._say(f"The solver failed with the loop {'{}-{}'.format(*factor.name)}; the graph goes on without.")
            else:
                self._say(f"The solver failed with the step to keyframe {factor.second}; it now says little.")
        return bool(loops)

    def _say(self, notice: str) -> None:
        if notice not in self._said:
            self._said.add(notice)
            self._notices.append(notice)
