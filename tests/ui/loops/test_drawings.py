"""The small charts for one loop, and the choice of the edge under a click.

Tests app/ui/loops/edges.py, app/ui/loops/panel.py.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from app.slam import lie
from app.slam.loops.scan_context import RINGS, SECTORS, YAWS
from app.ui.loops.edges import nearest
from app.ui.loops.inspector import (
    UNSEEN,
    best_yaw,
    contexts_image,
    disc,
    histogram,
    on_the_way,
    shift_curve,
    without_ceiling,
)
from app.ui.loops.panel import stand

angles = st.tuples(*(st.floats(-1.5, 1.5) for _ in range(3)))
places = st.tuples(*(st.floats(-50, 50) for _ in range(3)))


@settings(deadline=None)
@given(angles, places, angles, places, st.floats(0, 1))
def test_on_the_way_positions_go_straight_and_rotations_as_slerp_has_it(
    turn_a: tuple[float, ...], at_a: tuple[float, ...], turn_b: tuple[float, ...], at_b: tuple[float, ...], share: float
) -> None:
    Rs = Rotation.from_rotvec([turn_a, turn_b])
    a, b = (lie.transform(R, np.array(p)) for R, p in zip(Rs.as_matrix(), (at_a, at_b), strict=True))
    T = on_the_way(a, b, share)
    assert np.allclose(T[:3, 3], (1 - share) * a[:3, 3] + share * b[:3, 3])
    if (Rs[0].inv() * Rs[1]).magnitude() < 3.0:  # beyond there are two ways of the same length
        assert np.allclose(T[:3, :3], Slerp([0, 1], Rs)(share).as_matrix(), atol=1e-6)


def at(image: np.ndarray, angle: float, radius: float) -> np.ndarray:
    """Pixel of a disc in a direction (rad, anticlockwise from the right) at a share of its radius."""
    half = image.shape[0] / 2
    return image[int(half - half * radius * np.sin(angle)), int(half + half * radius * np.cos(angle))]


def lit(sector: int, ring: int) -> np.ndarray:
    """A context that saw everything and found something in one cell."""
    context = np.zeros((RINGS, SECTORS), np.float32)
    context[ring, sector] = 1.0
    return context


@pytest.mark.parametrize("sector", [0, 7, 30, 59])
def test_a_cell_is_drawn_in_its_direction_and_at_its_range(sector: int) -> None:
    image = disc(lit(sector, 10))
    angle, radius = (sector + 0.5) * 2 * np.pi / SECTORS, 10.5 / RINGS
    here = at(image, angle, radius)
    assert here[:3].sum() > 1.5 * at(image, angle + 1.0, radius)[:3].sum()
    assert np.array_equal(at(image, angle, 0.9), at(image, angle + 1.0, radius))


def test_what_was_never_seen_is_grey_and_the_corners_are_clear() -> None:
    context = lit(3, 10)
    context[15:] = np.nan
    image = disc(context)
    assert tuple(at(image, 2.0, 0.9)) == (*UNSEEN, 255)
    assert tuple(at(image, 2.0, 0.5)[:3]) != UNSEEN
    assert image[0, 0, 3] == 0


def test_the_newer_context_is_turned_to_lie_as_the_older_does() -> None:
    older, newer = lit(20, 10), lit(5, 10)
    turn = float(YAWS[15])  # the newer's columns moved on by 15
    image = contexts_image(older, newer, turn)
    left, right = image[:, :300], image[:, -300:]
    assert (left == right).all(axis=2).mean() > 0.99


def test_a_context_that_saw_nothing_is_all_grey() -> None:
    image = disc(np.full((RINGS, SECTORS), np.nan, np.float32))
    assert {tuple(pixel) for pixel in image[image[..., 3] > 0][:, :3]} == {UNSEEN}


def test_the_histogram_counts_every_point_below_its_end_and_marks_the_limit() -> None:
    edges, counts, mark = histogram(np.concatenate((np.full(90, 0.001), np.full(10, -0.03), [np.nan])), 0.05)
    assert counts[::2].tolist() == counts[1::2].tolist() and sorted(counts[::2])[-2:] == [10, 90]
    assert edges[2 * np.argmax(counts[::2])] <= 1.0 < edges[2 * np.argmax(counts[::2]) + 1]
    marked = np.isfinite(mark)
    assert np.allclose(edges[marked], 50.0) and mark[marked].tolist() == [0, 90]
    assert not histogram(np.empty(0), 0.05)[1].any()


def test_the_curve_of_turns_goes_from_half_a_turn_to_half_a_turn() -> None:
    distances = np.full(SECTORS, 0.6)
    distances[15] = 0.1  # 90 degrees
    degrees, shown, limit = shift_curve(distances, 0.3)
    assert (np.diff(degrees) > 0).all() and degrees[0] >= -180 and degrees[-1] <= 180
    assert degrees[shown.argmin()] == pytest.approx(90) == pytest.approx(np.degrees(best_yaw(distances)))
    assert (limit == 0.3).all()


@settings(deadline=None)
@given(st.integers(0, 30), st.floats(0.0, 0.9))
def test_of_many_edges_the_eye_s_ray_means_the_one_it_touches(which: int, share: float) -> None:
    rng = np.random.default_rng(which)
    lines = rng.uniform(-20, 20, (31, 3, 3)) + np.array([0, 60, 0])
    a, b = lines[which, 0], lines[which, 1]
    target = a + round(share * 11) / 11 * (b - a)
    origin = np.array([0.0, -30.0, 4.0])
    found = nearest(lines, origin, target - origin)
    assert found is not None
    samples = lines[found, :-1, None] + np.linspace(0, 1, 400)[:, None] * (
        lines[found, 1:, None] - lines[found, :-1, None]
    )
    rays = samples.reshape(-1, 3) - origin
    cosine = rays @ (target - origin) / np.linalg.norm(rays, axis=1) / np.linalg.norm(target - origin)
    assert np.arccos(np.clip(cosine.max(), -1, 1)) < 1e-3


def test_what_is_behind_or_far_beside_is_not_meant() -> None:
    line = np.array([[[0.0, 10.0, 0.0], [0.5, 10.0, 1.0], [1.0, 10.0, 0.0]]])
    assert nearest(line, np.zeros(3), np.array([0.0, 1.0, 0.0])) == 0
    assert nearest(line, np.zeros(3), np.array([0.0, -1.0, 0.0])) is None
    assert nearest(line, np.zeros(3), np.array([1.0, 1.0, 0.0])) is None
    assert nearest(np.empty((0, 3, 3)), np.zeros(3), np.ones(3)) is None


@settings(deadline=None)
@given(places, places, places, st.floats(3, 40))
def test_the_camera_stands_at_its_distance_above_what_it_looks_at(
    position: tuple[float, ...], look_at: tuple[float, ...], target: tuple[float, ...], distance: float
) -> None:
    stood = stand(np.array(position), np.array(look_at), np.array(target), distance)
    assert np.linalg.norm(stood - target) == pytest.approx(distance)
    assert stood[2] - target[2] > 0.6 * distance


def test_a_submap_is_drawn_without_its_ceiling_and_one_under_the_sky_as_it_is() -> None:
    rng = np.random.default_rng(0)
    floor = np.column_stack((rng.uniform(-5, 5, (2000, 2)), np.full(2000, -1.3)))
    wall = np.column_stack((np.full(1000, 5.0), rng.uniform(-5, 5, 1000), rng.uniform(-1.3, 1.0, 1000)))
    ceiling = np.column_stack((rng.uniform(-5, 5, (2000, 2)), np.full(2000, 1.5)))
    outdoors = np.concatenate((floor, wall)).astype(np.float32)
    assert np.array_equal(without_ceiling(np.concatenate((outdoors, ceiling.astype(np.float32)))), outdoors)
    assert np.array_equal(without_ceiling(outdoors), outdoors)
