"""Lines and planes to which feature points belong, and the pose that best fits the points to them.

LOAM's distances of a point to a line and to a plane are both written as distances to planes: a line is the intersection
of two perpendicular planes. So one solver serves both, and LIOM's factors.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from app.baselines.features import FeaturePoints
from app.slam import lie
from app.slam.types import F64, I64
from app.slam.voxel import VoxelGrid

_Tree: Any = KDTree  # scipy ships no types

NEIGHBOURS = 6
REACH_M = 1.2
"""Points farther away do not count as neighbours."""
LINE, PLANE = 5.0, 0.15
"""On a line, the neighbours' variance along it is at least this many times that across; on a plane, the variance across
is at most this share of the others."""
SPREAD = 0.02
"""Least ratio of the variances along a plane's shorter and longer axes: a single scan line does not form a plane."""
THICK_M = 0.06
"""Largest RMS distance of neighbours from their line or plane: three times a scanner's noise, so that hedges form
no planes."""
HUBER_M = 0.1
WEAK = 0.1
"""A direction constrained less than this share of a well-constrained one keeps the prediction (Zhang, Kaess and Singh,
"On Degeneracy of Optimization-based State Estimation Problems", ICRA 2016). Normals with errors of 0.2 rad seem to
constrain unobserved directions by a share of 0.04."""
_LINE_APART_M = 1000.0


@dataclass(frozen=True, slots=True)
class Pairs:
    """Attributes:
    points: (n, 3) m, in the moving frame. normals: (n, 3) unit and anchors: (n, 3) m, of the points' planes, in the
        fixed frame.
    """

    points: F64
    normals: F64
    anchors: F64

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True)
class PoseFit:
    """Attributes:
    T: (4, 4) T_fixed_moving. information: (6, 6), in units of the information of one point; rotation, then
        translation, in the fixed frame; zero in weak directions.
    pairs: number used.
    """

    T: F64
    information: F64
    pairs: int


def joined(*parts: Pairs) -> Pairs:
    return Pairs(*(np.concatenate([getattr(part, name) for part in parts]) for name in Pairs.__slots__))


def solve(T: F64, pairs: Pairs, steps: int = 2, free: F64 | None = None) -> PoseFit:
    """Gauss-Newton steps from `T` with Huber weights; directions that the pairs do not constrain stay unchanged.

    A perturbation acts from the left, about the moving frame's origin: R <- exp(w) R, p <- p + v.

    Args:
        free: (m, 6) orthonormal, the allowed perturbations; None: all.
    """
    free = np.eye(6) if free is None else free
    information = np.zeros((6, 6))
    if len(pairs) < 12:
        return PoseFit(T, information, len(pairs))
    for _ in range(steps):
        arms = pairs.points @ T[:3, :3].T
        distances = np.einsum("ni,ni->n", pairs.normals, arms + T[:3, 3] - pairs.anchors)
        J = np.hstack([np.cross(arms, pairs.normals), pairs.normals])
        weights = HUBER_M / np.maximum(np.abs(distances), HUBER_M)
        information = np.einsum("ni,nj,n->ij", J, J, weights)
        lever = np.sqrt(np.mean(np.sum(arms**2, axis=1)))
        gradient = -np.einsum("ni,n,n->i", J, distances, weights)
        step, information = _step(information, gradient, lever, free)
        T = lie.transform(lie.exp(step[:3]) @ T[:3, :3], T[:3, 3] + step[3:])
        if np.linalg.norm(step[:3]) < 1e-5 and np.linalg.norm(step[3:]) < 1e-4:
            break
    return PoseFit(T, information, len(pairs))


