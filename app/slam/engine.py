"""The engine: one frame in, one result out. Synchronous and deterministic."""

import time
from dataclasses import dataclass, field, replace

import numpy as np

from app.slam import channels, coast, ground, imu, keyframes, pause, start
from app.slam.certainty import Certainty, Doubt
from app.slam.clock import ClockOffset
from app.slam.floor import Floor
from app.slam.fusion import NOT_REGISTERED, Fused, fuse
from app.slam.gyroscope import GyroErrors
from app.slam.imu import POS, Belief
from app.slam.kernels import clouds
from app.slam.keyframes import KeyframeStore
from app.slam.lines import LineErrors
from app.slam.local_map import LocalMap, MapState
from app.slam.params import Params
from app.slam.pause import Interruption
from app.slam.prediction import Prediction, predict
from app.slam.sections import SensorParams
from app.slam.start import Ride
from app.slam.types import (
    F32,
    F64,
    STAGES,
    U8,
    U16,
    Cloud,
    FrameStatus,
    ImuSamples,
    Keyframe,
    NavState,
    Scan,
    StepResult,
)
from app.slam.voxel import VoxelGrid


@dataclass(frozen=True, slots=True)
class EngineProgress:
    """What one frame hands to the next, besides the map.

    Attributes:
        frame: index of the next frame. belief: None until the start is over. still: samples of the rest so far.
        T_odom_keyframe: T_odom_imu of the last keyframe. certainty: of its pose; both None before the first.
        floor: what is known of the floor around a scanner that sees none below itself; None before such a scan.
        lines, gyro, clock: estimated errors of the scan lines, of the gyroscope and of the IMU's clock.
        paused: the pause after which there is no keyframe yet; None if there is none.
        doubt: how far odometry may be off since the last keyframe.
        ride: while the start waits for a rest, what scans show in case the device rides evenly instead; else None.
        bent: whether the map holds only one scan, deskewed at an unknown speed (`app.slam.fusion`).
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
    gyro: GyroErrors = field(default_factory=GyroErrors)
    paused: Interruption | None = None
    doubt: Doubt = field(default_factory=Doubt)
    ride: Ride | None = None
    bent: bool = False


@dataclass(frozen=True, slots=True)
class EngineState:
    """All that the engine's future depends on. Restoring it restores every later result exactly."""

    params: Params
    progress: EngineProgress
    map: MapState
    keyframes: int


@dataclass(frozen=True, slots=True)
class _Begun:
    """The starting point for predicting a scan.

    Attributes:
        belief: before the scan; while waiting, at its end. samples: those that lead from there to the scan's end.
        still: as in `start.Started`. floor, paused: as in `EngineProgress`. notice: for the user; "" if none.
        ride: before the scan, in case the device rides evenly; None unless a longer rest is awaited.
    """

    belief: Belief
    samples: ImuSamples
    floor: Floor | None
    paused: Interruption | None = None
    still: ImuSamples | None = None
    ride: Belief | None = None
    notice: str = ""

    @property
    def waiting(self) -> bool:
        return self.ride is not None


