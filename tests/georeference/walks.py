"""A walk with a satellite receiver and exactly known truth."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from app.georeference import crs
from app.georeference.fixes import Fixes
from app.georeference.reference import GeoReference
from app.sensors.simulator.trajectory import Walker, walk
from app.slam import lie
from app.slam.trajectory import Trajectory
from app.slam.types import F64

START_NS = 1_700_000_000_000_000_000
LEVER = (0.1, -0.2, 0.45)
TRUTH = GeoReference(
    "EPSG:32632",
    (691_500.25, 5_334_700.5, 520.0),
    tuple(map(tuple, lie.from_rpy_degrees((0.0, 0.0, 37.0)).tolist())),  # type: ignore[arg-type]
    crs.grid_scale("EPSG:32632", 48.137, 11.575, 520.0),
)
"""Munich: 150 km east of the middle of its zone."""
LOOP = np.array([[0, 0], [20, 14], [28, 7], [20, 0], [0, 14], [-8, 7]], np.float64)
"""An eight: round a circle, being late is the same as being turned."""
LINE = np.array([[0.0, 0.0], [200.0, 0.0]])


@dataclass(frozen=True)
class Walked:
    trajectory: Trajectory
    fixes: Fixes
    outliers: F64


def walked(
    *,
    path: F64 = LOOP,
    duration_s: float = 90.0,
    noise: float = 0.02,
    offset_s: float = 0.08,
    outliers: float = 0.1,
    lever: tuple[float, float, float] = LEVER,
    rate_hz: float = 8.0,
    seed: int = 0,
) -> Walked:
    """Scans at 10 Hz, fixes stamped late by `offset_s`, some of them 5 m off in a random direction."""
    rng = np.random.default_rng(seed)
    curve = walk(path, duration_s, rng, walker=Walker(), closed=path is LOOP)
    times = np.arange(0.1, duration_s, 0.1)
    positions, rotations = curve.poses(times)
    stamps = START_NS + np.rint(times * 1e9).astype(np.int64)
    at = np.arange(0.03, duration_s, 1.0 / rate_hz)
    p, R = curve.poses(at)
    true = TRUTH.to_crs(p + R @ np.array(lever))
    wrong = np.flatnonzero(rng.random(len(at)) < outliers)
    measured = true + noise * rng.normal(size=true.shape)
    directions = rng.normal(size=(len(wrong), 3))
    measured[wrong] += 5.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    longitude, latitude = crs.transformer(TRUTH.crs, crs.WGS84).transform(measured[:, 0], measured[:, 1])
    late = START_NS + np.rint((at + offset_s) * 1e9).astype(np.int64)
    places = np.column_stack([latitude, longitude, measured[:, 2]])
    fixes = Fixes.of(late, places, np.full((len(at), 3), noise))
    return Walked(Trajectory(stamps, positions, Rotation.from_matrix(rotations).as_quat()), fixes, wrong + 1)


def off(found: GeoReference, trajectory: Trajectory) -> F64:
    """(n,) m, how far the walked path is from where it truly was."""
    return np.linalg.norm(found.to_crs(trajectory.positions) - TRUTH.to_crs(trajectory.positions), axis=1)
