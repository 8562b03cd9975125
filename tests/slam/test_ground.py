"""Ground segmentation finds the floor and nothing else, whatever the sensor's mounting; eq. 1-3 compared with numpy."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.slam import ground
from app.slam.sections import GroundParams
from app.slam.types import GROUND, NON_GROUND, SEED, GroundResult, Scan

from .scenes import FORWARD, Rig, Scene, Walk, box, corridor, furnished_room, sweep

ROLLED = FORWARD @ Rotation.from_euler("z", 180, degrees=True).as_matrix()
MOUNTS = {
    "forward": FORWARD,
    "forward, upside down": ROLLED,
    "forward, on its side": FORWARD @ Rotation.from_euler("z", 90, degrees=True).as_matrix(),
    "forward, looking 25 degrees down": Rotation.from_euler("y", 25, degrees=True).as_matrix() @ FORWARD,
    "forward, looking 10 degrees up": Rotation.from_euler("y", -10, degrees=True).as_matrix() @ FORWARD,
    "tilted 20 degrees aside": Rotation.from_euler("x", 20, degrees=True).as_matrix() @ FORWARD,
    "to the left": Rotation.from_euler("z", 90, degrees=True).as_matrix() @ FORWARD,
}
"""R_world_lidar."""
HIGHEST_ON_THE_FLOOR = 0.35
"""m; σ |p| at the far end of a room."""


def seen(scene: Scene, R: np.ndarray) -> Scan:
    return sweep(scene, Walk(R, still=100), Rig(columns=120), 0.0, seed=3)


@cache
def room_seen_by(mount: str) -> Scan:
    return seen(furnished_room(), MOUNTS[mount])


def segment(scan: Scan, R: np.ndarray, params: GroundParams | None = None) -> GroundResult:
    return ground.segment(scan.points, scan.ring, R.T @ [0.0, 0.0, -1.0], params or GroundParams())


def heights(scan: Scan, R: np.ndarray) -> np.ndarray:
    """Of each point over the sensor, m."""
    return np.asarray((scan.points.astype(float) @ R.T)[:, 2])


@pytest.mark.parametrize("mount", MOUNTS, ids=str)
@pytest.mark.parametrize("scene", [furnished_room(), corridor(20.0, pillars=True)], ids=["room", "corridor"])
def test_the_floor_is_found_for_any_mounting(mount: str, scene: Scene) -> None:
    R = MOUNTS[mount]
    scan = seen(scene, R)
    result = segment(scan, R)
    assert result.found, result.reason
    assert result.reason == ""
    tilt = np.degrees(np.arccos(np.clip(result.normal @ (R.T @ [0, 0, 1]), -1, 1)))
    assert tilt < 1.0  # pointing up, not down
    assert (R @ result.centroid)[2] == pytest.approx(-1.3, abs=0.01)
    assert np.linalg.norm(result.normal) == pytest.approx(1.0)

    labelled, true = result.labels != NON_GROUND, scan.truth_ground == 1
    assert labelled[true].mean() > 0.99
    assert true[labelled].mean() > 0.85  # the foot of a wall is within σ |p| of the floor
    assert result.share == pytest.approx(labelled.mean())
    assert result.seeds > ground.MIN_SEEDS


@pytest.mark.parametrize("mount", MOUNTS, ids=str)
def test_neither_ceiling_nor_wall_nor_table_is_ground(mount: str) -> None:
    R = MOUNTS[mount]
    scan = seen(furnished_room(), R)
    labelled = segment(scan, R).labels != NON_GROUND
    assert heights(scan, R)[labelled].max() < -1.3 + HIGHEST_ON_THE_FLOOR
    assert not np.any(labelled & (heights(scan, R) > 0))


def test_a_sensor_that_looks_at_the_ceiling_labels_no_ground() -> None:
    """z up: the hemisphere above. The floor is not visible, and the ceiling is not a floor."""
    scan = seen(furnished_room(), np.eye(3))
    result = segment(scan, np.eye(3))
    assert not result.found
    assert not result.labels.any()
    assert "seed" in result.reason
    assert result.share == 0.0


def test_a_sensor_that_looks_straight_down_sees_nothing_but_floor_below() -> None:
    """z down: the outermost lines look sideways; with all lines as candidates the floor is found."""
    R = np.diag([1.0, -1.0, -1.0])
    scan = seen(furnished_room(), R)
    result = segment(scan, R, GroundParams(scan_lines=32))
    assert result.found
    assert (result.labels != NON_GROUND)[scan.truth_ground == 1].mean() > 0.99
    assert not np.any((result.labels != NON_GROUND) & (heights(scan, R) > 0))


@pytest.mark.parametrize("degrees", [0, 10, 30])
def test_a_slope_is_ground(degrees: float) -> None:
    up = Rotation.from_euler("xy", [0.3 * degrees, -degrees], degrees=True).apply([0.0, 0.0, 1.0])
    scene = Scene(ground=(up, -1.3 * up[2]))
    scan = seen(scene, FORWARD)
    result = segment(scan, FORWARD)
    assert result.found, result.reason
    assert np.degrees(np.arccos(np.clip(result.normal @ (FORWARD.T @ up), -1, 1))) < 1.0
    assert (result.labels != NON_GROUND).mean() > 0.99


def test_the_limit_of_the_slope_decides_and_is_named() -> None:
    up = Rotation.from_euler("y", -35, degrees=True).apply([0.0, 0.0, 1.0])
    scan = seen(Scene(ground=(up, -1.3 * up[2])), FORWARD)
    assert segment(scan, FORWARD, GroundParams(max_slope=37)).found
    refused = segment(scan, FORWARD, GroundParams(max_slope=33))
    assert not refused.found
    assert "35" in refused.reason
    assert "33" in refused.reason
    assert not refused.labels.any()


def test_a_heap_under_the_sensor_is_no_plane_and_the_ratio_is_reported() -> None:
    rng = np.random.default_rng(0)
    points = (FORWARD.T @ (np.array([0, 0, -1.3])[:, None] + rng.normal(scale=0.15, size=(3, 300)))).T.astype(
        np.float32
    )
    result = ground.segment(points, np.zeros(300, np.uint16), FORWARD.T @ [0.0, 0, -1], GroundParams())
    assert not result.found
    assert not result.labels.any()
    assert "λ3/λ2" in result.reason
    assert result.planarity > 0.3
    assert result.seeds > ground.MIN_SEEDS  # still told, though none is labelled


def test_few_points_below_make_no_plane() -> None:
    points = np.tile(np.array([[0.0, 0.0, -1.3]], np.float32), (ground.MIN_SEEDS - 1, 1))
    result = ground.segment(points, np.zeros(len(points), np.uint16), np.array([0.0, 0, -1]), GroundParams())
    assert not result.found
    assert str(ground.MIN_SEEDS - 1) in result.reason


def test_one_line_of_seeds_makes_no_plane() -> None:
    """M = 1 on a flat floor: the seeds lie along one line, and a line is in many planes."""
    x = np.linspace(-0.4, 0.4, 60)
    points = np.column_stack([x, np.zeros(60), np.full(60, -1.3)])
    points += np.random.default_rng(0).normal(scale=0.004, size=points.shape)
    result = ground.segment(points.astype(np.float32), np.zeros(60, np.uint16), np.array([0.0, 0, -1]), GroundParams())
    assert not result.found
    assert not result.labels.any()


def test_seeds_all_in_one_place_make_no_plane() -> None:
    points = np.tile(np.array([[0.1, 0.0, -1.3]], np.float32), (100, 1))
    result = ground.segment(points, np.zeros(100, np.uint16), np.array([0.0, 0, -1]), GroundParams())
    assert not result.found


def test_a_scan_without_points_says_so() -> None:
    result = ground.segment(
        np.empty((0, 3), np.float32), np.empty(0, np.uint16), np.array([0.0, 0, -1]), GroundParams()
    )
    assert not result.found
    assert "no points" in result.reason
    assert len(result.labels) == 0


def test_switched_off_it_labels_nothing() -> None:
    scan = seen(furnished_room(), FORWARD)
    result = segment(scan, FORWARD, GroundParams(enabled=False))
    assert not result.found
    assert not result.labels.any()
    assert "off" in result.reason


# --- the paper's equations -----------------------------------------------------------------------
def by_numpy(
    scan: Scan, down: np.ndarray, p: GroundParams
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float, np.ndarray]:
    """Seeds, normal, centroid, λ3/λ2 and each point's (distance, threshold), in double precision."""
    points = scan.points.astype(np.float64)
    lines = np.unique(scan.ring)[: p.scan_lines]
    ranges = np.linalg.norm(points, axis=1)
    angles = np.degrees(np.arccos(points @ down / ranges))
    seeds = np.isin(scan.ring, lines) & (angles < p.alpha)
    assume(seeds.sum() >= ground.MIN_SEEDS)
    values, vectors = np.linalg.eigh(np.cov(points[seeds].T, bias=True))
    normal, centroid = vectors[:, 0], points[seeds].mean(axis=0)
    normal = normal if normal @ down < 0 else -normal
    return (
        seeds,
        normal,
        centroid,
        values[0] / values[1],
        np.stack([np.abs((centroid - points) @ normal), p.sigma * ranges]),
    )


