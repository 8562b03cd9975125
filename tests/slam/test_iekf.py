"""The filter's update: its result, and the input on which it does nothing. `test_registration` checks its algebra."""

from dataclasses import fields, replace

import numpy as np
import pytest

from app.slam import iekf
from app.slam.iekf import boxminus, boxplus
from app.slam.imu import DIM, POS, ROT, VEL, Belief
from app.slam.local_map import LocalMap
from app.slam.sections import FilterParams, MapParams
from app.slam.types import F32, NavState

from .scenes import Rig, Scene, box, furnished_room, pose_error
from .updates import correlated_prior, points_of, surveyed, truth, uncertain


@pytest.fixture(scope="module")
def room() -> LocalMap:
    return surveyed(furnished_room())


# --- where it ends up ----------------------------------------------------------------------------
@pytest.mark.parametrize("axis", range(3), ids=["about x", "about y", "about z"])
@pytest.mark.parametrize("degrees", [5.0, -5.0])
@pytest.mark.parametrize("direction", range(3), ids=["along x", "along y", "along z"])
def test_five_degrees_and_twenty_centimetres_are_recovered(
    room: LocalMap, axis: int, degrees: float, direction: int
) -> None:
    d = np.zeros(DIM)
    d[ROT][axis], d[POS][direction] = np.radians(degrees), 0.2 * np.sign(degrees)
    prior = Belief(boxplus(truth(), d), uncertain())
    posterior, registration = iekf.update(prior, points_of(furnished_room()), room, FilterParams(max_iterations=10))
    metres, angle = pose_error(posterior.state.T_odom_imu, truth().T_odom_imu)
    assert metres < 0.01
    assert angle < 0.2
    assert registration.inliers > 300
    assert registration.residual_rms < 0.01
    assert not registration.degenerate


def test_a_good_prior_stays_good_and_converges_at_once(room: LocalMap) -> None:
    posterior, registration = iekf.update(
        Belief(truth(), uncertain(1e-3, 1e-2)), points_of(furnished_room()), room, FilterParams()
    )
    metres, angle = pose_error(posterior.state.T_odom_imu, truth().T_odom_imu)
    assert metres < 0.003
    assert angle < 0.05
    assert registration.converged
    assert registration.iterations <= 3


def test_the_posterior_is_more_certain_than_the_prior(room: LocalMap) -> None:
    prior = Belief(truth(), uncertain())
    posterior, _ = iekf.update(prior, points_of(furnished_room()), room, FilterParams())
    np.testing.assert_array_equal(posterior.covariance, posterior.covariance.T)
    assert np.linalg.eigvalsh(posterior.covariance)[0] > 0
    assert np.linalg.eigvalsh(prior.covariance - posterior.covariance)[0] > -1e-12
    assert np.sqrt(np.diag(posterior.covariance)[:6]).max() < 0.01


def test_a_scan_far_from_where_the_prediction_is_sure_to_be_is_a_surprise(room: LocalMap) -> None:
    """15 cm off, sure to 1 cm: the square of 15 for one of the six degrees of freedom."""
    points, sure, off = points_of(furnished_room()), uncertain(1e-3, 1e-2), np.zeros(DIM)
    off[POS][0] = 0.15
    _, expected = iekf.update(Belief(truth(), sure), points, room, FilterParams())
    _, surprising = iekf.update(Belief(boxplus(truth(), off), sure), points, room, FilterParams())
    assert expected.surprise < 1.0 and 15**2 / 12 < surprising.surprise < 15**2


def test_what_is_correlated_with_the_pose_is_corrected_with_it(room: LocalMap) -> None:
    """A wrong velocity carried the position astray; seeing the position tells the velocity."""
    error = np.array([0.05, -0.04, 0.03])
    P = uncertain(1e-3, 1e-3)
    P[VEL, VEL] = np.eye(3) * 0.25
    P[POS, POS] += np.eye(3) * 0.25 * 0.1**2
    P[POS, VEL] = P[VEL, POS] = np.eye(3) * 0.25 * 0.1
    wrong = replace(truth(), v_odom_imu=error / 0.1, p_odom_imu=truth().p_odom_imu + error)
    posterior, _ = iekf.update(Belief(wrong, P), points_of(furnished_room()), room, FilterParams())
    np.testing.assert_allclose(posterior.state.v_odom_imu, 0, atol=0.05)


