"""The algebra of the filter's update compared with textbook formulas and SciPy.

Tests app/slam/iekf.py, app/slam/kernels/registration.py.
"""

import numpy as np
import pytest
from scipy.optimize import root

from app.slam import iekf
from app.slam.iekf import boxminus, boxplus
from app.slam.imu import DIM, Belief
from app.slam.kernels.registration import EDGE_ON, REPEATED, RESIDUAL_HUBER
from app.slam.local_map import LocalMap
from app.slam.sections import FilterParams
from app.slam.types import NavState

from .scenes import furnished_room
from .updates import correlated_prior, points_of, surveyed, truth, uncertain


@pytest.fixture(scope="module")
def room() -> LocalMap:
    return surveyed(furnished_room())


class Problem:
    """A scan against the room's planes, linearised by finite differences of the distances themselves."""

    def __init__(self, room: LocalMap, prior: Belief, points: np.ndarray, params: FilterParams) -> None:
        self.prior, self.points, self.params = prior, points.astype(np.float64), params
        planes = room.planes(self._world(prior.state), prior.state.p_odom_lidar, params)[0]
        self.normals, self.centers, self.deviations = planes.normals, planes.centers, planes.deviations
        ranges = np.linalg.norm(self.points, axis=1)
        all_distances = self._all_distances(prior.state)
        x = prior.state
        incidence = np.einsum("ij,ij->i", self.normals @ x.R_odom_imu @ x.R_imu_lidar, self.points) / ranges
        self.used = (planes.variances >= 0) & (np.abs(all_distances) <= params.gate * np.sqrt(ranges))
        self.used &= np.abs(incidence) >= EDGE_ON
        self.sigma = np.sqrt(planes.variances[self.used])

    def _world(self, x: NavState) -> np.ndarray:
        imu = self.points @ x.R_imu_lidar.T + x.p_imu_lidar
        return np.asarray(imu @ x.R_odom_imu.T + x.p_odom_imu)

    def _all_distances(self, x: NavState) -> np.ndarray:
        return np.asarray(np.einsum("ij,ij->i", self.normals, self._world(x) - self.centers))

    def distances(self, x: NavState) -> np.ndarray:
        return self._all_distances(x)[self.used]

    def stacked(self, x: NavState) -> np.ndarray:
        """(3 m,) m: the distances, then those along the two deviations of each normal."""
        offset = (self._world(x) - self.centers)[self.used]
        along = np.einsum("imc,ic->mi", self.deviations[self.used], offset)
        return np.concatenate([self.distances(x), *along])

    def jacobian(self, x: NavState) -> np.ndarray:
        """(3 m, 23), of what `stacked` gives."""
        h = 1e-6
        return np.stack(
            [(self.stacked(boxplus(x, e)) - self.stacked(boxplus(x, -e))) / (2 * h) for e in np.eye(DIM) * h],
            axis=1,
        )

    def weights(self, x: NavState) -> np.ndarray:
        """(3 m,) 1/m²: of the distances; and what the errors of the normals add to them on average is taken off."""
        over = np.abs(self.distances(x)) / (RESIDUAL_HUBER * self.sigma)
        w = 1.0 / (REPEATED * self.sigma**2 * np.maximum(over, 1.0))
        return np.concatenate([w, -w, -w])


