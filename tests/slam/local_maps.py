"""Local maps filled with points of simple surfaces."""

from dataclasses import fields

import numpy as np

from app.slam.local_map import LocalMap, Planes
from app.slam.sections import FilterParams, MapParams

SMALL = MapParams(max_voxels=5000)
LOOSE = FilterParams(plane_tilt=20.0)
HERE = np.zeros(3)


def stored(local_map: LocalMap) -> np.ndarray:
    """All points of the map, (n, 3) float64."""
    return local_map.checkpoint().points[:, :3].astype(float)


def filled(points: np.ndarray, params: MapParams = SMALL) -> LocalMap:
    local_map = LocalMap(params)
    local_map.insert(points.astype(np.float32), HERE, params)
    return local_map


def surface(seed: int, n: int = 4000, noise: float = 0.003, at: float = 0.0) -> np.ndarray:
    """A floor, two walls and a slope in a patch of 6 m around x = `at`."""
    rng = np.random.default_rng(seed)
    a, b = rng.uniform(-3, 3, (2, n))
    zero, kind = np.zeros(n), rng.integers(0, 4, n)[:, None]
    parts = [[a, b, zero - 1.3], [a, zero + 2.1, b], [zero - 2.4, a, b], [a, b, 0.5 * a + 0.2 * b]]
    return (
        np.choose(kind, [np.stack(p, axis=1) for p in parts])
        + rng.normal(scale=noise, size=(n, 3))
        + np.array([at, 0, 0])
    )


def equal(a: Planes, b: Planes) -> bool:
    """To the bit, wherever there is a plane."""
    found = a.variances >= 0
    return bool(
        np.array_equal(found, b.variances >= 0)
        and all(np.array_equal(getattr(a, f.name)[found], getattr(b, f.name)[found]) for f in fields(Planes))
    )
