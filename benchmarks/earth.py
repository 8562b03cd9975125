"""Accuracy of georeferenced maps: simulated walks; the receiver has 2 cm noise, 80 ms delay and 10 % outliers of 5 m.

Every point of the map is compared with its true position in UTM, computed from the true poses, the scanner's true
mounting and the position of the scene. The alignment uses only the fixes and the lever arm of 0.5 m. The errors of the
clock offset are listed with the lower bound of any estimate.
"""

import numpy as np

from app.cli.run import process
from app.export.results import Results
from app.georeference.align import align
from app.georeference.fixes import Fixes
from app.georeference.survey import Survey
from app.mapping.earth import bent, georeference
from app.mapping.opening import open_session
from app.sensors.navsat import recorded_fixes
from app.sensors.presets import resolve_params
from app.sensors.simulator.gnss import Gnss, received
from app.sensors.simulator.imperfections import IMPERFECT, NONE, livelier
from app.sensors.simulator.scanners import SCANNERS
from app.sensors.simulator.scenes import build_scene
from app.sensors.simulator.simulate import START_NS, simulate, trajectory_through, unit_of
from app.sensors.simulator.trajectory import SmoothTrajectory, Walker
from app.slam import lie
from app.slam.metrics import interpolate
from app.slam.trajectory import Trajectory, read_tum, truth_beside
from app.slam.types import F64
from app.slam.warmup import compile_kernels
from benchmarks.clock_floor import drift_rate, least_sigma_s
from benchmarks.record import Line
from benchmarks.scenes import FOLDER

LEVER = (0.1, -0.2, 0.447)
GNSS = Gnss(rate=10.0, noise=0.02, offset=0.08, outliers=0.1, wild=5.0, x=LEVER[0], y=LEVER[1], z=LEVER[2])
WALKS = (("outdoor", False), ("corridor", False), ("outdoor", True))
"""Scenes, and whether scanner and hand are imperfect."""
SECONDS, SEED, DRAWS = (90.0, 240.0), 5, 16


def run() -> list[Line]:
    compile_kernels()
    FOLDER.mkdir(parents=True, exist_ok=True)
    walks = [(scene, imperfect, seconds) for seconds in SECONDS for scene, imperfect in WALKS]
    return [line for scene, imperfect, seconds in walks for line in measure(scene, seconds, imperfect=imperfect)]


def measure(scene: str, seconds: float, *, imperfect: bool) -> list[Line]:
    name = f"{scene}{'-imperfect' if imperfect else ''}-{seconds:.0f}s"
    path = FOLDER / f"gnss-{name}.mcap"
    errors = IMPERFECT if imperfect else NONE
    if not path.exists():
        simulate(scene, path, duration_s=seconds, seed=SEED, every_block=6, gnss=GNSS, imperfections=errors)
    session = open_session(path, resolve_params(path, None, None, []))
    if (stop := process(session)) is not None:
        raise stop
    beside = truth_beside(path)
    assert beside is not None
    truth, fixes = read_tum(beside), recorded_fixes(path)
    sensor = session.params.sensor
    T_imu_lidar = lie.transform(lie.from_rpy_degrees(sensor.rotation), np.array(sensor.translation))
    T_imu_lidar = T_imu_lidar @ (unit_of(IMPERFECT, SEED).mounting if imperfect else np.eye(4))
    lines, mapped = [], session.results()
    for factors in (False, True):
        results = georeference(mapped, Survey(lever=LEVER, factors=factors))
        lines += compare(results, truth, fixes, f"{name}, {'as factors' if factors else 'align only'}", T_imu_lidar)
    walked = trajectory_through(
        build_scene(scene, SEED), seconds, SEED, livelier(Walker(), errors.hand), SCANNERS["bpearl"].R_body_imu
    )
    lines += offsets(mapped, walked, seconds, name)
    session.close()
    return lines


