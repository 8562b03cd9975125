"""Systematic errors of each scan line, estimated from the map while walking.

A real scanner's channels are off by up to a centimetre in range and a tenth of a degree in elevation. These errors
repeat in every scan, so they do not average out: lines at different elevations see the same surface at different
depths, so the map shows it too thick and the pose is pulled off. While walking, each line meets surfaces that other
lines have mapped; its mean distance from them is its error.

At rest, each line meets only what it mapped itself. So only one scan per keyframe is used.
"""

from dataclasses import dataclass

import numpy as np

from app.slam import channels
from app.slam.imu import Belief
from app.slam.kernels import lines as kernels
from app.slam.kernels import registration
from app.slam.local_map import LocalMap
from app.slam.sections import FilterParams
from app.slam.types import F32, F64, U16, Scan

LINES = 256
"""Number of lines whose errors are estimated; further lines of a scanner stay uncorrected."""
USUAL = np.array([0.01, np.radians(0.12)])
"""m, rad: prior standard deviations of these errors, from data sheets and calibrations of units of one model."""
DOUBT = np.array([0.003, np.radians(0.03)])
"""m, rad: apparent errors caused by the map's own inexactness. A scanner with no larger ones is left uncorrected."""
POINTS = 500
"""Points of a scan that are looked up (every k-th). They are few, so that two rarely meet the same patch of the map."""
FADES_M = 50.0
"""Evidence this far back counts 1/e."""


@dataclass(frozen=True, slots=True)
class LineErrors:
    """Attributes:
    errors: (LINES, 2), of the range in m and of the elevation in rad, to be subtracted from every return.
    information, moment: (LINES, 2, 2) and (LINES, 2), the normal equations accumulated for each line.
    """

    errors: F64
    information: F64
    moment: F64

    @classmethod
    def unknown(cls) -> "LineErrors":
        return cls(np.zeros((LINES, 2)), np.zeros((LINES, 2, 2)), np.zeros((LINES, 2)))

    def set_right(self, scan: Scan) -> Scan:
        """The scan without these errors; the same one if none are known."""
        return channels.bent(scan, -self.errors[:, 1], -self.errors[:, 0]) if self.errors.any() else scan

    def learnt(
        self, belief: Belief, points: F32, rings: U16, walked: float, local_map: LocalMap, params: FilterParams
    ) -> "LineErrors":
        """These errors, updated with a scan at `belief` before it enters the map.

        Earlier evidence fades over FADES_M walked, because the next view has different map errors. The mean range error
        of all lines is set to zero: scans cannot determine it, since a slightly larger map fits them as well. All
        errors are then shrunk towards zero, fully for a good scanner (James and Stein 1961, positive part).

        Args:
            points: (n, 3) float32 m, LiDAR frame, already corrected by `errors`. rings: (n,), their scan lines.
            walked: m since the last update.
        """
        step = max(1, len(points) // POINTS)
        points, rings, state = np.ascontiguousarray(points[::step]), np.ascontiguousarray(rings[::step]), belief.state
        world = np.empty((len(points), 3))
        registration.to_world(points, state.R_odom_imu, state.p_odom_imu, state.R_imu_lidar, state.p_imu_lidar, world)
        _, planes = local_map.planes(world, state.p_odom_lidar, params)
        kept = np.exp(-walked / FADES_M)
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
