"""The user's edits: a list that lies over whatever was found, and of which any number can be undone.

An edit names a pair of keyframes, whether that pair was found already or not. An edit without a loop to act on waits
for it, so a list of edits can be given before the session begins.
"""

import operator
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from app.slam.errors import HemislamError
from app.slam.loops.types import (
    Accept,
    Add,
    Edits,
    LoopEdge,
    LoopEdit,
    Origin,
    Pair,
    SetWeight,
    Solve,
    Verdict,
    loses,
)
from app.slam.types import F64


@dataclass(frozen=True, slots=True)
class EditEntry:
    """An edit, and the loop that an Add made; None while it waits for its keyframes."""

    edit: LoopEdit
    added: LoopEdge | None = None


class EditList:
    """The edits in force and those undone, with the loops that they added.

    Attributes:
        reached: how many keyframes the session ever had, one more after its end. An edit acts if its `since` is not
            greater.
    """

    def __init__(self) -> None:
        self.reached = 0
        self._done: list[EditEntry] = []
        self._undone: list[EditEntry] = []

    def __iter__(self) -> Iterator[EditEntry]:
        return iter(self._done)

    @property
    def edits(self) -> Edits:
        return Edits(tuple(entry.edit for entry in self._done), tuple(entry.edit for entry in self._undone))

    @property
    def acting(self) -> int:
        """How many edits in force act already."""
        return sum(entry.edit.since <= self.reached for entry in self._done)

    @property
    def solving(self) -> bool:
        """Whether poses are those of all factors solved at once."""
        return any(isinstance(entry.edit, Solve) and entry.edit.since <= self.reached for entry in self._done)

    @property
    def latest(self) -> int:
        """The greatest `since`; in edits of a session with more keyframes it may lie beyond the end."""
        return max((entry.edit.since for entry in [*self._done, *self._undone]), default=0)

    def give(self, entry: EditEntry) -> None:
        self._done.append(entry)
        self._undone.clear()

    def reach(self, reached: int) -> bool:
        """The session has come this far. Returns whether edits act from now on that did not before."""
        before, self.reached = self.reached, max(self.reached, reached)
        return any(before < entry.edit.since <= reached for entry in self._done)

    def load(self, edits: Edits) -> bool:
        """Replace all edits; loops that were added by those that stay are kept. Returns whether anything changed."""
        known = {entry.edit: entry for entry in [*self._undone, *self._done]}  # whatever their `since`

        def entry_of(edit: LoopEdit) -> EditEntry:
            entry = known.get(edit, EditEntry(edit))
            return entry if entry.edit.since == edit.since else replace(entry, edit=edit)

        before, self._done = self._done, [entry_of(edit) for edit in edits.done]
        self._undone = [entry_of(edit) for edit in edits.undone]
        same = len(before) == len(self._done) and all(map(operator.is_, before, self._done))
        return not same

    def resolve(self, count: int, complete: int, make: Callable[[Add], LoopEdge]) -> bool:
        """Make the loops by hand that wait for their keyframes, where these are there.

        Args:
            count: keyframes there are. complete: how many of them have complete surroundings; edits
                given from the start wait for those, others were given without.

        Returns:
            Whether there were any.
        """
        before = self._done

        def resolved(entry: EditEntry) -> EditEntry:
            edit = entry.edit
            if not isinstance(edit, Add) or entry.added is not None or edit.since > self.reached:
                return entry
            there = edit.newer < (count if edit.since else complete)
            return replace(entry, added=make(edit)) if there else entry

        self._done = [resolved(entry) for entry in before]
        return any(new is not old for new, old in zip(self._done, before, strict=True))

    def cut(self, count: int, half: int) -> None:
        """All keyframes but the first `count` were forgotten; see `Edits.cut`."""
        self.load(self.edits.cut(count, half))
        self.reached = count
        self._done, self._undone = (
            [replace(entry, added=None) if loses(entry.edit, count, half) else entry for entry in entries]
            for entries in (self._done, self._undone)
        )

    def lay_over(
        self, found: Mapping[Pair, LoopEdge], count: int, extra: EditEntry | None = None
    ) -> dict[Pair, LoopEdge]:
        """What was found, as it counts with the edits, and with one more if given.

        Args:
            count: number of keyframes; loops by hand beyond them do not count.
        """
        entries = [*self._done, *([extra] if extra else [])]
        edges = dict(found)
        for entry in entries:
            pair = entry.edit.pair
            if pair is None or entry.edit.since > self.reached:
                continue
            if entry.added is not None:
                if entry.added.newer < count:
                    edges[pair] = entry.added
            elif pair in edges:
                edges[pair] = _edited(edges[pair], entry.edit)
        return {pair: _standing(edges[pair], edges) for pair in sorted(edges)}


def check(edit: LoopEdit) -> None:
    """Raises HemislamError if the edit can never make sense, whatever is found."""
    if isinstance(edit, Solve):
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
    """As exactly as numbers are written that people pass on."""
    R = T[:3, :3]
    return bool(np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0 and np.allclose(T[3], (0, 0, 0, 1)))


def in_words(edit: LoopEdit) -> str:
    """An edit's name and pair, to begin a sentence with."""
    pair = edit.pair
    return f"{type(edit).__name__} {pair[0]}-{pair[1]}" if pair else type(edit).__name__


def _edited(edge: LoopEdge, edit: LoopEdit) -> LoopEdge:
    edge = replace(edge, represented_by=None, repeats=None)  # what the user has a word on is in the graph itself
    if isinstance(edit, SetWeight):
        return replace(edge, weight=edit.weight)
    if isinstance(edit, Add | Solve):  # one that waits; one that is for no loop
        return edge
    verdict = Verdict.ACCEPTED if isinstance(edit, Accept) else Verdict.REJECTED
    if verdict is edge.verdict:
        return replace(edge, edited=True)
    reason = f"{verdict} by hand; found {edge.verdict}: {edge.reason}"
    return replace(edge, verdict=verdict, edited=True, reason=reason)


def _standing(edge: LoopEdge, edges: Mapping[Pair, LoopEdge]) -> LoopEdge:
    """The same; in the graph itself if the one that was there for it, or that it repeats, no longer is.

    A loop by hand is repeated by none: it is the user's word, and not to be outvoted.
    """
    if edge.repeats is not None:
        tie = edges.get(edge.repeats)
        stands = tie is not None and tie.origin is Origin.DETECTED and tie.repeats is None
        if not stands or _counting(edge.repeats, edges) != edge.repeats:
            return replace(edge, repeats=None)
    first = _counting(edge.represented_by, edges)
    return edge if first == edge.represented_by else replace(edge, represented_by=first)


def _counting(pair: Pair | None, edges: Mapping[Pair, LoopEdge]) -> Pair | None:
    """The loop that counts where this one was to stand for others: it may have one that stands for it by now."""
    edge = None if pair is None else edges.get(pair)
    if edge is None or edge.verdict is not Verdict.ACCEPTED:
        return None
    return _counting(edge.represented_by, edges) or pair
