"""The engine: one frame in, one result out. Synchronous and deterministic."""

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from app.slam import channels, coast, ground, iekf, imu, keyframes, pause, rest, start
from app.slam.certainty import Certainty
from app.slam.clock import ClockOffset
from app.slam.floor import Floor
from app.slam.imu import POS, Belief
from app.slam.kernels import clouds
from app.slam.keyframes import KeyframeStore
from app.slam.lines import LineErrors
from app.slam.local_map import LocalMap, MapState
from app.slam.params import Params
from app.slam.pause import Interruption
from app.slam.sections import FilterParams
from app.slam.types import F64, STAGES, Cloud, FrameStatus, ImuSamples, Keyframe, Registration, Scan, StepResult
from app.slam.voxel import VoxelGrid, spread


@dataclass(frozen=True, slots=True)
class EngineProgress:
    """What one frame hands to the next, besides the map.

    Attributes:
        frame: index of the next one. belief: None until the start is over. still: samples of the rest so far.
        T_odom_keyframe: T_odom_imu of the last keyframe. certainty: of its pose; both None before the first.
        floor: what is known of the floor around a scanner that sees none below itself; None before such a scan.
        lines: estimated errors of the scan lines. clock: estimated offset of the IMU's clock.
        paused: the pause after which there is no keyframe yet; None: there is none.
        contradicted: whether a scan contradicted the prediction since the last keyframe.
    """

    frame: int = 0
    belief: Belief | None = None
    still: ImuSamples | None = None
    status: FrameStatus = FrameStatus.INITIALISING
    T_odom_keyframe: F64 | None = None
    certainty: Certainty | None = None
    floor: Floor | None = None
    lines: LineErrors = field(default_factory=LineErrors.unknown)
    clock: ClockOffset = field(default_factory=ClockOffset)
    paused: Interruption | None = None
    contradicted: bool = False


@dataclass(frozen=True, slots=True)
class EngineState:
    """All that the engine's future depends on. Restoring it restores every later result exactly."""

    params: Params
    progress: EngineProgress
    map: MapState
    keyframes: int


ASTRAY_M = 2.0
"""m: standard deviation of odometry's error once a scan has contradicted it, as after a stretch in which scans show
little: a speed that was wrong by 0.5 m/s for four seconds."""
_Fuse = Callable[[LocalMap, FilterParams], tuple[Belief, Registration]]