# --- too little to go by -------------------------------------------------------------------------
@pytest.mark.parametrize("count", [0, 1, iekf.MIN_INLIERS - 1])
def test_too_few_points_leave_the_prior_as_it_is_and_say_so(room: LocalMap, count: int) -> None:
    prior = Belief(boxplus(truth(), np.full(DIM, 1e-3)), uncertain())
    posterior, registration = iekf.update(prior, points_of(furnished_room())[:count], room, FilterParams())
    for field in fields(NavState):
        np.testing.assert_array_equal(getattr(posterior.state, field.name), getattr(prior.state, field.name))
    np.testing.assert_array_equal(posterior.covariance, prior.covariance)
    assert not registration.converged
    assert registration.inliers <= count
    assert str(registration.inliers) in registration.reason


def test_points_of_another_place_leave_the_prior_as_it_is(room: LocalMap) -> None:
    far = replace(truth(), p_odom_imu=np.array([200.0, 0, 0]))
    posterior, registration = iekf.update(Belief(far, uncertain()), points_of(furnished_room()), room, FilterParams())
    np.testing.assert_array_equal(posterior.state.p_odom_imu, [200.0, 0, 0])
    assert registration.inliers == 0
    assert registration.reason


LONG = box(-60.0, -1.2, -1.3, 60.0, 1.2, 1.2)
NEAR = Rig(columns=60, T_imu_lidar=np.eye(4), range_noise=0.003)


def test_a_plain_corridor_holds_everything_but_the_way_along_it() -> None:
    corridor = Scene(LONG)
    points = points_of(corridor, NEAR)
    points = points[np.linalg.norm(points, axis=1) < 20]
    d = np.zeros(DIM)
    d[POS] = [0.05, 0.05, -0.05]
    d[ROT] = np.radians([0.5, -0.5, 0.5])
    prior = Belief(boxplus(truth(NEAR), d), uncertain(0.02, 0.1))
    posterior, registration = iekf.update(prior, points, surveyed(corridor), FilterParams())
    assert registration.degenerate
    assert "direction" in registration.reason
    assert registration.eigenvalues[0] < 1e-2 * registration.eigenvalues[1]
    error = boxminus(posterior.state, truth(NEAR))
    assert np.abs(error[POS][1:]).max() < 0.01  # across, the walls hold it
    assert error[POS][0] == pytest.approx(0.05, abs=0.02)  # along, nothing is known, and nothing is invented
    assert np.sqrt(posterior.covariance[3, 3]) > 0.05
    assert np.sqrt(posterior.covariance[4, 4]) < 0.01


def rough_corridor(rng: np.random.Generator, points: int, length: float, noise: float = 0.02) -> np.ndarray:
    """(points, 3) m, of four walls along x that nothing interrupts, with a noise in m."""
    along, across = rng.uniform((-length, -1.0), (length, 1.0), (points, 2)).T
    wall = rng.choice((-1.2, 1.2), points)
    sides = np.stack([np.column_stack([along, wall, across]), np.column_stack([along, across, wall])])
    return sides[rng.integers(0, 2, points), np.arange(points)] + rng.normal(scale=noise, size=(points, 3))


def test_the_roughness_of_a_corridor_does_not_tell_the_way_along_it() -> None:
    """Each normal is off by some degrees, so it seems to see motion along the corridor; on average it sees none."""
    local_map, rng = LocalMap(MapParams()), np.random.default_rng(0)
    for _ in range(6):
        local_map.insert(rough_corridor(rng, 700, 6.0).astype(np.float32), np.zeros(3), MapParams())
    level = replace(truth(NEAR), R_odom_imu=np.eye(3), p_odom_imu=np.zeros(3))
    belief = Belief(level, uncertain(0.01, 0.3))
    for _ in range(10):
        scan = rough_corridor(rng, 600, 4.0).astype(np.float32)
        belief, registration = iekf.update(belief, scan, local_map, FilterParams())
        assert registration.inliers > 300
        assert registration.degenerate
    along, across, up = np.sqrt(np.diag(belief.covariance)[POS])
    assert along > 0.2
    assert max(across, up) < 0.005