def offsets(results: Results, walked: SmoothTrajectory, seconds: float, on: str) -> list[Line]:
    """Errors of the clock offset for other draws of the receiver's noise, and their lower bound."""
    lines, found = [], {"align only": list[tuple[float, float]](), "as factors": list[tuple[float, float]]()}
    for draw in range(DRAWS):
        fixes = received(GNSS, walked, seconds, START_NS, np.random.default_rng(1000 + draw))
        aligned = align(results.trajectory, fixes, lever=LEVER)
        after = bent(results, fixes, aligned, {}).found
        assert after is not None
        for use, one in zip(found, (aligned, after), strict=True):
            found[use].append((one.offset_s - GNSS.offset, one.offset_sigma_s))
    what = f"offset of the clocks, {DRAWS} draws"
    for use, pairs in found.items():
        off, sigmas = 1e3 * np.array(pairs).T
        lines += [
            Line.of(f"{what}: RMS error", f"{on}, {use}", "ms", [float(np.sqrt((off**2).mean()))]),
            Line.of(f"{what}: mean error", f"{on}, {use}", "ms", [float(off.mean())]),
            Line.of(f"{what}: error", f"{on}, {use}", "ms", np.abs(off)),
            Line.of(f"{what}: over 2 ms", f"{on}, {use}", "", [int((np.abs(off) > 2.0).sum())]),
            Line.of(f"{what}: stated sigma", f"{on}, {use}", "ms", sigmas),
            Line.of(f"{what}: RMS of error over sigma", f"{on}, {use}", "", [np.sqrt(((off / sigmas) ** 2).mean())]),
        ]
    times = np.arange(0.5 / GNSS.rate, seconds, 1.0 / (GNSS.rate * (1 - GNSS.outliers)))
    mapped = results.trajectory
    rate = drift_rate(mapped, walked.poses(np.asarray((mapped.stamps_ns - START_NS) * 1e-9, np.float64))[0])
    for bound, drift in (("noise", 0.0), ("noise and drift", rate)):
        least = least_sigma_s(walked, times, np.array(LEVER), GNSS.noise, drift)
        lines.append(Line.of(f"offset of the clocks: least sigma by {bound}", on, "ms", [1e3 * least]))
    return lines


def compare(results: Results, truth: Trajectory, fixes: Fixes, on: str, T_imu_lidar: F64) -> list[Line]:
    """Compare offset, map points and outlier fixes with the truth. T_imu_lidar: (4, 4), true mounting."""
    found = results.found
    assert found is not None and results.where is not None
    off = np.concatenate([_off(results, truth, index, T_imu_lidar) for index in range(len(results.keyframes))])
    wild = _wild(fixes, truth)
    left_out = {name for name, used in zip(found.names, found.used, strict=True) if not used}
    told = set(found.names)
    return [
        Line.of("offset of the clocks, error", on, "ms", [abs(found.offset_s - GNSS.offset) * 1e3]),
        Line.of("points of the map, RMS", on, "cm", [100 * float(np.sqrt((off**2).mean()))]),
        Line.of("points of the map, error", on, "cm", 100 * off),
        Line.of("wild fixes", on, "", [len(wild & told)]),
        Line.of("wild fixes that count", on, "", [len((wild & told) - left_out)]),
        Line.of("sound fixes left out", on, "", [len(left_out - wild)]),
    ]


def _off(results: Results, truth: Trajectory, index: int, T_imu_lidar: F64) -> F64:
    """(n,) m, distance of each point of a keyframe from its true position."""
    keyframe = results.keyframes[index]
    there, inside = interpolate(truth, np.array([keyframe.stamp_ns]))
    if not inside.all() or results.where is None:
        return np.empty(0)
    (T_scene_imu,) = there.poses
    points = keyframe.cloud.points.astype(np.float64)
    ours = lie.moved(results.frame.at(index) @ keyframe.T_odom_imu @ keyframe.T_imu_lidar, points)
    true = lie.moved(T_scene_imu @ T_imu_lidar, points)
    ours, true = results.where.to_crs(ours), GNSS.reference.to_crs(true)
    return np.asarray(np.linalg.norm(ours - true, axis=1))


def _wild(fixes: Fixes, truth: Trajectory) -> set[str]:
    """Names of the fixes more than 1 m from the true position of the antenna."""
    poses, inside = interpolate(truth, fixes.stamps_ns - round(GNSS.offset * 1e9))
    T = poses.poses
    antenna = GNSS.reference.to_geographic(T[:, :3, :3] @ np.array(LEVER) + T[:, :3, 3])
    metres = (fixes.places[inside] - antenna) * [111_200.0, 74_300.0, 1.0]
    return {str(row + 1) for row in np.flatnonzero(inside)[np.linalg.norm(metres, axis=1) > 1.0]}
