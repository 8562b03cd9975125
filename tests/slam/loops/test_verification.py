"""Registration of submaps to one another.

Tests app/slam/kernels/patches.py, app/slam/kernels/submaps.py.
"""

import numpy as np
import pytest

from app.slam import lie
from app.slam.loops.submap import Submap
from app.slam.loops.verification import Prepared, assess, prepare, refine, register, rough, slide
from app.slam.types import F64


def wall(start: tuple[float, float], end: tuple[float, float], rng: np.random.Generator, height: float = 2.6) -> F64:
    a, b = np.array(start), np.array(end)
    count = int(np.linalg.norm(b - a) * height * 40)
    along = rng.uniform(0, 1, (count, 1))
    return np.column_stack([a + along * (b - a), rng.uniform(-1.2, height - 1.2, count)])


def corridor(rng: np.random.Generator, fins: tuple[float, ...] = (), length: float = 30.0) -> F64:
    """Two walls and a floor along x, seen from the middle; a fin on alternating sides at each x."""
    half = length / 2
    floor = np.column_stack([rng.uniform(-half, half, 3000), rng.uniform(-1.2, 1.2, 3000), np.full(3000, -1.2)])
    parts = [wall((-half, 1.2), (half, 1.2), rng), wall((-half, -1.2), (half, -1.2), rng), floor]
    for k, x in enumerate(fins):
        y = 1.2 if k % 2 else -1.2
        inner = y * 0.4
        parts.append(wall((x, y), (x, inner), rng))
    return np.vstack(parts) + rng.normal(scale=0.005, size=(sum(map(len, parts)), 3))


def seen(points: F64, T_here_there: F64) -> Prepared:
    """The same world, looked at from another level frame."""
    T = lie.inverse(T_here_there)
    moved = (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    return prepare(Submap(0, moved, np.zeros_like(moved), 20.0))


def pose(x: float, y: float, z: float, yaw_deg: float) -> F64:
    return lie.transform(lie.exp(np.array([0.0, 0.0, np.radians(yaw_deg)])), np.array([x, y, z]))


FINS = (-9.0, -5.5, -1.0, 3.0, 4.6, 9.5)


@pytest.mark.parametrize("guess", [(0.0, 0.0, 0.0, 0.0), (0.6, 0.3, 0.1, 4.0), (-0.5, -0.4, -0.2, -5.0)])
def test_a_submap_is_found_where_it_is(guess: tuple[float, float, float, float]) -> None:
    truth = pose(0.8, -0.2, 0.05, 2.0)
    target = seen(corridor(np.random.default_rng(0), FINS), np.eye(4))
    source = seen(corridor(np.random.default_rng(1), FINS), truth)
    T = refine(target, source, register(target, source, rough(target, source, pose(*guess) @ truth)[0]))
    assert np.linalg.norm(T[:3, 3] - truth[:3, 3]) < 0.01
    assert np.degrees(np.linalg.norm(lie.log(T[:3, :3] @ truth[:3, :3].T))) < 0.1
    fit = assess(target, source, T)
    assert fit.overlap > 0.95
    assert fit.residual_rms < 0.01
    assert slide(target, source, fit, fit.directions[0]) < 0.02


def test_a_plain_corridor_slides_along_itself() -> None:
    target = seen(corridor(np.random.default_rng(0)), np.eye(4))
    source = seen(corridor(np.random.default_rng(1)), np.eye(4))
    fit = assess(target, source, register(target, source, np.eye(4)))
    assert fit.overlap > 0.95, "nothing else speaks against it"
    assert abs(fit.directions[0, 0]) > 0.99, "it is not held along x"
    assert slide(target, source, fit, fit.directions[0]) > 0.2
    assert slide(target, source, fit, fit.directions[1]) < 0.02, "across it the walls hold"
    held = seen(corridor(np.random.default_rng(1), FINS), np.eye(4))
    assert fit.condition < 0.2 * assess(held, held, np.eye(4)).condition


def test_the_two_sides_of_a_wall_are_not_laid_on_each_other() -> None:
    rng = np.random.default_rng(0)
    left = wall((-6.0, 1.0), (6.0, 1.0), rng).astype(np.float32)
    right = wall((-6.0, 1.15), (6.0, 1.15), rng).astype(np.float32)
    inside = prepare(Submap(0, left, np.zeros_like(left), 20.0))
    outside = prepare(Submap(1, right, np.tile(np.float32([0.0, 3.0, 0.0]), (len(right), 1)), 20.0))
    assert len(assess(inside, inside, np.eye(4)).residuals) > 100
    assert len(assess(inside, outside, np.eye(4)).residuals) == 0


def test_the_information_is_that_of_small_motions() -> None:
    """Against the change of the sum of squares itself, over correspondences that stay."""
    target = seen(corridor(np.random.default_rng(0), FINS), np.eye(4))
    source = seen(corridor(np.random.default_rng(1), FINS), pose(0.5, 0.1, 0.0, 3.0))
    T = refine(target, source, register(target, source, pose(0.5, 0.1, 0.0, 3.0)))
    fit = assess(target, source, T)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 0.004
        costs = []
        for sign in (-1, 0, 1):
            moved = T.copy()
            moved[:3, 3] += sign * step
            costs.append(float(np.sum(assess(target, source, moved).residuals ** 2)))
        curvature = (costs[0] - 2 * costs[1] + costs[2]) / step[axis] ** 2
        assert curvature / 2 == pytest.approx(fit.information[3 + axis, 3 + axis], rel=0.3), "partners change a little"


@pytest.mark.parametrize("count", [0, 1, 5])
def test_a_place_of_few_points_or_none_shares_nothing_with_another(count: int) -> None:
    few = seen(corridor(np.random.default_rng(0))[:count], np.eye(4))
    full = seen(corridor(np.random.default_rng(1), FINS), np.eye(4))
    for target, source in ((few, full), (full, few), (few, few)):
        T = refine(target, source, register(target, source, rough(target, source, np.eye(4))[0]))
        fit = assess(target, source, T)
        assert np.isfinite(T).all() and fit.overlap == 0.0
        assert slide(target, source, fit, fit.directions[0]) < np.inf
        assert count > 1 or not len(fit.residuals)
