"""The only declaration of every parameter. Sliders, flags, YAML, REST and documentation are generated from it.

A parameter has a type, a default, a range, a step, a unit and a meaning of one or two sentences. Its `effect` says
when a change takes effect: `now` (the current frame is segmented again at once), `frame` (from the next frame on) or
`restart` (when the recording is opened again).
"""

from functools import partial
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator
from pydantic.config import JsonDict

Effect = Literal["now", "frame", "restart"]

Metres = Annotated[float, Field(ge=-100, le=100)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
AxesName = Annotated[str, Field(pattern=r"^-?(x-?(y-?z|z-?y)|y-?(x-?z|z-?x)|z-?(x-?y|y-?x))$")]
PerLine = Annotated[str, Field(pattern=r"^ *(-?\d{1,2}(\.\d*)?( +|$))*$", max_length=4000)]


def _param(
    effect: Effect,
    default: Any,
    meaning: str,
    slider: tuple[float, float, float] | None = None,
    unit: str = "",
    *,
    step: float | None = None,
    symbol: str = "",
) -> Any:
    """A parameter. `slider`: minimum, maximum and step of a number. A vector has only a step."""
    least, greatest, step = slider or (None, None, step)
    extra: JsonDict = {"unit": unit, "step": step, "effect": effect, "symbol": symbol}
    return Field(default, description=meaning, ge=least, le=greatest, json_schema_extra=extra)


_at_once = partial(_param, "now")
_next_frame = partial(_param, "frame")
_on_restart = partial(_param, "restart")


class Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*")
    @classmethod
    def _can_be_written(cls, value: Any) -> Any:
        """Refuse text that UTF-8 cannot encode: a JSON string can hold half of a surrogate pair."""
        if isinstance(value, str):
            value.encode()
        return value

    @field_validator("*", mode="before")
    @classmethod
    def _is_no_switch(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse true and false for a number: YAML reads `yes` and `no` as booleans, which Python takes for 1 and 0."""
        parts = value if isinstance(value, list | tuple) else (value,)
        is_switch = isinstance(cls.model_fields[str(info.field_name)].default, bool)
        if not is_switch and any(isinstance(part, bool) for part in parts):
            raise ValueError("true and false are not numbers")
        return value

    @classmethod
    def summary(cls) -> str:
        """What the section is about, in one line."""
        return (cls.__doc__ or "").strip().splitlines()[0]


class RecordingParams(Section):
    """How a recording is read. With `auto`, the doctor decides and reports its choice."""

    lidar_topic: str = _on_restart(
        "",
        "Topic of the point clouds. Empty: the one whose points have times and rings, else the one with most messages.",
    )
    imu_topic: str = _on_restart(
        "", "Topic of the IMU. Empty: of the topics with both rates and accelerations, the one with the most messages."
    )
    time_field: str = _on_restart(
        "auto", "Name of the per-point time field. With `none`, the time is derived from the azimuth."
    )
    time_unit: Literal["auto", "s", "ms", "us", "ns"] = _on_restart("auto", "Unit of the per-point time.")
    time_reference: Literal["auto", "absolute", "relative"] = _on_restart(
        "auto", "Whether the per-point time is absolute or relative to the scan's header stamp."
    )
    header_stamp: Literal["auto", "first", "last"] = _on_restart(
        "auto", "Whether a scan's header stamp is the time of its first or of its last point."
    )
    acceleration_unit: Literal["auto", "m/s2", "g", "mg"] = _on_restart("auto", "Unit of the accelerometer.")
    gyroscope_unit: Literal["auto", "rad/s", "deg/s"] = _on_restart("auto", "Unit of the gyroscope.")
    accelerometer_axes: AxesName = _on_restart(
        "xyz", "The recorded axes that are the x, y and z axes of the IMU, such as -yxz."
    )
    gyroscope_axes: AxesName = _on_restart(
        "xyz", "The recorded axes that are the x, y and z axes of the gyroscope, if they differ."
    )
    imu_time_offset: float = _on_restart(
        0.0, "Time added to the IMU's stamps if its clock differs from the LiDAR's.", (-4e9, 4e9, 0.001), "s"
    )
    rotation_rate: float = _on_restart(
        0.0,
        "Revolutions per second, used only if points have no time. 0: the rate of the point clouds.",
        (0, 100, 1),
        "Hz",
    )


class SensorParams(Section):
    """Where the LiDAR is mounted on the IMU, and which returns are used."""

    translation: tuple[Metres, Metres, Metres] = _on_restart(
        (0.0, 0.0, 0.0), "Position of the LiDAR in the IMU frame (x, y, z).", step=0.001, unit="m"
    )
    rotation: tuple[Degrees, Degrees, Degrees] = _on_restart(
        (0.0, 0.0, 0.0),
        "Orientation of the LiDAR in the IMU frame (roll, pitch, yaw; R = Rz Ry Rx).",
        step=0.1,
        unit="deg",
    )
    elevation_corrections: PerLine = _next_frame(
        "", "Added to the elevation of each scan line: numbers separated by spaces, lowest line first.", unit="deg"
    )
    range_corrections: PerLine = _next_frame(
        "", "Added to the ranges of each scan line: numbers separated by spaces, lowest line first.", unit="m"
    )
    min_range: float = _next_frame(
        0.4, "Nearer returns are dropped: they come from the person who carries the scanner.", (0, 10, 0.1), "m"
    )
    max_range: float = _next_frame(100.0, "Farther returns are dropped.", (1, 300, 1), "m")


class GroundParams(Section):
    """Seed-point ground segmentation and ground downsampling (paper 2.2, eq. 1-3)."""

    enabled: bool = _at_once(True, "Segment the ground, and downsample it before the filter uses it.")
    scan_lines: int = _at_once(
        8,
        "Number of outermost scan lines that are searched for ground seeds. More lines give more seeds.",
        (1, 128, 1),
        symbol="M",
    )
    alpha: float = _at_once(
        25.0,
        "Largest angle between a ground seed and straight down. A larger angle gives more seeds.",
        (1, 90, 1),
        "deg",
        symbol="α",
    )
    sigma: float = _at_once(
        0.025,
        "A point is ground if it is nearer to the ground plane than this times its range. More gives more ground.",
        (0.001, 0.2, 0.001),
        "m/m",
        symbol="σ",
    )
    planarity: float = _at_once(
        0.3, "The seeds form a plane if their λ3/λ2 is below this.", (0.01, 1, 0.01), symbol="λ3/λ2"
    )
    max_slope: float = _at_once(
        40.0, "A steeper plane is a wall or the side of a staircase, not ground.", (1, 90, 1), "deg"
    )
    voxel_size: float = _at_once(
        0.5,
        "Edge of the voxels in which ground points are replaced by their centroid.",
        (0.05, 5, 0.05),
        "m",
        symbol="voxel",
    )


class ScanParams(Section):
    """Which points of a scan reach the filter, after ground downsampling."""

    voxel_size: float = _next_frame(
        0.4,
        "Edge of the voxels that downsample all points for the filter (FAST-LIO2's filter_size_surf).",
        (0.05, 3, 0.05),
        "m",
    )


class ImuParams(Section):
    """Noise of the IMU, and how the filter starts."""

    gyro_noise: float = _next_frame(1.2e-3, "Noise density of the gyroscope.", (1e-6, 1, 1e-4), "rad/s/√Hz")
    accel_noise: float = _next_frame(1.3e-2, "Noise density of the accelerometer.", (1e-6, 10, 1e-3), "m/s²/√Hz")
    gyro_bias_walk: float = _next_frame(2.5e-5, "Random walk of the gyroscope's bias.", (0, 1, 1e-5), "rad/s²/√Hz")
    accel_bias_walk: float = _next_frame(1.0e-4, "Random walk of the accelerometer's bias.", (0, 1, 1e-4), "m/s³/√Hz")
    gravity: float = _on_restart(9.81, "Local gravity.", (9.7, 9.9, 0.001), "m/s²")
    max_rate: float = _next_frame(
        35.0,
        "Samples with a higher rate about any axis are refused: no gyroscope measures that much.",
        (5, 1000, 1),
        "rad/s",
    )
    max_acceleration: float = _next_frame(
        490.0,
        "Samples with a higher acceleration on any axis are refused: this is 50 g, more than IMUs measure.",
        (20, 5000, 10),
        "m/s²",
    )
    start_duration: float = _on_restart(
        1.0,
        "Time at rest that the engine waits for at the start, to measure biases and gravity.",
        (0.1, 10, 0.1),
        "s",
    )
    learn_clock: bool = _next_frame(True, "Learn the offset of the IMU's clock and correct its stamps.")
    learn_scale: bool = _next_frame(True, "Learn the gyroscope's scale errors and correct its rates.")
    max_gap: float = _next_frame(
        0.1, "A longer gap between IMU samples is reported and bridged with the LiDAR alone.", (0.005, 5, 0.005), "s"
    )


class FilterParams(Section):
    """The update of the iterated Kalman filter (paper 2.3, eq. 5-7)."""

    point_noise: float = _next_frame(
        0.015, "Standard deviation of a point-to-plane distance on a flat surface.", (0.001, 1, 0.005), "m"
    )
    neighbours: int = _next_frame(
        5,
        "Number of map points that a plane is fitted to. If they lie along a line, more points are added.",
        (4, 20, 1),
    )
    plane_tilt: float = _next_frame(
        1.5,
        "Largest uncertainty of a plane's normal. Points are added until it is met; if it never is, no plane is used.",
        (0.1, 20, 0.1),
        "deg",
    )
    gate: float = _next_frame(
        0.11, "Residuals above this times √range are not used (FAST-LIO2's gate).", (0.01, 1, 0.01), "m/√m"
    )
    max_points: int = _next_frame(
        1000,
        "Largest number of points of a scan that are matched to the map. They are spread evenly.",
        (100, 20_000, 100),
    )
    max_iterations: int = _next_frame(5, "Largest number of iterations in one update.", (1, 20, 1))
    plane_threshold: float = _next_frame(
        0.1, "All points that a plane is fitted to must be nearer to it than this.", (0.01, 1, 0.01), "m"
    )
    neighbour_distance: float = _next_frame(
        1.0, "Map points farther from a point than this are not its neighbours.", (0.2, 5, 0.1), "m"
    )
    estimate_extrinsics: bool = _next_frame(True, "Refine the LiDAR's pose on the IMU while mapping.")
    learn_lines: bool = _next_frame(True, "Learn each scan line's range and elevation errors and correct them.")


class MapParams(Section):
    """The local map: hashed voxels that scans are registered to. Its memory is bounded."""

    voxel_size: float = _on_restart(
        1.0, "Edge of a map voxel. Neighbours are searched within at most one edge length.", (0.1, 3, 0.05), "m"
    )
    spacing: float = _next_frame(
        0.15,
        "Smallest distance between two points of a voxel. It keeps the map from growing at rest.",
        (0, 1, 0.05),
        "m",
    )
    points_per_voxel: int = _on_restart(40, "Largest number of points in one voxel.", (1, 50, 1))
    radius: float = _next_frame(100.0, "Voxels farther than this from the sensor are dropped.", (10, 500, 5), "m")
    max_voxels: int = _on_restart(
        100_000, "Largest number of voxels in the map. It bounds the memory.", (1000, 2_000_000, 1000)
    )


class KeyframeParams(Section):
    """Which frames become keyframes. The map consists of keyframes."""

    distance: float = _next_frame(0.5, "Distance moved after which a frame becomes a keyframe.", (0.05, 20, 0.05), "m")
    angle: float = _next_frame(15.0, "Angle turned after which a frame becomes a keyframe.", (1, 180, 1), "deg")


class MovingParams(Section):
    """Moving points: other keyframes see through their places. Frames are not affected."""

    enabled: bool = _at_once(True, "Label moving points.")
    seen_through: int = _at_once(
        2, "A point is moving if at least this many of the keyframes around its own see through its place.", (1, 10, 1)
    )


class LoopsParams(Section):
    """Loop closure and the pose graph (paper 2.4, eq. 8)."""

    enabled: bool = _on_restart(True, "Search for loops and correct the map with them.")
    min_time: float = _next_frame(15.0, "Shortest time between the two visits of a loop.", (1, 600, 1), "s")
    candidates: int = _next_frame(
        10, "Number of places, nearest by ring key, whose Scan Contexts are compared.", (1, 100, 1), symbol="M"
    )
    verified: int = _next_frame(
        2, "Number of the most similar of these places that are registered for each keyframe.", (1, 10, 1)
    )
    context_distance: float = _next_frame(
        0.3, "Candidates with a larger Scan Context distance are rejected without registration.", (0.01, 1, 0.01)
    )
    submap_keyframes: int = _on_restart(
        8, "Number of keyframes before, and as many after a keyframe, that form its submap with it.", (0, 50, 1)
    )
    submap_voxel: float = _on_restart(0.25, "Edge of the voxels that downsample submaps.", (0.05, 2, 0.05), "m")
    min_overlap: float = _next_frame(
        0.3,
        "Smallest share of the points on upright surfaces near both keyframes that must have a partner.",
        (0, 1, 0.01),
    )
    max_residual: float = _next_frame(
        0.05, "Largest point-to-plane residual (RMS) of a registration.", (0.005, 1, 0.005), "m"
    )
    max_slide: float = _next_frame(
        0.05,
        "A registration pushed along its weakest direction must return this close; else the direction is left open.",
        (0.005, 1, 0.005),
        "m",
    )
    max_mahalanobis: float = _next_frame(
        3.5,
        "Largest distance from where odometry expects a loop. A farther one needs support by several others.",
        (0.5, 20, 0.1),
        "σ",
    )
    support: int = _next_frame(
        2, "Number of candidates nearby that must agree with a candidate before it is accepted.", (0, 10, 1)
    )
    drift_translation: float = _next_frame(
        1.0, "Standard deviation of the drift in position, per distance moved.", (0.01, 20, 0.1), "%"
    )
    drift_height: float = _next_frame(
        0.2,
        "Standard deviation of the drift in height, per distance moved. Gravity keeps it small.",
        (0.01, 20, 0.1),
        "%",
    )
    drift_rotation: float = _next_frame(
        0.02, "Standard deviation of the drift in heading, per distance moved.", (0.001, 2, 0.005), "deg/m"
    )
    latency: int = _on_restart(
        20,
        "Frames from a keyframe until its loops take effect. Fixed, so that results do not depend on speed.",
        (1, 1000, 1),
    )
    window: int = _on_restart(
        0,
        "Number of newest keyframes whose poses are solved for, as in the paper. 0: all keyframes, the whole map.",
        (0, 100_000, 10),
    )