def _step(information: F64, gradient: F64, lever: float, free: F64) -> tuple[F64, F64]:
    """The step (6,) within `free` and the information (6, 6), both without unconstrained directions.

    lever: m, converts rotations to lengths, so that all directions can be compared.
    """
    basis = free / np.array([lever] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(basis @ information @ basis.T)
    seen = values > WEAK * np.median(values)
    along = vectors.T @ (basis @ gradient)
    back = np.linalg.pinv(basis) @ vectors[:, seen]
    step = (vectors @ np.where(seen, along / np.where(seen, values, 1.0), 0.0)) @ basis
    return step, (back * values[seen]) @ back.T


def register(T: F64, pairs: Callable[[F64], Pairs], rounds: int, free: F64 | None = None) -> PoseFit:
    """From a good guess `T`, match and solve in turn, at most `rounds` times. pairs: matches points at a pose."""
    for _ in range(rounds):
        fit = solve(T, pairs(T), free=free)
        change = lie.log_se3(lie.inverse(T) @ fit.T)
        T = fit.T
        if np.linalg.norm(change) < 1e-3:
            break
    return fit


class LastScan:
    """Edges and planes of one scan, to which the next scan is matched (section V.B)."""

    def __init__(self, edges: FeaturePoints, planes: FeaturePoints) -> None:
        self._edges, self._planes = _Lines(edges), _Lines(planes)

    def pairs(self, edges: FeaturePoints, planes: FeaturePoints, T: F64) -> Pairs:
        """Pairs of the next scan's features that T_last_next places near a line or a plane."""
        return joined(self._on_edges(edges, T), self._on_planes(planes, T))

    def _on_edges(self, features: FeaturePoints, T: F64) -> Pairs:
        """Lines through the nearest edge point and the nearest edge point on an adjacent scan line."""
        near, beside, _, found = self._edges.neighbours(lie.moved(T, features.points))
        along = beside - near
        length = np.linalg.norm(along, axis=1)
        found &= (length > 1e-3) & (length < REACH_M)
        return _about_lines(features.points[found], near[found], along[found] / length[found, None])

    def _on_planes(self, features: FeaturePoints, T: F64) -> Pairs:
        """Planes through the nearest point, one beside it on its scan line, and one on another scan line."""
        near, beside, along, found = self._planes.neighbours(lie.moved(T, features.points))
        normals = np.cross(beside - near, along - near)
        lengths = np.linalg.norm(normals, axis=1)
        spans = np.linalg.norm(beside - near, axis=1) * np.linalg.norm(along - near, axis=1)
        found &= lengths > 0.2 * spans + 1e-9  # the triangle must not be a sliver
        return Pairs(features.points[found], normals[found] / lengths[found, None], near[found])


class _Lines:
    """Points on scan lines. A fourth coordinate separates the lines, so one tree finds the nearest on a given line."""

    def __init__(self, cloud: FeaturePoints) -> None:
        self._cloud = cloud
        self._tree = _Tree(cloud.points) if len(cloud) else None
        self._by_line = _Tree(self._apart(cloud.points, cloud.lines)) if len(cloud) else None

    def neighbours(self, points: F64) -> tuple[F64, F64, F64, np.ndarray]:
        """(m, 3) nearest point, nearest on an adjacent line, second nearest on its own line; (m,) mask where all three
        exist."""
        nothing = np.zeros((len(points), 3))
        if self._tree is None or self._by_line is None or len(self._cloud) < 3 or not len(points):
            return nothing, nothing, nothing, np.zeros(len(points), np.bool_)
        distance, near = self._tree.query(points)
        line = self._cloud.lines[near]
        sides = [self._by_line.query(self._apart(points, line + side)) for side in (-1, 1)]
        nearer = sides[0][0] <= sides[1][0]
        beside = np.where(nearer, sides[0][1], sides[1][1])
        pair = self._by_line.query(self._apart(points, line), k=2)[1]
        along = np.where(pair[:, 0] == near, pair[:, 1], pair[:, 0])
        found = (distance < REACH_M) & (np.abs(self._cloud.lines[beside] - line) == 1)
        found &= self._cloud.lines[along] == line
        cloud = self._cloud.points
        return cloud[near], cloud[beside], cloud[along], found

    @staticmethod
    def _apart(points: F64, lines: I64) -> F64:
        return np.column_stack([points, _LINE_APART_M * lines])


class FeatureMap:
    """Edges and planes of many scans around the sensor, thinned by voxels (section VI).

    Args:
        edge_voxel, plane_voxel: edges of the voxels, m. reach: m from the sensor beyond which points are forgotten.
    """

    def __init__(self, edge_voxel: float, plane_voxel: float, reach: float) -> None:
        self._voxels, self._reach, self._grid = (edge_voxel, plane_voxel), reach, VoxelGrid()
        self._clouds = [np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32)]
        self._trees: list[Any] = [None, None]

    def __len__(self) -> int:
        return sum(len(cloud) for cloud in self._clouds)

    def thinned(self, edges: F64, planes: F64) -> tuple[F64, F64]:
        """One point per voxel, which is enough for matching."""
        return tuple(  # type: ignore[return-value]
            self._grid.downsample(points.astype(np.float32), voxel).points.astype(np.float64)
            for points, voxel in zip((edges, planes), self._voxels, strict=True)
        )

    def insert(self, edges: F64, planes: F64, centre: F64) -> None:
        """Add points (n, 3) m in the map's frame, seen from `centre` (3,)."""
        for index, points in enumerate((edges, planes)):
            cloud = np.concatenate([self._clouds[index], points.astype(np.float32)])
            cloud = cloud[np.sum((cloud - centre) ** 2, axis=1) < self._reach**2]
            self._clouds[index] = self._grid.downsample(cloud, self._voxels[index]).points
            self._trees[index] = _Tree(self._clouds[index]) if len(self._clouds[index]) >= NEIGHBOURS else None

    def pairs(self, edges: F64, planes: F64, T: F64) -> Pairs:
        """Pairs of points (n, 3) that T_map_moving places near a line or a plane of the map."""
        return joined(self._on_lines(edges, T), self._on_planes(planes, T))

    def _on_lines(self, points: F64, T: F64) -> Pairs:
        points, means, values, vectors = self._patches(0, points, T)
        found = (values[:, 2] > LINE * values[:, 1]) & (values[:, 1] < THICK_M**2)
        return _about_lines(points[found], means[found], vectors[found, :, 2])

    def _on_planes(self, points: F64, T: F64) -> Pairs:
        points, means, values, vectors = self._patches(1, points, T)
        found = (values[:, 0] < PLANE * values[:, 1]) & (values[:, 0] < THICK_M**2)
        found &= values[:, 1] > SPREAD * values[:, 2]
        return Pairs(points[found], vectors[found, :, 0], means[found])

    def _patches(self, index: int, points: F64, T: F64) -> tuple[F64, F64, F64, F64]:
        """Mask of the points with enough neighbours; of these, mean, variances (m, 3) ascending and axes (m, 3, 3)."""
        tree = self._trees[index]
        if tree is None or not len(points):
            return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3))
        distance, near = tree.query(lie.moved(T, points), k=NEIGHBOURS, distance_upper_bound=REACH_M)
        whole = np.isfinite(distance[:, -1])
        patches = self._clouds[index][near[whole]].astype(np.float64)
        means = patches.mean(axis=1)
        apart = patches - means[:, None]
        values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", apart, apart) / NEIGHBOURS)
        return points[whole], means, values, vectors


def _about_lines(points: F64, anchors: F64, directions: F64) -> Pairs:
    """Two perpendicular planes for each line through `anchors` (n, 3) along `directions` (n, 3)."""
    across = np.cross(directions, np.eye(3)[np.argmin(np.abs(directions), axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    normals = np.concatenate([across, np.cross(directions, across)])
    return Pairs(np.tile(points, (2, 1)), normals, np.tile(anchors, (2, 1)))