@pytest.mark.parametrize(("points", "least", "most"), [(2, -0.01, 0.02), (20, 0.08, 0.11)], ids=["two", "twenty"])
def test_two_points_do_not_tell_the_way_along_a_corridor(points: int, least: float, most: float) -> None:
    """A panel across the corridor now stands 10 cm closer. Twenty points on it are believed, two are not."""
    local_map, rng = LocalMap(MapParams()), np.random.default_rng(1)

    def seen(walls: int, panel: int, at: float) -> np.ndarray:
        across = np.column_stack([np.full(panel, at), rng.uniform(-0.3, 0.3, (panel, 2))])
        across[:, 0] += rng.normal(scale=0.01, size=panel)
        return np.concatenate([rough_corridor(rng, walls, 6.0, 0.01), across]).astype(np.float32)

    for _ in range(6):
        local_map.insert(seen(700, 60, 3.0), np.zeros(3), MapParams())
    level = replace(
        truth(NEAR), R_odom_imu=np.eye(3), R_imu_lidar=np.eye(3), p_odom_imu=np.zeros(3), p_imu_lidar=np.zeros(3)
    )
    scan, params = seen(600, points, 2.9), FilterParams(gate=0.3)
    posterior, _ = iekf.update(Belief(level, uncertain(0.01, 0.05)), scan, local_map, params)
    assert least < posterior.state.p_odom_imu[0] < most


def test_a_corridors_end_in_sight_ends_the_degeneracy() -> None:
    ending = Scene(box(-60.0, -1.2, -1.3, 8.0, 1.2, 1.2))
    points = points_of(ending, NEAR)
    _, registration = iekf.update(Belief(truth(NEAR), uncertain(0.02, 0.1)), points, surveyed(ending), FilterParams())
    assert not registration.degenerate
    assert registration.reason == ""


def test_eigenvalues_ascend_and_are_of_the_information(room: LocalMap) -> None:
    points = points_of(furnished_room())
    few, many = (
        iekf.update(Belief(truth(), uncertain()), p, room, FilterParams())[1].eigenvalues
        for p in (points[::3].copy(), points)
    )
    assert np.all(np.diff(many) >= 0)
    assert np.all(many > few)  # three times the points, about three times the information
    np.testing.assert_allclose(many / few, 3, rtol=0.5)


@pytest.mark.parametrize(
    ("surprise", "inliers", "blamed"), [(3.5, 900, False), (9.0, 900, True), (9.0, 300, False), (np.nan, 900, False)]
)
def test_the_imu_is_to_blame_for_a_contradiction_if_the_scan_shows_enough(
    room: LocalMap, surprise: float, inliers: int, blamed: bool
) -> None:
    _, found = iekf.update(correlated_prior(5e-3), points_of(furnished_room()), room, FilterParams())
    assert iekf.is_imu_to_blame(replace(found, used=1000, inliers=inliers, surprise=surprise)) is blamed


# --- what is estimated, and from which points
def test_extrinsics_stay_unless_they_are_estimated(room: LocalMap) -> None:
    prior, points = correlated_prior(5e-3), points_of(furnished_room())
    kept, _ = iekf.update(prior, points, room, FilterParams(estimate_extrinsics=False))
    np.testing.assert_array_equal(kept.state.R_imu_lidar, prior.state.R_imu_lidar)
    np.testing.assert_array_equal(kept.state.p_imu_lidar, prior.state.p_imu_lidar)
    np.testing.assert_array_equal(kept.covariance[17:, 17:], prior.covariance[17:, 17:])


def test_switching_the_extrinsics_on_and_off_keeps_the_covariance_one(room: LocalMap) -> None:
    """A covariance with a negative eigenvalue claims to know more than everything."""
    belief, points = correlated_prior(5e-3), points_of(furnished_room())
    for extrinsics in (True, False, False, True, False, True):
        belief, _ = iekf.update(belief, points, room, FilterParams(estimate_extrinsics=extrinsics))
        assert np.linalg.eigvalsh(belief.covariance)[0] > 0


