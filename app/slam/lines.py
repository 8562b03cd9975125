"""What each scan line measures wrong, learnt from the map while walking.

A real scanner's channels are off by up to a centimetre in range and a tenth of a degree in elevation. That repeats in
every scan, so it does not average out: lines at different elevations see one surface at different depths, and the
surface is mapped thick and pulls at the pose. But as one walks, each line meets surfaces that other lines have mapped,
and its mean distance from them tells its error.

At rest each line meets only what it mapped itself. So a scan counts once for each keyframe.
"""

from dataclasses import dataclass

import numpy as np

from app.slam.certainty import VIEW_M
from app.slam.imu import Belief
from app.slam.kernels import lines as kernels
from app.slam.kernels import registration
from app.slam.local_map import LocalMap
from app.slam.sections import FilterParams
from app.slam.types import F32, F64, U16

LINES = 256
"""Lines with errors of their own; a scanner with more keeps those of the others."""
USUAL = np.array([0.01, np.radians(0.12)])
"""m, rad: standard deviations of these errors, from data sheets and from calibrations of one model's units."""
DOUBT = np.array([0.003, np.radians(0.03)])
"""m, rad: errors that lines seem to have because the map is not exact. A scanner whose lines seem no worse is good."""
POINTS = 500
"""Points of a scan that are looked up, every k-th: so few that hardly any two meet the same patch of the map."""


@dataclass(frozen=True, slots=True)
class LineErrors:
    """Attributes:
    errors: (LINES, 2) of the range in m and the elevation in rad. They are taken off every return.
    information, moment: (LINES, 2, 2) and (LINES, 2), weighted sums of what was seen of them.
    """

    errors: F64
    information: F64
    moment: F64

    @classmethod
    def unknown(cls) -> "LineErrors":
        return cls(np.zeros((LINES, 2)), np.zeros((LINES, 2, 2)), np.zeros((LINES, 2)))

    def learnt(
        self, belief: Belief, points: F32, rings: U16, walked: float, local_map: LocalMap, params: FilterParams
    ) -> "LineErrors":
        """With what a scan at `belief` says, before it enters the map.

        What was learnt fades over VIEW_M walked, since the map's own errors are others in the next view. The mean
        error of all ranges is left out: a map that is larger all round fits the same scans. All are shrunk by how large
        they would be for a good scanner (James and Stein 1961, positive part).

        Args:
            points: (n, 3) float32 m, LiDAR frame, without the present errors. rings: (n,) of them.
            walked: m since the last time.
        """
        step = max(1, len(points) // POINTS)
        points, rings, state = np.ascontiguousarray(points[::step]), np.ascontiguousarray(rings[::step]), belief.state
        world = np.empty((len(points), 3))
        registration.to_world(points, state.R_odom_imu, state.p_odom_imu, state.R_imu_lidar, state.p_imu_lidar, world)
        _, planes = local_map.planes(world, params)
        kept = np.exp(-walked / VIEW_M)
        information, moment = kept * self.information, kept * self.moment
        kernels.observe(
            points, rings, world, state.R_odom_imu @ state.R_imu_lidar, planes.normals, planes.centers,
            planes.variances, params.gate, self.errors, information, moment,
        )  # fmt: skip
        errors = np.linalg.solve(information + np.diag(USUAL**-2.0), moment[:, :, None])[:, :, 0]
        if (weights := information[:, 0, 0]).any():
            seen = weights > 0
            errors[seen, 0] -= np.average(errors[seen, 0], weights=weights[seen])
            errors *= np.maximum(0.0, 1.0 - DOUBT**2 / np.maximum(np.mean(errors[seen] ** 2, axis=0), 1e-12))
        return LineErrors(errors, information, moment)
