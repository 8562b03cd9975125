"""The local map that scans are registered to: hashed voxels of bounded memory, and planes through them."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from app.slam.kernels import map as kernels
from app.slam.parallel import in_parts
from app.slam.sections import FilterParams, MapParams
from app.slam.types import F32, F64, I32, U8

DRIFT_M = 15.0
"""m: over this distance, odometry is taken to drift by the RMS distance of the scans' points from the map's planes."""
OLD_M = 0.025
"""m: a surface is old once odometry may have drifted this far since it was last seen."""
RELAXED = 4.0
"""Tilt allowed to a poor plane, as a multiple of that of a good one."""
PART = 128
"""Points for which one thread searches planes at a time; this takes about 0.2 ms."""


@dataclass(frozen=True, slots=True)
class MapState:
    """A copy of the map. Restoring it restores every later result exactly.

    Attributes:
        cells: (v, 3) indices of the voxels, in order of insertion. counts: (v,) points in each.
        points: (sum of counts, 8), voxel by voxel: as in the store of `kernels.map.insert`.
        center: (3,) m, the sensor at the last eviction. way: (4,), the sensor in m where drift was last added, and the
            variance of odometry's drift up to there, m².
    """

    cells: I32
    counts: U8
    points: F32
    center: F64
    way: F64


@dataclass(frozen=True, slots=True)
class Planes:
    """Planes through the neighbourhoods of n query points.

    Attributes:
        normals: (n, 3) unit. centers: (n, 3) m, odom. Both are zeros where there is no plane.
        variances: (n,) m², of a point's distance from its plane; negative where there is no plane.
        deviations: (n, 2, 3) rad, two vectors whose outer products sum to the normal's covariance.
    """

    normals: F64
    centers: F64
    variances: F64
    deviations: F64


class LocalMap:
    """Points of past scans in a hash of voxels. The number of points per voxel and of voxels is bounded."""

    def __init__(self, params: MapParams) -> None:
        self._voxel = params.voxel_size
        size = params.max_voxels
        self._table = np.full(1 << int(np.ceil(np.log2(2 * size))), -1, dtype=np.int32)
        self._cells = np.zeros((size, 3), dtype=np.int32)
        self._counts = np.zeros(size, dtype=np.uint8)
        self._store = np.zeros((size, params.points_per_voxel, 8), dtype=np.float32)
        self._used = 0
        self._center = np.zeros(3)
        self._way = np.zeros(4)

    @property
    def voxels(self) -> int:
        return self._used

    def clear(self) -> None:
        """Forget all points."""
        self._used = 0
        self._evict(self._center, math.inf)

    def insert(self, points: F32, position: F64, params: MapParams, residual: float = 0.0) -> None:
        """Add (n, 3) odom points seen from `position` (3,), and drop voxels beyond the radius around it.

        When the map is full, the radius shrinks until there is room again, so that what is near the sensor is
        always mapped. residual: RMS of the scan's distances from the map, m.
        """
        if (step := float(np.linalg.norm(position - self._way[:3]))) > 1.0:  # a swaying hand does not walk
            self._way = np.r_[position, self._way[3] + step / DRIFT_M * residual**2]
        if np.linalg.norm(position - self._center) > 0.1 * params.radius:
            self._evict(position, params.radius)
        refused, radius = self._insert(points, position, params), params.radius
        while len(refused) and radius > 1.0:
            radius *= 0.8
            self._evict(position, radius)
            near = refused[np.linalg.norm(refused - position, axis=1) < radius]
            refused = self._insert(near, position, params)

    def _insert(self, points: F32, position: F64, params: MapParams) -> F32:
        """Returns the points for which the map has no room."""
        refused = np.empty(len(points), np.bool_)
        self._used = int(kernels.insert(
            points, position, self._voxel, params.spacing, self._way[3], self._way[3] - OLD_M**2,
            self._table, self._cells, self._counts, self._store, self._used, refused,
        ))  # fmt: skip
        return points[refused]

    def _evict(self, center: F64, radius: float) -> None:
        self._used = int(
            kernels.evict(center, radius, self._voxel, self._table, self._cells, self._counts, self._store, self._used)
        )
        self._center = np.array(center)

    def planes(self, queries: F64, position: F64, params: FilterParams) -> tuple[Planes, Planes]:
        """Good and poor planes for (n, 3) odom points seen from `position` (3,), see `kernels.map.planes`.

        The normal of a poor one may be RELAXED times as uncertain as that of a good one.
        """
        n = len(queries)
        normals, centers, variances = np.zeros((2, n, 3)), np.zeros((2, n, 3)), np.empty((2, n))
        deviations = np.empty((2, n, 2, 3))
        reach, tilt = min(params.neighbour_distance, self._voxel), math.radians(params.plane_tilt)
        tilts, old = np.array([RELAXED * tilt, tilt]), self._way[3] - OLD_M**2

        def search(begin: int, end: int) -> None:
            kernels.planes(
                begin, end, queries, position, self._voxel, reach, params.neighbours, params.plane_threshold,
                tilts, params.point_noise, old, self._table, self._cells, self._counts, self._store,
                normals, centers, variances, deviations,
            )  # fmt: skip

        in_parts(search, n, PART)
        poor, good = (Planes(*parts) for parts in zip(normals, centers, variances, deviations, strict=True))
        return good, poor

    def checkpoint(self) -> MapState:
        n = self._used
        points = self._store[:n][self._taken(n)]
        return MapState(self._cells[:n].copy(), self._counts[:n].copy(), points, self._center.copy(), self._way.copy())

    def restore(self, state: MapState) -> None:
        n = len(state.cells)
        self._cells[:n], self._counts[:n] = state.cells, state.counts
        self._store[:n][self._taken(n)] = state.points
        self._used, self._way = n, np.array(state.way)
        self._evict(np.array(state.center), math.inf)  # drops nothing; it rebuilds the hash table

    def _taken(self, n: int) -> npt.NDArray[np.bool_]:
        """(n, points_per_voxel): which places of the first n voxels hold a point."""
        return np.arange(self._store.shape[1]) < self._counts[:n, None]
