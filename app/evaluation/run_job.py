"""Runs a job with the engine or a baseline, and writes its files."""

import json
import os
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict
from itertools import islice
from typing import Any

import numpy as np

from app import __version__
from app.baselines.poses import keep_keyframe
from app.baselines.systems import find_system
from app.evaluation import crops, map_sharpness
from app.evaluation.job import GROUND_RANGES_M, Job, reopen
from app.export.exports import timings_csv
from app.mapping.feed import FeedInfo, FileFeed
from app.mapping.opening import open_session
from app.mapping.painted import UNMARKED
from app.mapping.session import Session
from app.slam.errors import HemislamError
from app.slam.keyframes import KeyframeStore
from app.slam.loops.types import Origin, Verdict
from app.slam.metrics import GroundScore
from app.slam.provenance import describe_machine, peak_memory_mb
from app.slam.report import finite
from app.slam.trajectory import Trajectory, write_tum
from app.slam.types import F64, TIMINGS, FrameStatus, Keyframe, Measurement, StepResult


def run_job(job: Job, progress: Callable[[int, int], None]) -> None:
    """Run to the end and write the files; `progress` is called with (frames done, frames in all).

    Raises:
        HemislamError: the recording cannot be used. OSError: the disk is full or fails.
    """
    from app.slam.loops.service import InlineLoops
    from app.slam.warmup import compile_kernels

    compile_kernels()
    if job.baseline:
        run_baseline(job, progress)
        return
    marks = dict(job.marks)
    ground, cpu_ms = [GroundScore() for _ in GROUND_RANGES_M[1:]], list[float]()
    session = open_session(job.recording, job.params, *job.read, loops=InlineLoops)
    try:
        info = session.feed.info
        while (entry := session.peek()) is not None:
            if not isinstance(entry, Measurement):
                continue
            begin = time.process_time()
            result = session.advance()
            cpu_ms.append((time.process_time() - begin) * 1e3)
            assert isinstance(result, StepResult)
            if result.stamp_ns > job.begin_ns(info):
                _score_ground(ground, result, marks)
            progress(session.frame + 1, info.frames or 0)
        if session.loops:
            session.loops.poll()  # the loops of the last keyframes
        log, frame, keyframes = session.log, session.map_frame, session.engine.keyframes
        poses = frame.poses(np.array([keyframe.T_odom_imu for keyframe in keyframes]).reshape(-1, 4, 4))
        times = np.column_stack([log.timings_ms, cpu_ms])
        facts = _common(job) | {
            "lost": log.statuses[FrameStatus.LOST],
            "dropped": dict(log.dropped.most_common()),
            "loops": None if session.loops is None else session.loops.accepted,
            "loop_drift_m": _loop_drift(session),
            "ground_share": log.ground_share,
            "ground": [asdict(score) for score in ground] if job.marks or log.ground_score is not None else None,
        }
        _write(job, info, frame.trajectory(log.odometry), times, keyframes, poses, facts)
    finally:
        session.close()


def run_baseline(job: Job, progress: Callable[[int, int], None]) -> None:
    """Run another system on the same measurements. For the map, its clouds are undistorted with its own poses.

    If it returns no finite pose, its last pose is used, and the frame counts as lost.
    """
    system = find_system(job.baseline).start(job.params)
    feed, keyframes = FileFeed(job.recording, job.params, *job.read), KeyframeStore()
    stamps, poses, times, dropped = list[int](), list[F64](), list[list[float]](), Counter[str]()
    lost = 0
    try:
        while (entry := feed.next()) is not None:
            if not isinstance(entry, Measurement):
                dropped[entry.reason] += 1
                continue
            begin, cpu_begin = time.perf_counter(), time.process_time()
            stamp, pose = system.step(entry)
            taken = (time.perf_counter() - begin) * 1e3, (time.process_time() - cpu_begin) * 1e3
            times.append([*[0.0] * (len(TIMINGS) - 1), *taken])  # no stages
            if not np.isfinite(pose).all():
                lost, pose = lost + 1, poses[-1] if poses else np.eye(4)
            keep_keyframe(keyframes, entry.scan, (stamp, pose), (stamps[-1], poses[-1]) if poses else None, job.params)
            stamps.append(stamp)
            poses.append(pose)
            progress(len(poses), feed.info.frames or 0)
        trajectory = Trajectory.from_poses(stamps, np.array(poses))
        facts = _common(job) | {"lost": lost, "dropped": dict(dropped.most_common())}
        kept = np.array([keyframe.T_odom_imu for keyframe in keyframes]).reshape(-1, 4, 4)
        _write(job, feed.info, trajectory, np.array(times), keyframes, kept, facts)
    finally:
        keyframes.close()
        feed.close()


