"""The loop back end: keyframes in, loops and corrected poses out. Synchronous and deterministic.

There are two layers. The loops that were found are the history (`search`); the user's edits override them and belong to
the present. The graph is a function of both, so it does not matter when an edit was made, and undoing an edit is the
same as never having made it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.edits import Add, Edits, LoopEdit, Solve, apply_edits, check, in_words, rows
from app.slam.loops.factors import Closing, PositionPrior, residuals
from app.slam.loops.messages import (
    Added,
    Answer,
    Answered,
    ApplyEdit,
    Ask,
    AskG2o,
    AskResiduals,
    Failure,
    Inspect,
    LoopState,
    Reply,
    Request,
    Target,
    TryOut,
)
from app.slam.loops.pose_graph import Graph, failure, optimum
from app.slam.loops.search import Search
from app.slam.loops.solvers import g2o_text
from app.slam.loops.types import FactorResidual, LoopDetail, LoopEdge, Pair, Preview, Verdict
from app.slam.loops.verdicts import by_hand
from app.slam.sections import LoopsParams
from app.slam.types import F64, Keyframe


class LoopBackend:
    """Finds loops among the keyframes of one session and corrects their poses (paper 2.4).

    It keeps a thinned cloud of every keyframe on disk until `close`.

    Attributes:
        edits: the user's, in force and undone.
    """

    def __init__(self) -> None:
        self.edits = Edits()
        self._search = Search()
        self._edited = self._search.graph  # with the edits; without any, the search's own graph
        self._made: dict[tuple[Add, int], LoopEdge] = {}  # loops by hand, by the last keyframe that they depend on
        self._state: tuple[F64, dict[Pair, LoopEdge]] | None = None  # poses and loops; None: not up to date
        self._notices: list[str] = []
        self._said: set[str] = set()  # all notices given so far

    def __len__(self) -> int:
        return len(self._search)

    @property
    def known(self) -> int:
        """Number of keyframes of the history, including those beyond the present one."""
        return self._search.known

    @property
    def finished(self) -> bool:
        return self._search.finished

    def close(self) -> None:
        self._search.close()

    # --- the session -----------------------------------------------------------------------------
    def add(self, keyframe: Keyframe, params: LoopsParams, priors: tuple[PositionPrior, ...] = ()) -> None:
        """As `Search.add`."""
        self._state = None
        self._made = {key: edge for key, edge in self._made.items() if key[1] < keyframe.index}
        self._search.add(keyframe, params, priors)
        if len(self) < 2:
            self._edited = Graph(self._odometry[0], self._search.start.window)  # the first keyframe is another one

    def finish(self) -> None:
        """The session ends here: look for loops of the last keyframes too. `add` and `go_to` take that back."""
        self._state = None
        self._search.finish()
        for edit in self.edits.done:
            if edit.pair and edit.pair not in self.by_pair:
                self._say(f"{in_words(edit)} has no effect: there is no such loop; loops.csv lists all.")

    def go_to(self, count: int) -> None:
        """Go to the state after `count` keyframes of the history. Raises HemislamError if it has fewer."""
        self._state = None
        self._search.go_to(count)

    def forget(self) -> None:
        """Forget the history beyond the present keyframe."""
        self._search.forget()

    # --- requests --------------------------------------------------------------------------------
    def handle(self, request: Request) -> Reply:
        """The reply to a request. One that cannot be met gives a `Failure`, never an exception."""
        if isinstance(request, Ask):
            return self.answer(request)
        try:
            self.add(request.keyframe, request.params)
            return Added(len(self))
        except HemislamError as error:
            return Failure(str(error))

    def answer(self, ask: Ask) -> Answer:
        """The answer to a question; a `Failure` if it cannot be done."""
        question = ask.question
        try:
            self._go_to_target(ask.target)
            match question:
                case TryOut(edit):
                    return Answered(question, self.preview(edit))
                case Inspect(older, newer):
                    return Answered(question, self.detail(older, newer))
                case AskResiduals():
                    return Answered(question, self.factor_residuals())
                case AskG2o():
                    return Answered(question, self.g2o())
                case ApplyEdit(edit):
                    self.apply(edit)
        except HemislamError as error:
            return Failure(str(error))
        return LoopState(
            count=len(self),
            finished=self.finished,
            corrections=self.corrections,
            edges=self.edges,
            undo=self.edits.done,
            redo=self.edits.undone,
            notices=self.take_notices(),
        )

    def _go_to_target(self, target: Target) -> None:
        """Go to a state. Raises as `load`, and then nothing has changed."""
        self.load(target.edits)
        count = min(target.count, self.known)
        if (count, target.finished) != (len(self), self.finished):
            self.go_to(count)
            if target.finished:
                self.finish()

    # --- results --------------------------------------------------------------------------------
    @property
    def poses(self) -> F64:
        """(k, 4, 4) T_map_imu of all keyframes."""
        poses, edges = self._solved()
        if Solve() in self.edits.done:
            try:
                return optimum(poses, self._factors(edges))
            except HemislamError as error:
                self._say(str(error))
        return poses

    @property
    def corrections(self) -> F64:
        """(k, 4, 4) T_map_odom at each keyframe, read-only; identity while nothing corrects odometry."""
        corrections = np.tile(np.eye(4), (len(self), 1, 1))
        measured = any(measured.priors for measured in self._search.measured)
        if measured or Solve() in self.edits.done or any(edge.counts for edge in self.edges):
            corrections = np.asarray(self.poses @ lie.inverse(self._odometry))
        corrections.setflags(write=False)
        return corrections

    @property
    def edges(self) -> tuple[LoopEdge, ...]:
        """All candidates with their present verdicts, in the order of their keyframes."""
        return tuple(self.by_pair.values())

    @property
    def by_pair(self) -> Mapping[Pair, LoopEdge]:
        """The same, by pair. This mapping is never changed later."""
        return self._solved()[1]

    def take_notices(self) -> tuple[str, ...]:
        """What went wrong since the last call, in sentences. Each sentence is reported once."""
        notices, self._notices = self._notices, []
        return tuple(notices)

    def factor_residuals(self) -> tuple[FactorResidual, ...]:
        """The residual of every factor of the graph, odometry first."""
        return residuals(self._factors(self.by_pair), self.poses)

    def detail(self, older: KeyframeId, newer: KeyframeId) -> LoopDetail:
        """What the inspector shows of two keyframes. Raises HemislamError if one does not exist."""
        self._check_there(older, newer)
        edge = self.by_pair.get((older, newer))
        measured = None if edge is None else edge.T_older_newer
        counts = edge is not None and edge.verdict is Verdict.ACCEPTED
        poses = self._odometry if counts else self.poses  # the graph already includes it
        return self._search.detector.detail(older, newer, poses, measured)

    def g2o(self) -> str:
        """The graph as the text of a g2o file."""
        return g2o_text(self.poses, self._factors(self.by_pair))

    # --- edits -----------------------------------------------------------------------------------
    def apply(self, edit: LoopEdit) -> None:
        """Add an edit. Those undone before can no longer be redone. Raises HemislamError if it makes no sense."""
        edit = self._ready(edit)
        self.load(Edits((*self.edits.done, edit)))
        if edit.pair and edit.pair not in self.by_pair:
            self._notices.append(f"{in_words(edit)} waits until there is such a loop.")

    def load(self, edits: Edits) -> None:
        """Replace all edits. Raises HemislamError if one makes no sense, and then nothing has changed."""
        for edit in (*edits.done, *edits.undone):
            check(edit)
        if edits.done != self.edits.done:
            self._state = None
        self.edits = edits
        known = {*edits.done, *edits.undone}
        self._made = {key: edge for key, edge in self._made.items() if key[0] in known}

    def preview(self, edit: LoopEdit) -> Preview:
        """What the graph would become with an edit, without applying it.

        Raises:
            HemislamError: it makes no sense, or there is no such loop or keyframe yet.
        """
        edit = self._ready(edit)
        if edit.pair:
            older, newer = edit.pair
            self._check_there(older, newer)
            if not isinstance(edit, Add) and edit.pair not in self.by_pair:
                raise HemislamError(f"There is no loop candidate of keyframes {older} and {newer}.")
        factors = self._factors(self._edited.sound(self._with_edits((*self.edits.done, edit))))
        poses = optimum(self._solved()[0], factors)
        return Preview(poses, residuals(factors, poses))

    def _ready(self, edit: LoopEdit) -> LoopEdit:
        """The edit, with the present guess if it adds a loop without one, so that repeating it gives the same.

        Raises HemislamError if it makes no sense, or adds a loop whose registration finds nothing in common.
        """
        check(edit)
        if isinstance(edit, Add) and edit.newer < len(self):
            if edit.guess is None:
                edit = replace(edit, guess=rows(self._present(edit.older, edit.newer)))
            if edit.register and not self._make(edit).evidence.overlap:
                raise HemislamError(
                    f"The surroundings of keyframes {edit.older} and {edit.newer} have nothing in common from there;"
                    " nudge one nearer to where it belongs, or tie them without registration."
                )
        return edit

    def _make(self, edit: Add) -> LoopEdge:
        """The loop by hand between existing keyframes, registered by as much of their surroundings as there is."""
        detector = self._search.detector
        key = edit, min(edit.newer + detector.ahead, len(self) - 1)
        if key not in self._made:
            self._made[key] = by_hand(edit, detector, self._search.start)
        return self._made[key]

    def _present(self, older: int, newer: int) -> F64:
        """(4, 4) T_older_newer according to the graph."""
        poses = self.poses
        return np.asarray(lie.inverse(poses[older]) @ poses[newer])

    def _check_there(self, older: int, newer: int) -> None:
        if not 0 <= older < newer < len(self):
            raise HemislamError(
                f"Keyframes {older} and {newer} cannot be compared; choose an older and a newer one of the"
                f" {len(self)} there are."
            )

    # --- the graph -------------------------------------------------------------------------------
    @property
    def _odometry(self) -> F64:
        """(k, 4, 4) T_odom_imu."""
        return self._search.detector.poses

    def _with_edits(self, edits: Iterable[LoopEdit]) -> dict[Pair, LoopEdge]:
        """The loops found, with the edits applied."""
        made = {edit: self._make(edit) for edit in edits if isinstance(edit, Add) and edit.newer < len(self)}
        return apply_edits(self._search.found, edits, made)

    def _solved(self) -> tuple[F64, dict[Pair, LoopEdge]]:
        """(k, 4, 4) T_map_imu by the incremental solver, and the loops with their present verdicts."""
        if self._state is None:
            edges = self._with_edits(self.edits.done)
            graph = self._edited if self.edits.done else self._search.graph
            poses = graph.solve(self._search.measured, edges, self._odometry)
            self._state = poses, graph.sound(edges)
            for factor in graph.failed:
                self._say(failure(factor))
        return self._state

    def _factors(self, edges: Mapping[Pair, LoopEdge]) -> list[Closing]:
        """All factors of the graph."""
        return self._edited.factors(self._search.measured, edges, self._odometry)

    def _say(self, notice: str) -> None:
        if notice not in self._said:
            self._said.add(notice)
            self._notices.append(notice)
