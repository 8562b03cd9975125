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
    RecordingParams,
    ScanParams,
    Section,
    SensorParams,
)

__all__ = [
    "Effect",
    "FilterParams",
    "GroundParams",
    "ImuParams",
    "KeyframeParams",
    "Leaf",
    "LoopsParams",
    "MapParams",
    "Params",
    "RecordingParams",
    "ScanParams",
    "SensorParams",
    "leaves",
]


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
    loops: LoopsParams = LoopsParams()

    @classmethod
    def parse(cls, tree: Mapping[str, Any]) -> "Params":
        """Build from a nested mapping; missing names take their defaults.

        Raises:
            HemislamError: naming the parameter that is unknown or out of range, its range and unit.
        """
        return cls().merged(tree)

    def merged(self, tree: Mapping[str, Any]) -> "Params":
        """This, with the values of a (partial) nested mapping laid over it. Raises as `parse`."""
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
        """This, with dotted names set: `params.with_values({"ground.alpha": 30})`. Raises as `parse`."""
        tree: dict[str, dict[str, Any]] = {}
        for path, value in values.items():
            section, dot, name = path.partition(".")
            if not dot:
                raise HemislamError(_unknown("parameter", path, {leaf.path for leaf in leaves()}))
            tree.setdefault(section, {})[name] = value
        return self.merged(tree)

    def with_assignments(self, assignments: list[str]) -> "Params":
        """This, with command-line texts `section.name=value` applied; values are read as YAML."""
        values: dict[str, Any] = {}
        for text in assignments:
            path, equals, value = text.partition("=")
            if not equals:
                raise HemislamError(f"`--set {text}` has no value; write it as `--set ground.alpha=30`.")
            try:
                values[path.strip()] = yaml.safe_load(value)
            except yaml.YAMLError:
                raise HemislamError(
                    f"The value of `--set {text}` can not be read; write it as `--set ground.alpha=30`."
                ) from None
        return self.with_values(values)

    def value(self, path: str) -> Any:
        """The value of a dotted name."""
        section, _, name = path.partition(".")
        return getattr(getattr(self, section), name)

    def changed(self, other: "Params") -> dict[str, Any]:
        """Dotted names whose value differs in `other`, with the value there."""
        return {
            leaf.path: other.value(leaf.path) for leaf in leaves() if self.value(leaf.path) != other.value(leaf.path)
        }

    def to_yaml(self, *, comments: bool = True) -> str:
        """The whole tree as YAML that `parse_yaml` reads back to the same value."""
        lines: list[str] = []
        for section_name, section in self:
            if comments:
                lines.append(f"# {(type(section).__doc__ or '').strip().splitlines()[0]}")
            lines.append(f"{section_name}:")
            for leaf in leaves():
                if leaf.section != section_name:
                    continue
                if comments:
                    lines.append(f"  # {leaf.help}")
                text = (
                    yaml.safe_dump(_plain(self.value(leaf.path)), default_flow_style=True).removesuffix("...\n").strip()
                )
                lines.append(f"  {leaf.name}: {text}")
        return "\n".join(lines) + "\n"

    def merged_yaml(self, text: str, source: str = "the YAML text") -> "Params":
        """This, with a YAML text laid over it. Raises `HemislamError` naming `source`."""
        try:
            tree = yaml.safe_load(text)
        except yaml.YAMLError as error:
            where = getattr(error, "problem_mark", None)
            line = f" in line {where.line + 1}" if where else ""
            raise HemislamError(f"{source} is not valid YAML{line}; `hemislam params` prints an example.") from None
        try:
            return self.merged({} if tree is None else tree)
        except HemislamError as error:
            raise HemislamError(f"{source}: {error}") from None


@dataclass(frozen=True, slots=True)
class Leaf:
    """One parameter's declaration, flattened for those who generate from it."""

    section: str
    name: str
    annotation: Any
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
        if isinstance(self.default, str):
            return "a text"
        if isinstance(self.default, tuple):
            return f"{len(self.default)} numbers such as {list(self.default)}" + (
                f" ({self.unit})" if self.unit else ""
            )
        kind = "a whole number" if isinstance(self.default, int) else "a number"
        if self.minimum is not None and self.maximum is not None:
            return f"{kind} from {self.minimum:g} to {self.maximum:g} {self.unit}".rstrip()
        return f"{kind} ({self.unit})" if self.unit else kind

    @property
    def help(self) -> str:
        """Meaning, unit, range and when it takes effect, in one line."""
        facts = [f"unit {self.unit}"] if self.unit else []
        if self.minimum is not None and self.maximum is not None:
            facts.append(f"{self.minimum:g} to {self.maximum:g}")
        if self.choices:
            facts.append("one of " + ", ".join(self.choices))
        facts.append(
            {"now": "acts at once", "frame": "acts from the next frame", "restart": "acts on restart"}[self.effect]
        )
        return f"{self.meaning} [{'; '.join(facts)}]"


@cache
def leaves() -> tuple[Leaf, ...]:
    """Every parameter, in the order of declaration."""
    found = []
    for section, section_field in Params.model_fields.items():
        section_type = section_field.annotation
        assert isinstance(section_type, type) and issubclass(section_type, Section)
        schema = section_type.model_json_schema()["properties"]
        for name, info in section_type.model_fields.items():
            entry = schema[name]
            leaf = Leaf(
                section=section,
                name=name,
                annotation=info.annotation,
                default=info.default,
                meaning=info.description or "",
                unit=entry["unit"],
                minimum=entry.get("minimum"),
                maximum=entry.get("maximum"),
                step=entry["step"],
                effect=entry["effect"],
                symbol=entry["symbol"],
                choices=tuple(entry.get("enum", ())),
            )
            found.append(leaf)
    return tuple(found)


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _unknown(kind: str, name: str, known: Iterable[str], prefix: str = "") -> str:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f"did you mean `{prefix}{near[0]}`?" if near else "`hemislam params` lists them all."
    return f"There is no {kind} `{prefix}{name}`; {hint}"


def _explain(error: ValidationError, values: Mapping[str, Mapping[str, Any]]) -> str:
    """The first thing that is wrong, in words that do not need pydantic's."""
    section, name = (str(part) for part in error.errors()[0]["loc"][:2])
    leaf = next(leaf for leaf in leaves() if leaf.path == f"{section}.{name}")
    given = _plain(values[section][name])
    return f"`{leaf.path}` can not be {given!r}: it must be {leaf.requirement}."
