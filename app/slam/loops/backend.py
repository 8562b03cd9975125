"""The loop back end: keyframes in, loops and corrected poses out. Synchronous and deterministic.

There are two layers. What was found is history: each keyframe appends to it, and going back means reading less of
it. The user's edits lie over the history and belong to the present. The graph is a function of both, solved in the
order in which keyframes and loops came, so undoing an edit is the same as never having made it. An edit removes
nothing from the history, but later keyframes are looked at with the loops as they count then.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.loops import inspection
from app.slam.loops.detection import Detector, Head
from app.slam.loops.drift import Drift
from app.slam.loops.edits import EditList, Entry, check, in_words
from app.slam.loops.factors import Factor, odometry_factor
from app.slam.loops.history import History, Record
from app.slam.loops.messages import Target
from app.slam.loops.pose_graph import g2o_text, optimise
from app.slam.loops.search import Found, search
from app.slam.loops.solution import Solution, loop_factors
from app.slam.loops.types import (
    Add,
    Edits,
    FactorResidual,
    LoopDetail,
    LoopEdge,
    LoopEdit,
    Pair,
    Preview,
    Solve,
    Verdict,
    pair_of,
    rows,
)
from app.slam.loops.verdicts import by_hand, worth_correcting
from app.slam.sections import LoopsParams
from app.slam.types import F64, Keyframe


class LoopBackend:
    """Finds loops among the keyframes of one session and corrects their poses (paper 2.4).

    It keeps a thinned cloud of every keyframe on disk until `close`.
    """

    def __init__(self) -> None:
        self._history = History()
        self._edits = EditList()
        self._start = LoopsParams()  # for what acts on restart
        self._detector = Detector(self._start)
        self._solution = Solution()
        self._found: dict[Pair, LoopEdge] = {}
        self._by_pair: dict[Pair, LoopEdge] | None = None  # as they count; None: not up to date
        self._finished = False
        self._idle: set[str] = set()  # edits reported to have no effect
        self._notices: list[str] = []
        self._said: set[str] = set()  # reported failures of the solver

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
    def add(self, keyframe: Keyframe, params: LoopsParams) -> None:
        """Take the next keyframe, and look for loops of the newest one whose surroundings are complete.

        If the history has the same keyframe next, nothing is computed again. Raises HemislamError if one is missing.
        """
        if keyframe.index != len(self):
            raise HemislamError(f"Keyframe {keyframe.index} cannot follow on {len(self)} keyframes; one is missing.")
        self.go_to(len(self))
        if self._is_known(keyframe, params):
            self.go_to(len(self) + 1)
            return
        self.forget()
        if not self.known:
            self._begin(params)
        self._detector.take(keyframe)
        index, head = len(self), self._detector.head
        odometry = odometry_factor(index, head(index - 1), head(index), _drift(params)) if index else None
        self._step(odometry)
        found = Found()
        if params.enabled:
            complete = len(self) - 1 - self._start.submap_keyframes
            found = self._look(max(complete, self._detector.described), complete + 1, params)
        self._history.append(Record(params, found, odometry))
        self._learn(found)
        self._reach(self.known)

    def finish(self) -> None:
        """The session ends here: look for loops of the last keyframes too. `add` and `go_to` take that back."""
        if self._finished or not len(self):
            return
        count, params = len(self), self._history[len(self) - 1].params
        if count not in self._history.ends:
            self._history.ends[count] = (
                self._look(self._detector.described, count, params) if params.enabled else Found()
            )
        self._finished = True
        self._stand(count)
        self._reach(max(self.known + 1, self._edits.latest) if count == self.known else 0)
        self._tell_idle()

    def go_to(self, count: int) -> None:
        """Go to the state after `count` keyframes of the history. Raises HemislamError if it has fewer."""
        if not 0 <= count <= self.known:
            raise HemislamError(f"The loop search knows {self.known} keyframes and cannot go to {count}.")
        if self._finished or not len(self) <= count <= len(self) + 1:
            self._finished = False
            self._stand(count)
        elif count == len(self) + 1:  # as `_stand` would, but quicker
            found = self._history[len(self)].found
            self._step(self._history[len(self)].odometry)
            self._detector.learn(found.contexts)
            self._learn(found)
        self._resolve()

    def forget(self) -> None:
        """Forget the history beyond the present keyframe."""
        count = len(self)
        if count == self.known:
            return
        self._history.truncate(count)
        self._detector.forget()
        self._edits.cut(count, self._start.submap_keyframes)
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
        if self._edits.reach(reached):
            self._solve()
        self._resolve()

    def _begin(self, params: LoopsParams) -> None:
        self._detector.close()
        self._start, self._detector = params, Detector(params)

    def _stand(self, count: int) -> None:
        """Read from the history what was found with the first `count` keyframes, and solve."""
        self._detector.stand(count, self._history.contexts(count, finished=self._finished))
        self._found = {edge.pair: edge for edge in self._history.updates(count, finished=self._finished)}
        self._solve()

    def _is_known(self, keyframe: Keyframe, params: LoopsParams) -> bool:
        """Whether the history has this keyframe next, with the same parameters."""
        index = len(self)
        looked = index < self.known and self._history[index].params == params
        return looked and self._detector.head(index).same(Head.of(keyframe))

    def _step(self, odometry: Factor | None) -> None:
        """Add the next keyframe to the graph."""
        self._detector.go_on()
        self._by_pair = None
        if odometry is None:
            self._solution.begin(self._detector.poses[0], self._start.window)
        else:
            self._solution.extend(odometry)

    def _learn(self, found: Found) -> None:
        """Put into effect what was found with the newest keyframe."""
        self._found.update((edge.pair, edge) for edge in found.updates)
        self._by_pair, newest = None, len(self) - 1
        decided = [edge for edge in self.edges if edge.decided_at == newest]
        broken = self._solution.broken
        self._solution.close(self._loops(decided, self.by_pair))
        if self._solution.broken != broken:
            self._by_pair = None

    def _look(self, first: int, end: int, params: LoopsParams) -> Found:
        """Look for loops of the keyframes `first` to `end` - 1, without changing the graph."""
        keyframes = range(first, max(end, 0))
        return search(self._detector, keyframes, self._found, self._edges, self._solution.poses, _drift(params), params)

    # --- results --------------------------------------------------------------------------------
    @property
    def poses(self) -> F64:
        """(k, 4, 4) T_map_imu of all keyframes."""
        if not self._edits.solving:
            return self._solution.poses
        try:
            return self._optimum(self.edges)
        except HemislamError as error:
            if str(error) not in self._said:
                self._said.add(str(error))
                self._notices.append(str(error))
            return self._solution.poses

    @property
    def corrections(self) -> F64:
        """(k, 4, 4) T_map_odom at each keyframe; identity while odometry agrees with the loops."""
        if self._edits.solving or worth_correcting(self.edges, self._detector.poses):
            return self.corrections_of(self.poses)
        return np.tile(np.eye(4), (len(self), 1, 1))

    def corrections_of(self, poses: F64) -> F64:
        """(k, 4, 4) T_map_odom at each keyframe, for these T_map_imu."""
        return poses @ lie.inverse(self._detector.poses)

    @property
    def edges(self) -> tuple[LoopEdge, ...]:
        """All candidates as they count now, in the order of their keyframes."""
        return tuple(self.by_pair.values())

    @property
    def by_pair(self) -> Mapping[Pair, LoopEdge]:
        """The same, by pair. It is not changed later."""
        if self._by_pair is None:
            self._by_pair = self._edges(self._found)
        return self._by_pair

    def take_notices(self) -> tuple[str, ...]:
        """What went wrong since the last call, in sentences."""
        notices, self._notices = self._notices, []
        return (*self._solution.take_notices(), *notices)

    def factor_residuals(self) -> tuple[FactorResidual, ...]:
        """The residual of every factor of the graph, odometry first."""
        return inspection.residuals(self._factors(self.edges), self.poses)

    def detail(self, older: int, newer: int) -> LoopDetail:
        """What the inspector shows of two keyframes. Raises HemislamError if one does not exist."""
        self._check_there(older, newer)
        edge = self.by_pair.get((older, newer))
        measured = None if edge is None else edge.T_older_newer
        counts = edge is not None and edge.verdict is Verdict.ACCEPTED
        poses = self._detector.poses if counts else self.poses  # the graph already includes it
        return inspection.detail(self._detector, older, newer, poses, measured)

    def g2o(self) -> str:
        """The graph as the text of a g2o file."""
        return g2o_text(self.poses, self._factors(self.edges))

    # --- edits -----------------------------------------------------------------------------------
    @property
    def edits(self) -> Edits:
        """The user's edits, in force and undone."""
        return self._edits.edits

    @property
    def acting(self) -> int:
        """How many of those in force act already."""
        return self._edits.acting

    def apply(self, edit: LoopEdit) -> None:
        """Add an edit. Those undone before can no longer be redone. Raises HemislamError if it makes no sense."""
        check(edit)
        pair = pair_of(edit)
        if isinstance(edit, Add):
            there = edit.newer < len(self)
            if there and edit.guess is None:  # as it is now, so that it is the same when repeated
                edit = replace(edit, guess=rows(self._present(edit.older, edit.newer)))
        else:
            there = pair is None or pair in self.by_pair
        self._edits.give(self._fitting(self._entry(replace(edit, since=self._edits.reached if there else 0))))
        self._solve()
        if not there:
            self._notices.append(f"{in_words(edit)} waits until there is such a loop.")

    def load(self, edits: Edits) -> None:
        """Replace all edits. Raises HemislamError if one makes no sense, and then nothing has changed."""
        for edit in (*edits.done, *edits.undone):
            check(edit)
        if self._edits.load(edits):
            self._solve()
            self._resolve()

    def preview(self, edit: LoopEdit) -> Preview:
        """What the graph would become by a edit, without doing it.

        Raises:
            HemislamError: it makes no sense, or there is no such loop or keyframe yet.
        """
        check(edit)
        if not isinstance(edit, Solve):
            self._check_there(edit.older, edit.newer)
            if not isinstance(edit, Add) and pair_of(edit) not in self.by_pair:
                raise HemislamError(f"There is no loop candidate of keyframes {edit.older} and {edit.newer}.")
        edges = tuple(self._edges(self._found, self._fitting(self._entry(replace(edit, since=0)))).values())
        poses = self._optimum(edges)
        return Preview(poses, inspection.residuals(self._factors(edges), poses))

    def _entry(self, edit: LoopEdit) -> Entry:
        there = isinstance(edit, Add) and edit.newer < len(self)
        return Entry(edit, self._made(edit) if isinstance(edit, Add) and there else None)

    def _fitting(self, entry: Entry) -> Entry:
        """The same entry. Raises HemislamError if its registration found nothing in common."""
        edge = entry.added
        if edge is not None and isinstance(entry.edit, Add) and entry.edit.register and not edge.evidence.overlap:
            raise HemislamError(
                f"The surroundings of keyframes {edge.older} and {edge.newer} have nothing in common from there;"
                " nudge one nearer to where it belongs, or tie them without registration."
            )
        return entry

    def _made(self, edit: Add) -> LoopEdge:
        older, newer = edit.older, edit.newer
        guess = self._present(older, newer) if edit.guess is None else np.array(edit.guess, dtype=np.float64)
        return by_hand(older, newer, self._detector, guess, register=edit.register)

    def _present(self, older: int, newer: int) -> F64:
        """(4, 4) T_older_newer as the graph has it."""
        poses = self.poses
        return np.asarray(lie.inverse(poses[older]) @ poses[newer])

    def _resolve(self) -> None:
        """Make the loops by hand whose keyframes now exist."""
        count = len(self)
        complete = count if self._finished else count - self._start.submap_keyframes
        if self._edits.resolve(count, complete, self._made):
            self._solve()

    def _tell_idle(self) -> None:
        """At the end, report each edit without effect once."""
        idle = [in_words(entry.edit) for entry in self._edits if entry.pair and entry.pair not in self.by_pair]
        new = [words for words in idle if words not in self._idle]
        self._notices += [f"{words} has no effect: there is no such loop; loops.csv lists all." for words in new]
        self._idle = set(idle)

    def _check_there(self, older: int, newer: int) -> None:
        if not 0 <= older < newer < len(self):
            raise HemislamError(
                f"Keyframes {older} and {newer} cannot be compared; choose an older and a newer one of the"
                f" {len(self)} there are."
            )

    # --- the graph -------------------------------------------------------------------------------
    def _edges(self, found: dict[Pair, LoopEdge], extra: Entry | None = None) -> dict[Pair, LoopEdge]:
        edges = self._edits.lay_over(found, len(self), extra)
        for pair in self._solution.broken & edges.keys():
            edges[pair] = replace(edges[pair], verdict=Verdict.REJECTED, reason="the solver failed with it")
        return edges

    def _solve(self) -> None:
        """Solve the graph again, in the order in which keyframes and loops came."""
        self._by_pair = None
        if not len(self):
            self._solution.clear()
            return
        edges = self._edits.lay_over(self._found, len(self))
        arrivals: dict[int, list[LoopEdge]] = {}
        for edge in edges.values():
            if edge.counts:
                arrivals.setdefault(edge.decided_at, []).append(edge)
        loops = {index: self._loops(arrived, edges) for index, arrived in arrivals.items()}
        steps = self._history.steps(len(self), loops)
        self._solution.solve(self._detector.poses[0], self._start.window, steps)

    def _factors(self, edges: tuple[LoopEdge, ...]) -> list[Factor]:
        by_pair = {edge.pair: edge for edge in edges}
        return self._history.odometry(len(self)) + self._loops(edges, by_pair)

    def _loops(self, edges: Iterable[LoopEdge], by_pair: Mapping[Pair, LoopEdge]) -> list[Factor]:
        return loop_factors(edges, by_pair, self._detector.poses, window=self._start.window)

    def _optimum(self, edges: tuple[LoopEdge, ...]) -> F64:
        """(k, 4, 4) T_map_imu by all factors at once. Raises HemislamError if the solver fails."""
        poses = self._solution.poses
        if len(poses) < 2:
            return poses
        try:
            return optimise(poses[0], self._factors(edges), poses)
        except ArithmeticError as error:
            raise HemislamError(f"The solver fails with this graph ({error}); reject the loop added last.") from error


def _drift(params: LoopsParams) -> Drift:
    return Drift(params.drift_translation / 100, np.radians(params.drift_rotation))
