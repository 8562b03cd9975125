"""Loop edits as a file: a list in YAML, for `hemislam run --loops edits.yaml`.

    - accept: [12, 340]
    - reject: [3, 40]
    - weigh: [12, 340]
      weight: 2.5
    - add: [5, 300]
      register: false
      guess: [[1.0, 0.0, 0.0, 0.2], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    - solve: at once

A loop is named by its older and its newer keyframe. `guess` is T_older_newer of the IMU frames; without it, the graph's
present one is used. `register` is true by default. `solve: at once` takes the poses from all factors at once
(Levenberg-Marquardt) instead of one after the other. Any entry may have `since`: the number of keyframes from which
on it acts; by default it acts from the start.
"""

from collections.abc import Iterable
from dataclasses import fields
from typing import Any, Final

import numpy as np
import yaml

from app.slam.errors import HemislamError
from app.slam.loops.edits import check
from app.slam.loops.types import Accept, Add, LoopEdit, Pair, Reject, SetWeight, Solve, rows
from app.slam.user_text import read_yaml

_VERBS: Final[dict[str, type[LoopEdit]]] = {
    "accept": Accept, "reject": Reject, "weigh": SetWeight, "add": Add, "solve": Solve
}  # fmt: skip
_AT_ONCE: Final = "at once"
_HEAD: Final = "# Edits of loops, in their order: hemislam run RECORDING --loops THIS_FILE\n"


def write(edits: Iterable[LoopEdit]) -> str:
    """YAML text of edits; `read` gives the same ones back, to the last digit."""
    entries = [_entry(edit) for edit in edits]
    return _HEAD + yaml.safe_dump(entries, sort_keys=False, default_flow_style=None, width=1000)


def read(text: str, source: str = "the list of edits") -> tuple[LoopEdit, ...]:
    """The edits of a YAML text.

    Raises:
        HemislamError: naming `source` and the entry that cannot be used, counted from 1.
    """
    entries = read_yaml(text, source, "write entries such as `- accept: [12, 340]`")
    if entries is None:
        return ()
    if not isinstance(entries, list):
        raise HemislamError(f"{source} must be a list; write entries such as `- accept: [12, 340]`.")
    edits = []
    for number, entry in enumerate(entries, 1):
        try:
            edits.append(_edit(entry))
        except HemislamError as error:
            raise HemislamError(f"{source}, entry {number}: {error}") from None
    return tuple(edits)


def _entry(edit: LoopEdit) -> dict[str, Any]:
    verb = next(verb for verb, kind in _VERBS.items() if isinstance(edit, kind))
    entry: dict[str, Any] = {verb: _AT_ONCE if isinstance(edit, Solve) else [edit.older, edit.newer]}
    if isinstance(edit, SetWeight):
        entry["weight"] = float(edit.weight)
    if isinstance(edit, Add):
        entry["register"] = edit.register
        if edit.guess is not None:
            entry["guess"] = [list(row) for row in edit.guess]
    return {**entry, "since": edit.since} if edit.since else entry


def _edit(entry: object) -> LoopEdit:
    verbs = [verb for verb in _VERBS if verb in entry] if isinstance(entry, dict) else []
    if not isinstance(entry, dict) or len(verbs) != 1:
        raise HemislamError(
            "it must hold one of accept, reject, weigh or add, with two keyframes: accept: [12, 340]; or `solve:"
            f" {_AT_ONCE}`."
        )
    (verb,) = verbs
    kind = _VERBS[verb]
    known = [field.name for field in fields(kind) if field.name not in ("older", "newer", "since")]
    unknown = sorted(str(name) for name in entry.keys() - {verb, "since", *known})
    if unknown:
        raise HemislamError(f"{verb} has no {unknown[0]}; it takes {' and '.join(known) or 'nothing else'}.")
    since = _since(entry.get("since", 0))
    if kind is Solve:
        if entry[verb] != _AT_ONCE:
            raise HemislamError(f"solve is {entry[verb]!r}; it can only be `{_AT_ONCE}`.")
        return Solve(since=since)
    older, newer = _pair(verb, entry[verb])
    edit: LoopEdit
    if kind is SetWeight:
        edit = SetWeight(older, newer, _weight(entry.get("weight")), since=since)
    elif kind is Add:
        register = entry.get("register", True)
        if not isinstance(register, bool):
            raise HemislamError(f"register is {register!r}; it must be true or false.")
        edit = Add(older, newer, _guess(entry.get("guess")), register, since=since)
    else:
        edit = (Accept if kind is Accept else Reject)(older, newer, since=since)
    check(edit)
    return edit


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _pair(verb: str, value: object) -> Pair:
    if not isinstance(value, list) or len(value) != 2 or not all(map(_is_count, value)) or value[0] >= value[1]:
        raise HemislamError(f"{verb} is {value!r}; it takes two keyframes, the older one first: [12, 340].")
    return value[0], value[1]


def _since(value: Any) -> int:
    if not _is_count(value):
        raise HemislamError(f"since is {value!r}; it must be a number of keyframes.")
    return int(value)


def _weight(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise HemislamError(f"weight is {value!r}; it must be a number greater than 0.")
    return float(value)


def _guess(value: object) -> tuple[tuple[float, ...], ...] | None:
    if value is None:
        return None
    try:
        T = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        T = np.empty(0)
    return rows(T) if T.ndim == 2 else ()  # what is no matrix is refused by `check`
