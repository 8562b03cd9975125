"""Lines and planes that feature points belong to, and the pose that brings the points onto them.

Both of LOAM's distances, of a point to a line and to a plane, are written as distances to planes: a line is where two
planes at right angles meet. So one solver does for both, and for LIOM's factors.
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
"""Neighbours farther away do not belong to a point."""
LINE, PLANE = 5.0, 0.15
"""The variance of neighbours along a line is at least this many times that across it; across a plane, at most that
share of the others."""
SPREAD = 0.02
"""Least share of the variance along a plane's longer axis that the shorter one has: a scan line makes no plane."""
THICK_M = 0.06
"""RMS distance of neighbours from their line or plane above which they form none: three times a scanner's noise,
so that hedges have no planes."""
HUBER_M = 0.1
WEAK = 0.1
"""A direction constrained by less than this share of a well-seen one keeps the prediction (Zhang, Kaess and Singh, "On
Degeneracy of Optimization-based State Estimation Problems", ICRA 2016). Normals that are wrong by 0.2 rad seem to
constrain unseen directions by a share of 0.04."""
_LINE_APART_M = 1000.0


@dataclass(frozen=True, slots=True)
class Pairs:
    """Attributes:
    points: (n, 3) m, in the moving frame. normals: (n, 3) unit and anchors: (n, 3) m, of the planes that they are
        on, in the fixed frame.
    """

    points: F64
    normals: F64
    anchors: F64

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True)
class PoseFit:
    """Attributes:
    T: (4, 4) T_fixed_moving. information: (6, 6) of it in units of one point's, rotation then translation in the
        fixed frame; nothing of weak directions.
    pairs: used.
    """

    T: F64
    information: F64
    pairs: int


def joined(*parts: Pairs) -> Pairs:
    return Pairs(*(np.concatenate([getattr(part, name) for part in parts]) for name in Pairs.__slots__))


def solve(T: F64, pairs: Pairs, steps: int = 2, free: F64 | None = None) -> PoseFit:
    """Gauss-Newton steps from `T` with Huber's weights; directions that the pairs leave open stay as they are.

    A perturbation acts from the left, about the moving frame's origin: R <- exp(w) R, p <- p + v.

    Args:
        free: (m, 6) orthonormal, the perturbations that are allowed; None: all.
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
    """The step (6,) within `free` and the information (6, 6), both without what the pairs do not determine.

    lever: m, by which rotations are made lengths, so that all directions can be compared.
    """
    basis = free / np.array([lever] * 3 + [1.0] * 3)
    values, vectors = np.linalg.eigh(basis @ information @ basis.T)
    seen = values > WEAK * np.median(values)
    along = vectors.T @ (basis @ gradient)
    back = np.linalg.pinv(basis) @ vectors[:, seen]
    step = (vectors @ np.where(seen, along / np.where(seen, values, 1.0), 0.0)) @ basis
    return step, (back * values[seen]) @ back.T


def register(T: F64, pairs: Callable[[F64], Pairs], rounds: int, free: F64 | None = None) -> PoseFit:
    """Match and solve in turn from a good guess `T` on, at most `rounds` times. pairs: what lies together at a pose."""
    for _ in range(rounds):
        fit = solve(T, pairs(T), free=free)
        change = lie.log_se3(lie.inverse(T) @ fit.T)
        T = fit.T
        if np.linalg.norm(change) < 1e-3:
            break
    return fit


class LastScan:
    """Edges and planes of one scan, to match the next one with (section V.B)."""

    def __init__(self, edges: FeaturePoints, planes: FeaturePoints) -> None:
        self._edges, self._planes = _Lines(edges), _Lines(planes)

    def pairs(self, edges: FeaturePoints, planes: FeaturePoints, T: F64) -> Pairs:
        """Of the features of the next scan that T_last_next brings near a line or a plane."""
        return joined(self._on_edges(edges, T), self._on_planes(planes, T))

    def _on_edges(self, features: FeaturePoints, T: F64) -> Pairs:
        """A line through the nearest edge point and the nearest one of a scan line beside it."""
        near, beside, _, found = self._edges.neighbours(lie.moved(T, features.points))
        along = beside - near
        length = np.linalg.norm(along, axis=1)
        found &= (length > 1e-3) & (length < REACH_M)
        return _about_lines(features.points[found], near[found], along[found] / length[found, None])

    def _on_planes(self, features: FeaturePoints, T: F64) -> Pairs:
        """A plane through the nearest point, one beside it on its scan line, and one of another scan line."""
        near, beside, along, found = self._planes.neighbours(lie.moved(T, features.points))
        normals = np.cross(beside - near, along - near)
        lengths = np.linalg.norm(normals, axis=1)
        spans = np.linalg.norm(beside - near, axis=1) * np.linalg.norm(along - near, axis=1)
        found &= lengths > 0.2 * spans + 1e-9  # no sliver
        return Pairs(features.points[found], normals[found] / lengths[found, None], near[found])


class _Lines:
    """Points on scan lines. A fourth coordinate keeps the lines apart, so that one tree finds the nearest of a line."""

    def __init__(self, cloud: FeaturePoints) -> None:
        self._cloud = cloud
        self._tree = _Tree(cloud.points) if len(cloud) else None
        self._by_line = _Tree(self._apart(cloud.points, cloud.lines)) if len(cloud) else None

    def neighbours(self, points: F64) -> tuple[F64, F64, F64, np.ndarray]:
        """(m, 3) nearest point, nearest of a line beside that one's, second nearest of its own line; (m,) where all
        of that exists."""
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
        """One point for each voxel, as matching needs no more."""
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
        """Of points (n, 3) that T_map_moving brings near a line or a plane of the map."""
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
        """The points that have enough neighbours; mean, variances (m, 3) ascending and axes (m, 3, 3) of those."""
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
    """Two planes that meet in each line, through `anchors` (n, 3) along `directions` (n, 3)."""
    across = np.cross(directions, np.eye(3)[np.argmin(np.abs(directions), axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    normals = np.concatenate([across, np.cross(directions, across)])
    return Pairs(np.tile(points, (2, 1)), normals, np.tile(anchors, (2, 1)))