def _common(job: Job) -> dict[str, Any]:
    """The entries of run.json that every run has."""
    return {
        "key": job.key,
        "hemislam": __version__,
        "code": job.code,
        "recording": str(job.recording),
        "sha256": job.sha256,
        "variant": job.variant,
        "baseline": job.baseline,
        "parameters": job.params.model_dump(mode="json"),
        "start_s": job.start_s,
        "duration_s": job.duration_s,
        "peak_memory_mb": peak_memory_mb(),
        "load": os.getloadavg()[0],
        "machine": describe_machine(),
    }


def _loop_drift(session: Session) -> float | None:
    """Median distance (m) between the newer keyframes of accepted loops and where odometry places them."""
    if session.loops is None:
        return None
    poses = [keyframe.T_odom_imu for keyframe in session.engine.keyframes]
    drifts = [
        np.linalg.norm((np.linalg.inv(poses[edge.older]) @ poses[edge.newer] - edge.T_older_newer)[:3, 3])
        for edge in session.loops.edges
        if edge.verdict is Verdict.ACCEPTED and edge.origin is Origin.DETECTED
    ]
    return float(np.median(drifts)) if drifts else None


def _write(
    job: Job, info: FeedInfo, whole: Trajectory, times: F64, keyframes: KeyframeStore, poses: F64, facts: dict[str, Any]
) -> None:
    """Cut off the lead, measure the map, and write all files.

    Args:
        whole: including the lead. times: (n, stages, total and CPU), ms. poses: of the keyframes.

    Raises:
        HemislamError: the recording ends before the part begins.
    """
    counted = whole.stamps_ns > job.begin_ns(info)
    if not counted.any():
        lasts = f"; it lasts {info.duration_s:.1f} s" if info.duration_s is not None else ""
        raise HemislamError(f"{job.recording} has no scan after {job.start_s:g} s{lasts}.")
    trajectory = whole.chosen(counted)
    before = sum(keyframes.when(index)[1] <= job.begin_ns(info) for index in range(len(keyframes)))
    poses = poses[before:]

    def part_of_map() -> Iterator[Keyframe]:
        return islice(keyframes, before, None)

    measured = map_sharpness.measure(map_sharpness.collect(part_of_map(), poses))
    facts |= {"frames": len(trajectory), "distance_m": trajectory.distance, "map_sharpness": finite(asdict(measured))}
    timings = timings_csv(trajectory.stamps_ns, times[counted, :-1], {"cpu_ms": times[counted, -1]})
    reopen(job)
    write_tum(job.folder / "trajectory.tum", trajectory)
    (job.folder / "timings.csv").write_text(timings, encoding="utf-8")
    centres = {place: _position_at(trajectory, share) for place, share in crops.PLACES.items()}
    pieces = {place: crops.crop(part_of_map(), poses, centre) for place, centre in centres.items()}
    np.savez_compressed(job.folder / "crops.npz", allow_pickle=False, **pieces)
    text = json.dumps(facts, indent=2, ensure_ascii=False) + "\n"
    (job.folder / "run.json").write_text(text, encoding="utf-8", errors="backslashreplace")  # paths need not be UTF-8


def _score_ground(scores: list[GroundScore], result: StepResult, marks: dict[int, bytes]) -> None:
    """Add a frame's score over all its points or, if there are marks, over the marked points."""
    cloud, truth = result.cloud, result.truth_ground
    if marks:
        truth = np.frombuffer(marks.get(result.stamp_ns, b""), np.uint8)
    if truth is None or len(truth) != len(cloud):
        return
    ranges = np.digitize(np.linalg.norm(cloud.points, axis=1), GROUND_RANGES_M[1:-1])
    for index in range(len(scores)):
        chosen = (ranges == index) & (truth != UNMARKED)
        scores[index] += GroundScore.of(cloud.labels[chosen], truth[chosen])


def _position_at(trajectory: Trajectory, share: float) -> F64:
    stamps = trajectory.stamps_ns
    wanted = stamps[0] + int(share * (stamps[-1] - stamps[0]))
    return np.asarray(trajectory.positions[int(np.argmin(np.abs(stamps - wanted)))])
