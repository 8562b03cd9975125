"""One recording run with one variant or baseline, in a process of its own, and the files that it leaves.

A run's folder holds trajectory.tum, timings.csv, crops.npz and, written last, run.json with the key
of all that the results depend on: a folder with the right key is finished and never run again.
"""

import hashlib
import json
import os
import shutil
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from app import __version__
from app.baselines.keyframes import keep_keyframe
from app.baselines.systems import find_system
from app.evaluation import crops, map_sharpness
from app.export.results import timings_csv
from app.mapping.feed import FileFeed
from app.mapping.opening import open_session
from app.mapping.painted import UNMARKED
from app.mapping.session import Session
from app.slam.keyframes import KeyframeStore
from app.slam.loops.types import Origin, Verdict
from app.slam.metrics import GroundScore
from app.slam.params import Params
from app.slam.provenance import describe_machine, peak_memory_mb
from app.slam.trajectory import Trajectory, write_tum
from app.slam.types import F64, TIMINGS, FrameStatus, Measurement, StepResult

FORMAT = 2
GROUND_RANGES_M = (0.0, 5.0, 10.0, 20.0, 40.0, 100.0)
RUN_FILES = ("trajectory.tum", "timings.csv", "crops.npz", "run.json")


@cache
def code_digest() -> str:
    """Hash of the code that results depend on, so that a change of it runs jobs again."""
    root = Path(__file__).parents[1]
    files = [path for room in ("slam", "mapping", "baselines") for path in (root / room).rglob("*.py")]
    files += [path for path in (root / "sensors").rglob("*.py") if "simulator" not in path.parts]
    files += [root / "export" / "results.py"]
    files += [root / "evaluation" / name for name in ("job.py", "map_sharpness.py", "crops.py")]
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class Job:
    """Attributes:
    recording: its path, sha256: of its bytes. name: of the recording in tables. variant: its name.
    params: as run. folder: for the results. threads: for the kernels. code: `code_digest()`.
    baseline: name of the system that is run in place of the engine; "" for the engine.
    marks: (stamp of a frame, a byte for each point of its cloud as in `app.mapping.painted`), in place of the
        recording's labels of ground.
    """

    recording: Path
    sha256: str
    name: str
    variant: str
    params: Params
    folder: Path
    threads: int = 1
    start_s: float = 0.0
    duration_s: float | None = None
    code: str = field(default_factory=code_digest)
    baseline: str = ""
    marks: tuple[tuple[int, bytes], ...] = ()
    key: str = field(init=False)
    """Hash of all that a result depends on, the machine and its load aside."""

    def __post_init__(self) -> None:
        parts = {
            "format": FORMAT,
            "version": __version__,
            "code": self.code,
            "input": self.sha256,
            "parameters": self.params.model_dump(mode="json"),
            "part": [self.start_s, self.duration_s],
            "baseline": [self.baseline, find_system(self.baseline).version()] if self.baseline else None,
            "marks": [[stamp, hashlib.sha256(labels).hexdigest()] for stamp, labels in self.marks],
        }
        key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
        object.__setattr__(self, "key", key)  # once, where the job is made, so that its process agrees


