"""Compare with peers from PyPI on the same recording: KISS-ICP and RKO-LIO, and Patchwork++ for the ground alone.

`make bench-peers` installs them into build/peers, which comes last on the path, and runs this. Each gets the same
scans, its own defaults, and the true mounting of the sensor. A peer's pose may belong to the start, the middle or the
end of a scan; the one with the smallest error is used.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from app.evaluation.truth import read_truth
from app.evaluation.truth_match import match
from app.sensors.presets import resolve_params
from app.sensors.recording import open_recording
from app.slam import lie
from app.slam.engine import Engine
from app.slam.errors import HemislamError
from app.slam.metrics import GroundScore, ate
from app.slam.params import Params
from app.slam.trajectory import Trajectory, truth_beside
from app.slam.types import F64, Measurement
from app.slam.warmup import compile_kernels
from benchmarks.record import Line, show
from benchmarks.scenes import FOLDER, SCENES, recording

PEERS = FOLDER.parent / "peers"

Step = Callable[[Measurement], F64]
"""Process one measurement and return the pose of the LiDAR, T_world_lidar."""


def run(paths: list[Path], preset: str | None = None, duration_s: float | None = None) -> list[Line]:
    compile_kernels()
    lines = []
    for path in paths:
        params = resolve_params(path, preset, None, [])
        lines += _odometry(path, params, duration_s) + _ground(path, params, duration_s)
    return lines


def _odometry(path: Path, params: Params, duration_s: float | None) -> list[Line]:
    """Wall time and CPU time per frame and the error of each system, and their ratios to ours."""
    T_imu_lidar = _mounting(params)
    truth_path = truth_beside(path)
    truth = read_truth(str(truth_path)) if truth_path else None
    on, lines = path.stem, []
    ours: tuple[float, float, float] | None = None
    for name, make in (("hemislam", _hemislam), ("rko_lio", _rko_lio), ("kiss-icp", _kiss_icp)):
        times, cpu_times, poses, dates = _play(path, params, duration_s, name, make(params, T_imu_lidar))
        lines.append(Line.of(f"{name}, time per frame", on, "ms", times))
        lines.append(Line.of(f"{name}, CPU time per frame", on, "ms", cpu_times))
        error = float("nan")
        if truth is not None:
            error = min(_error(poses @ lie.inverse(T_imu_lidar), stamps, truth) for stamps in dates)
            lines.append(Line.of(f"{name}, ATE", on, "mm", [1e3 * error]))
        found = float(np.median(times)), float(np.median(cpu_times)), error
        ours = ours or found
        if found is not ours:
            for what, theirs, mine in zip(("time", "CPU time", "ATE"), found, ours, strict=True):
                lines.append(Line.of(f"{name} over hemislam, {what}", on, "ratio", [theirs / mine]))
    return lines


def _play(
    path: Path, params: Params, duration_s: float | None, name: str, step: Step
) -> tuple[list[float], list[float], F64, list[Any]]:
    """Wall ms, CPU ms and pose of each scan, and the stamps of the scans' start, middle and end."""
    times, cpu_times, poses, dates = [], [], [], []
    with open_recording(path, params) as source, tqdm(desc=name, unit=" frames", leave=False, disable=None) as bar:
        for entry in source.measurements(0.0, duration_s):
            if not isinstance(entry, Measurement):
                continue
            begin, cpu_begin = time.perf_counter(), time.process_time()
            poses.append(step(entry))
            times.append((time.perf_counter() - begin) * 1e3)
            cpu_times.append((time.process_time() - cpu_begin) * 1e3)
            first, last = entry.scan.stamp_ns, entry.scan.end_ns
            dates.append((first, (first + last) // 2, last))
            bar.update()
    return times, cpu_times, np.array(poses), list(np.array(dates, np.int64).T)


def _error(poses: F64, stamps: Any, truth: Any) -> float:
    """ATE, m; nan if the peer is so far off that nothing can be aligned."""
    try:
        estimate = Trajectory.from_poses(stamps, poses)
        return ate(estimate, match(truth, estimate).trajectory).position.rmse
    except (HemislamError, ValueError, np.linalg.LinAlgError):
        return float("nan")


def _mounting(params: Params) -> F64:
    """T_imu_lidar."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", params.sensor.rotation, degrees=True).as_matrix()
    T[:3, 3] = params.sensor.translation
    return T


def _hemislam(params: Params, T_imu_lidar: F64) -> Step:
    engine = Engine(params)

    def step(measurement: Measurement) -> F64:
        result = engine.step(measurement.scan, measurement.imu)
        return result.T_map_imu @ T_imu_lidar

    return step


def _rko_lio(params: Params, T_imu_lidar: F64) -> Step:
    from rko_lio.config import LIOConfig
    from rko_lio.lio import LIO

    lio = LIO(LIOConfig())
    last_ns = -1

    def step(measurement: Measurement) -> F64:
        nonlocal last_ns
        scan, imu = measurement.scan, measurement.imu
        for stamp, gyro, accel in zip(imu.stamps_ns, imu.gyro, imu.accel, strict=True):
            if stamp > last_ns:
                lio.add_imu_measurement(accel, gyro, int(stamp), np.eye(4))
                last_ns = int(stamp)
        stamps = scan.stamp_ns + scan.offsets_ns.astype(np.int64)
        lio.register_scan(scan.points.astype(np.float64), stamps, T_imu_lidar)
        return np.asarray(lio.pose() @ T_imu_lidar)

    return step


def _kiss_icp(params: Params, T_imu_lidar: F64) -> Step:
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.max_range, config.data.min_range = params.sensor.max_range, params.sensor.min_range
    config.mapping.voxel_size = config.data.max_range / 100.0  # its own rule
    odometry = KissICP(config)

    def step(measurement: Measurement) -> F64:
        scan = measurement.scan
        odometry.register_frame(scan.points.astype(np.float64), scan.offsets_ns / max(int(scan.offsets_ns.max()), 1))
        return np.asarray(odometry.last_pose).copy()

    return step


def _ground(path: Path, params: Params, duration_s: float | None) -> list[Line]:
    """Patchwork++ and ours on the same deskewed, levelled clouds, against the labels in the recording."""
    import pypatchworkpp

    settings = pypatchworkpp.Parameters()
    settings.verbose = False
    settings.sensor_height = 1.2
    settings.min_range = params.sensor.min_range
    peer = pypatchworkpp.patchworkpp(settings)
    engine = Engine(params)
    ours_ms, theirs_ms = [], []
    ours, theirs = GroundScore(), GroundScore()
    with open_recording(path, params) as source:
        for entry in source.measurements(0.0, duration_s):
            if not isinstance(entry, Measurement):
                continue
            result = engine.step(entry.scan, entry.imu)
            if result.truth_ground is None:
                return []
            R_level_lidar = (result.T_map_imu @ _mounting(params))[:3, :3]
            cloud = result.cloud.points @ R_level_lidar.T.astype(np.float32)
            table = np.column_stack([cloud, result.cloud.intensity]).astype(np.float32)
            begin = time.perf_counter()
            peer.estimateGround(table)
            theirs_ms.append((time.perf_counter() - begin) * 1e3)
            ours_ms.append(result.timings_ms["ground"])
            labels = np.zeros(len(cloud), np.uint8)
            labels[np.asarray(peer.getGroundIndices()).ravel()] = 1
            theirs += GroundScore.of(labels, result.truth_ground)
            ours += GroundScore.of(result.cloud.labels, result.truth_ground)
    engine.close()
    on = f"{path.stem}, ground alone"
    return [
        Line.of("hemislam, time per frame", on, "ms", ours_ms),
        Line.of("hemislam, F1", on, "", [ours.f1]),
        Line.of("patchwork++, time per frame", on, "ms", theirs_ms),
        Line.of("patchwork++, F1", on, "", [theirs.f1]),
        Line.of("patchwork++ over hemislam, time", on, "ratio", [np.median(theirs_ms) / np.median(ours_ms)]),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description="Peers from PyPI on the same recording.")
    parser.add_argument("recordings", nargs="*", type=Path, help="else the simulated scenes of the benchmarks")
    parser.add_argument("--preset", help="as of hemislam itself")
    parser.add_argument("--duration", type=float, help="seconds of each recording; else all of it")
    given = parser.parse_args()
    sys.path.append(str(PEERS))  # last, so that hemislam's own versions of shared packages win
    try:
        show(run(given.recordings or [recording(scene) for scene in SCENES], given.preset, given.duration))
    except ImportError as error:
        sys.exit(f"The peers are not installed ({error}); `make bench-peers` does that.")


if __name__ == "__main__":
    main()