class Engine:
    """LiDAR-inertial odometry and keyframes of one session (paper 2.2-2.4).

    Feed it scans in order of time, each with the IMU samples that cover it (`Measurement`). The
    same scans, samples and parameters give the same results to the last bit. Loops are not its
    concern: `app.mapping.session.Session` looks for them beside it.

    Args:
        keyframes: where to keep them; None: in a temporary file.

    Attributes:
        params: used from the next step on. Those that act on restart are read only when the engine is made.
        keyframes: the full map so far.
    """

    def __init__(self, params: Params, keyframes: KeyframeStore | None = None) -> None:
        self.params = params
        self.keyframes = KeyframeStore() if keyframes is None else keyframes
        self._map = LocalMap(params.map)
        self._grid = VoxelGrid()
        self._progress = EngineProgress()

    def step(self, scan: Scan, samples: ImuSamples) -> StepResult:
        """Process one scan with the samples that cover the time from the previous scan's end to this scan's end.

        Without any samples the velocities are assumed to be constant. Samples without finite rates and a finite
        acceleration other than zero are left out.
        """
        p, before, watch = self.params, self._progress, _Stopwatch()
        end_ns = scan.end_ns
        lines = before.lines if p.filter.learn_lines else LineErrors.unknown()
        clock = before.clock if p.imu.learn_clock else ClockOffset()
        scan = lines.set_right(_in_range(channels.corrected(scan, p.sensor), p.sensor))
        gyro = before.gyro if p.imu.learn_scale else GyroErrors()
        measured = _measured(samples)
        left_out = len(samples) - len(measured)
        bad = (f"{left_out} IMU samples hold no measurement and were left out",) if left_out else ()
        samples = gyro.set_right(clock.set_right(measured))
        begun = self._begin(scan, samples, end_ns)
        prediction = predict(begun.belief, begun.samples, end_ns, p.imu, clock.sigma)
        watch.lap("propagate")
        points = prediction.deskew(scan)
        points.setflags(write=False)
        watch.lap("deskew")

        # paper 2.2: the ground alone is downsampled first, then all points by the filter's scan voxel
        predicted = prediction.belief.state
        down = _down_in_lidar(predicted)
        surface = ground.segment(points, scan.ring, down, p.ground, begun.floor, predicted.T_odom_lidar)
        watch.lap("ground")
        reduced = self._grid.downsample(points, p.ground.voxel_size, chosen=surface.labels)
        sampled = self._grid.downsample(reduced.points, p.scan.voxel_size)
        watch.lap("downsample")

        # paper 2.3, eq. 5-7
        if begun.waiting:
            fused = Fused(prediction.belief, NOT_REGISTERED, points, sampled.points)
        else:
            source, alike = reduced.source[sampled.source], self._alike(begun.belief, begun.samples, end_ns)
            fused = fuse(prediction, scan, points, sampled.points, source, self._map, p, alike)
        mapped = fused if begun.ride is None else self._followed(begun.ride, scan, samples, clock.sigma)
        if mapped.anew:
            self._map.clear()
        status = FrameStatus.LOST if fused.lost else FrameStatus.TRACKING
        status = FrameStatus.INITIALISING if begun.waiting else status
        watch.lap("update")

        posterior, paused = fused.belief, begun.paused
        believed = prediction.covered and not (fused.imu_wrong or fused.anew)
        if status is FrameStatus.TRACKING and fused.registration.inliers and believed:
            if p.imu.learn_clock:
                clock = clock.learnt(begun.samples, predicted, posterior.state)
            if p.imu.learn_scale:
                gyro = gyro.learnt(begun.belief.state, predicted, posterior.state)
        settling = paused is not None and not pause.is_over(paused, end_ns)
        if paused is not None and not settling:
            posterior = pause.levelled(posterior)
            self._map.clear()
        due = not (begun.waiting or settling or fused.bent) and (paused is not None or self._is_due(posterior))
        if due and status is FrameStatus.TRACKING and paused is None and p.filter.learn_lines:
            lines = self._learnt(lines, posterior, fused.points, scan.ring)
        self._insert(mapped.belief if begun.waiting else posterior, mapped)
        watch.lap("insert")

        cloud = _kept(fused.points, surface.labels, scan)
        doubt = before.doubt.after(fused.registration, (end_ns - begun.belief.state.stamp_ns) * 1e-9)
        keyframe, certainty = None, before.certainty
        if due:
            certainty = (certainty or Certainty.begin(posterior, refined=p.filter.estimate_extrinsics)).moved(posterior)
            kept = replace(cloud, offsets_ns=cloud.offsets_ns - np.int32(end_ns - scan.stamp_ns))
            keyframe = self._keyframe(posterior, kept, certainty, paused, doubt.metres)
        watch.lap("keyframe")

        result = StepResult(
            index=before.frame,
            stamp_ns=end_ns,
            status=status,
            state=posterior.state,
            T_map_odom=np.eye(4),
            cloud=cloud,
            ground=surface,
            registration=fused.registration,
            points_in=len(scan),
            points_reduced=len(reduced.points),
            points_filter=len(sampled.points),
            timings_ms=watch.laps(),
            keyframe=keyframe,
            notices=bad + _notices(begun, before.status, status, fused, before.bent),
            truth_ground=scan.truth_ground,
            imu_gap_s=imu.longest_gap(samples, end_ns),
            clock_late_s=clock.late,
            position_sigma=float(np.sqrt(np.linalg.eigvalsh(posterior.covariance[POS, POS])[-1])),
        )
        self._progress = EngineProgress(
            frame=before.frame + 1,
            belief=None if begun.waiting else posterior,
            still=begun.still,
            status=status,
            T_odom_keyframe=before.T_odom_keyframe if keyframe is None else keyframe.T_odom_imu,
            certainty=certainty,
            floor=surface.floor,
            lines=lines,
            clock=clock,
            gyro=gyro,
            paused=paused if settling else None,
            doubt=doubt if keyframe is None else replace(doubt, metres=0.0),
            ride=Ride(mapped.belief, mapped.residual) if begun.waiting else None,
            bent=mapped.bent,
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
        """The present state. It holds only the number of keyframes, since the store keeps them."""
        return EngineState(self.params, self._progress, self._map.checkpoint(), len(self.keyframes))

    def restore(self, state: EngineState) -> None:
        """Go back to a checkpoint, or continue from one of another engine of the same recording."""
        self.params, self._progress = state.params, state.progress
        self._map.restore(state.map)
        self.keyframes.truncate(state.keyframes)

    def close(self) -> None:
        """Release the disk space of the keyframes."""
        self.keyframes.close()

    def _begin(self, scan: Scan, samples: ImuSamples, end_ns: int) -> _Begun:
        """Continue from the previous frame, begin anew after a pause, or start."""
        before, p = self._progress, self.params
        if before.belief is not None:
            paused = pause.before(scan, samples, before.belief.state.stamp_ns)
            if paused is None:
                return _Begun(before.belief, samples, before.floor, before.paused)
            belief, samples = pause.resumed(before.belief, paused, scan, samples, p)
            self._map.clear()
            notice = (
                f"There are neither scans nor IMU samples for {paused.seconds:.1f} s. The map begins anew; loops tie "
                "it to what was mapped before."
            )
            return _Begun(belief, samples, None, paused, notice=notice)
        if not len(samples):
            self._map.clear()  # drop what was mapped while waiting for a rest
            notice = "There is no IMU: motion is estimated from the LiDAR alone, less accurately."
            return _Begun(coast.begin(scan, p), samples, before.floor, notice=notice)
        started, ride = start.proceed(before.still, scan, samples, p), before.ride
        if started.waiting and imu.longest_gap(samples, end_ns) <= p.imu.max_gap:
            begin_ns = max(scan.stamp_ns, int(started.still.stamps_ns[0]))
            by_scans = start.moving(started.still, begin_ns, p) if ride is None else ride.belief
            return _Begun(started.belief, samples, before.floor, still=started.still, ride=by_scans)
        if ride is not None and start.has_ridden(ride, started.belief):
            return _Begun(ride.belief, samples, before.floor, notice=start.RIDING)
        self._map.clear()  # drop what was mapped while waiting for a rest
        return _Begun(started.belief, samples, before.floor, notice=started.notice)

    def _followed(self, ride: Belief, scan: Scan, samples: ImuSamples, clock_sigma: float) -> Fused:
        """The scan fused as if the device moved, in case it does not rest although its IMU suggests so."""
        p = self.params
        prediction = predict(ride, samples, scan.end_ns, p.imu, clock_sigma)
        points = prediction.deskew(scan)
        sampled = self._grid.downsample(points, p.scan.voxel_size)
        alike = self._alike(ride, samples, scan.end_ns)
        return fuse(prediction, scan, points, sampled.points, sampled.source, self._map, p, alike)

    def _alike(self, belief: Belief, samples: ImuSamples, end_ns: int) -> Prediction | None:
        """The prediction for a scan that is bent like the only scan in the map; None if that scan is not bent."""
        if not self._progress.bent:
            return None
        at_map_begin = imu.at_map_begin(belief, self.params.filter.estimate_extrinsics)
        return predict(at_map_begin, samples, end_ns, self.params.imu, self._progress.clock.sigma)

    def _is_due(self, belief: Belief) -> bool:
        return keyframes.is_due(self._progress.T_odom_keyframe, belief.state.T_odom_imu, self.params.keyframe)

    def _learnt(self, lines: LineErrors, belief: Belief, points: F32, rings: U16) -> LineErrors:
        """The line errors, updated with a scan that becomes a keyframe; the first keyframe changes nothing."""
        last = self._progress.T_odom_keyframe
        if last is None:
            return lines
        walked = float(np.linalg.norm(belief.state.p_odom_imu - last[:3, 3]))
        return lines.learnt(belief, points, rings, walked, self._map, self.params.filter)

    def _insert(self, belief: Belief, fused: Fused) -> None:
        points = fused.sampled
        T = belief.state.T_odom_lidar.astype(np.float32)
        self._map.insert(points @ T[:3, :3].T + T[:3, 3], T[:3, 3].astype(np.float64), self.params.map, fused.residual)

    def _keyframe(
        self, belief: Belief, cloud: Cloud, certainty: Certainty, paused: Interruption | None, astray: float
    ) -> Keyframe:
        state, covariance = belief.state, certainty.in_map(belief)
        keyframe = Keyframe(
            index=len(self.keyframes),
            frame=self._progress.frame,
            stamp_ns=state.stamp_ns,
            T_odom_imu=state.T_odom_imu,
            T_imu_lidar=state.T_imu_lidar,
            covariance=covariance,
            cloud=cloud,
            drift=certainty.covariance(belief) - covariance,
            resumed_ns=0 if paused is None else paused.end_ns,
            astray=astray,
        )
        self.keyframes.append(keyframe)
        return keyframe


def _notices(begun: _Begun, last: FrameStatus, status: FrameStatus, fused: Fused, bent: bool) -> tuple[str, ...]:
    """Notices for the user. bent: as in `EngineProgress`, before this frame."""
    notices = [begun.notice] if begun.notice else []
    if bent and not (begun.waiting or begun.paused or fused.bent or fused.anew):
        notices.append(start.GUESSED)
    if status is not last and FrameStatus.LOST in (status, last):
        lost = status is FrameStatus.LOST
        notices.append(f"Lost: {fused.registration.reason}." if lost else "Tracking again.")
    return tuple(notices)


def _down_in_lidar(state: NavState) -> F64:
    down = (state.R_odom_imu @ state.R_imu_lidar).T @ state.g_odom
    return np.asarray(down / np.linalg.norm(down))


def _in_range(scan: Scan, params: SensorParams) -> Scan:
    keep = np.empty(len(scan), dtype=np.bool_)
    if clouds.in_range(scan.points, params.min_range, params.max_range, keep) == len(scan):
        return scan
    return scan.part(keep)


def _measured(samples: ImuSamples) -> ImuSamples:
    """Those that an IMU can measure: finite, and with an acceleration, since gravity is always there."""
    finite = np.isfinite(np.hstack((samples.gyro, samples.accel))).all(axis=1)
    keep = np.asarray(finite & (samples.accel != 0.0).any(axis=1))
    return samples if keep.all() else samples.part(keep)


def _kept(points: F32, labels: U8, scan: Scan) -> Cloud:
    """The cloud of a scan: its deskewed points with all else that is kept, now read-only."""
    for array in (points, labels):
        array.setflags(write=False)
    return Cloud(points, labels, scan.intensity, scan.ring, scan.offsets_ns)


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