def test_points_along_the_cone_of_a_scan_line_do_not_hold_the_heading(room: LocalMap) -> None:
    """A thicket seen from one place: the returns of a line lie on its cone, at all depths. Such a patch looks flat,
    and turning on the spot moves points off it, but it is no surface."""
    rng = np.random.default_rng(0)
    bearing, depth = rng.uniform(-0.3, 0.3, 4000), rng.uniform(4.0, 9.0, 4000)
    cone = np.column_stack([depth * np.cos(bearing), depth * np.sin(bearing), rng.normal(scale=0.005, size=4000)])
    local_map = LocalMap(MapParams(spacing=0.05))
    local_map.insert(cone.astype(np.float32), np.zeros(3), MapParams(spacing=0.05))
    level = replace(
        truth(), R_odom_imu=np.eye(3), p_odom_imu=np.zeros(3), R_imu_lidar=np.eye(3), p_imu_lidar=np.zeros(3)
    )
    seen = cone[:500].astype(np.float32)
    assert np.count_nonzero(local_map.planes(seen.astype(float), np.zeros(3), FilterParams())[0].variances >= 0) > 100
    _, registration = iekf.update(Belief(level, uncertain(1e-2, 1e-2)), seen, local_map, FilterParams())
    assert registration.inliers == 0


def park(seed: int) -> F32:
    """(n, 3) m: a floor 1.3 m below the scanner, and eight trunks around it, seen to 1 cm."""
    rng = np.random.default_rng(seed)
    floor = np.column_stack([rng.uniform(-8.0, 8.0, (4000, 2)), np.full(4000, -1.3)])
    around = 2 * np.pi * np.arange(8)[:, None] / 8
    towards = around + np.pi + rng.uniform(-1.2, 1.2, (8, 40))  # only the side that the scanner sees
    trunks = np.stack(
        [
            6.0 * np.cos(around) + 0.15 * np.cos(towards),
            6.0 * np.sin(around) + 0.15 * np.sin(towards),
            rng.uniform(-1.2, 1.5, (8, 40)),
        ],
        axis=-1,
    )
    points = np.concatenate([floor, trunks.reshape(-1, 3)])
    return (points + rng.normal(scale=0.01, size=points.shape)).astype(np.float32)


def test_where_good_planes_leave_a_direction_open_poor_ones_hold_the_scanner() -> None:
    local_map = LocalMap(MapParams())
    for seed in range(8):
        local_map.insert(park(seed), np.zeros(3), MapParams())
    seen = park(9)[::4]
    good, _ = local_map.planes(seen.astype(float), np.zeros(3), FilterParams())
    assert np.abs(good.normals[good.variances >= 0.0, 2]).min() > 0.9, "a trunk has a good plane"
    level = replace(
        truth(), R_odom_imu=np.eye(3), R_imu_lidar=np.eye(3), p_odom_imu=np.zeros(3), p_imu_lidar=np.zeros(3)
    )
    off = np.zeros(DIM)
    off[POS] = 0.06, -0.08, 0.0
    posterior, _ = iekf.update(Belief(boxplus(level, off), uncertain(1e-2, 1e-1)), seen, local_map, FilterParams())
    assert np.linalg.norm(posterior.state.p_odom_imu) < 0.02


def test_where_good_planes_hold_the_scanner_poor_ones_are_not_used(room: LocalMap) -> None:
    points, state = points_of(furnished_room()), truth()
    world = (points @ state.R_imu_lidar.T + state.p_imu_lidar) @ state.R_odom_imu.T + state.p_odom_imu
    good, poor = (
        np.count_nonzero(planes.variances >= 0.0) for planes in room.planes(world, state.p_odom_lidar, FilterParams())
    )
    _, registration = iekf.update(Belief(state, uncertain(1e-3, 1e-3)), points, room, FilterParams())
    assert registration.inliers <= good < poor