@given(
    lines=st.integers(2, 32),
    alpha=st.floats(8, 60),
    sigma=st.floats(0.001, 0.2),
    mount=st.sampled_from(list(MOUNTS)),
)
def test_labels_and_plane_are_those_of_the_papers_equations(lines: int, alpha: float, sigma: float, mount: str) -> None:
    R = MOUNTS[mount]
    params = GroundParams(scan_lines=lines, alpha=alpha, sigma=sigma, max_slope=90)
    scan = room_seen_by(mount)
    seeds, normal, centroid, ratio, (distance, threshold) = by_numpy(scan, R.T @ [0, 0, -1], params)
    result = segment(scan, R, params)
    assert result.seeds == seeds.sum()
    assert result.planarity == pytest.approx(ratio, rel=1e-3, abs=1e-6)
    assert result.found == (ratio < 0.3)
    if result.found:
        np.testing.assert_allclose(result.centroid, centroid, atol=1e-6)
        np.testing.assert_allclose(result.normal, normal, atol=1e-5)
        clear = np.abs(distance - threshold) > 1e-5
        np.testing.assert_array_equal((result.labels != NON_GROUND)[clear], (distance < threshold)[clear])
        np.testing.assert_array_equal(result.labels == SEED, seeds & (result.labels != NON_GROUND))


