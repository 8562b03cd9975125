"""Keyframe clouds thinned for display, and the whole map to what a page may show.

Every chunk has a level: 0 is as it was made, each further one leaves one point per voxel, with edges that
double, and the last one leaves none. Levels rise where they are missed least and never fall, and what was thinned
away is kept nowhere: however long the walk, its map takes no more memory than a page's budget of points. Nor has it
more clouds than a page can draw: where keyframes are close, one takes over the points of the one before it.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from app.server.protocol import Chunk
from app.server.setup import POINT_BUDGET
from app.slam import lie
from app.slam.types import F32, F64, I64, Keyframe

FINEST_VOXEL_M: Final = 0.08
COARSEST_LEVEL: Final = 8
"""At 0.08 m · 2^7 = 10 m a keyframe is down to a handful of points; there is nothing left to thin."""
EMPTY_LEVEL: Final = COARSEST_LEVEL + 1
MOST_SHOWN: Final = 1000
"""Keyframes that have points: each costs the page a drawing of its own, and the server some kilobytes."""
FRAME_POINTS, KEYFRAME_POINTS, CANDIDATE_POINTS = 5, 22, 36
"""As much memory as so many points of the map (29 bytes each with what viser keeps) take, here and in the page's
scene: a frame's place on the path, a keyframe without its points, a loop candidate with its arch."""
_SLACK: Final = 0.97
"""Over budget, the map is thinned to this share of it, so that not every new keyframe thins again."""


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
    return np.random.default_rng(seed).permutation(_first_per_voxel(points, voxel_size))


def room(budget: int, frames: int, keyframes: int, candidates: int) -> int:
    """Most points that the map may have, so that memory stays as it is however long the walk.

    What else there is of it takes its part of what `POINT_BUDGET` points take, or as many as `budget`, if that is
    more; but no more than half of it.
    """
    beside = FRAME_POINTS * frames + KEYFRAME_POINTS * keyframes + CANDIDATE_POINTS * candidates
    return max(min(budget, max(budget, POINT_BUDGET) - beside), budget // 2)


def within_budget(chunks: tuple[Chunk, ...], poses: F64, sensor: F64, budget: int) -> tuple[Chunk, ...]:
    """The same chunks if they have no more points than `budget`; else some of them at higher levels.

    Depends on nothing but its arguments, so that two readers of one session hold the same.

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
        before, kept[index] = kept[index], coarser(kept[index])
        total -= len(before.points) - len(kept[index].points)
        levels[index] += 1
    return tuple(kept)


def _spread(chunks: tuple[Chunk, ...], poses: F64) -> tuple[Chunk, ...]:
    """The same with at most `MOST_SHOWN` that have points: where the walk is shortest between two of them, the one
    between these gives its points away.

    It gives them to the one after it, so that going back shows nothing that was not measured yet. As the crow flies,
    there would be no end to it where one turns round and walks back.
    """
    shown = [index for index, chunk in enumerate(chunks) if chunk.level < EMPTY_LEVEL]
    if len(shown) <= MOST_SHOWN:
        return chunks
    kept = list(chunks)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    walked = np.concatenate([[0.0], np.cumsum(steps)])
    while len(shown) > MOST_SHOWN:
        where = walked[[chunks[index].index for index in shown]]
        place = 1 + int(np.argmin(where[2:] - where[:-2]))
        index, after = shown.pop(place), shown[place]
        kept[index], kept[after] = _emptied(kept[index]), _joined(kept[index], kept[after], poses)
    return tuple(kept)


def _joined(chunk: Chunk, after: Chunk, poses: F64) -> Chunk:
    """The chunk `after` with the points of another, where `poses` lay them; they move with it from then on.

    What both of them saw is there once, as fine as its level is, but for a chunk as it was made.
    """
    T_map_lidar, T_map_after = (poses[one.index] @ one.T_imu_lidar for one in (chunk, after))
    T = lie.inverse(T_map_after) @ T_map_lidar
    points = (chunk.points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    order = np.random.default_rng(after.index).permutation(len(points) + len(after.points))
    both = replace(
        after,
        points=np.concatenate((points, after.points))[order],
        labels=np.concatenate((chunk.labels, after.labels))[order],
        intensity=np.concatenate((chunk.intensity, after.intensity))[order],
        ring=np.concatenate((chunk.ring, after.ring))[order],
        joined=chunk.joined + after.joined + 1,
    )
    return _at_level(both, after.level) if after.level else both


def coarser(chunk: Chunk) -> Chunk:
    """A chunk at the next level."""
    return _at_level(chunk, chunk.level + 1)


def _at_level(chunk: Chunk, level: int) -> Chunk:
    """With one of its points per voxel of a level >= 1."""
    chosen = np.sort(_first_per_voxel(chunk.points, voxel_of_level(level)))  # of random points in their order
    return _taken(chunk, chosen, level)


_NO_POINTS: Final = np.empty((0, 3), np.float32)
_NO_LABELS: Final = np.empty(0, np.uint8)
_NO_INTENSITY: Final = np.empty(0, np.float32)
_NO_RING: Final = np.empty(0, np.uint16)


def _emptied(chunk: Chunk) -> Chunk:
    """Without its points. The arrays are in common: of a walk that goes on, most keyframes end so."""
    return replace(
        chunk, points=_NO_POINTS, labels=_NO_LABELS, intensity=_NO_INTENSITY, ring=_NO_RING, level=EMPTY_LEVEL
    )


def with_same_mounting(chunk: Chunk, before: Chunk) -> Chunk:
    """The chunk with its T_imu_lidar in common with the one before, where the two are equal."""
    same = np.array_equal(chunk.T_imu_lidar, before.T_imu_lidar)
    return replace(chunk, T_imu_lidar=before.T_imu_lidar) if same else chunk


def _taken(chunk: Chunk, chosen: I64, level: int) -> Chunk:
    return replace(
        chunk,
        points=chunk.points[chosen],
        labels=chunk.labels[chosen],
        intensity=chunk.intensity[chosen],
        ring=chunk.ring[chosen],
        level=level,
    )


def voxel_of_level(level: int) -> float:
    """Voxel edge in metres of a level >= 1."""
    return float(FINEST_VOXEL_M * 2 ** (level - 1))


def next_to_thin(levels: Sequence[int], positions: F64, sensor: F64) -> int | None:
    """The keyframe that is thinned next, or None when all are at the coarsest level.

    Of those drawn finest it is the one farthest from the sensor, and of equally far ones the oldest.

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
    """Indices, in the order of the voxels, of the first point of `points` (n, 3) in every occupied voxel."""
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    cells = np.floor(points * np.float32(1 / voxel_size)).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    keys = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    first = np.concatenate(([True], ordered[1:] != ordered[:-1]))
    return np.asarray(order[first])
