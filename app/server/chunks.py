"""Keyframe clouds thinned for display."""

import numpy as np

from app.server.protocol import Chunk
from app.slam.types import F32, I64, Keyframe


def thinned(keyframe: Keyframe, voxel_size: float) -> Chunk:
    """A keyframe's cloud with one of its points per voxel of this edge (m), in random order."""
    cloud = keyframe.cloud
    chosen = one_per_voxel(cloud.points, voxel_size, seed=keyframe.index)
    return Chunk(
        index=keyframe.index,
        frame=keyframe.frame,
        stamp_ns=keyframe.stamp_ns,
        points=cloud.points[chosen],
        labels=cloud.labels[chosen],
        intensity=cloud.intensity[chosen],
        ring=cloud.ring[chosen],
        T_imu_lidar=keyframe.T_imu_lidar,
    )


def one_per_voxel(points: F32, voxel_size: float, seed: int = 0) -> I64:
    """Indices, shuffled by `seed`, of one point of `points` (n, 3) in every occupied voxel."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    cells = np.floor(points * np.float32(1 / voxel_size)).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    keys = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    first = np.concatenate(([True], ordered[1:] != ordered[:-1]))
    return np.random.default_rng(seed).permutation(order[first])
