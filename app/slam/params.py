"""The one declaration of every parameter: sliders, flags, YAML, REST and documentation come from it.

A parameter has a type, a default, a range, a step, a unit, one sentence of meaning, and says when a
change takes effect: `now` (the current frame is done again at once), `frame` (from the next frame
on) or `restart` (when the recording is opened again).
"""

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.config import JsonDict

from app.slam.errors import HemislamError

Effect = Literal["now", "frame", "restart"]


def _param(
    default: Any,
    meaning: str,
    *,
    unit: str = "",
    ge: float | None = None,
    le: float | None = None,
    step: float | None = None,
    effect: Effect = "frame",
    symbol: str = "",
) -> Any:
    extra: JsonDict = {"unit": unit, "step": step, "effect": effect, "symbol": symbol}
    return Field(default, description=meaning, ge=ge, le=le, json_schema_extra=extra)


class Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Recording(Section):
    """How a recording is read. `auto` lets the recording doctor decide and say so."""

    lidar_topic: str = _param(
        "", "Topic of the point clouds; empty: the one of type PointCloud2 with most messages.", effect="restart"
    )
    imu_topic: str = _param("", "Topic of the IMU; empty: the one of type Imu with most messages.", effect="restart")
    time_field: str = _param(
        "auto", "Name of the per-point time field; `none` derives the time from the azimuth.", effect="restart"
    )
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = _param("auto", "Unit of the per-point time.", effect="restart")
    time_reference: Literal["auto", "absolute", "relative"] = _param(
        "auto", "Whether the per-point time is absolute or counted from the scan's header stamp.", effect="restart"
    )
    header_stamp: Literal["auto", "first", "last"] = _param(
        "auto", "Which point of a scan its header stamp belongs to.", effect="restart"
    )
    acceleration_unit: Literal["auto", "m/s2", "g"] = _param("auto", "Unit of the accelerometer.", effect="restart")
    imu_time_offset: float = _param(
        0.0,
        "Added to the IMU's stamps, for clocks that are not synchronised.",
        unit="s",
        step=0.001,
        effect="restart",
    )
    rotation_rate: float = _param(
        0.0,
        "Revolutions per second, used only when points carry no time; 0: the rate of the clouds.",
        unit="Hz",
        ge=0,
        le=100,
        step=1,
        effect="restart",
    )


class Sensor(Section):
    """Where the LiDAR sits on the IMU, and which returns are believed."""

    translation: tuple[float, float, float] = _param(
        (0.0, 0.0, 0.0), "Position of the LiDAR in the IMU frame (x, y, z).", unit="m", step=0.001, effect="restart"
    )
    rotation: tuple[float, float, float] = _param(
        (0.0, 0.0, 0.0),
        "Orientation of the LiDAR in the IMU frame (roll, pitch, yaw; R = Rz Ry Rx).",
        unit="deg",
        step=0.1,
        effect="restart",
    )
    min_range: float = _param(
        0.4, "Returns nearer than this are dropped (the person who carries it).", unit="m", ge=0, le=10, step=0.1
    )
    max_range: float = _param(100.0, "Returns farther than this are dropped.", unit="m", ge=1, le=300, step=1)


class Ground(Section):
    """Seed-point ground segmentation and ground downsampling (paper 2.2, eq. 1-3)."""

    enabled: bool = _param(True, "Segment the ground and thin it before the filter.", effect="now")
    scan_lines: int = _param(
        8,
        "Number of outermost scan lines on which seed points are looked for.",
        ge=1,
        le=128,
        step=1,
        effect="now",
        symbol="M",
    )
    alpha: float = _param(
        40.0,
        "Largest angle between a seed point and the direction straight down.",
        unit="deg",
        ge=1,
        le=90,
        step=1,
        effect="now",
        symbol="α",
    )
    sigma: float = _param(
        0.03,
        "Distance to the plane below which a point is ground, per metre of range.",
        unit="m/m",
        ge=0.001,
        le=0.2,
        step=0.001,
        effect="now",
        symbol="σ",
    )
    planarity: float = _param(
        0.3, "The seeds form a plane if λ3/λ2 is below this.", ge=0.01, le=1, step=0.01, effect="now", symbol="λ3/λ2"
    )
    voxel_size: float = _param(
        0.5,
        "Edge of the voxels in which ground points are replaced by their centroid.",
        unit="m",
        ge=0.05,
        le=5,
        step=0.05,
        effect="now",
        symbol="voxel",
    )


class ScanVoxel(Section):
    """What the filter sees of a scan, after the ground was thinned."""

    voxel_size: float = _param(
        0.4,
        "Edge of the voxels in which all points are thinned for the filter (FAST-LIO2's filter_size_surf).",
        unit="m",
        ge=0.05,
        le=3,
        step=0.05,
    )


class Imu(Section):
    """The IMU's noise and how the filter starts."""

    gyro_noise: float = _param(1.2e-3, "Gyroscope noise density.", unit="rad/s/√Hz", ge=1e-6, le=1, step=1e-4)
    accel_noise: float = _param(1.3e-2, "Accelerometer noise density.", unit="m/s²/√Hz", ge=1e-6, le=10, step=1e-3)
    gyro_bias_walk: float = _param(
        2.5e-5, "Random walk of the gyroscope's bias.", unit="rad/s²/√Hz", ge=0, le=1, step=1e-5
    )
    accel_bias_walk: float = _param(
        1.0e-4, "Random walk of the accelerometer's bias.", unit="m/s³/√Hz", ge=0, le=1, step=1e-4
    )
    gravity: float = _param(9.81, "Local gravity.", unit="m/s²", ge=9.7, le=9.9, step=0.001, effect="restart")
    start_duration: float = _param(
        1.0,
        "Time to stand still at the start, for the first biases and gravity.",
        unit="s",
        ge=0.1,
        le=10,
        step=0.1,
        effect="restart",
    )
    max_gap: float = _param(
        0.1,
        "A longer gap between IMU samples is reported and bridged with a wide covariance.",
        unit="s",
        ge=0.005,
        le=5,
        step=0.005,
    )


