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
from dataclasses import MISSING, fields
from typing import Annotated, Any, Final

import yaml
from pydantic import Strict, TypeAdapter, ValidationError

from app.slam.errors import HemislamError
from app.slam.keyframe_id import KeyframeId
from app.slam.loops.edits import Accept, Add, LoopEdit, Override, Reject, SetWeight, Solve, check
from app.slam.user_text import read_yaml

_VERBS: Final[dict[str, Any]] = {
    "accept": Accept, "reject": Reject, "weigh": SetWeight, "add": Add, "solve": Solve, "override": Override
}  # fmt: skip
_AT_ONCE: Final = "at once"


_SWITCH: Final = TypeAdapter(Annotated[bool, Strict()]), "true or false"
_VALUES: Final[dict[str, tuple[TypeAdapter[Any], str]]] = {
    "weight": (TypeAdapter(Annotated[float, Strict()]), "a number greater than 0"),
    "register": _SWITCH,
    "guess": (TypeAdapter(tuple[tuple[float, ...], ...] | None), "a 4x4 matrix of numbers"),
    "accepted": _SWITCH,
}
"""What an entry may hold beside its verb, and what that must be."""
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
    values = {name: getattr(edit, name) for name in _values(type(edit))}
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
    values = _values(_VERBS[verb])
    given = {name: entry[name] for name in entry if name not in (verb, "since")}  # older files hold `since`, unused
    if unknown := sorted(str(name) for name in given.keys() - values.keys()):
        raise HemislamError(f"{verb} has no {unknown[0]}; it takes {' and '.join(values) or 'nothing else'}.")
    for name, value in (values | given).items():
        kind, must_be = _VALUES[name]
        try:
            values[name] = kind.validate_python(value)
        except ValidationError:
            raise HemislamError(f"{name} is {value!r}; it must be {must_be}.") from None
    edit: LoopEdit = _VERBS[verb](*_subject(verb, entry[verb]), **values)
    check(edit)
    return edit


def _values(kind: type[LoopEdit]) -> dict[str, Any]:
    """What an entry may hold beside its verb, with the defaults; None where there is none."""
    names = (field for field in fields(kind) if field.name not in ("older", "newer", "what"))
    return {field.name: None if field.default is MISSING else field.default for field in names}


def _subject(verb: str, value: object) -> tuple[Any, ...]:
    """What an edit is for, as its first arguments."""
    if verb == "solve":
        if value != _AT_ONCE:
            raise HemislamError(f"solve is {value!r}; it can only be `{_AT_ONCE}`.")
        return ()
    if verb == "override":
        if not isinstance(value, str) or not re.fullmatch(r"(fix \d{1,9}|point .{1,100})", value):
            raise HemislamError(f"override is {value!r}; it takes `fix 12` or `point NAME`.")
        return (value,)
    names = [re.fullmatch(r"(?:(\d{1,6})/)?(\d{1,12})", str(one)) for one in value] if isinstance(value, list) else []
    pair = tuple(KeyframeId(int(name[1] or 0), int(name[2])) for name in names if name)
    if len(names) != 2 or len(pair) != 2 or pair[0] >= pair[1]:
        raise HemislamError(f"{verb} is {value!r}; it takes two keyframes, the older one first: [12, 340].")
    return pair
