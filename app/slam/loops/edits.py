"""The user's commands: a list that lies over whatever was found, and of which any number can be undone.

A command is for a pair of keyframes, whether the pair was found already or not. One that finds
nothing to act on waits, so that a list of commands may be given before the walk begins.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from app.slam.errors import HemislamError
from app.slam.loops.types import Accept, Add, LoopEdge, LoopEdit, Origin, Pair, SetWeight, Solve, Verdict, pair_of
from app.slam.types import F64


@dataclass(frozen=True, slots=True)
class Entry:
    """A command, and for Add the loop that it came to; None as long as it waits for its keyframes."""

    command: LoopEdit
    added: LoopEdge | None = None

    @property
    def pair(self) -> Pair | None:
        return pair_of(self.command)


class EditList:
    """Commands in force, and those taken back.

    Attributes:
        reached: keyframes that the walk ever had, and one more after its end, to hold against `since`.
    """

    def __init__(self) -> None:
        self.reached = 0
        self._done: list[Entry] = []
        self._undone: list[Entry] = []
        self._used = False  # ever: what was found meanwhile may be placed by loops that no longer count

    def __iter__(self) -> Iterator[Entry]:
        return iter(self._done)

    @property
    def commands(self) -> tuple[LoopEdit, ...]:
        """In force, in order."""
        return tuple(entry.command for entry in self._done)

    @property
    def undone(self) -> tuple[LoopEdit, ...]:
        """Those that `redo` would give again, the next one last."""
        return tuple(entry.command for entry in self._undone)

    @property
    def solving(self) -> bool:
        """Whether poses are those of all factors solved at once."""
        return any(isinstance(entry.command, Solve) and entry.command.since <= self.reached for entry in self._done)

    @property
    def latest(self) -> int:
        """The greatest `since`; of a list from a walk that had more keyframes it may lie beyond the end."""
        return max((entry.command.since for entry in [*self._done, *self._undone]), default=0)

    def give(self, entry: Entry) -> None:
        self._done.append(entry)
        self._undone.clear()
        self._used = True

    def reach(self, reached: int) -> bool:
        """The walk has come on. Returns whether commands act from now on that did not before."""
        before, self.reached = self.reached, max(self.reached, reached)
        return any(before < entry.command.since <= reached for entry in self._done)

    def load(self, commands: tuple[LoopEdit, ...], undone: tuple[LoopEdit, ...]) -> None:
        self._done = [Entry(command) for command in commands]
        self._undone = [Entry(command) for command in undone]
        self._used = self._used or bool(commands)

    def undo(self) -> None:
        """Raises HemislamError if there is nothing to undo."""
        if not self._done:
            raise HemislamError("There is no edit to undo.")
        self._undone.append(self._done.pop())

    def redo(self) -> None:
        """Raises HemislamError if there is nothing to redo."""
        if not self._undone:
            raise HemislamError("There is no edit to redo.")
        self._done.append(self._undone.pop())

    def resolve(self, count: int, complete: int, make: Callable[[Add], LoopEdge]) -> bool:
        """Make the loops by hand that wait for their keyframes, where these are there.

        Args:
            count: keyframes there are. complete: how many of them have complete surroundings; commands
                given from the start wait for those, others were given without.

        Returns:
            Whether there were any.
        """
        before = self._done

        def resolved(entry: Entry) -> Entry:
            command = entry.command
            if not isinstance(command, Add) or entry.added is not None or command.since > self.reached:
                return entry
            there = command.newer < (count if command.since else complete)
            return replace(entry, added=make(command)) if there else entry

        self._done = [resolved(entry) for entry in before]
        return any(new is not old for new, old in zip(self._done, before, strict=True))

    def go_back(self, reached: int, lost: Callable[[Pair], bool]) -> None:
        """Keyframes were forgotten: commands go on acting, but loops by hand that lost theirs wait for others."""
        self.reached = reached

        def kept(entry: Entry) -> Entry:
            if entry.pair is not None and lost(entry.pair):
                return Entry(replace(entry.command, since=0))
            return replace(entry, command=replace(entry.command, since=min(entry.command.since, reached)))

        self._done, self._undone = [kept(e) for e in self._done], [kept(e) for e in self._undone]

    def lay_over(self, found: Mapping[Pair, LoopEdge], count: int, extra: Entry | None = None) -> dict[Pair, LoopEdge]:
        """What was found, as it counts with the commands, and with one more if there is one.

        Args:
            count: keyframes there are; loops by hand beyond them do not count.
        """
        entries = [*self._done, *([extra] if extra else [])]
        if not (self._used or entries):
            return {pair: found[pair] for pair in sorted(found)}
        edges = dict(found)
        for entry in entries:
            pair = entry.pair
            if pair is None or entry.command.since > self.reached:
                continue
            if entry.added is not None:
                if entry.added.newer < count:
                    edges[pair] = entry.added
            elif pair in edges:
                edges[pair] = _edited(edges[pair], entry.command)
        return {pair: _standing(edges[pair], edges) for pair in sorted(edges)}


def check(command: LoopEdit) -> None:
    """Raises HemislamError if the command can never make sense, whatever is found."""
    if isinstance(command, Solve):
        return
    older, newer = command.older, command.newer
    if not 0 <= older < newer:
        raise HemislamError(f"Keyframes {older} and {newer} can not be tied together; name an older and a newer one.")
    if isinstance(command, SetWeight) and not (np.isfinite(command.weight) and command.weight > 0):
        raise HemislamError(f"A loop's weight can not be {command.weight:g}; it must be greater than 0.")
    if isinstance(command, Add) and command.guess is not None:
        lengths = {len(row) for row in command.guess}
        if len(command.guess) != 4 or lengths != {4} or not np.isfinite(command.guess).all():
            raise HemislamError("The guess of a loop must be a 4x4 matrix T_older_newer of finite numbers.")
        if not _is_rigid(np.array(command.guess)):
            raise HemislamError("The guess of a loop must be a rotation and a position: a rigid 4x4 T_older_newer.")


def _is_rigid(T: F64) -> bool:
    """As exactly as numbers are written that people pass on."""
    R = T[:3, :3]
    return bool(np.allclose(R @ R.T, np.eye(3), atol=1e-3) and np.linalg.det(R) > 0 and np.allclose(T[3], (0, 0, 0, 1)))


def in_words(command: LoopEdit) -> str:
    """A command's name and pair, to begin a sentence with."""
    pair = pair_of(command)
    return f"{type(command).__name__} {pair[0]}-{pair[1]}" if pair else type(command).__name__


def _edited(edge: LoopEdge, command: LoopEdit) -> LoopEdge:
    edge = replace(edge, represented_by=None, repeats=None)  # what the user has a word on is in the graph itself
    if isinstance(command, SetWeight):
        return replace(edge, weight=command.weight)
    if isinstance(command, Add | Solve):  # one that waits; one that is for no loop
        return edge
    verdict = Verdict.ACCEPTED if isinstance(command, Accept) else Verdict.REJECTED
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