@pytest.mark.parametrize("sigma", [0.005, 0.025, 0.1])
@pytest.mark.parametrize("where", [(1.0, 0.5), (3.0, -2.0), (8.0, 1.0)])
def test_the_threshold_grows_with_range_exactly_as_equation_3_says(sigma: float, where: tuple[float, float]) -> None:
    """A point lifted over the floor is ground up to σ |p| and not a hair more."""
    u = np.linspace(-0.3, 0.3, 12)
    floor = np.array([[x, y, -1.0] for x in u for y in u])
    lift = np.linspace(0.0, 0.98, 3000)
    probes = np.column_stack([np.full(3000, where[0]), np.full(3000, where[1]), lift - 1.0])
    points = np.concatenate([floor, probes]).astype(np.float32)
    ring = np.concatenate([np.zeros(len(floor)), np.full(3000, 20)]).astype(np.uint16)
    result = ground.segment(points, ring, np.array([0.0, 0, -1]), GroundParams(sigma=sigma, scan_lines=1, alpha=35))
    assert result.found
    expected = lift < sigma * np.linalg.norm(probes, axis=1)
    clear = np.abs(lift - sigma * np.linalg.norm(probes, axis=1)) > 1e-5
    assert 0 < expected.sum() < 3000
    np.testing.assert_array_equal((result.labels[len(floor) :] == GROUND)[clear], expected[clear])


