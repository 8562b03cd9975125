"""Seed-point ground segmentation (paper 2.2, eq. 1-3).

A scanner that sees nothing within alpha of straight down, such as a Mid-360 held upright, takes cells of the floor as
seeds, farther out and from earlier scans (`app.slam.floor`).
"""

from dataclasses import replace

import numpy as np

from app.slam import lie
from app.slam.floor import Floor
from app.slam.kernels import ground as kernels
from app.slam.sections import GroundParams
from app.slam.types import F32, F64, NON_GROUND, SEED, U16, GroundResult

MIN_SEEDS = 20
"""Least number of seeds for a plane."""


def segment(
    points: F32,
    ring: U16,
    down: F64,
    params: GroundParams,
    known: Floor | None = None,
    T_odom_lidar: F64 | None = None,
) -> GroundResult:
    """Label the ground of one scan.

    Args:
        points: (n, 3) float32 m, LiDAR frame.
        ring: (n,) rank of each point's scan line by elevation; 0 is the outermost.
        down: (3,) unit, direction of gravity in the LiDAR frame.
        known: the floor from earlier scans. T_odom_lidar: (4, 4); None for a lone scan.

    Returns:
        Labels and the plane. Without an acceptable plane every label is NON_GROUND, and `reason` says why.
    """
    labels = np.zeros(len(points), dtype=np.uint8)
    none = GroundResult(
        labels=labels,
        found=False,
        reason="",
        normal=-down,
        centroid=np.full(3, np.nan),
        down=down,
        planarity=float("nan"),
        seeds=0,
        share=0.0,
        T_odom_lidar=T_odom_lidar,
        known=known,
        floor=known,
    )
    if not params.enabled:
        return replace(none, reason="ground segmentation is switched off")
    if len(points) == 0:
        return replace(none, reason="the scan has no points")

    seeds, steep = kernels.steep_seeds(points, ring, params.scan_lines, down, np.cos(np.radians(params.alpha)), labels)
    if steep == 0:  # a scanner held upright
        return _on_floor(points, ring, params, none)
    if seeds < MIN_SEEDS:
        labels[:] = NON_GROUND
        return replace(none, reason=f"only {seeds} seed points; a plane needs {MIN_SEEDS}", seeds=seeds)
    sums = np.zeros(12)
    kernels.moments(points, labels, sums)
    mean = sums[3:6] / seeds
    xx, xy, xz, yy, yz, zz = sums[6:] / seeds
    covariance = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) - np.outer(mean, mean)
    result = _plane(replace(none, seeds=seeds), sums[:3] + mean, covariance, params)
    if result.found:
        count = kernels.label(points, result.centroid, result.normal, params.sigma, labels)
        return replace(result, share=count / len(points))
    labels[:] = NON_GROUND
    return result


def _plane(result: GroundResult, mean: F64, covariance: F64, params: GroundParams) -> GroundResult:
    """The result with the plane of its seeds (eq. 1), if that is one and not too steep."""
    values, vectors = np.linalg.eigh(covariance)  # ascending: values[0] is lambda3
    planarity = float(max(values[0], 0.0) / values[1]) if values[1] > 0 else 1.0
    normal = vectors[:, 0] * -np.sign(vectors[:, 0] @ result.down or -1.0)
    slope = float(np.degrees(np.arccos(np.clip(-normal @ result.down, -1.0, 1.0))))
    reason = ""
    if planarity >= params.planarity:
        reason = f"λ3/λ2 of the seeds is {planarity:.2f}, not below {params.planarity:g}: they form no plane"
    elif slope > params.max_slope:
        reason = f"the seeds' plane is {slope:.0f}° steep, over {params.max_slope:g}°"
    return replace(result, found=not reason, reason=reason, normal=normal, centroid=mean, planarity=planarity)


def _on_floor(points: F32, ring: U16, params: GroundParams, none: GroundResult) -> GroundResult:
    """The result by cells of the floor: labels, and the plane of the cells that are seeds. none: without any labels."""
    T_odom_lidar = none.T_odom_lidar
    if T_odom_lidar is None:
        T_odom_lidar = lie.transform(lie.between(none.down, np.array([0.0, 0.0, -1.0])), np.zeros(3))
    known = none.known or Floor.unknown(T_odom_lidar)
    floor, kinds, cells = known.with_scan(points, ring, T_odom_lidar, params).find(params)
    none = replace(none, floor=floor)
    if not len(cells):
        return replace(none, reason="no seeds: no flat ground is seen around the scanner")
    mean = cells.mean(axis=0)
    result = _plane(none, mean, (cells - mean).T @ (cells - mean) / len(cells), params)
    if not result.found:
        return result
    count = floor.label(points, ring, kinds, params, none.labels)
    seeds = int(np.count_nonzero(none.labels == SEED))
    return replace(result, share=count / len(points), seeds=seeds)