class Engine:
    """LiDAR-inertial odometry and keyframes of one session (paper 2.2-2.4).

    Feed it scans in order of time, each with the IMU samples that cover it (`Measurement`). The
    same scans, samples and parameters give the same results to the last bit. Loops are not its
    concern: `app.mapping.session.Session` looks for them beside it.

    Args:
        keyframes: where to keep them; None: in a temporary file.

    Attributes:
        params: used from the next step on; those that act on restart are read only once, here.
        keyframes: the full map so far.
    """

    def __init__(self, params: Params, keyframes: KeyframeStore | None = None) -> None:
        self.params = params
        self.keyframes = KeyframeStore() if keyframes is None else keyframes
        self._map = LocalMap(params.map)
        self._grid = VoxelGrid()
        self._progress = EngineProgress()

    def step(self, scan: Scan, samples: ImuSamples) -> StepResult:
        """Process one scan with the samples that cover the time from the previous scan's end to its own.

        Without any samples the velocities are taken to be constant.
        """
        p, before, watch = self.params, self._progress, _Stopwatch()
        end_ns, notices = scan.end_ns, []
        scan = _in_range(channels.corrected(scan, p.sensor), p.sensor.min_range, p.sensor.max_range)
        lines = before.lines if p.filter.learn_lines else LineErrors.unknown()
        if lines.errors.any():
            scan = channels.bent(scan, -lines.errors[:, 1], -lines.errors[:, 0])
        clock = before.clock if p.imu.learn_clock else ClockOffset()
        samples = clock.set_right(samples)
        silent_s = imu.longest_gap(samples, end_ns)
        if before.belief is not None and (paused := pause.before(scan, samples, before.belief.state.stamp_ns)):
            resumed, samples = pause.resumed(before.belief, paused, scan, samples, p)
            before = replace(before, belief=resumed, floor=None, paused=paused)
            self._map.clear()
            notices.append(
                f"There are neither scans nor IMU samples for {paused.seconds:.1f} s. The map begins anew; loops tie "
                "it to what was mapped before."
            )
        gapless = imu.longest_gap(samples, end_ns) <= p.imu.max_gap

        belief, still, waiting = before.belief, before.still, False
        if belief is None and not len(samples):
            belief = coast.begin(scan, p)
            notices.append("There is no IMU: motion is estimated from the LiDAR alone, less accurately.")
        elif belief is None:
            started = start.proceed(still, scan, samples, p)
            belief, still, waiting = started.belief, started.still, started.waiting and gapless
            notices += [started.notice] if started.notice else []
        if len(samples):
            before_scan = belief if gapless else imu.before_gap(belief)
            predicted, path = imu.propagate(before_scan, samples, end_ns, p.imu, clock.sigma)
            unsure = coast.is_unsure(predicted)
            predicted = rest.hold(predicted, samples) if gapless and not unsure else predicted
            watch.lap("propagate")
            points = imu.deskew(scan, path, predicted.state)
            course = coast.Course.measured(path, predicted.state) if not gapless or unsure else None
        else:
            course = coast.Course.steady(belief.state.stamp_ns, end_ns)
            predicted = coast.propagate(belief, end_ns, course)
            watch.lap("propagate")
            points = coast.deskew(scan, predicted.state, course)
        watch.lap("deskew")

        # paper 2.2: the ground, and only the ground, is thinned before the filter's own scan voxel
        down, T_odom_lidar = _down_in_lidar(predicted), predicted.state.T_odom_lidar
        surface = ground.segment(points, scan.ring, down, p.ground, before.floor, T_odom_lidar)
        watch.lap("ground")
        reduced = self._grid.downsample(points, p.ground.voxel_size, chosen=surface.labels)
        sampled = self._grid.downsample(reduced.points, p.scan.voxel_size)
        watch.lap("downsample")

        # paper 2.3, eq. 5-7
        posterior, registration, adrift, contradicted = predicted, _NOT_REGISTERED, False, before.contradicted
        if self._map.voxels:
            if course is None:
                chosen = spread(sampled.points, p.filter.max_points, p.scan.voxel_size)
                fuse = partial(iekf.update, predicted, chosen)
                posterior, registration = self._update(belief, predicted, fuse)
                if registration.surprise > iekf.SURPRISING:  # once more, as if nothing were known of the speed
                    contradicted = True
                    open_speed = imu.with_open_speed(predicted, (end_ns - belief.state.stamp_ns) * 1e-9)
                    posterior, _ = self._update(belief, predicted, partial(iekf.update, open_speed, chosen))
            else:  # the points themselves, since centroids have no time
                source, refines = reduced.source[sampled.source], p.filter.estimate_extrinsics and gapless
                fuse = partial(coast.update, predicted, scan.part(source), course, extrinsics=refines)
                posterior, registration = self._update(belief, predicted, fuse)
                points = coast.deskew(scan, posterior.state, course)
                sampled = replace(sampled, points=points[source])
                # the prediction was no measurement that the scan could contradict
                registration = replace(registration, predicted_change=np.nan, correction=np.nan)
                blind = not len(samples) or not gapless
                if blind and registration.degenerate and coast.is_adrift(posterior):
                    adrift, why = True, "the IMU is silent" if len(samples) else "there is no IMU"
                    registration = replace(registration, reason=f"{registration.reason}, and {why}")
        posterior = posterior if gapless else imu.after_gap(posterior, belief)
        if iekf.is_imu_to_blame(registration):
            posterior = imu.with_open_biases(posterior)
        status = FrameStatus.LOST if adrift else _status(waiting, self._map.voxels > 0, registration)
        watch.lap("update")

        if registration.inliers and status is FrameStatus.TRACKING and len(samples) and gapless and p.imu.learn_clock:
            clock = clock.learnt(samples, predicted.state, posterior.state)
        paused = before.paused
        settling = paused is not None and not pause.is_over(paused, end_ns)
        if paused is not None and not settling:
            posterior = pause.levelled(posterior)
            self._map.clear()
        here, last = posterior.state.T_odom_imu, before.T_odom_keyframe
        due = not waiting and not settling and (paused is not None or keyframes.is_due(last, here, p.keyframe))
        mapped = status is FrameStatus.TRACKING and paused is None
        if due and last is not None and mapped and p.filter.learn_lines:
            walked = float(np.linalg.norm(here[:3, 3] - last[:3, 3]))
            lines = lines.learnt(posterior, points, scan.ring, walked, self._map, p.filter)
        if not waiting:
            self._insert(posterior, sampled.points, float(np.nan_to_num(registration.residual_rms)))
        watch.lap("insert")

        cloud = Cloud(points, surface.labels, scan.intensity, scan.ring, scan.offsets_ns)
        for array in (points, surface.labels, scan.intensity, scan.ring, scan.offsets_ns):
            array.setflags(write=False)
        keyframe, certainty = None, before.certainty
        if due:
            certainty = (certainty or Certainty.begin(posterior, refined=p.filter.estimate_extrinsics)).moved(posterior)
            resumed_ns, astray = 0 if paused is None else paused.end_ns, ASTRAY_M if contradicted else 0.0
            keyframe = self._keyframe(posterior, cloud, certainty, resumed_ns, astray)
        watch.lap("keyframe")

        if status is not before.status and FrameStatus.LOST in (status, before.status):
            notices.append(f"Lost: {registration.reason}." if status is FrameStatus.LOST else "Tracking again.")
        result = StepResult(
            index=before.frame,
            stamp_ns=end_ns,
            status=status,
            state=posterior.state,
            T_map_odom=np.eye(4),
            cloud=cloud,
            ground=surface,
            registration=registration,
            points_in=len(scan),
            points_reduced=len(reduced.points),
            points_filter=len(sampled.points),
            timings_ms=watch.laps(),
            keyframe=keyframe,
            notices=tuple(notices),
            truth_ground=scan.truth_ground,
            imu_gap_s=silent_s,
            clock_late_s=clock.late,
            position_sigma=float(np.sqrt(np.linalg.eigvalsh(posterior.covariance[POS, POS])[-1])),
        )
        T_odom_keyframe = before.T_odom_keyframe if keyframe is None else keyframe.T_odom_imu
        self._progress = EngineProgress(
            frame=before.frame + 1,
            belief=None if waiting else posterior,
            still=still,
            status=status,
            T_odom_keyframe=T_odom_keyframe,
            certainty=certainty,
            floor=surface.floor,
            lines=lines,
            clock=clock,
            paused=paused if settling else None,
            contradicted=contradicted and keyframe is None,
        )
        return result

    @property
    def g_odom(self) -> F64:
        """(3,) m/s^2, gravity as estimated by now; before the start is over, straight down."""
        belief = self._progress.belief
        return np.array([0.0, 0.0, -self.params.imu.gravity]) if belief is None else belief.state.g_odom

    def relabel(self, result: StepResult) -> StepResult:
        """The same frame with its ground segmented by the present parameters. Changes nothing else."""
        cloud, before, p = result.cloud, result.ground, self.params.ground
        surface = ground.segment(cloud.points, cloud.ring, before.down, p, before.known, before.T_odom_lidar)
        reduced = self._grid.downsample(cloud.points, p.voxel_size, chosen=surface.labels)
        surface.labels.setflags(write=False)
        return replace(
            result, cloud=replace(cloud, labels=surface.labels), ground=surface, points_reduced=len(reduced.points)
        )

    def checkpoint(self) -> EngineState:
        """The present state; of the keyframes only their number, since the store keeps them."""
        return EngineState(self.params, self._progress, self._map.checkpoint(), len(self.keyframes))

    def restore(self, state: EngineState) -> None:
        """Go back to (or, in another engine of the same recording, on from) a checkpoint."""
        self.params, self._progress = state.params, state.progress
        self._map.restore(state.map)
        self.keyframes.truncate(state.keyframes)

    def close(self) -> None:
        """Give the disk space of the keyframes back."""
        self.keyframes.close()

    def _update(self, last: Belief, predicted: Belief, fuse: _Fuse) -> tuple[Belief, Registration]:
        """What `fuse` gives; after a numerical failure, the prediction stands and the frame is lost."""
        with contextlib.suppress(np.linalg.LinAlgError):
            posterior, registration = fuse(self._map, self.params.filter)
            if np.isfinite(posterior.covariance).all() and np.isfinite(posterior.state.T_odom_imu).all():
                change, correction = (
                    float(np.linalg.norm(after.v_odom_imu - before.v_odom_imu))
                    for before, after in ((last.state, predicted.state), (predicted.state, posterior.state))
                )
                return posterior, replace(registration, predicted_change=change, correction=correction)
        return predicted, replace(_NOT_REGISTERED, reason="the update gave no finite pose")

    def _insert(self, belief: Belief, points: np.ndarray, residual: float) -> None:
        T = belief.state.T_odom_lidar.astype(np.float32)
        self._map.insert(points @ T[:3, :3].T + T[:3, 3], T[:3, 3].astype(np.float64), self.params.map, residual)

    def _keyframe(self, belief: Belief, cloud: Cloud, certainty: Certainty, resumed_ns: int, astray: float) -> Keyframe:
        state = belief.state
        covariance = certainty.in_map(belief)
        keyframe = Keyframe(
            index=len(self.keyframes),
            frame=self._progress.frame,
            stamp_ns=state.stamp_ns,
            T_odom_imu=state.T_odom_imu,
            T_imu_lidar=state.T_imu_lidar,
            covariance=covariance,
            cloud=cloud,
            drift=certainty.covariance(belief) - covariance,
            resumed_ns=resumed_ns,
            astray=astray,
        )
        self.keyframes.append(keyframe)
        return keyframe


