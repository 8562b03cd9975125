"""The user's edits: a list that overrides whatever was found. Any number of them can be undone.

An edit names a pair of keyframes, whether that pair was found already or not. An edit without a loop to act on waits
for it, so a list of edits can be given before the session begins.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from app.slam.arrays import F64
from app.slam.errors import HemislamError
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.types import LoopEdge, Origin, Pair, Verdict


@dataclass(frozen=True, slots=True)
class _Edit:
    @property
    def pair(self) -> Pair | None:
        """The loop that it edits; None if it concerns the graph or a fix instead."""
        return None


@dataclass(frozen=True, slots=True)
class _PairEdit(_Edit):
    older: KeyframeId
    newer: KeyframeId

    @property
    def pair(self) -> Pair:
        return self.older, self.newer


@dataclass(frozen=True, slots=True)
class Accept(_PairEdit):
    """Make a candidate a factor of the graph, whatever its verdict."""


@dataclass(frozen=True, slots=True)
class Reject(_PairEdit):
    """Take a loop out of the graph."""


@dataclass(frozen=True, slots=True)
class SetWeight(_PairEdit):
    """Divide a loop's covariance by `weight` (> 0); 1 leaves it as registered."""

    weight: float


@dataclass(frozen=True, slots=True)
class Add(_PairEdit):
    """Tie two keyframes together by hand.

    Attributes:
        guess: (4, 4) T_older_newer of the IMU frames from which their submaps are registered;
            None: searched from where odometry places them. Rows of numbers, so that edits can be compared.
        register: False takes the guess as it is.
    """

    guess: tuple[tuple[float, ...], ...] | None = None
    register: bool = True


@dataclass(frozen=True, slots=True)
class Solve(_Edit):
    """Take the poses from all factors solved at once (Levenberg-Marquardt).

    They differ from the incremental poses if these only came near the optimum, or if the solver has a window.
    """


@dataclass(frozen=True, slots=True)
class Override(_Edit):
    """Count or leave out a fix or control point that georeferences the map, whatever its residual. Loops stay the same.

    Attributes:
        what: "fix 12" or "point P1", as the table of residuals names them.
    """

    what: str
    accepted: bool


LoopEdit = Accept | Reject | SetWeight | Add | Solve | Override


@dataclass(frozen=True, slots=True)
class Edits:
    """The user's edits in force, in order, and those undone, of which the last is the next to redo."""

    done: tuple[LoopEdit, ...] = ()
    undone: tuple[LoopEdit, ...] = ()

    def undo(self) -> "Edits":
        """Raises HemislamError if there is nothing to undo."""
        if not self.done:
            raise HemislamError("There is no edit to undo.")
        return Edits(self.done[:-1], (*self.undone, self.done[-1]))

    def redo(self) -> "Edits":
        """Raises HemislamError if there is nothing to redo."""
        if not self.undone:
            raise HemislamError("There is no edit to redo.")
        return Edits((*self.done, self.undone[-1]), self.undone[:-1])

    def among(self, count: int) -> "Edits":
        """The edits that name only the first `count` keyframes."""

        def kept(edits: tuple[LoopEdit, ...]) -> tuple[LoopEdit, ...]:
            return tuple(edit for edit in edits if edit.pair is None or edit.pair[1].index < count)

        return Edits(kept(self.done), kept(self.undone))


def rows(T: F64) -> tuple[tuple[float, ...], ...]:
    """A matrix as an edit holds it."""
    return tuple(tuple(float(value) for value in row) for row in np.asarray(T))


def apply_edits(
    found: Mapping[Pair, LoopEdge], edits: Iterable[LoopEdit], made: Mapping[Add, LoopEdge]
) -> dict[Pair, LoopEdge]:
    """The loops found, with the edits applied, sorted by pair.

    Args:
        made: the loops by hand; an Add without one waits for its keyframes.
    """
    edges = dict(found)
    for edit in edits:
        if isinstance(edit, Add) and edit in made:
            edges[edit.pair] = made[edit]
        elif edit.pair is not None and edit.pair in edges:
            edges[edit.pair] = _edited(edges[edit.pair], edit)
    return {pair: _standing(edges[pair], edges) for pair in sorted(edges)}


def check(edit: LoopEdit) -> None:
    """Raises HemislamError if the edit can never make sense, whatever is found."""
    if isinstance(edit, Solve | Override):
        return
    older, newer = edit.older, edit.newer
    if not 0 <= older < newer:
        raise HemislamError(f"Keyframes {older} and {newer} cannot be tied together; name an older and a newer one.")
    if isinstance(edit, SetWeight) and not (np.isfinite(edit.weight) and edit.weight > 0):
        raise HemislamError(f"A loop's weight cannot be {edit.weight:g}; it must be greater than 0.")
    if isinstance(edit, Add) and edit.guess is not None:
        if [len(row) for row in edit.guess] != [4] * 4 or not np.isfinite(edit.guess).all():
            raise HemislamError("The guess of a loop must be a 4x4 matrix T_older_newer of finite numbers.")
        if not _is_rigid(np.array(edit.guess)):
            raise HemislamError("The guess of a loop must be a rigid 4x4 transform: a rotation and a position.")


def _is_rigid(T: F64) -> bool:
    """Whether a matrix is a rigid transform, within the rounding of numbers written as text."""
    R = T[:3, :3]
    return bool(np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0 and np.allclose(T[3], (0, 0, 0, 1)))


def in_words(edit: LoopEdit) -> str:
    """An edit's name and pair, to begin a sentence with."""
    pair = edit.pair
    return f"{type(edit).__name__} {pair[0]}-{pair[1]}" if pair else type(edit).__name__


_FOUND: Final = {
    Verdict.ACCEPTED: "accepted it",
    Verdict.REJECTED: "rejected it",
    Verdict.CANDIDATE: "left it undecided",
}


def _edited(edge: LoopEdge, edit: LoopEdit) -> LoopEdge:
    edge = replace(edge, represented_by=None, repeats=None)  # a loop that the user edited enters the graph itself
    if isinstance(edit, SetWeight):
        return replace(edge, weight=edit.weight)
    if isinstance(edit, Add | Solve | Override):  # one that waits; those that are for no loop
        return edge
    verdict = Verdict.ACCEPTED if isinstance(edit, Accept) else Verdict.REJECTED
    if verdict is edge.verdict:
        return replace(edge, edited=True)
    reason = f"{verdict} manually; the search {_FOUND[edge.verdict]}: {edge.reason}"
    return replace(edge, verdict=verdict, edited=True, reason=reason)


def _standing(edge: LoopEdge, edges: Mapping[Pair, LoopEdge]) -> LoopEdge:
    """The same loop. It enters the graph itself if the loop that represents it, or that it repeats, is no longer there.

    No loop repeats one that was added by hand: that is the user's decision and must not be outvoted.
    """
    if edge.repeats is not None:
        tie = edges.get(edge.repeats)
        stands = tie is not None and tie.origin is Origin.DETECTED and tie.repeats is None
        if not stands or _counting(edge.repeats, edges) != edge.repeats:
            return replace(edge, repeats=None)
    first = _counting(edge.represented_by, edges)
    return edge if first == edge.represented_by else replace(edge, represented_by=first)


def _counting(pair: Pair | None, edges: Mapping[Pair, LoopEdge]) -> Pair | None:
    """The loop that counts in place of `pair`: by now, another loop may represent it. None if there is none."""
    edge = None if pair is None else edges.get(pair)
    if edge is None or edge.verdict is not Verdict.ACCEPTED:
        return None
    return _counting(edge.represented_by, edges) or pair
