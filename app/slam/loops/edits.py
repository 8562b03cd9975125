"""The user's edits: a list that lies over whatever was found, and of which any number can be undone.

An edit names a pair of keyframes, whether that pair was found already or not. An edit without a loop to act on waits
for it, so a list of edits can be given before the session begins.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from app.slam.errors import HemislamError
from app.slam.loops.types import Accept, Add, LoopEdge, LoopEdit, Origin, Pair, SetWeight, Solve, Verdict
from app.slam.types import F64


def lay_over(
    found: Mapping[Pair, LoopEdge], edits: Iterable[LoopEdit], made: Mapping[Add, LoopEdge], count: int
) -> dict[Pair, LoopEdge]:
    """What was found, as it counts with the edits.

    Args:
        made: the loops by hand; an Add without one waits for its keyframes. count: number of keyframes; loops by hand
            beyond them do not count.
    """
    edges = dict(found)
    for edit in edits:
        if isinstance(edit, Add) and edit in made:
            if edit.newer < count:
                edges[edit.pair] = made[edit]
        elif edit.pair is not None and edit.pair in edges:
            edges[edit.pair] = _edited(edges[edit.pair], edit)
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
