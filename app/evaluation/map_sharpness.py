"""Numbers for the sharpness of a map that need no truth (the paper's fineness, shown in its Figure 7).

- Mean map entropy: from the spread of points in small balls, in nats; lower is sharper
  (Droeschel & Behnke, ICRA 2014; Razlaw et al., ECMR 2015).
- Plane thickness: spread of points perpendicular to the planes that they form, m.
- Revisit gap: distance between two passes over the same surface, along its normal, m.

Compare only maps of the same recording. Between different trajectories or point densities, the numbers mean little.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from app.slam import lie
from app.slam.types import F64, I64, Keyframe

MAX_RANGE_M = 20.0
"""Points farther from the sensor are too sparse to use."""
POINTS_PER_KEYFRAME = 4000
BALL_M = 0.3
BALLS = 5000
MIN_POINTS = 12
PATCH_M = 0.5
PASS_S, PASS_M = 20.0, 20.0
"""Least time and least path between two passes over a surface."""


@dataclass(frozen=True, slots=True)
class MapSharpness:
    """Attributes:
    entropy: mean, nats. thickness: median over planes, m; NaN if there are none.
    revisit_median, revisit_p95: of the gaps, m; NaN without a revisit. revisits: number of surfaces compared.
    """

    entropy: float
    thickness: float
    revisit_median: float
    revisit_p95: float
    revisits: int


@dataclass(frozen=True, slots=True)
class MapPoints:
    """Attributes:
    points: (n, 3) m, map frame. sensors: (n, 3) m, position of the sensor for each point.
    times: (n,) s. walked: (n,) m, path length at that time.
    """

    points: F64
    sensors: F64
    times: F64
    walked: F64

    def __len__(self) -> int:
        return len(self.points)


def collect(keyframes: Iterable[Keyframe], poses: F64) -> MapPoints:
    """A thinned map from keyframes and their poses T_map_imu (k, 4, 4)."""
    parts: list[F64] = []
    walked, last = 0.0, None
    for keyframe, T_map_imu in zip(keyframes, poses, strict=True):
        walked += 0.0 if last is None else float(np.linalg.norm(T_map_imu[:3, 3] - last))
        last = T_map_imu[:3, 3]
        cloud = keyframe.cloud.points
        near = cloud[np.einsum("ni,ni->n", cloud, cloud) < MAX_RANGE_M**2]
        if not len(near):
            continue
        count = min(POINTS_PER_KEYFRAME, len(near))
        T = T_map_imu @ keyframe.T_imu_lidar
        points = lie.moved(T, near[np.arange(count) * len(near) // count].astype(np.float64))
        extra = np.tile([*T[:3, 3], keyframe.stamp_ns * 1e-9, walked], (count, 1))
        parts.append(np.hstack([points, extra]))
    table = np.vstack(parts) if parts else np.zeros((0, 8))
    return MapPoints(table[:, :3], table[:, 3:6], table[:, 6], table[:, 7])


def measure(cloud: MapPoints) -> MapSharpness:
    entropy, thickness = _crispness(cloud.points)
    gaps = revisit_gaps(cloud)
    return MapSharpness(
        entropy=entropy,
        thickness=thickness,
        revisit_median=float(np.median(gaps)) if len(gaps) else float("nan"),
        revisit_p95=float(np.percentile(gaps, 95)) if len(gaps) else float("nan"),
        revisits=len(gaps),
    )


def _crispness(points: F64) -> tuple[float, float]:
    """Mean map entropy and median plane thickness, over balls around points spread over the map."""
    if len(points) < MIN_POINTS:
        return float("nan"), float("nan")
    tree = _tree(points)
    centres = points[np.unique(np.linspace(0, len(points) - 1, BALLS).astype(np.int64))]
    values: list[F64] = []
    for begin in range(0, len(centres), 500):
        members = tree.query_ball_point(centres[begin : begin + 500], BALL_M)
        members = [ball for ball in members if len(ball) >= MIN_POINTS]
        if members:
            sizes = np.array([len(ball) for ball in members])
            covariances = _covariances(points[np.concatenate(members)], sizes)[1]
            values.append(np.asarray(np.linalg.eigvalsh(covariances), np.float64))
    if not values:
        return float("nan"), float("nan")
    eigenvalues = np.maximum(np.vstack(values), 1e-9)  # ascending; at least 0.03 mm, squared
    entropy = 0.5 * (3 * np.log(2 * np.pi * math.e) + np.log(eigenvalues).sum(axis=1))
    flat = (eigenvalues[:, 0] < 0.1 * eigenvalues[:, 1]) & (eigenvalues[:, 1] > (0.2 * BALL_M) ** 2)
    thickness = np.sqrt(eigenvalues[flat, 0])
    return float(entropy.mean()), float(np.median(thickness)) if len(thickness) else float("nan")


def revisit_gaps(cloud: MapPoints) -> F64:
    """Distances (k,) m along the normal between patches of a surface seen in two passes.

    A patch is the part of a surface seen in one time window in a voxel of PATCH_M. It is compared with the older patch
    that faces the same way, at most PATCH_M to the side and 2 PATCH_M along the normal. A larger gap is not recognised
    as the same surface.
    """
    patches = list(_patches(cloud))
    if not patches:
        return np.zeros(0)
    centres, normals, times, walked = (np.concatenate(column) for column in zip(*patches, strict=True))
    gaps: list[F64] = []
    for begin in np.arange(times.min() + PASS_S, times.max() + PASS_S, PASS_S / 2):
        new = (times >= begin) & (times < begin + PASS_S / 2)
        old = times < begin - PASS_S / 2
        if not (new.any() and old.any()):
            continue
        tree = _tree(centres[old])
        count = min(12, len(tree.data))
        distance, index = tree.query(centres[new], k=count, distance_upper_bound=2 * PATCH_M)
        distance, index = distance.reshape(-1, count), index.reshape(-1, count)
        found = np.isfinite(distance)
        index = np.where(found, index, 0)
        apart = centres[new][:, None] - centres[old][index]
        along = np.einsum("nki,nki->nk", apart, normals[old][index])
        beside = np.sqrt(np.maximum(distance**2 - along**2, 0, where=found, out=np.full_like(along, np.inf)))
        facing = np.einsum("nki,ni->nk", normals[old][index], normals[new]) > np.cos(np.radians(20))
        apart_in_path = walked[new][:, None] - walked[old][index] >= PASS_M
        apart_in_time = times[new][:, None] - times[old][index] >= PASS_S
        fits = found & facing & (beside < PATCH_M) & apart_in_path & apart_in_time
        best = np.argmin(np.where(fits, beside, np.inf), axis=1)
        rows = np.flatnonzero(fits[np.arange(len(best)), best])
        gaps.append(np.abs(along[rows, best[rows]]))
    return np.concatenate(gaps) if gaps else np.zeros(0)


def _patches(cloud: MapPoints) -> Iterator[tuple[F64, F64, F64, F64]]:
    """Centres, normals towards the sensor, times and walked distances of the flat patches, by time window."""
    if not len(cloud):
        return
    window = np.floor((cloud.times - cloud.times.min()) / (PASS_S / 2)).astype(np.int64)
    for number in np.unique(window):
        chosen = np.flatnonzero(window == number)
        voxel = np.floor(cloud.points[chosen] / PATCH_M).astype(np.int64)
        _, inverse = np.unique(voxel, axis=0, return_inverse=True)
        order = np.argsort(inverse.ravel(), kind="stable")
        sizes = np.bincount(inverse.ravel())
        keep = np.repeat(sizes >= MIN_POINTS, sizes)
        if not keep.any():
            continue
        rows, sizes = chosen[order][keep], sizes[sizes >= MIN_POINTS]
        centres, covariances = _covariances(cloud.points[rows], sizes)
        values, vectors = np.linalg.eigh(covariances)
        flat = (values[:, 1] > (0.1 * PATCH_M) ** 2) & (values[:, 0] < 0.04 * values[:, 1])
        starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
        normals = vectors[:, :, 0]
        seen_from = np.add.reduceat(cloud.sensors[rows], starts) / sizes[:, None] - centres
        normals = normals * np.where(np.einsum("ni,ni->n", normals, seen_from) < 0, -1.0, 1.0)[:, None]
        times = np.add.reduceat(cloud.times[rows] - cloud.times[0], starts) / sizes + cloud.times[0]
        walked = np.add.reduceat(cloud.walked[rows], starts) / sizes
        yield centres[flat], normals[flat], times[flat], walked[flat]


def _tree(points: F64) -> Any:
    return KDTree(points)  # type: ignore[no-untyped-call]  # scipy ships no types


def _covariances(points: F64, sizes: I64) -> tuple[F64, F64]:
    """Means (g, 3) and covariances (g, 3, 3) of consecutive groups of points."""
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])
    means = np.add.reduceat(points, starts) / sizes[:, None]
    centred = points - np.repeat(means, sizes, axis=0)
    products = np.einsum("ni,nj->nij", centred, centred)
    return means, np.add.reduceat(products, starts) / sizes[:, None, None]
