"""Values that pass between the packages. Frozen; their arrays are read-only.

Conventions (all of hemislam):
- `T_target_source` maps coordinates of `source` into `target`; 4x4 float64, or (R, p).
- Frames: `lidar` and `imu` are the sensors' own axes. `odom` is the filter's world: its origin is
  the first IMU pose, its +z axis points up (against gravity). `map` is `odom` corrected by loop
  closures, and equal to it without any.
- Time is integer nanoseconds since the Unix epoch; only differences are floats, in seconds.
- Units are SI; angles are radians in code and degrees where a person sets them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from app.slam.arrays import F32 as F32
from app.slam.arrays import F64 as F64
from app.slam.arrays import I32 as I32
from app.slam.arrays import I64 as I64
from app.slam.arrays import U8 as U8
from app.slam.arrays import U16 as U16
from app.slam.arrays import Mask as Mask
from app.slam.arrays import Vector as Vector
from app.slam.floor import Floor
from app.slam.loops.types import LoopEdge

NON_GROUND, GROUND, SEED, MOVING = 0, 1, 2, 3
"""Point labels. A seed is a ground point that also helped to fit the plane. Only keyframes have moving points, and only
once the keyframes around them are there (`app.mapping.labels`)."""


def is_ground(labels: U8) -> Mask:
    """(n,) whether labels (n,) are GROUND or SEED."""
    return np.asarray((labels == GROUND) | (labels == SEED))


@dataclass(frozen=True, slots=True)
class Scan:
    """One LiDAR revolution as measured, in any order, without invalid returns. Its arrays become read-only.

    Attributes:
        stamp_ns: time of the FIRST point.
        points: (n, 3) float32, metres, LiDAR frame at each point's own time (not deskewed).
        offsets_ns: (n,) int32, each point's time after `stamp_ns`, >= 0.
        intensity: (n,) float32, the sensor's own scale (0-255 for RoboSense).
        ring: (n,) uint16, rank of the scan line's elevation; 0 = lowest = outermost cone.
        truth_ground: (n,) uint8, 1 where the recording labels a point as ground; None without labels.
        refused: how many more points there were that cannot be returns: too far, or without a time.
    """

    stamp_ns: int
    points: F32
    offsets_ns: I32
    intensity: F32
    ring: U16
    truth_ground: U8 | None = None
    refused: int = 0

    def __post_init__(self) -> None:
        columns = (self.offsets_ns, self.intensity, self.ring, self.truth_ground)
        shapes = [array.shape for array in (self.points, *columns) if array is not None]
        count = len(self.points)
        if shapes != [(count, 3), *[(count,)] * (len(shapes) - 1)]:  # kernels check no bounds
            raise ValueError(
                f"a scan has points (n, 3), and offsets_ns, intensity and ring (n,), but these are {shapes}"
            )
        for array in (self.points, *columns):
            if array is not None:
                array.setflags(write=False)

    @property
    def end_ns(self) -> int:
        """Time of the last point. The pose of a frame is the pose at this time."""
        return self.stamp_ns + (int(self.offsets_ns.max()) if self.offsets_ns.size else 0)

    def part(self, which: Mask | I32 | I64) -> "Scan":
        """Some of its points, by a mask or by their indices; `refused` is not kept."""
        labels = None if self.truth_ground is None else self.truth_ground[which]
        points, offsets_ns = self.points[which], self.offsets_ns[which]
        return Scan(self.stamp_ns, points, offsets_ns, self.intensity[which], self.ring[which], labels)

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True)
class Samples:
    """Consecutive stamped samples of one sensor. A kind of sensor is a subclass that adds arrays of k rows.

    Attributes:
        stamps_ns: (k,) int64.
    """

    stamps_ns: I64

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True, slots=True)
class ImuSamples(Samples):
    """Consecutive IMU samples, strictly increasing in time.

    Attributes:
        gyro: (k, 3) float64, rad/s, IMU frame.
        accel: (k, 3) float64, specific force in m/s^2, IMU frame (+9.81 upwards at rest).
    """

    gyro: F64
    accel: F64

    def __post_init__(self) -> None:
        shapes = [array.shape for array in (self.gyro, self.accel, self.stamps_ns)]
        if shapes != [(len(self), 3), (len(self), 3), (len(self),)]:
            raise ValueError(f"IMU samples have gyro (k, 3), accel (k, 3) and stamps_ns (k,), but these are {shapes}")

    def part(self, which: Mask | slice) -> "ImuSamples":
        """Some of them, by a mask or a slice."""
        return ImuSamples(self.stamps_ns[which], self.gyro[which], self.accel[which])


@dataclass(frozen=True, slots=True)
class Measurement:
    """A scan with the IMU samples that cover it.

    `imu` runs from the last sample at or before the previous scan's end (for the first scan: from
    the first sample there is) to the first sample at or after this scan's end, so that both ends
    can be interpolated. While the IMU is silent it ends earlier, with the last sample there is.
    `notices` says what was wrong with their times (gaps, back-steps). `streams` holds the samples
    of other sensors (satellite fixes, wheel odometry, images) by their type: those up to this
    scan's end that no earlier measurement holds, in order of time.
    """

    scan: Scan
    imu: ImuSamples
    notices: tuple[str, ...] = ()
    streams: Mapping[type[Samples], Samples] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DroppedScan:
    """A scan that the engine does not get. `reason`: why, in a few words for a report."""

    stamp_ns: int
    reason: str


@dataclass(frozen=True, slots=True)
class NavState:
    """The filter's state (paper eq. 4) at `stamp_ns`.

    Attributes:
        R_odom_imu: (3, 3). p_odom_imu: (3,) m. v_odom_imu: (3,) m/s.
        b_gyro: (3,) rad/s and b_accel: (3,) m/s^2, IMU frame. Without an IMU, b_gyro is minus the rate of turn.
        g_odom: (3,) m/s^2, gravity (pointing down, norm fixed).
        R_imu_lidar: (3, 3). p_imu_lidar: (3,) m.
    """

    stamp_ns: int
    R_odom_imu: F64
    p_odom_imu: F64
    v_odom_imu: F64
    b_gyro: F64
    b_accel: F64
    g_odom: F64
    R_imu_lidar: F64
    p_imu_lidar: F64

    @property
    def T_odom_imu(self) -> F64:
        T = np.eye(4)
        T[:3, :3] = self.R_odom_imu
        T[:3, 3] = self.p_odom_imu
        return T

    @property
    def T_imu_lidar(self) -> F64:
        T = np.eye(4)
        T[:3, :3] = self.R_imu_lidar
        T[:3, 3] = self.p_imu_lidar
        return T

    @property
    def T_odom_lidar(self) -> F64:
        return self.T_odom_imu @ self.T_imu_lidar

    @property
    def p_odom_lidar(self) -> F64:
        return self.R_odom_imu @ self.p_imu_lidar + self.p_odom_imu


@dataclass(frozen=True, slots=True)
class Cloud:
    """A deskewed scan, as it is drawn, stored in keyframes and exported.

    Attributes:
        points: (n, 3) float32, metres, LiDAR frame at the scan's end.
        labels: (n,) uint8 of NON_GROUND, GROUND, SEED, MOVING.
        intensity: (n,) float32. ring: (n,) uint16. offsets_ns: (n,) int32, as in `Scan`.
    """

    points: F32
    labels: U8
    intensity: F32
    ring: U16
    offsets_ns: I32

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True)
class GroundResult:
    """What ground segmentation found in one scan (paper 2.2).

    Attributes:
        labels: (n,) uint8 of NON_GROUND, GROUND, SEED.
        found: whether a plane was accepted. reason: why not, in words; "" if one was.
        normal: (3,) unit normal of the plane, LiDAR frame, pointing up. centroid: (3,) m.
        down: (3,) unit direction of gravity in the LiDAR frame, as used.
        planarity: lambda3 / lambda2 of the seeds (nan without seeds); accepted below the limit.
        seeds: number of seed points. share: ground points over all points, 0-1.
        T_odom_lidar: (4, 4) as used; None for a lone scan.
        known, floor: the floor around a scanner that sees none below itself, before this scan and with it; None if no
            such scan has come.
    """

    labels: U8
    found: bool
    reason: str
    normal: F64
    centroid: F64
    down: F64
    planarity: float
    seeds: int
    share: float
    T_odom_lidar: F64 | None = None
    known: Floor | None = None
    floor: Floor | None = None


@dataclass(frozen=True, slots=True)
class Matches:
    """The points that the filter looked up in the map, and the planes that it found for them.

    Attributes:
        points: (n, 3) float32 m, LiDAR frame at the scan's end.
        residuals: (n,) float32, signed distance to the plane in m; nan where no plane was accepted.
        normals: (n, 3) unit and centers: (n, 3) m, float32, odom; zeros where no plane was found.
    """

    points: F32
    residuals: F32
    normals: F32
    centers: F32


@dataclass(frozen=True, slots=True)
class Registration:
    """How the filter's update went (paper eq. 5-7).

    Attributes:
        converged, iterations: of the iterated update.
        used: points looked up in the map. inliers: points with an accepted plane.
        residual_rms: m, point to plane, of the inliers after the update.
        eigenvalues: (6,) ascending, of the 6x6 pose information with rotation scaled to metres. A small one
            means that the scan hardly observes that direction.
        degenerate: whether this scan alone leaves a direction unobserved. reason: in words.
        matches: by point; None if nothing was looked up.
        predicted_change, correction: m/s, how much the IMU changed the velocity since the last frame, and how much of
            that, or in addition, the update changed.
        surprise: square of the update's correction in units of the predicted covariance, for each degree of freedom
            that the scan determines: about 1, or less, if neither scan nor prediction is wrong.
    """

    converged: bool
    iterations: int
    used: int
    inliers: int
    residual_rms: float
    eigenvalues: F64
    degenerate: bool
    reason: str = ""
    matches: Matches | None = None
    predicted_change: float = float("nan")
    correction: float = float("nan")
    surprise: float = float("nan")


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A cloud that stays in its own frame; only its pose moves when loops are closed.

    Attributes:
        index: 0, 1, 2, ... frame: index of the frame it was taken from. stamp_ns: scan end.
        T_odom_imu: (4, 4) pose by odometry. T_imu_lidar: (4, 4) at that moment.
        covariance: (6, 6) of the pose against the local map, rotation (IMU frame) then translation (odom).
        cloud: in the LiDAR frame at `stamp_ns`, from which its `offsets_ns` count, <= 0.
        drift: (6, 6) what drift since the first keyframe adds to `covariance`.
        resumed_ns: when the scans went on, if it is the first after a pause (`app.slam.pause`); otherwise 0.
        astray: m, standard deviation by which odometry may be off since the last keyframe, if a scan contradicted it;
            otherwise 0.
    """

    index: int
    frame: int
    stamp_ns: int
    T_odom_imu: F64
    T_imu_lidar: F64
    covariance: F64
    cloud: Cloud
    drift: F64 = field(default_factory=lambda: np.zeros((6, 6)))
    resumed_ns: int = 0
    astray: float = 0.0


