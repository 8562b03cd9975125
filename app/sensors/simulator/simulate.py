"""Simulates the measurements along one trajectory through one scene, and writes them to disk."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from app.sensors.navsat import TOPIC, navsat_message
from app.sensors.robosense import BPEARL, CHANNELS
from app.sensors.ros import RecordingWriter
from app.sensors.simulator.gnss import Gnss, received
from app.sensors.simulator.imperfections import NONE, Imperfections, Unit, companions, livelier
from app.sensors.simulator.lidar import Lidar
from app.sensors.simulator.raycast import Raycaster, SimulatedScene
from app.sensors.simulator.scanners import SCANNERS, Scanner
from app.sensors.simulator.scenes import build_scene
from app.sensors.simulator.trajectory import (
    IMU_RATE_HZ,
    R_BODY_IMU,
    ImuNoise,
    SmoothTrajectory,
    Walker,
    measured,
    seconds,
    walk,
)
from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.trajectory import Trajectory, write_tum
from app.slam.types import F64, I64

START_NS = 1_700_000_000_000_000_000
"""Start time of every recording."""

TRANSPORT_NS = 4_000_000
"""Delay from the last point of a cloud to its arrival at the recorder."""

_FIRST_TURN_S = 0.05
_IMU_PERIOD_NS = 1_000_000_000 // IMU_RATE_HZ

_TRAJECTORY, _IMU, _LIDAR, _UNIT, _PEOPLE, _GNSS = 1, 2, 3, 4, 5, 6
"""Independent streams of random numbers (stream 0 is the scene's)."""


@dataclass(frozen=True, slots=True)
class SimulationSummary:
    """The recording that was written.

    Attributes:
        recording: the file. bytes: its size. scans, points: their numbers.
        duration_s, distance_m: of the trajectory.
    """

    recording: Path
    scans: int
    points: int
    duration_s: float
    distance_m: float
    bytes: int


def simulate(
    scene: str,
    out: Path,
    *,
    duration_s: float = 60.0,
    seed: int = 0,
    rate_hz: int = 10,
    every_block: int = 1,
    range_step: float = BPEARL.range_step,
    coordinate_step: float = 0.0,
    walker: Walker | None = None,
    imperfections: Imperfections = NONE,
    unit_seed: int | None = None,
    scanner: str = "bpearl",
    tables: Path | None = None,
    upright: bool | None = None,
    gnss: Gnss | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> SimulationSummary:
    """Simulate a person who carries a LiDAR and an IMU, and write a ROS 2 recording.

    Besides `out` (`<stem>.mcap`, written scan by scan), this writes the exact truth `<stem>_truth.tum` (T_world_imu at
    every scan's end, absolute seconds; the world's z is up) and `<stem>.params.yaml` (the sensor's mounting, loaded
    with the recording). The same arguments give the same measurements. Existing files are replaced after everything
    is written.

    Args:
        scene: a name in SCENES. out: ends in .mcap; its folder must exist.
        duration_s: of the recording, including the still start (walker.still).
        seed: for everything random: the scene's details, the trajectory, noise and biases.
        rate_hz: scans per second. every_block: fire only every k-th block, so that a scan of an RS-Bpearl has
            57,632 / k firings at 10 Hz and the file is small.
        range_step: m, rounding of ranges: 0.005, or 0.0025 for a newer unit; 0 = none.
        coordinate_step: m, rounding of x, y, z; 0 = none. A power of two near the noise, such as
            0.00390625, makes the file a third smaller.
        walker: how the person walks; None = the defaults.
        imperfections: errors of a real scanner and hand, and people beside the operator.
        unit_seed: for the constant errors of one scanner; None: `seed`.
        scanner: a name in SCANNERS. tables: folder with its maker's tables, if it needs any.
        upright: held with the LiDAR's z up instead of forward; None: as usual for this scanner.
        gnss: an additional satellite receiver; the true georeference is then in `<stem>_georeference.json`.
        progress: called with (scans done, all scans).

    Raises:
        HemislamError: the scene is unknown, an argument is out of range, a file cannot be written, or open3d cannot be
            loaded.
    """
    out = Path(out)
    device = _device(scanner, upright, rate_hz)
    _check(out)
    _check_range("duration_s", duration_s, 0.5, 86_400.0, "s")
    _check_range("every_block", every_block, 1, 90, "blocks")
    _check_range("range_step", range_step, 0.0, 0.1, "m")
    _check_range("coordinate_step", coordinate_step, 0.0, 0.1, "m")
    place = build_scene(scene, seed)
    walker = livelier(walker or Walker(), imperfections.hand)
    trajectory = trajectory_through(place, duration_s, seed, walker, device.R_body_imu)
    company = companions(imperfections.companions, trajectory, place, _random(seed, _PEOPLE))
    caster = Raycaster(place.mesh, (*place.movers, *company))
    turns = device.patterns(rate_hz, every_block, tables)
    unit_seed = seed if unit_seed is None else unit_seed
    unit = None if imperfections == NONE else unit_of(imperfections, unit_seed, turns(0).channels)
    lidar = replace(
        device.lidar, range_step=range_step, coordinate_step=coordinate_step or device.lidar.coordinate_step, unit=unit
    )
    imu_stamps = START_NS + np.arange(round(duration_s * IMU_RATE_HZ) + 1, dtype=np.int64) * _IMU_PERIOD_NS
    imu = measured(trajectory, imu_stamps, START_NS, ImuNoise(), _random(seed, _IMU))
    if unit is not None:
        imu = unit.felt(imu, START_NS, _random(seed, _UNIT, _IMU))

    fixes = received(gnss, trajectory, duration_s, START_NS, _random(seed, _GNSS)) if gnss else None

    total = int((duration_s - _FIRST_TURN_S) * rate_hz + 1e-6)
    points = written = fixed = 0
    truth, params = out.with_name(f"{out.stem}_truth.tum"), out.with_name(f"{out.stem}.params.yaml")
    unfinished = out.with_name(out.name + ".part")
    ends: list[int] = []

    def add_imu(stop: int) -> None:
        nonlocal written
        for k in range(written, stop):
            stamp = int(imu.stamps_ns[k])
            recording.add_imu(stamp, imu.gyro[k], imu.accel[k] / device.accel_unit, stamp)
        written = max(written, stop)

    def add_fixes(until_ns: int) -> None:
        nonlocal fixed
        while fixes is not None and fixed < len(fixes) and fixes.stamps_ns[fixed] <= until_ns:
            recording.add(TOPIC, navsat_message(fixes, fixed), int(fixes.stamps_ns[fixed]))
            fixed += 1

    try:
        with unfinished.open("wb") as file:
            recording = RecordingWriter(file, device.layout)
            for index in range(total):
                start_s = _FIRST_TURN_S + index / rate_hz
                rng = _random(seed, _LIDAR, index)
                scan = lidar.turn(turns(index), caster, trajectory, start_s, START_NS, rng)
                if not len(scan):
                    continue
                points += len(scan)
                ends.append(scan.end_ns)
                logged_ns = scan.end_ns + TRANSPORT_NS
                add_imu(int(np.searchsorted(imu.stamps_ns, logged_ns, side="right")))
                add_fixes(logged_ns)
                recording.add_scan(scan, logged_ns)
                progress(index + 1, total)
            add_imu(len(imu))
            add_fixes(int(imu_stamps[-1]))
            recording.finish()
        _write_truth(truth, trajectory, np.array(ends, np.int64))
        params.write_text(_SIDECAR + yaml.safe_dump(_settings(device.lidar)))
        if gnss is not None:
            out.with_name(f"{out.stem}_georeference.json").write_text(gnss.reference.to_json(), encoding="utf-8")
        unfinished.replace(out)
    except OSError as error:
        raise HemislamError(f"{out} cannot be written ({error.strerror}); choose another place.") from error
    finally:
        unfinished.unlink(missing_ok=True)

    path = trajectory.poses(np.arange(0.0, duration_s, 0.02))[0]
    return SimulationSummary(
        recording=out,
        scans=len(ends),
        points=points,
        duration_s=duration_s,
        distance_m=float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
        bytes=out.stat().st_size,
    )


def unit_of(imperfections: Imperfections, seed: int, channels: int = CHANNELS) -> Unit:
    """The scanner that `simulate` uses."""
    return Unit(imperfections, _random(seed, _UNIT), channels)


def trajectory_through(
    place: SimulatedScene, duration_s: float, seed: int, walker: Walker, R_body_imu: F64 = R_BODY_IMU
) -> SmoothTrajectory:
    """The trajectory that `simulate` follows."""
    rng = _random(seed, _TRAJECTORY)
    return walk(
        place.path, duration_s, rng, walker=walker, closed=place.closed, height=place.height, R_body_imu=R_body_imu
    )


_SIDECAR = "# Mounting of the simulated scanner; read with the recording beside it.\n"


def _settings(lidar: Lidar) -> dict[str, Any]:
    """The parameters with which its recordings are read."""
    sensor = {"translation": lidar.p_imu_lidar.tolist()}
    if not np.array_equal(lidar.R_imu_lidar, np.eye(3)):
        sensor["rotation"] = list(lie.rpy_degrees(lidar.R_imu_lidar))
    return {"sensor": sensor}


def _device(name: str, upright: bool | None, rate_hz: int) -> Scanner:
    if name not in SCANNERS:
        raise HemislamError(f"There is no scanner `{name}` to simulate; choose one of {', '.join(SCANNERS)}.")
    device = SCANNERS[name]
    if rate_hz not in device.rates_hz:
        rates = " or ".join(map(str, device.rates_hz))
        raise HemislamError(f"The {name} makes {rates} scans a second, not {rate_hz}; choose one of these.")
    return device if upright is None else replace(device, upright=upright)


def _random(seed: int, *stream: int) -> np.random.Generator:
    return np.random.default_rng([seed, *stream])


def _write_truth(path: Path, trajectory: SmoothTrajectory, stamps_ns: I64) -> None:
    positions, rotations = trajectory.poses(seconds(stamps_ns - START_NS))
    write_tum(path, Trajectory(stamps_ns, positions, Rotation.from_matrix(rotations).as_quat()))


def _check(out: Path) -> None:
    if out.suffix != ".mcap":
        raise HemislamError(f"The recording must be named *.mcap, not `{out.name}`.")
    if not out.parent.is_dir():
        raise HemislamError(f"The folder {out.parent} does not exist; make it first or choose another.")


def _check_range(name: str, value: float, low: float, high: float, unit: str) -> None:
    if not low <= value <= high:
        raise HemislamError(f"The simulator's {name} cannot be {value:g}; choose {low:g} to {high:g} {unit}.")
