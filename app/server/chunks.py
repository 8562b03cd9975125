"""Keyframe clouds for display, thinned so that the whole map fits into the number of points that a page can show.

Every chunk has a level. Level 0 is the original chunk. At each further level it has one point per voxel, and the
edge of the voxels doubles; at the last level it has no points. The map is thinned where this is least noticed. Levels
never decrease: points that were removed are lost. The number of clouds is limited too: where keyframes are close
together, one takes over the points of the previous one.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from app.server.protocol import Chunk
from app.slam import lie
from app.slam.metrics import walked_m
from app.slam.types import F32, F64, I64, Keyframe

VOXEL_M: Final = 0.05
"""Edge of the voxels of level 0."""
FINEST_VOXEL_M: Final = 0.08
COARSEST_LEVEL: Final = 8
"""At 0.08 m · 2^7 = 10 m, only a handful of a keyframe's points are left."""
EMPTY_LEVEL: Final = COARSEST_LEVEL + 1
MOST_SHOWN: Final = 1000
"""Maximum number of keyframes that have points. Each is one draw call in the page."""
_BY_POINT: Final = ("points", "labels", "intensity", "ring")
"""Arrays of a chunk and of a keyframe's cloud with one row per point."""
_SLACK: Final = 0.97
"""A map over its budget is thinned to this share of the budget, so that not every new keyframe triggers thinning."""


def thinned(keyframe: Keyframe) -> Chunk:
    """A keyframe's cloud with one of its points per voxel, in random order."""
    cloud = keyframe.cloud
    chosen = one_per_voxel(cloud.points, VOXEL_M, seed=keyframe.index)
    return Chunk(
        index=keyframe.index,
        frame=keyframe.frame,
        stamp_ns=keyframe.stamp_ns,
        T_imu_lidar=keyframe.T_imu_lidar,
        **{name: getattr(cloud, name)[chosen] for name in _BY_POINT},
    )


def one_per_voxel(points: F32, voxel_size: float, seed: int = 0) -> I64:
    """Indices, shuffled by `seed`, of one point of `points` (n, 3) in every occupied voxel."""
    return np.random.default_rng(seed).permutation(_first_per_voxel(points, voxel_size))


def within_budget(chunks: tuple[Chunk, ...], poses: F64, sensor: F64, budget: int) -> tuple[Chunk, ...]:
    """The same chunks if they have at most `budget` points; otherwise some of them at higher levels.

    Args:
        poses: (k, 4, 4) T_map_imu of at least the keyframes of these chunks. sensor: (3,) m, in the map.
    """
    chunks = _spread(chunks, poses)
    total = sum(len(chunk.points) for chunk in chunks)
    if total <= budget:
        return chunks
    kept = list(chunks)
    levels = [chunk.level for chunk in kept]
    positions = poses[[chunk.index for chunk in kept], :3, 3]
    while total > budget * _SLACK and (index := next_to_thin(levels, positions, sensor)) is not None:
        levels[index] += 1
        before, kept[index] = kept[index], at_level(kept[index], levels[index])
        total -= len(before.points) - len(kept[index].points)
    return tuple(kept)


def _spread(chunks: tuple[Chunk, ...], poses: F64) -> tuple[Chunk, ...]:
    """The same chunks, of which at most `MOST_SHOWN` keep points, spread evenly along the trajectory.

    The keyframe whose two neighbours are closest to each other gives its points to the later neighbour, so a seek back
    never shows points that were not measured yet.
    """
    shown = [index for index, chunk in enumerate(chunks) if chunk.level < EMPTY_LEVEL]
    if len(shown) <= MOST_SHOWN:
        return chunks
    kept = list(chunks)
    distance = walked_m(poses[:, :3, 3])
    while len(shown) > MOST_SHOWN:
        where = distance[[chunks[index].index for index in shown]]
        place = 1 + int(np.argmin(where[2:] - where[:-2]))
        index, after = shown.pop(place), shown[place]
        kept[index], kept[after] = (
            at_level(kept[index], EMPTY_LEVEL),
            _joined(kept[index], kept[after], poses),
        )
    return tuple(kept)


def _joined(chunk: Chunk, after: Chunk, poses: F64) -> Chunk:
    """The chunk `after` with the points of `chunk`, placed by the present poses, thinned to the level of `after`."""
    T_map_lidar, T_map_after = (poses[one.index] @ one.T_imu_lidar for one in (chunk, after))
    T = lie.inverse(T_map_after) @ T_map_lidar
    moved = replace(chunk, points=lie.moved(T, chunk.points).astype(np.float32))
    both: dict[str, Any] = {name: np.concatenate((getattr(moved, name), getattr(after, name))) for name in _BY_POINT}
    joined = replace(after, **both)
    order = np.random.default_rng(after.index).permutation(len(joined.points))
    joined = _chosen(joined, order, after.level)
    return at_level(joined, after.level) if after.level else joined


def as_thin(chunk: Chunk, held: Chunk | None) -> Chunk:
    """A chunk at the level of the one it replaces, so that a changed label does not cost other keyframes points."""
    return at_level(chunk, held.level) if held is not None and chunk.level < held.level else chunk


def at_level(chunk: Chunk, level: int) -> Chunk:
    """The chunk at a level >= 1: the same points, whichever lower levels it had before."""
    if level == EMPTY_LEVEL:
        return _chosen(chunk, np.empty(0, np.int64), level)
    return _chosen(chunk, np.sort(_first_per_voxel(chunk.points, voxel_of_level(level))), level)  # in random order


def _chosen(chunk: Chunk, chosen: I64, level: int) -> Chunk:
    return replace(chunk, level=level, **{name: getattr(chunk, name)[chosen] for name in _BY_POINT})


def voxel_of_level(level: int) -> float:
    """Voxel edge in metres of a level >= 1."""
    return float(FINEST_VOXEL_M * 2 ** (level - 1))


def next_to_thin(levels: Sequence[int], positions: F64, sensor: F64) -> int | None:
    """The keyframe at the lowest level that is farthest from the sensor; None if all are at the coarsest level.

    Args:
        levels: of each keyframe. positions: (k, 3) m. sensor: (3,) m, in the same frame.
    """
    finest = min(levels, default=COARSEST_LEVEL)
    if finest >= COARSEST_LEVEL:
        return None
    candidates = np.flatnonzero(np.asarray(levels) == finest)
    distances = np.linalg.norm(positions[candidates] - sensor, axis=1)
    return int(candidates[np.argmax(distances)])


def _first_per_voxel(points: F32, voxel_size: float) -> I64:
    """Indices, by voxel, of the first of `points` (n, 3) in every occupied voxel."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    cells = np.floor(points * np.float32(1 / voxel_size)).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    keys = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    return np.unique(keys, return_index=True)[1]