_NOT_REGISTERED = Registration(
    False, 0, 0, 0, float("nan"), np.full(6, np.nan), False, "the map is still empty; this scan begins it"
)


def _status(waiting: bool, mapped: bool, registration: Registration) -> FrameStatus:
    if waiting:
        return FrameStatus.INITIALISING
    if mapped and registration.inliers < iekf.MIN_INLIERS:
        return FrameStatus.LOST
    return FrameStatus.TRACKING


def _down_in_lidar(belief: Belief) -> np.ndarray:
    state = belief.state
    down = (state.R_odom_imu @ state.R_imu_lidar).T @ state.g_odom
    return np.asarray(down / np.linalg.norm(down))


def _in_range(scan: Scan, nearest: float, farthest: float) -> Scan:
    keep = np.empty(len(scan), dtype=np.bool_)
    if clouds.in_range(scan.points, nearest, farthest, keep) == len(scan):
        return scan
    return scan.part(keep)


class _Stopwatch:
    """Milliseconds of each stage. What it reads never influences a result."""

    def __init__(self) -> None:
        self._begin = self._last = time.perf_counter()
        self._laps = dict.fromkeys(STAGES, 0.0)

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self._laps[stage] += (now - self._last) * 1e3
        self._last = now

    def laps(self) -> dict[str, float]:
        return {**self._laps, "total": (self._last - self._begin) * 1e3}
