"""A known room, scans of it, and the prior of an update."""

import numpy as np

from app.slam.iekf import boxplus
from app.slam.imu import DIM, POS, ROT, Belief
from app.slam.local_map import LocalMap
from app.slam.sections import MapParams
from app.slam.types import NavState

from .scenes import GRAVITY, START_NS, Rig, Scene, Walk, mounted, sweep

SIDEWAYS = mounted((90, 10, -30), (0.1, -0.2, 0.15))
RIG = Rig(columns=60, T_imu_lidar=SIDEWAYS, range_noise=0.003)
STANDING = Walk(still=1e9)


def state_at(walk: Walk, t: float, rig: Rig | None = None) -> NavState:
    """The truth as a filter's state; odom is the scene's world."""
    rig = rig or Rig()
    return NavState(
        stamp_ns=START_NS + round(t * 1e9),
        R_odom_imu=walk.pose(t)[:3, :3].copy(),
        p_odom_imu=walk.pose(t)[:3, 3].copy(),
        v_odom_imu=walk.velocities(np.array([t]))[0],
        b_gyro=np.array(rig.b_gyro),
        b_accel=np.array(rig.b_accel),
        g_odom=np.array([0.0, 0.0, -GRAVITY]),
        R_imu_lidar=rig.T_imu_lidar[:3, :3].copy(),
        p_imu_lidar=rig.T_imu_lidar[:3, 3].copy(),
    )


def truth(rig: Rig = RIG) -> NavState:
    return state_at(STANDING, 0.0, rig)


def surveyed(scene: Scene) -> LocalMap:
    """The map of a scene, seen from several places at high density."""
    params = MapParams(max_voxels=20_000)
    local_map, rng = LocalMap(params), np.random.default_rng(1)
    for origin in ([0.0, 0, 0], [1.5, -1.0, 0.2], [1.5, 0.9, -0.4], [-1.5, 0.5, 0.0]):
        directions = rng.normal(size=(12_000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        ranges, _ = scene.cast(np.tile(origin, (len(directions), 1)), directions)
        near = ranges < 30
        points = np.array(origin) + directions[near] * (ranges + rng.normal(scale=0.002, size=len(ranges)))[near, None]
        local_map.insert(points.astype(np.float32), np.array(origin), params)
    return local_map


def points_of(scene: Scene, rig: Rig = RIG) -> np.ndarray:
    return np.ascontiguousarray(sweep(scene, STANDING, rig, 0.0, seed=7).points[::2])


def uncertain(rotation: float = 0.1, position: float = 0.3) -> np.ndarray:
    sigma = np.full(DIM, 1e-3)
    sigma[ROT], sigma[POS] = rotation, position
    return np.diag(sigma**2)


def correlated_prior(scale: float) -> Belief:
    """Off by a few `scale` in every direction, with a full covariance."""
    rng = np.random.default_rng(8)
    root = rng.normal(size=(DIM, DIM))
    P = scale**2 * (root @ root.T / DIM + 0.3 * np.eye(DIM))
    return Belief(boxplus(truth(), rng.multivariate_normal(np.zeros(DIM), P)), P)
