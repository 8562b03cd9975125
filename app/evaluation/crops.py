"""Pieces of the map from above, at the same places in every variant, for comparison side by side."""

from collections.abc import Iterable

import numpy as np

from app.slam.types import F64, U16, Keyframe

HALF_M = 9.0
PIXEL_M = 0.05
SLICE_M = (-0.6, 0.7)
"""Heights relative to the sensor: walls and trunks appear as lines, without floor and ceiling."""
REACH_M = 15.0
PLACES = {"start": 0.0, "half way": 0.5}
"""Share of the recording's duration at each place. If a trajectory returns, its start shows both passes."""


def crop(keyframes: Iterable[Keyframe], poses: F64, centre: F64) -> U16:
    """Points per pixel in a square of 2 HALF_M around `centre` (3,), row 0 in the north (+y)."""
    pixels = round(2 * HALF_M / PIXEL_M)
    image = np.zeros((pixels, pixels), np.int64)
    for keyframe, T_map_imu in zip(keyframes, poses, strict=True):
        if np.linalg.norm(T_map_imu[:2, 3] - centre[:2]) > HALF_M + REACH_M:
            continue
        T = T_map_imu @ keyframe.T_imu_lidar
        points = keyframe.cloud.points.astype(np.float64) @ T[:3, :3].T + (T[:3, 3] - centre)
        level = (points[:, 2] > SLICE_M[0]) & (points[:, 2] < SLICE_M[1])
        column, row = np.floor((points[level, :2] + HALF_M) / PIXEL_M).astype(np.int64).T
        inside = (column >= 0) & (column < pixels) & (row >= 0) & (row < pixels)
        np.add.at(image, (pixels - 1 - row[inside], column[inside]), 1)
    return np.minimum(image, 65535).astype(np.uint16)
