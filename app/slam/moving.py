"""Points on moving objects: those points of a keyframe whose places other keyframes around it see through.

A person who walks by is at a place in one keyframe only: in other keyframes, beams pass through this place and return
from behind it. A wall is hit by the beams of every keyframe. Both cases are counted for each small voxel. Only nearby
keyframes are compared, with their odometry, which drifts little within a few metres. So loops change nothing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.spatial import KDTree

from app.slam import lie
from app.slam.kernels import free_space as kernels
from app.slam.sections import MovingParams
from app.slam.types import F32, F64, I32, Keyframe, Mask

AROUND: Final = 10
"""Number of keyframes before, and again after, that check a keyframe's points."""
REACH: Final = 25.0
"""m: farther points are not judged, because scan lines are too far apart there."""
VOXEL: Final = 0.15
"""m: points of a voxel are judged together."""
BIN: Final = math.radians(1.0)
"""Width of a bin of directions, which share one range: beams of most scanners are closer than twice that."""
WIDE: Final = 2 * (int(2.0 / BIN) + 1 + kernels.RING)
"""Bins on each side of an image that holds all directions."""
MARGIN: Final = 0.1
SLACK: Final = 0.01
"""m, and share of the range: a return this close to a place still counts as at it."""
SHARE: Final = 0.7
"""At least this share of the keyframes that know about a place must see through it."""
NEIGHBOURHOOD: Final = 0.4
"""m: radius of a voxel's surroundings."""
COMPANY: Final = 3
"""A moving voxel needs this many moving voxels around it, itself included: lone ones are stray returns at edges."""
NEIGHBOURS: Final = 2
"""An undecided voxel moves too if at least this many voxels around it move, and no fewer than stand still."""


@dataclass(frozen=True, slots=True)
class Sight:
    """What a keyframe saw. T_odom_lidar: (4, 4). image: (w, w, 2) float32 m, ranges (`kernels.look`)."""

    T_odom_lidar: F64
    image: F32


def sight(keyframe: Keyframe) -> Sight:
    """The ranges of a keyframe by direction: half a megabyte."""
    image = np.empty((WIDE, WIDE, 2), np.float32)
    kernels.look(keyframe.cloud.points, BIN, image)
    return Sight(keyframe.T_odom_imu @ keyframe.T_imu_lidar, image)


def around(index: int, count: int) -> list[int]:
    """The indices, out of `count`, of the keyframes that check a keyframe's points, nearest first."""
    near = [place for step in range(1, AROUND + 1) for place in (index - step, index + step)]
    return [place for place in near if 0 <= place < count]


def find(keyframe: Keyframe, others: Sequence[Sight], params: MovingParams) -> Mask:
    """(n,) whether each point of a keyframe is on a moving object.

    Args:
        others: the keyframes around it, nearest first.
    """
    points, n = keyframe.cloud.points, len(keyframe.cloud)
    cells, (first, voxel) = np.empty((n, 3), np.int32), np.empty((2, n), np.int32)
    table = np.empty(1 << (2 * n + 2).bit_length(), np.int32)
    count = kernels.group(points, keyframe.cloud.labels, VOXEL, REACH, table, cells, first, voxel)
    first = first[:count]
    through, hits = np.zeros((2, count), np.int32)
    T_odom_lidar = keyframe.T_odom_imu @ keyframe.T_imu_lidar
    for other in others:
        T = lie.inverse(other.T_odom_lidar) @ T_odom_lidar
        settled = int((1 - SHARE) * len(others))
        kernels.vote(points, first, T[:3], BIN, other.image, MARGIN, SLACK, settled, through, hits)
    moves = _judged(points[first], through, hits, params.seen_through)
    return np.append(moves, False)[voxel]  # voxel -1 is the last


def _judged(places: F32, through: I32, hits: I32, least: int) -> Mask:
    """(m,) whether voxels at places (m, 3) m move, by how many keyframes see through them and hit something there."""
    moves = (through >= least) & (through >= SHARE * (through + hits))
    moves[moves] = _near(places[moves], places[moves]) >= COMPANY
    undecided = np.flatnonzero(~moves & (2 * through >= hits))
    stands = ~moves & (2 * through < hits)
    beside = _near(places[undecided], places[moves])
    moves[undecided[(beside >= NEIGHBOURS) & (beside >= _near(places[undecided], places[stands]))]] = True
    return moves


def _near(places: F32, others: F32) -> I32:
    """How many of the others are in the surroundings of each place."""
    if not len(places) or not len(others):
        return np.zeros(len(places), np.int32)
    # queried only once, so it must be fast to build
    tree: Any = KDTree(others, 24, compact_nodes=False, balanced_tree=False)  # type: ignore[no-untyped-call]  # no types
    return np.asarray(tree.query_ball_point(places, NEIGHBOURHOOD, return_length=True), np.int32)
