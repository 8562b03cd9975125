"""Seed-point ground segmentation (paper 2.2, eq. 1-3).

A scanner that sees nothing within alpha of straight down, such as a Mid-360 held upright, takes its seeds farther out:
where polar cells of its lowest rings are flat.
"""

from dataclasses import replace

import numpy as np

from app.slam.kernels import ground as kernels
from app.slam.sections import GroundParams
from app.slam.types import F32, F64, NON_GROUND, U16, GroundResult

MIN_SEEDS = 20
"""Least number of seeds for a plane."""


def segment(points: F32, ring: U16, down: F64, params: GroundParams) -> GroundResult:
    """Label the ground of one scan.

    Args:
        points: (n, 3) float32 m, LiDAR frame.
        ring: (n,) rank of each point's scan line by elevation; 0 is the outermost.
        down: (3,) unit, direction of gravity in the LiDAR frame.

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
    )
    if not params.enabled:
        return replace(none, reason="ground segmentation is switched off")
    if len(points) == 0:
        return replace(none, reason="the scan has no points")

    cos_alpha, cos_slope = np.cos(np.radians([params.alpha, params.max_slope]))
    seeds, steep = kernels.steep_seeds(points, ring, params.scan_lines, down, cos_alpha, labels)
    if steep == 0:  # a scanner held upright
        seeds = kernels.flat_seeds(points, ring, params.scan_lines, down, params.sigma, cos_slope, labels)
    if seeds < MIN_SEEDS:
        labels[:] = NON_GROUND
        return replace(none, reason=f"only {seeds} seed points; a plane needs {MIN_SEEDS}", seeds=seeds)
    sums = np.zeros(12)
    kernels.moments(points, labels, sums)

    # eq. 1: principal components of the seeds
    mean = sums[3:6] / seeds
    xx, xy, xz, yy, yz, zz = sums[6:] / seeds
    covariance = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) - np.outer(mean, mean)
    values, vectors = np.linalg.eigh(covariance)  # ascending: values[0] is lambda3
    planarity = float(max(values[0], 0.0) / values[1]) if values[1] > 0 else 1.0
    normal = vectors[:, 0] * -np.sign(vectors[:, 0] @ down or -1.0)
    centroid = sums[:3] + mean
    result = replace(none, normal=normal, centroid=centroid, planarity=planarity, seeds=seeds)
    slope = float(np.degrees(np.arccos(np.clip(-normal @ down, -1.0, 1.0))))
    if planarity >= params.planarity:
        reason = f"λ3/λ2 of the seeds is {planarity:.2f}, not below {params.planarity:g}: they form no plane"
    elif slope > params.max_slope:
        reason = f"the seeds' plane is {slope:.0f}° steep, over {params.max_slope:g}°"
    else:
        count = kernels.label(points, centroid, normal, params.sigma, labels)
        return replace(result, found=True, share=count / len(points))
    labels[:] = NON_GROUND
    return replace(result, reason=reason)
