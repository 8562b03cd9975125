"""Distances between two maps along the surface normal, and the level of detection: a smaller distance may be chance.

After M3C2: Lague, Brodu, Leroux 2013, "Accurate 3D comparison of complex topography with terrestrial laser scanner".
Two differences: each point uses the smallest scale at which its surroundings are planar, and only the nearest layer of
the other map counts, because there is often another surface behind a thin wall.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import small_gicp

from app.slam import lie
from app.slam.errors import HemislamError
from app.slam.kernels import cells
from app.slam.types import F32, F64, I64

THIN_M: Final = 0.01
"""Maps are thinned to voxels of this size when read; with larger voxels, means would shift to the voxels' middles."""
CORE_M: Final = 0.1
"""One distance is measured in each voxel of this size."""
RADII_M: Final = np.array([0.1, 0.2, 0.4])
LEAST: Final = 5
"""Fewest points from which a mean is computed."""
REACH_M: Final = 0.5
"""Surfaces farther apart do not count as the same surface."""
_FIT_VOXEL_M: Final = 0.2
_FIT_REACH_M: Final = 2.0
_FARTHEST_M: Final = 1000.0
"""Points farther outside the other map are ignored; small_gicp would warn about each point beyond 200 km."""
_EDGE_M: Final = 0.2
_BATCH: Final = 10_000


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Points sorted by the cube that contains them: points (n, 3) f32; keys (m,) i64; starts (m + 1,) i64; edge, m."""

    points: F32
    keys: I64
    starts: I64
    edge: float


def sorted_cells(points: F32, edge: float) -> Cells:
    """Sort (n, 3) points within 2^20 edges of their origin."""
    found = _keys(points, edge)
    order = np.argsort(found, kind="stable")
    keys, starts = np.unique(found[order], return_index=True)
    return Cells(points[order], keys, np.append(starts, len(points)).astype(np.int64), edge)


def density(points: F32, edge: float = 0.25) -> F32:
    """(n,) number of points in a cube of about two edges around each of (n, 3) points."""
    found, out = sorted_cells(points, edge), np.empty(len(points), np.int32)
    cells.count_around(points, found.keys, found.starts, edge, out)
    return out.astype(np.float32)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Distances of a map from another map.

    Attributes:
        distance: (n,) m, of each point: positive in front of the other surface, towards the sensor; NaN where the
            other map has no surface within reach.
        detectable: (n,) m, the level of detection at 95 %: a smaller distance may be chance. NaN likewise.
        T: (4, 4) by which the other map was moved before the comparison.
    """

    distance: F32
    detectable: F32
    T: F64

    @cached_property
    def known(self) -> F32:
        """(k,) m, the distances that are not NaN."""
        return self.distance[np.isfinite(self.distance)]

    @property
    def covered(self) -> float:
        """Share of the points that have a counterpart."""
        return len(self.known) / max(len(self.distance), 1)

    @property
    def changed(self) -> float:
        """Share of these points whose distance is more than chance."""
        return float(np.count_nonzero(np.abs(self.distance) > self.detectable)) / max(len(self.known), 1)

    @property
    def median(self) -> float:
        return float(np.median(self.known)) if len(self.known) else np.nan

    @property
    def typical(self) -> float:
        """m: half of the distances are smaller."""
        return float(np.median(np.abs(self.known))) if len(self.known) else np.nan

    @property
    def p95(self) -> float:
        """m: 95 % of the distances are smaller."""
        return float(np.percentile(np.abs(self.known), 95)) if len(self.known) else np.nan


def compare(
    points: F64,
    sensors: F64,
    other: F64,
    *,
    reach: float = REACH_M,
    fit: bool = False,
    progress: Callable[[float], None] = lambda share: None,
) -> Comparison:
    """Compare a map with another one in the same frame.

    Args:
        points: (n, 3) m, of the map. sensors: (n, 3) m, from where each was seen. other: (k, 3) m.
        reach: m, largest distance that counts.
        fit: first move the other map for the best fit.
        progress: called with the share that is done, 0-1.

    Raises:
        HemislamError: a map has no points, or the maps do not overlap.
    """
    if not len(points) or not len(other):
        raise HemislamError("A map without points cannot be compared.")
    origin = np.round(np.median(points, axis=0))
    mine, theirs = (points - origin).astype(np.float32), (other - origin).astype(np.float32)
    T = _fitted(mine, theirs) if fit else np.eye(4)
    theirs = lie.moved(T, theirs).astype(np.float32)
    low, high = mine.min(axis=0) - reach - 1, mine.max(axis=0) + reach + 1
    theirs = theirs[((theirs > low) & (theirs < high)).all(axis=1)]
    if not len(theirs):
        raise HemislamError("The maps do not lie on each other; they must be in the same frame, as of one recording.")
    own, them = (sorted_cells(cloud, _EDGE_M) for cloud in (mine, theirs))
    _, first, core_of = np.unique(_keys(mine, CORE_M), return_index=True, return_inverse=True)
    cores, seen_from = mine[first], (sensors - origin).astype(np.float32)[first]
    out = np.empty((len(cores), 2), np.float32)
    for begin in range(0, len(cores), _BATCH):
        part = slice(begin, begin + _BATCH)
        cells.distances(
            cores[part], seen_from[part], own.points, own.keys, own.starts, them.points, them.keys, them.starts,
            own.edge, RADII_M, reach, LEAST, out[part],
        )  # fmt: skip
        progress(min((begin + _BATCH) / len(cores), 1.0))
    if np.isnan(out[:, 0]).all():
        raise HemislamError(
            f"No surface of one map lies within {reach:g} m of the other; they are apart or too sparse."
        )
    about = np.eye(4)
    about[:3, :3], about[:3, 3] = T[:3, :3], T[:3, 3] + origin - T[:3, :3] @ origin
    return Comparison(out[core_of, 0], out[core_of, 1], about)


def _keys(points: F32, edge: float) -> I64:
    found = np.empty(len(points), np.int64)
    cells.keys_of(points, edge, found)
    return found


def _fitted(mine: F32, theirs: F32) -> F64:
    """(4, 4), transform of their points onto mine (Segal 2009, generalised ICP)."""
    theirs = theirs[(np.abs(theirs) < np.abs(mine).max() + _FARTHEST_M).all(axis=1)]
    if len(theirs):
        found = small_gicp.align(
            mine.astype(np.float64),
            theirs.astype(np.float64),
            registration_type="GICP",
            downsampling_resolution=_FIT_VOXEL_M,
            max_correspondence_distance=_FIT_REACH_M,
            num_threads=1,
        )
        if found.converged and found.num_inliers >= 100:
            return np.asarray(found.T_target_source, np.float64)
    raise HemislamError("The maps could not be fitted to each other; they must lie within 2 m and a few degrees.")