def test_the_planarity_limit_lets_a_rougher_floor_pass() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-0.4, 0.4, size=(400, 3)) * [1, 1, 0] + [0, 0, -1.3]
    points[:, 2] += rng.normal(scale=0.08, size=400)
    ratio = np.divide(*np.linalg.eigvalsh(np.cov(points.T))[:2])
    for limit in (0.5 * ratio, 2 * ratio):
        result = ground.segment(
            points.astype(np.float32), np.zeros(400, np.uint16), np.array([0.0, 0, -1]), GroundParams(planarity=limit)
        )
        assert result.found == (limit > ratio)
        assert result.planarity == pytest.approx(ratio, rel=0.05)


def test_more_lines_and_a_wider_angle_give_more_seeds_and_a_wider_sigma_more_ground() -> None:
    scan = seen(furnished_room(), FORWARD)
    by_lines = [segment(scan, FORWARD, GroundParams(scan_lines=m)).seeds for m in (1, 2, 4, 8, 16, 32)]
    by_alpha = [segment(scan, FORWARD, GroundParams(alpha=a)).seeds for a in (5, 10, 20, 40, 60)]
    shares = [segment(scan, FORWARD, GroundParams(sigma=s)) for s in (0.002, 0.01, 0.025, 0.1)]
    assert by_lines == sorted(by_lines)
    assert by_lines[0] < by_lines[-1]
    assert by_alpha == sorted(by_alpha)
    assert by_alpha[0] < by_alpha[-1]
    for narrow, wide in pairwise(shares):
        assert np.all((wide.labels != NON_GROUND) >= (narrow.labels != NON_GROUND))
        assert wide.share > narrow.share


def test_lines_are_ranked_among_those_that_are_there() -> None:
    """Some drivers leave lines out, or number them with holes: the outermost present ones count."""
    scan = seen(furnished_room(), FORWARD)
    keep = scan.ring % 3 == 1
    spread = ground.segment(scan.points[keep], scan.ring[keep], FORWARD.T @ [0.0, 0, -1], GroundParams(scan_lines=4))
    _, dense_ring = np.unique(scan.ring[keep], return_inverse=True)
    dense = ground.segment(
        scan.points[keep], dense_ring.astype(np.uint16), FORWARD.T @ [0.0, 0, -1], GroundParams(scan_lines=4)
    )
    assert spread.found
    np.testing.assert_array_equal(spread.labels, dense.labels)


def test_points_and_rings_are_left_as_they_were() -> None:
    scan = seen(furnished_room(), FORWARD)
    points, ring = scan.points.copy(), scan.ring.copy()
    segment(scan, FORWARD)
    np.testing.assert_array_equal(scan.points, points)
    np.testing.assert_array_equal(scan.ring, ring)


def test_a_floor_far_from_the_origin_of_the_seeds_keeps_its_precision() -> None:
    """A drone's height: 60 m over a flat field, millimetre noise."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-20, 20, (2000, 2)), rng.normal(-60, 0.002, 2000)]).astype(np.float32)
    result = ground.segment(points, np.zeros(2000, np.uint16), np.array([0.0, 0, -1]), GroundParams())
    assert result.found
    assert result.centroid[2] == pytest.approx(-60, abs=1e-3)
    assert result.normal[2] == pytest.approx(1.0, abs=1e-7)
    assert result.planarity == pytest.approx((0.002**2) / (40**2 / 12), rel=0.2)


def test_a_box_beside_the_feet_is_reported_rather_than_labelled() -> None:
    """Half of the seeds on a box, half on the floor: no plane, so nothing is thinned in this frame (paper 2.2)."""
    scene = Scene(box(-3.0, -3.0, -1.3, 5.0, 3.0, 1.4), (box(0.1, 0.25, -1.3, 0.7, 0.9, -0.9),))
    result = segment(seen(scene, FORWARD), FORWARD)
    assert not result.found
    assert "λ3/λ2" in result.reason
    assert not result.labels.any()