class Filter(Section):
    """The iterated Kalman filter's update (paper 2.3, eq. 5-7)."""

    point_noise: float = _param(
        0.03, "Standard deviation of a point-to-plane distance.", unit="m", ge=0.001, le=1, step=0.005
    )
    neighbours: int = _param(
        5, "Map points that make a plane; more are taken where these lie along one line.", ge=4, le=20, step=1
    )
    plane_tilt: float = _param(
        1.5,
        "Most uncertainty of a plane's normal; neighbours along one scan line widen the patch until it is met.",
        unit="deg",
        ge=0.1,
        le=20,
        step=0.1,
    )
    gate: float = _param(
        0.11, "Residuals over this times √range are not used (FAST-LIO2's gate).", unit="m/√m", ge=0.01, le=1, step=0.01
    )
    max_iterations: int = _param(5, "Most iterations of one update.", ge=1, le=20, step=1)
    plane_threshold: float = _param(
        0.1, "All neighbours must lie within this of their plane.", unit="m", ge=0.01, le=1, step=0.01
    )
    neighbour_distance: float = _param(
        1.0, "Neighbours farther than this from a point are not used.", unit="m", ge=0.2, le=5, step=0.1
    )
    estimate_extrinsics: bool = _param(False, "Estimate the LiDAR's pose on the IMU while mapping.")


class LocalMap(Section):
    """The hashed voxel map that scans are registered to. Its memory is bounded."""

    voxel_size: float = _param(
        1.0,
        "Edge of a map voxel; neighbours are looked for within one edge at most.",
        unit="m",
        ge=0.1,
        le=3,
        step=0.05,
        effect="restart",
    )
    spacing: float = _param(
        0.2,
        "No two points of a voxel are nearer than this, so that standing still piles up nothing.",
        unit="m",
        ge=0.0,
        le=1,
        step=0.05,
    )
    points_per_voxel: int = _param(40, "Most points kept in one voxel.", ge=1, le=50, step=1, effect="restart")
    radius: float = _param(
        100.0, "Voxels farther than this from the sensor are dropped.", unit="m", ge=10, le=500, step=5
    )
    max_voxels: int = _param(
        100_000,
        "Most voxels kept; memory does not grow beyond them.",
        ge=1000,
        le=2_000_000,
        step=1000,
        effect="restart",
    )


class Keyframes(Section):
    """Which frames are kept for the map."""

    distance: float = _param(0.5, "A new keyframe after walking this far.", unit="m", ge=0.05, le=20, step=0.05)
    angle: float = _param(15.0, "A new keyframe after turning this far.", unit="deg", ge=1, le=180, step=1)


class Params(Section):
    """All parameters of hemislam."""

    recording: Recording = Recording()
    sensor: Sensor = Sensor()
    ground: Ground = Ground()
    scan: ScanVoxel = ScanVoxel()
    imu: Imu = Imu()
    filter: Filter = Filter()
    map: LocalMap = LocalMap()
    keyframe: Keyframes = Keyframes()

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
                    raise HemislamError(
                        _unknown("parameter", f"{section}.{name}", {f"{section}.{n}" for n in values[section]})
                    )
                values[section][name] = value
        try:
            return type(self).model_validate(values)
        except ValidationError as error:
            raise HemislamError(_explain(error)) from None

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
    def help(self) -> str:
        """Meaning, unit, range and when it takes effect, in one line."""
        parts = [self.meaning]
        facts = [f"unit {self.unit}"] if self.unit else []
        if self.minimum is not None and self.maximum is not None:
            facts.append(f"{self.minimum:g} to {self.maximum:g}")
        if self.choices:
            facts.append("one of " + ", ".join(self.choices))
        facts.append(
            {"now": "acts at once", "frame": "acts from the next frame", "restart": "acts on restart"}[self.effect]
        )
        return f"{parts[0]} [{'; '.join(facts)}]"


def leaves() -> Iterator[Leaf]:
    """Every parameter, in the order of declaration."""
    for section, section_field in Params.model_fields.items():
        section_type = section_field.annotation
        assert isinstance(section_type, type) and issubclass(section_type, Section)
        schema = section_type.model_json_schema()["properties"]
        for name, info in section_type.model_fields.items():
            entry = schema[name]
            yield Leaf(
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


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _unknown(kind: str, name: str, known: Any) -> str:
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    hint = f"did you mean `{near[0]}`?" if near else "`hemislam params` lists them all."
    return f"There is no {kind} `{name}`; {hint}"


def _explain(error: ValidationError) -> str:
    first = error.errors()[0]
    path = ".".join(str(part) for part in first["loc"][:2])
    leaf = next((leaf for leaf in leaves() if leaf.path == path), None)
    if leaf is None:
        return f"Parameters can not be used: {first['msg']}."
    given = first.get("input")
    return f"`{path}` can not be {given!r}: {first['msg'].lower()}. {leaf.help}"
