"""The parameter tree as one frozen value: checked, merged, written and read. `sections` declares it."""

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import yaml
from pydantic import ValidationError

from app.slam.errors import HemislamError
from app.slam.sections import (
    Effect,
    FilterParams,
    GroundParams,
    ImuParams,
    KeyframeParams,
    LoopsParams,
    MapParams,
    MovingParams,
    RecordingParams,
    ScanParams,
    Section,
    SensorParams,
)
from app.slam.user_text import read_assignments, read_yaml

WHEN: dict[Effect, str] = {"now": "at once", "frame": "from the next frame", "restart": "on restart"}
"""When a change of a parameter takes effect, in words."""


class Params(Section):
    """All parameters of hemislam."""

    recording: RecordingParams = RecordingParams()
    sensor: SensorParams = SensorParams()
    ground: GroundParams = GroundParams()
    scan: ScanParams = ScanParams()
    imu: ImuParams = ImuParams()
    filter: FilterParams = FilterParams()
    map: MapParams = MapParams()
    keyframe: KeyframeParams = KeyframeParams()
    moving: MovingParams = MovingParams()
    loops: LoopsParams = LoopsParams()

    def merged(self, tree: Mapping[str, Any]) -> "Params":
        """These parameters, overridden by the values of a (partial) nested mapping.

        Raises:
            HemislamError: naming the parameter that is unknown or out of range, its range and unit.
        """
        if not isinstance(tree, Mapping):
            raise HemislamError(
                f"Parameters must be a mapping of sections, not {type(tree).__name__}; `hemislam params` prints one."
            )
        values = self.model_dump()
        for section, entries in tree.items():
            if section not in values:
                raise HemislamError(_unknown("section", str(section), values))
            if entries is None:
                continue
            if not isinstance(entries, Mapping):
                raise HemislamError(
                    f"Parameter section `{section}` must hold `name: value` lines; `hemislam params` prints an example."
                )
            for name, value in entries.items():
                if name not in values[section]:
                    raise HemislamError(_unknown("parameter", str(name), values[section], f"{section}."))
                values[section][name] = value
        try:
            return type(self).model_validate(values)
        except ValidationError as error:
            raise HemislamError(_explain(error, values)) from None

    def with_values(self, values: Mapping[str, Any]) -> "Params":
        """This, with dotted names set: `params.with_values({"ground.alpha": 30})`. Raises as `merged`."""
        if flat := next((path for path in values if "." not in path), None):
            raise HemislamError(_unknown("parameter", flat, {leaf.path for leaf in leaves()}))
        return self.merged(nested(values))

    def with_assignments(self, assignments: list[str]) -> "Params":
        """This, with command-line texts `section.name=value` applied; values are read as YAML."""
        return self.with_values(read_assignments(assignments, "--set", "--set ground.alpha=30"))

    def value(self, path: str) -> Any:
        """The value of a dotted name."""
        section, _, name = path.partition(".")
        return getattr(getattr(self, section), name)

    def changed(self, other: "Params") -> dict[str, Any]:
        """Dotted names whose value differs in `other`, with the value there."""
        return {
            leaf.path: other.value(leaf.path) for leaf in leaves() if self.value(leaf.path) != other.value(leaf.path)
        }

    def to_yaml(self) -> str:
        """The whole tree as YAML that `merged_yaml` reads back to the same value."""
        lines: list[str] = []
        for name, section in self:
            lines += [f"# {section.summary()}", f"{name}:"]
            for leaf in leaves():
                if leaf.section == name:
                    lines += [f"  # {leaf.help}", f"  {leaf.name}: {_yaml(self.value(leaf.path))}"]
        return "\n".join(lines) + "\n"

    def merged_yaml(self, text: str, source: str = "the YAML text") -> "Params":
        """These parameters, overridden by a YAML text. Raises `HemislamError` naming `source`."""
        tree = read_yaml(text, source, "`hemislam params` prints an example")
        try:
            return self.merged({} if tree is None else tree)
        except HemislamError as error:
            raise HemislamError(f"{source}: {error}") from None