def finished(job: Job) -> dict[str, Any] | None:
    """What run.json holds, if the job was run to its end with just these inputs."""
    try:
        report: dict[str, Any] = json.loads((job.folder / "run.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    whole = all((job.folder / name).is_file() for name in RUN_FILES)
    return report if whole and report.get("key") == job.key else None


def run_job(job: Job, progress: Callable[[int, int], None]) -> None:
    """Run to the end and write the files; `progress` is called with (frames done, frames in all).

    Raises:
        HemislamError: the recording cannot be used. OSError: the disk is full or fails.
    """
    import numba

    from app.slam.loops.service import InlineLoops
    from app.slam.warmup import compile_kernels

    numba.set_num_threads(min(job.threads, numba.get_num_threads()))
    compile_kernels()
    if job.baseline:
        run_baseline(job, progress)
        return
    marks = dict(job.marks)
    ground, cpu_ms = [GroundScore() for _ in GROUND_RANGES_M[1:]], list[float]()
    session = open_session(job.recording, job.params, job.start_s, job.duration_s, loops=InlineLoops)
    try:
        total = session.feed.info.frames or 0
        while (entry := session.peek()) is not None:
            if not isinstance(entry, Measurement):
                continue
            begin = time.process_time()
            result = session.advance()
            cpu_ms.append((time.process_time() - begin) * 1e3)
            assert isinstance(result, StepResult)
            _score_ground(ground, result, marks)
            progress(session.frame + 1, total)
        if session.loops:
            session.loops.poll()  # those of the last keyframes
        log, frame, keyframes = session.log, session.map_frame, session.engine.keyframes
        poses = frame.poses(np.array([keyframe.T_odom_imu for keyframe in keyframes]).reshape(-1, 4, 4))
        timings = timings_csv(log.stamps_ns, log.timings_ms, {"cpu_ms": cpu_ms})
        _write(job, frame.trajectory(log.odometry), keyframes, poses, timings, _facts(job, session, ground))
    finally:
        session.close()


def run_baseline(job: Job, progress: Callable[[int, int], None]) -> None:
    """Another system on the same measurements. Its clouds are undistorted by its own poses, for the map.

    Where it gives no finite pose, its last one stands, and the frame counts as lost.
    """
    system = find_system(job.baseline).start(job.params)
    feed, keyframes = FileFeed(job.recording, job.params, job.start_s, job.duration_s), KeyframeStore()
    stamps, poses, times, dropped = list[int](), list[F64](), list[tuple[float, float]](), Counter[str]()
    lost = 0
    try:
        while (entry := feed.next()) is not None:
            if not isinstance(entry, Measurement):
                dropped[entry.reason] += 1
                continue
            begin, cpu_begin = time.perf_counter(), time.process_time()
            stamp, pose = system.step(entry)
            times.append(((time.perf_counter() - begin) * 1e3, (time.process_time() - cpu_begin) * 1e3))
            if not np.isfinite(pose).all():
                lost, pose = lost + 1, poses[-1] if poses else np.eye(4)
            keep_keyframe(keyframes, entry.scan, (stamp, pose), (stamps[-1], poses[-1]) if poses else None, job.params)
            stamps.append(stamp)
            poses.append(pose)
            progress(len(poses), feed.info.frames or 0)
        trajectory = Trajectory.from_poses(stamps, np.array(poses))
        wall_ms, cpu_ms = np.array(times).reshape(-1, 2).T
        stages = np.zeros((len(stamps), len(TIMINGS)))
        stages[:, -1] = wall_ms
        timings = timings_csv(trajectory.stamps_ns, stages, {"cpu_ms": cpu_ms})
        facts = _common(job) | {
            "frames": len(stamps),
            "lost": lost,
            "dropped": dict(dropped.most_common()),
            "distance_m": trajectory.distance,
            "loops": None,
            "ground_share": None,
            "ground": None,
        }
        kept = np.array([keyframe.T_odom_imu for keyframe in keyframes]).reshape(-1, 4, 4)
        _write(job, trajectory, keyframes, kept, timings, facts)
    finally:
        keyframes.close()
        feed.close()


def _common(job: Job) -> dict[str, Any]:
    """What run.json holds of any run."""
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
        "threads": job.threads,
        "load": os.getloadavg()[0],
        "machine": describe_machine(),
    }


def _facts(job: Job, session: Session, ground: list[GroundScore]) -> dict[str, Any]:
    """What run.json holds of a run of the engine, except what needs the map."""
    log = session.log
    return _common(job) | {
        "frames": len(log),
        "lost": log.statuses[FrameStatus.LOST],
        "dropped": dict(log.dropped.most_common()),
        "distance_m": session.map_frame.trajectory(log.odometry).distance,
        "loops": None if session.loops is None else session.loops.accepted,
        "loop_drift_m": _loop_drift(session),
        "ground_share": log.ground_share,
        "ground": [asdict(score) for score in ground] if job.marks or log.ground_score is not None else None,
    }


def _loop_drift(session: Session) -> float | None:
    """Median distance between where odometry and where accepted loops have their newer keyframes, m."""
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
    job: Job, trajectory: Trajectory, keyframes: KeyframeStore, poses: F64, timings: str, facts: dict[str, Any]
) -> None:
    """All files beside their places, then moved there, run.json last: a kill in between leaves no result."""
    measured = map_sharpness.measure(map_sharpness.collect(keyframes, poses))
    facts["map_sharpness"] = {name: value if np.isfinite(value) else None for name, value in asdict(measured).items()}

    part = job.folder.with_name(f"{job.folder.name}.part-{os.getpid()}")
    part.mkdir(parents=True, exist_ok=True)
    try:
        write_tum(part / "trajectory.tum", trajectory)
        (part / "timings.csv").write_text(timings, encoding="utf-8")
        centres = {place: _position_at(trajectory, share) for place, share in crops.PLACES.items()}
        np.savez_compressed(
            part / "crops.npz",
            allow_pickle=False,
            **{place: crops.crop(keyframes, poses, centre) for place, centre in centres.items()},
        )
        (part / "run.json").write_text(json.dumps(facts, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
        job.folder.mkdir(exist_ok=True)
        (job.folder / "run.json").unlink(missing_ok=True)
        for name in RUN_FILES:
            (part / name).replace(job.folder / name)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def clear_remains(folder: Path) -> None:
    """Remove what runs that were killed left in the making."""
    for part in folder.glob("*/*.part-*"):
        shutil.rmtree(part, ignore_errors=True)


def _score_ground(scores: list[GroundScore], result: StepResult, marks: dict[int, bytes]) -> None:
    """Add a frame's score, over all its points or, if there are marks, over those that are marked."""
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
