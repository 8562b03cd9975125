"""The one declaration of every parameter: sliders, flags, YAML, REST and documentation come from it.

A parameter has a type, a default, a range, a step, a unit, one sentence of meaning, and says when a
change takes effect: `now` (the current frame is done again at once), `frame` (from the next frame
on) or `restart` (when the recording is opened again).
"""

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator
from pydantic.config import JsonDict

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

    @field_validator("*")
    @classmethod
    def _can_be_written(cls, value: Any) -> Any:
        if isinstance(value, str):
            value.encode()  # half of a character, as JSON can have it, raises
        return value


class RecordingParams(Section):
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


class SensorParams(Section):
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


class GroundParams(Section):
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
        25.0,
        "Largest angle between a seed point and the direction straight down.",
        unit="deg",
        ge=1,
        le=90,
        step=1,
        effect="now",
        symbol="α",
    )
    sigma: float = _param(
        0.025,
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
    max_slope: float = _param(
        40.0,
        "A plane steeper than this is a wall or a stair's side, not ground.",
        unit="deg",
        ge=1,
        le=90,
        step=1,
        effect="now",
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


class ScanParams(Section):
    """What the filter sees of a scan, after the ground was thinned."""

    voxel_size: float = _param(
        0.4,
        "Edge of the voxels in which all points are thinned for the filter (FAST-LIO2's filter_size_surf).",
        unit="m",
        ge=0.05,
        le=3,
        step=0.05,
    )


class ImuParams(Section):
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


class FilterParams(Section):
    """The iterated Kalman filter's update (paper 2.3, eq. 5-7)."""

    point_noise: float = _param(
        0.015,
        "Standard deviation of a point-to-plane distance on a flat surface.",
        unit="m",
        ge=0.001,
        le=1,
        step=0.005,
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
    max_points: int = _param(
        1000,
        "Most points of a scan, evenly over space, that are looked up in the map.",
        ge=100,
        le=20_000,
        step=100,
    )
    max_iterations: int = _param(5, "Most iterations of one update.", ge=1, le=20, step=1)
    plane_threshold: float = _param(
        0.1, "All neighbours must lie within this of their plane.", unit="m", ge=0.01, le=1, step=0.01
    )
    neighbour_distance: float = _param(
        1.0, "Neighbours farther than this from a point are not used.", unit="m", ge=0.2, le=5, step=0.1
    )
    estimate_extrinsics: bool = _param(False, "Estimate the LiDAR's pose on the IMU while mapping.")


class MapParams(Section):
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


class KeyframeParams(Section):
    """Which frames are kept for the map."""

    distance: float = _param(0.5, "A new keyframe after walking this far.", unit="m", ge=0.05, le=20, step=0.05)
    angle: float = _param(15.0, "A new keyframe after turning this far.", unit="deg", ge=1, le=180, step=1)


class LoopsParams(Section):
    """Recognising places seen before, and the graph that they straighten (paper 2.4, eq. 8)."""

    enabled: bool = _param(True, "Look for loops and correct the map by them.", effect="restart")
    min_time: float = _param(15.0, "Places left less long ago than this are no loops.", unit="s", ge=1, le=600, step=1)
    candidates: int = _param(
        10, "Nearest places by ring key whose Scan Contexts are compared.", ge=1, le=100, step=1, symbol="M"
    )
    verified: int = _param(2, "Best of these that are registered, for each keyframe.", ge=1, le=10, step=1)
    context_distance: float = _param(
        0.3, "Candidates whose Scan Contexts differ more than this are refused unregistered.", ge=0.01, le=1, step=0.01
    )
    submap_keyframes: int = _param(
        8, "Keyframes before and after one that make its submap with it.", ge=0, le=50, step=1, effect="restart"
    )
    submap_voxel: float = _param(
        0.25, "Edge of the voxels that thin submaps.", unit="m", ge=0.05, le=2, step=0.05, effect="restart"
    )
    min_overlap: float = _param(
        0.3, "Least share of points near both keyframes that must have a partner.", ge=0, le=1, step=0.01
    )
    max_residual: float = _param(
        0.05, "Most residual, point to plane, of a registration (rms).", unit="m", ge=0.005, le=1, step=0.005
    )
    max_slide: float = _param(
        0.05,
        "A registration pushed along its weakest direction must come back this close, or it slides.",
        unit="m",
        ge=0.005,
        le=1,
        step=0.005,
    )
    max_mahalanobis: float = _param(
        3.5, "Most standard deviations from where odometry expects a loop.", unit="σ", ge=0.5, le=20, step=0.1
    )
    support: int = _param(2, "Candidates nearby that must agree before one is accepted.", ge=0, le=10, step=1)
    drift_translation: float = _param(
        1.0, "Drift of odometry's position (standard deviation) per distance.", unit="%", ge=0.01, le=20, step=0.1
    )
    drift_rotation: float = _param(
        0.02, "Drift of odometry's heading (standard deviation) per distance.", unit="deg/m", ge=0.001, le=2, step=0.005
    )
    latency: int = _param(
        20,
        "Frames after a keyframe at which what was found with it takes effect; fixed, so that results never depend on"
        " the machine's speed.",
        ge=1,
        le=1000,
        step=1,
        effect="restart",
    )
    window: int = _param(
        0,
        "Newest keyframes whose poses are solved for, as in the paper; 0: all, so that late loops straighten the"
        " whole map.",
        ge=0,
        le=100_000,
        step=10,
        effect="restart",
    )