def nested(values: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Values by dotted name as a tree of sections, as `Params.merged` and parameter files have it."""
    tree: dict[str, dict[str, Any]] = {}
    for path, value in values.items():
        section, _, name = path.partition(".")
        tree.setdefault(section, {})[name] = value
    return tree


@dataclass(frozen=True, slots=True)
class Leaf:
    """The declaration of one parameter. `minimum` and `maximum` of a vector hold for each of its components."""

    section: str
    name: str
    default: Any
    meaning: str
    unit: str
    minimum: float | None
    maximum: float | None
    step: float | None
    effect: Effect
    symbol: str
    choices: tuple[str, ...]

    @property
    def path(self) -> str:
        return f"{self.section}.{self.name}"

    @property
    def requirement(self) -> str:
        """What a value must be, in words."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        if isinstance(self.default, bool):
            return "true or false"
        if isinstance(self.default, str) and self.unit:
            return "numbers with spaces between, in quotes, such as '0.01 -0.02'"
        if isinstance(self.default, str):
            return f"a text ({self.meaning.removesuffix('.')})"
        limits = f"from {self.minimum:g} to {self.maximum:g} {self.unit}".rstrip()
        if isinstance(self.default, tuple):
            return f"{len(self.default)} numbers {limits}, such as {list(self.default)}"
        return f"{'a whole number' if isinstance(self.default, int) else 'a number'} {limits}"

    @property
    def range(self) -> str:
        """The values allowed, without the unit; "" for a text or a switch."""
        if self.choices:
            return "one of " + ", ".join(self.choices)
        return "" if self.minimum is None else f"{self.minimum:g} to {self.maximum:g}"

    @property
    def help(self) -> str:
        """Meaning, unit, range and when it takes effect, in one line."""
        facts = [f"unit {self.unit}" if self.unit else "", self.range, f"applies {WHEN[self.effect]}"]
        return f"{self.meaning} [{'; '.join(fact for fact in facts if fact)}]"


@cache
def leaves() -> tuple[Leaf, ...]:
    """Every parameter, in the order of declaration."""
    found = []
    for section, field in Params.model_fields.items():
        section_type = field.annotation
        assert isinstance(section_type, type) and issubclass(section_type, Section)
        schema = section_type.model_json_schema()["properties"]
        for name, info in section_type.model_fields.items():
            entry = schema[name]
            number = entry.get("prefixItems", [entry])[0]  # the components of a vector share one range
            leaf = Leaf(
                section=section,
                name=name,
                default=info.default,
                meaning=info.description or "",
                unit=entry["unit"],
                minimum=number.get("minimum"),
                maximum=number.get("maximum"),
                step=entry["step"],
                effect=entry["effect"],
                symbol=entry["symbol"],
                choices=tuple(entry.get("enum", ())),
            )
            found.append(leaf)
    return tuple(found)


def params_markdown() -> str:
    """All parameters as Markdown: one heading and one table per section, for the documentation."""
    head = ("parameter", "symbol", "default", "range", "unit", "takes effect", "meaning")
    lines: list[str] = []
    for name, section in Params():
        lines += [f"## {name}", "", section.summary(), ""]
        lines += [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
        for leaf in leaves():
            if leaf.section == name:
                default = f"`{_yaml(leaf.default)}`"
                cells = (f"`{leaf.path}`", leaf.symbol, default, leaf.range, leaf.unit, WHEN[leaf.effect], leaf.meaning)
                lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
        lines.append("")
    return "\n".join(lines)


def _yaml(value: Any) -> str:
    """A value on one line of YAML."""
    return yaml.safe_dump(_plain(value), default_flow_style=True).removesuffix("...\n").strip()


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _unknown(kind: str, name: str, known: Iterable[str], prefix: str = "") -> str:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f"did you mean `{prefix}{near[0]}`?" if near else "`hemislam params` lists them all."
    return f"There is no {kind} `{prefix}{name}`; {hint}"


def _explain(error: ValidationError, values: Mapping[str, Mapping[str, Any]]) -> str:
    """The first error in one sentence of our own."""
    section, name = (str(part) for part in error.errors()[0]["loc"][:2])
    leaf = next(leaf for leaf in leaves() if leaf.path == f"{section}.{name}")
    given = _plain(values[section][name])
    return f"`{leaf.path}` cannot be {given!r}: it must be {leaf.requirement}."
