"""The ground around a scanner that sees none below itself, such as a Mid-360 held upright.

Such a scanner sees the ground only some ten metres ahead, in few points. So cells of half a metre around it keep what
the last scans show, and which height earlier ones found to be ground. All of these cells together are the floor.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from app.slam.arrays import F32, F64, I64, U8, U16
from app.slam.kernels import floor as kernels
from app.slam.kernels.floor import CELLS, EDGE_M
from app.slam.kernels.ground import last_line
from app.slam.sections import GroundParams

HALF = 5
"""Scans in each half of the last scans. When the newer half is full, the older one is dropped."""


@dataclass(frozen=True, slots=True)
class Floor:
    """Cells around the last scan, whose z axis is up.

    Attributes:
        T_odom_lidar: (4, 4), of the last scan. corner: (2,), index of the first cell; a cell's edge is EDGE_M.
        scans: number of scans seen.
        seen: (2, CELLS, CELLS, 4) of the last up to HALF scans and the HALF before: `kernels.COUNT` and so on.
        known: (CELLS, CELLS, 2): heights (m) that scans before the last found, and how many did; 0 if none.
        found: (CELLS, CELLS): heights that `find` found after the last scan; nan where there is no floor.
    """

    T_odom_lidar: F64
    corner: I64
    scans: int
    seen: F32
    known: F32
    found: F32

    @classmethod
    def unknown(cls, T_odom_lidar: F64) -> Self:
        """The floor around this pose before any scan."""
        seen = np.tile(kernels.NOTHING, (2, CELLS, CELLS, 1))
        found = np.full((CELLS, CELLS), np.nan, np.float32)
        return cls(T_odom_lidar, _corner(T_odom_lidar), 0, seen, np.zeros((CELLS, CELLS, 2), np.float32), found)

    def with_scan(self, points: F32, ring: U16, T_odom_lidar: F64, params: GroundParams) -> Self:
        """The floor with one more scan: points (n, 3) m, LiDAR frame, and their lines (n,), 0 the lowest."""
        seen, known, corner = np.empty_like(self.seen), np.empty_like(self.known), _corner(T_odom_lidar)
        full = self.scans % HALF == 0
        kernels.carry(self.seen, self.found, self.known, corner - self.corner, full, seen, known)
        p = T_odom_lidar[:3, 3]
        kernels.see(points, ring, last_line(ring, params.scan_lines), T_odom_lidar[:3, :3], p, corner, seen[0])
        return replace(self, T_odom_lidar=T_odom_lidar, corner=corner, scans=self.scans + 1, seen=seen, known=known)

    def find(self, params: GroundParams) -> tuple[Self, U8, F64]:
        """The floor with its heights, what each cell is, and the cells of its plane.

        Returns:
            This with `found`; (CELLS, CELLS), `kernels.NONE` and so on; (k, 3) m, LiDAR frame.
        """
        found, kinds = np.empty((CELLS, CELLS), np.float32), np.empty((CELLS, CELLS), np.uint8)
        seeds = np.empty((CELLS * CELLS, 3))
        R, p = self.T_odom_lidar[:3, :3], self.T_odom_lidar[:3, 3]
        steepest = float(np.cos(np.radians(params.max_slope)))
        count = kernels.find(self.seen, self.known, self.corner, p, params.sigma, steepest, found, kinds, seeds)
        return replace(self, found=found), kinds, seeds[:count] @ R

    def label(self, points: F32, ring: U16, kinds: U8, params: GroundParams, labels: U8) -> int:
        """Label the last scan's points by `found`. Returns the number of points on the floor; see `kernels.label`."""
        R, p = self.T_odom_lidar[:3, :3], self.T_odom_lidar[:3, 3]
        last = last_line(ring, params.scan_lines)
        return int(kernels.label(points, ring, last, R, p, self.corner, self.found, kinds, params.sigma, labels))


def _corner(T_odom_lidar: F64) -> I64:
    """(2,) index of the first cell of the square around this pose."""
    return np.floor(T_odom_lidar[:2, 3] / EDGE_M).astype(np.int64) - CELLS // 2