@pytest.mark.parametrize("extrinsics", [False, True], ids=["extrinsics fixed", "extrinsics estimated"])
def test_one_iteration_is_the_textbook_kalman_update(room: LocalMap, extrinsics: bool) -> None:
    """K = P H^T (H P H^T + R)^-1 with a Jacobian by finite differences: the gain in its other form.

    A residual over RESIDUAL_HUBER standard deviations counts as noisier, so that it pulls as one at that limit would.
    """
    params = FilterParams(max_iterations=1, estimate_extrinsics=extrinsics)
    prior, points = correlated_prior(1e-2), points_of(furnished_room())[::2].copy()
    problem = Problem(room, prior, points, params)
    free = slice(0, DIM if extrinsics else 17)
    H, P, w = problem.jacobian(prior.state)[:, free], prior.covariance[free, free], problem.weights(prior.state)
    assert 0.01 < (np.abs(problem.distances(prior.state)) > RESIDUAL_HUBER * problem.sigma).mean() < 0.5
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(1.0 / w))
    step = np.zeros(DIM)
    step[free] = -K @ problem.stacked(prior.state)

    posterior, registration = iekf.update(prior, points, room, params)
    assert registration.inliers == problem.used.sum() > 300
    np.testing.assert_allclose(boxminus(posterior.state, prior.state), step, atol=1e-7)
    np.testing.assert_allclose(posterior.covariance[free, free], (np.eye(len(P)) - K @ H) @ P, atol=1e-10)


@pytest.mark.parametrize("strays", [0.0, 0.1], ids=["all on their planes", "some off them"])
@pytest.mark.parametrize("extrinsics", [False, True], ids=["extrinsics fixed", "extrinsics estimated"])
def test_the_iteration_ends_where_equation_7_is_solved(room: LocalMap, extrinsics: bool, strays: float) -> None:
    """SciPy's root of its gradient, from the same prior, with the weights of the end."""
    params = FilterParams(max_iterations=20, estimate_extrinsics=extrinsics, gate=1.0)
    prior, points = correlated_prior(2e-4), points_of(furnished_room())
    moved = np.random.default_rng(4).random(len(points)) < strays
    points[moved] *= np.float32(1.06)
    problem = Problem(room, prior, points, params)
    free = DIM if extrinsics else 17
    information = np.linalg.inv(prior.covariance[:free, :free])

    def gradient(d: np.ndarray) -> np.ndarray:
        x = boxplus(prior.state, np.concatenate([d, np.zeros(DIM - free)]))
        turned = np.stack([boxminus(boxplus(x, e), prior.state) for e in np.eye(DIM) * 1e-7], axis=1)
        J = (turned - boxminus(x, prior.state)[:, None])[:free, :free] / 1e-7
        pull = problem.jacobian(x)[:, :free].T @ (problem.weights(x) * problem.stacked(x))
        return np.asarray(np.linalg.solve(information, J.T @ information @ d + pull))

    best = root(gradient, np.zeros(free), tol=1e-12).x
    posterior, registration = iekf.update(prior, points, room, params)
    assert registration.converged
    far = np.abs(problem.distances(posterior.state)) > RESIDUAL_HUBER * problem.sigma
    assert (far.mean() > 0.05) == (strays > 0.0)
    np.testing.assert_allclose(boxminus(posterior.state, prior.state)[:free], best, atol=2e-6)


def test_twice_as_far_from_where_the_map_has_it_a_thing_pulls_no_harder(room: LocalMap) -> None:
    """A tenth of all points farther away than the map has them, as behind a door that was opened since."""
    prior, points = Belief(truth(), uncertain(1e-3, 1e-2)), points_of(furnished_room())

    def pulled(farther: float) -> float:
        moved = points.copy()
        moved[: len(points) // 10] *= np.float32(1.0 + farther)
        there, _ = iekf.update(prior, moved, room, FilterParams(gate=1.0))
        return float(np.linalg.norm(there.state.p_odom_imu - truth().p_odom_imu))

    assert pulled(0.06) < 1.2 * pulled(0.03) < 0.02


def test_the_residual_reported_is_that_of_the_inliers(room: LocalMap) -> None:
    params, prior = FilterParams(max_iterations=1), Belief(truth(), uncertain(1e-3, 1e-2))
    points = points_of(furnished_room())
    problem = Problem(room, prior, points, params)
    _, registration = iekf.update(prior, points, room, params)
    assert registration.residual_rms == pytest.approx(np.sqrt(np.mean(problem.distances(prior.state) ** 2)), rel=1e-6)
    assert registration.used == len(points)
