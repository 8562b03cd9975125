"""Loop edits as a file: a list in YAML, for `hemislam run --loops edits.yaml`.

    - accept: [12, 340]
    - reject: [3, 40]
    - weigh: [12, 340]
      weight: 2.5
    - add: [5, 300]
      register: false
      guess: [[1.0, 0.0, 0.0, 0.2], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    - solve: at once
    - override: fix 12
      accepted: false

A loop is named by its older and its newer keyframe: an index, or `session/index` in another session than the first.
`guess` is T_older_newer of the IMU frames; without it, the search starts from where odometry places it. `register` is
true by default. `solve: at once` takes the poses from all factors at once
(Levenberg-Marquardt) instead of one after the other. `override` counts or leaves out a satellite fix,
by its number, or a control point by its name: `point P1`.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Annotated, Any, Final

import yaml
from pydantic import Strict, TypeAdapter, ValidationError

from app.slam.errors import HemislamError
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.edits import Accept, Add, LoopEdit, Override, Reject, SetWeight, Solve, check
from app.slam.loops.types import Pair
from app.slam.user_text import read_yaml

_VERBS: Final[dict[str, Any]] = {
    "accept": Accept, "reject": Reject, "weigh": SetWeight, "add": Add, "solve": Solve, "override": Override
}  # fmt: skip
_AT_ONCE: Final = "at once"


@dataclass
class _Values:
    weight: Annotated[float, Strict()] = 1.0
    register: Annotated[bool, Strict()] = True
    guess: tuple[tuple[float, ...], ...] | None = None
    accepted: Annotated[bool, Strict()] = True


_VALUES: Final = TypeAdapter(_Values)
_NEEDED: Final[dict[str, dict[str, Any]]] = {"weigh": {"weight": None}, "override": {"accepted": None}}
_MUST_BE: Final = {
    "weight": "a number greater than 0",
    "register": "true or false",
    "guess": "a 4x4 matrix of numbers",
    "accepted": "true or false",
}
_EXAMPLE: Final = "write entries such as `- accept: [12, 340]`"
_HEAD: Final = "# Edits of loops, in their order: hemislam run RECORDING --loops THIS_FILE\n"


def write(edits: Iterable[LoopEdit]) -> str:
    """YAML text of edits; `read` gives the same ones back, to the last digit."""
    return _HEAD + yaml.safe_dump(entries_of(edits), sort_keys=False, default_flow_style=None, width=1000)


def read(text: str, source: str = "the list of edits") -> tuple[LoopEdit, ...]:
    """The edits of a YAML text. Raises HemislamError, naming `source`: as `edits_of`, or it is not YAML."""
    return edits_of(read_yaml(text, source, _EXAMPLE), source)


def entries_of(edits: Iterable[LoopEdit]) -> list[dict[str, Any]]:
    """Edits as YAML and JSON can hold them."""
    return [_entry(edit) for edit in edits]


def edits_of(entries: object, source: str = "the list of edits") -> tuple[LoopEdit, ...]:
    """The edits from which `entries_of` made these entries; no edits for None.

    Raises:
        HemislamError: naming `source` and the entry that cannot be used, counted from 1.
    """
    if entries is None:
        return ()
    if not isinstance(entries, list):
        raise HemislamError(f"{source} must be a list; {_EXAMPLE}.")
    edits = []
    for number, entry in enumerate(entries, 1):
        try:
            edits.append(_edit(entry))
        except HemislamError as error:
            raise HemislamError(f"{source}, entry {number}: {error}") from None
    return tuple(edits)


def _entry(edit: LoopEdit) -> dict[str, Any]:
    verb = next(verb for verb, kind in _VERBS.items() if isinstance(edit, kind))
    if isinstance(edit, Override):
        return {verb: edit.what, "accepted": edit.accepted}
    pair = [int(one) if one < KeyframeId(1, 0) else str(one) for one in edit.pair or ()]
    values = {name: getattr(edit, name) for name in _names(type(edit))}
    if guess := values.pop("guess", None):
        values["guess"] = [list(row) for row in guess]
    return {verb: pair or _AT_ONCE} | values


def _edit(entry: object) -> LoopEdit:
    verbs = [verb for verb in _VERBS if verb in entry] if isinstance(entry, dict) else []
    if not isinstance(entry, dict) or len(verbs) != 1:
        raise HemislamError(
            "it must hold one of accept, reject, weigh or add, with two keyframes: accept: [12, 340]; or `solve:"
            f" {_AT_ONCE}`; or `override: fix 12`."
        )
    (verb,) = verbs
    entry = {name: value for name, value in entry.items() if name != "since"}  # older files hold it; it added nothing
    known = _names(_VERBS[verb])
    if unknown := sorted(str(name) for name in entry.keys() - {verb, *known}):
        raise HemislamError(f"{verb} has no {unknown[0]}; it takes {' and '.join(known) or 'nothing else'}.")
    given = _NEEDED.get(verb, {}) | {name: entry[name] for name in entry if name != verb}
    try:
        read = _VALUES.validate_python(given)
    except ValidationError as error:
        name = str(error.errors()[0]["loc"][0])
        raise HemislamError(f"{name} is {given[name]!r}; it must be {_MUST_BE[name]}.") from None
    if verb == "solve" and entry[verb] != _AT_ONCE:
        raise HemislamError(f"solve is {entry[verb]!r}; it can only be `{_AT_ONCE}`.")
    edit: LoopEdit = _VERBS[verb](*_subject(verb, entry[verb]), **{name: getattr(read, name) for name in given})
    check(edit)
    return edit


def _names(kind: type[LoopEdit]) -> list[str]:
    """What an entry may hold beside its verb."""
    return [field.name for field in fields(kind) if field.name not in ("older", "newer", "what")]


def _subject(verb: str, value: object) -> tuple[Any, ...]:
    """What an edit is for, as its first arguments."""
    if verb == "solve":
        return ()
    if verb != "override":
        return _pair(verb, value)
    if not isinstance(value, str) or not re.fullmatch(r"(fix \d{1,9}|point .{1,100})", value):
        raise HemislamError(f"override is {value!r}; it takes `fix 12` or `point NAME`.")
    return (value,)


def _pair(verb: str, value: object) -> Pair:
    names = [re.fullmatch(r"(?:(\d{1,6})/)?(\d{1,12})", str(one)) for one in value] if isinstance(value, list) else []
    pair = [KeyframeId(int(name[1] or 0), int(name[2])) for name in names if name]
    if len(names) != 2 or len(pair) != 2 or pair[0] >= pair[1]:
        raise HemislamError(f"{verb} is {value!r}; it takes two keyframes, the older one first: [12, 340].")
    return pair[0], pair[1]
