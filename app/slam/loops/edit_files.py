"""EditList as a file: a list of loop commands in YAML, for `hemislam run --loops edits.yaml`.

    - accept: [12, 340]
    - reject: [3, 40]
    - weigh: [12, 340]
      weight: 2.5
    - add: [5, 300]
      register: false
      guess: [[1.0, 0.0, 0.0, 0.2], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    - solve: at once

A loop is named by its older and its newer keyframe. `guess` is T_older_newer of the IMU frames,
left out: where the graph has them; `register` is true if left out. `solve: at once` takes the poses
from all factors at once (Levenberg-Marquardt) instead of one after the other. `since`, of any entry, is how
many keyframes the walk had when it was given; it acts from there on, left out: from the start.
"""

import math
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
import yaml

from app.slam.errors import HemislamError
from app.slam.loops.types import Accept, Add, LoopEdit, Pair, Reject, SetWeight, Solve, rows
from app.slam.yaml_text import read_yaml

_FIELDS: Final[dict[str, frozenset[str]]] = {
    "accept": frozenset(),
    "reject": frozenset(),
    "weigh": frozenset({"weight"}),
    "add": frozenset({"guess", "register"}),
    "solve": frozenset(),
}
"""What an entry may hold beside its verb, keyframes and `since`."""

_AT_ONCE: Final = "at once"

_HEAD: Final = "# EditList of loops, in their order: hemislam run RECORDING --loops THIS_FILE\n"


def write(commands: Iterable[LoopEdit]) -> str:
    """YAML text of commands; `read` gives the same ones back, to the last digit."""
    entries = [_entry(command) for command in commands]
    return _HEAD + yaml.safe_dump(entries, sort_keys=False, default_flow_style=None, width=1000)


def read(text: str, source: str = "the list of edits") -> tuple[LoopEdit, ...]:
    """Commands of a YAML text.

    Raises:
        HemislamError: naming `source` and the entry that cannot be used, counted from 1.
    """
    entries = read_yaml(text, source, "write entries such as `- accept: [12, 340]`")
    if entries is None:
        return ()
    if not isinstance(entries, list):
        raise HemislamError(f"{source} must be a list; write entries such as `- accept: [12, 340]`.")
    commands = []
    for number, entry in enumerate(entries, 1):
        try:
            commands.append(_command(entry))
        except HemislamError as error:
            raise HemislamError(f"{source}, entry {number}: {error}") from None
    return tuple(commands)


def _entry(command: LoopEdit) -> dict[str, Any]:
    entry: dict[str, Any]
    match command:
        case Accept(older, newer):
            entry = {"accept": [older, newer]}
        case Reject(older, newer):
            entry = {"reject": [older, newer]}
        case SetWeight(older, newer, weight):
            entry = {"weigh": [older, newer], "weight": float(weight)}
        case Solve():
            entry = {"solve": _AT_ONCE}
        case Add(older, newer, guess, register):
            entry = {"add": [older, newer], "register": register}
            if guess is not None:
                entry["guess"] = [list(row) for row in guess]
    return {**entry, "since": command.since} if command.since else entry


def _command(entry: object) -> LoopEdit:
    verbs = [verb for verb in _FIELDS if verb in entry] if isinstance(entry, dict) else []
    if not isinstance(entry, dict) or len(verbs) != 1:
        raise HemislamError(
            "it must hold one of accept, reject, weigh or add, with two keyframes: accept: [12, 340]; or `solve:"
            f" {_AT_ONCE}`."
        )
    verb = verbs[0]
    unknown = sorted(str(name) for name in entry.keys() - {verb, "since"} - _FIELDS[verb])
    if unknown:
        allowed = " and ".join(sorted(_FIELDS[verb])) or "nothing else"
        raise HemislamError(f"{unknown[0]} means nothing to {verb}; it takes {allowed}.")
    since = _since(entry.get("since", 0))
    if verb == "solve":
        if entry[verb] != _AT_ONCE:
            raise HemislamError(f"solve is {entry[verb]!r}; it can only be `{_AT_ONCE}`.")
        return Solve(since)
    older, newer = _pair(verb, entry[verb])
    match verb:
        case "accept":
            return Accept(older, newer, since)
        case "reject":
            return Reject(older, newer, since)
        case "weigh":
            return SetWeight(older, newer, _weight(entry.get("weight")), since)
        case _:
            register = entry.get("register", True)
            if not isinstance(register, bool):
                raise HemislamError(f"register is {register!r}; it must be true or false.")
            return Add(older, newer, _guess(entry.get("guess")), register, since)


def _pair(verb: str, value: object) -> Pair:
    good = (
        isinstance(value, list)
        and len(value) == 2
        and all(isinstance(index, int) and not isinstance(index, bool) for index in value)
    )
    if not good or not isinstance(value, list) or not 0 <= value[0] < value[1]:
        raise HemislamError(f"{verb} is {value!r}; it takes two keyframes, the older one first: [12, 340].")
    return value[0], value[1]


def _since(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise HemislamError(f"since is {value!r}; it must be a number of keyframes.")
    return value


def _weight(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
        raise HemislamError(f"weight is {value!r}; it must be a number greater than 0.")
    return float(value)


def _guess(value: object) -> tuple[tuple[float, ...], ...] | None:
    if value is None:
        return None
    try:
        T = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        T = np.empty(0)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise HemislamError("guess must be the four rows of a 4x4 matrix T_older_newer of finite numbers.")
    if not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-3) or not np.allclose(T[3], (0, 0, 0, 1)):
        raise HemislamError("guess is no rigid transform; its upper left 3x3 must be a rotation, its last row 0 0 0 1.")
    return rows(T)