class FrameStatus(StrEnum):
    INITIALISING = "initialising"
    """The device rests at the start, for the first biases. The pose is the origin."""
    TRACKING = "tracking"
    LOST = "lost"
    """Too few points match the map. The pose is the IMU's prediction."""


STAGES = ("propagate", "deskew", "ground", "downsample", "update", "insert", "keyframe", "loops")
"""Stages of `Engine.step`, in order."""
TIMINGS = (*STAGES, "total")
"""Keys of `StepResult.timings_ms`."""


@dataclass(frozen=True, slots=True)
class StepResult:
    """The result of processing one frame.

    Attributes:
        index: frame number from 0. stamp_ns: scan end, the time of `state`.
        T_map_odom: (4, 4). The pose in the map is T_map_odom @ state.T_odom_imu.
        cloud: deskewed points with labels. ground, registration: results of these steps.
        points_in: points of the scan. points_reduced: after ground downsampling.
        points_filter: after the scan voxel, as the filter gets them.
        timings_ms: of STAGES and "total". keyframe: if this frame became one.
        loops: candidates that took effect with this frame, or whose verdict changed.
        notices: what a user should know about this frame, in sentences.
        imu_gap_s: longest time between the IMU samples that cover it.
        dropped: scans dropped between the frame before and this one.
        clock_late_s: how late the IMU's clock is, as estimated so far.
        position_sigma: m, standard deviation of the position in its most uncertain direction, by the filter.
    """

    index: int
    stamp_ns: int
    status: FrameStatus
    state: NavState
    T_map_odom: F64
    cloud: Cloud
    ground: GroundResult
    registration: Registration
    points_in: int
    points_reduced: int
    points_filter: int
    timings_ms: dict[str, float]
    keyframe: Keyframe | None = None
    loops: tuple[LoopEdge, ...] = ()
    notices: tuple[str, ...] = field(default=())
    truth_ground: U8 | None = None
    imu_gap_s: float = 0.0
    dropped: int = 0
    clock_late_s: float = 0.0
    position_sigma: float = 0.0

    @property
    def T_map_imu(self) -> F64:
        return self.T_map_odom @ self.state.T_odom_imu

    @property
    def T_map_lidar(self) -> F64:
        return self.T_map_imu @ self.state.T_imu_lidar
