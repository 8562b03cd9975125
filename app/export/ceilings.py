"""Ceilings, which hide everything below them in views from above."""

from typing import Final

import numpy as np
import numpy.typing as npt

from app.slam.types import F32, F64, U8, is_ground

_CONE: Final = float(np.cos(np.radians(35.0)))
_HIGHEST_M: Final = 8.0
_LEAST_SHARE: Final = 0.004
_FLATNESS_M: Final = 0.12
"""Largest median deviation of a ceiling's points from their median height: treetops are rougher."""
_MARGIN_M: Final = 0.25


def below_ceiling(points: F32, labels: U8, up: F64) -> npt.NDArray[np.bool_]:
    """Mask of the points that stay when the ceiling above a keyframe is hidden: all points if there is none.

    Points labelled ground always stay: a ceiling mistaken for ground must be visible.

    Args:
        points: (n, 3) m, LiDAR frame. labels: (n,). up: (3,) unit, LiDAR frame.
    """
    height = points @ up.astype(np.float32)
    overhead = height[height > _CONE * np.linalg.norm(points, axis=1)]
    if len(overhead) < max(30.0, _LEAST_SHARE * len(points)):
        return np.ones(len(points), np.bool_)
    ceiling = float(np.median(overhead))
    if ceiling > _HIGHEST_M or float(np.median(np.abs(overhead - ceiling))) > _FLATNESS_M:
        return np.ones(len(points), np.bool_)
    return np.asarray((height < ceiling - _MARGIN_M) | is_ground(labels))
