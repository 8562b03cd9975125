"""Each recording beside the project goes through the real reader and the engine once per test session."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from app.sensors.presets import PRESETS, resolve_params
from app.sensors.recording import open_recording
from app.slam.engine import Engine
from app.slam.metrics import GroundScore, interpolate
from app.slam.params import Params
from app.slam.trajectory import Trajectory, read_tum
from app.slam.types import F64, NON_GROUND, FrameStatus, Measurement

H2LID_MOUNT = Params().merged(PRESETS["h2lid-mount"])


@dataclass
class Pass:
    """What came of one recording.

    Attributes:
        estimate: poses of all frames. score: of the ground labels. statuses: how many frames each.
        found: frames with a ground plane. overhead: points over the sensor that were labelled ground but are none,
            and nearest_overhead, the nearest of them, m.
        converged: registrations that converged. g_odom: m/s^2, gravity as estimated at the end.
    """

    estimate: Trajectory
    truth: Trajectory
    score: GroundScore = field(default_factory=GroundScore)
    statuses: Counter[FrameStatus] = field(default_factory=Counter)
    found: int = 0
    overhead: int = 0
    nearest_overhead: float = float("inf")
    converged: int = 0
    g_odom: F64 = field(default_factory=lambda: np.zeros(3))


def process(
    path: Path, truth_path: Path, params: Params, start_s: float = 0.0, duration_s: float | None = None
) -> Pass:
    truth, engine = read_tum(truth_path), Engine(params)
    stamps, poses = [], []
    outcome = Pass(truth, truth)
    with open_recording(path, params) as recording:
        for entry in recording.measurements(start_s, duration_s):
            if not isinstance(entry, Measurement):
                continue
            r = engine.step(entry.scan, entry.imu)
            stamps.append(r.stamp_ns)
            poses.append(r.T_map_imu)
            outcome.statuses[r.status] += 1
            outcome.converged += r.registration.converged
            outcome.found += r.ground.found
            if r.truth_ground is None:
                continue
            outcome.score += GroundScore.of(r.cloud.labels, r.truth_ground)
            here, usable = interpolate(truth, np.array([r.stamp_ns]))
            if usable.any():
                R_truth_lidar = here.rotations[0].as_matrix() @ r.state.R_imu_lidar
                heights = r.cloud.points.astype(np.float64) @ R_truth_lidar[2]
                over = (r.cloud.labels != NON_GROUND) & (heights > 0) & (r.truth_ground == 0)
                outcome.overhead += int(np.sum(over))
                ranges = np.linalg.norm(r.cloud.points[over], axis=1)
                outcome.nearest_overhead = min([outcome.nearest_overhead, *ranges.tolist()])
    outcome.g_odom = engine.g_odom
    engine.close()
    outcome.estimate = Trajectory.from_poses(stamps, np.array(poses))
    return outcome


@pytest.fixture(scope="session")
def passed(shared_data: Path) -> Callable[[str], Pass]:
    """The outcome of "hall", "outdoor", "garage", "mid360" or "amid the sample"."""

    @cache
    def outcome(name: str) -> Pass:
        if name == "garage":
            return process(shared_data / "garage_hdl32e.mcap", shared_data / "garage_hdl32e_reference.tum", Params())
        if name == "amid the sample":
            sample = Path(__file__).resolve().parents[2] / "sample_data" / "cloister.mcap"
            return process(
                sample, sample.with_name("cloister_truth.tum"), resolve_params(sample, None, None, []), 10.0, 14.0
            )
        if name == "mid360":
            mid360 = Params().merged(PRESETS["mid360"])
            return process(shared_data / "hall_mid360.mcap", shared_data / "hall_mid360_truth.tum", mid360)
        return process(shared_data / f"{name}_bpearl.mcap", shared_data / f"{name}_bpearl_truth.tum", H2LID_MOUNT)

    return outcome
