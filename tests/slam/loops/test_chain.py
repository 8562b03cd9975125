"""A stretch of odometry as one factor, and the poses between two known poses."""

import numpy as np
from scipy.optimize import least_squares

from app.slam import lie
from app.slam.loops.chain import Chain
from app.slam.types import F64


def walk(count: int, seed: int, spread: float = 0.3) -> tuple[Chain, list[F64], list[F64]]:
    """A chain of poses that turn and go on at random, its steps and their covariances."""
    rng = np.random.default_rng(seed)
    steps, covariances = [], []
    chain = Chain(lie.exp_se3(rng.normal(scale=0.5, size=6)))
    for _ in range(count - 1):
        A = rng.normal(size=(6, 6))
        steps.append(lie.exp_se3(rng.normal(scale=spread, size=6) + np.array([0, 0, 0, 1.0, 0, 0])))
        covariances.append(1e-4 * (A @ A.T / 6 + np.eye(6)))
        chain.append(steps[-1], covariances[-1])
    return chain, steps, covariances


def test_the_adjoint_carries_a_perturbation_to_the_other_side() -> None:
    rng = np.random.default_rng(0)
    T, v = lie.exp_se3(rng.normal(size=(5, 6))), rng.normal(scale=0.1, size=(5, 6))
    carried = (lie.adjoint(T) @ v[..., None])[..., 0]
    np.testing.assert_allclose(lie.exp_se3(carried) @ T, T @ lie.exp_se3(v), atol=1e-12)


def test_the_covariance_of_a_stretch_is_what_many_noisy_walks_scatter_by() -> None:
    chain, steps, covariances = walk(9, seed=1)
    T, covariance = chain.between(2, 8)
    rng = np.random.default_rng(2)
    noisy = np.tile(np.eye(4), (40_000, 1, 1))
    for step, own in zip(steps[2:8], covariances[2:8], strict=True):
        noisy = noisy @ step @ lie.exp_se3(rng.multivariate_normal(np.zeros(6), 1e-2 * own, size=len(noisy)))
    scatter = np.cov(lie.log_se3(lie.inverse(T) @ noisy).T)
    sigmas = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(
        1e2 * scatter / np.outer(sigmas, sigmas), covariance / np.outer(sigmas, sigmas), atol=0.03
    )


def test_poses_between_known_ones_are_those_that_need_the_least_error_of_the_steps() -> None:
    chain, steps, covariances = walk(7, seed=3)
    first, last = chain.poses[0], chain.poses[6] @ lie.exp_se3(np.array([0.01, -0.02, 0.015, 0.05, -0.08, 0.03]))

    def errors(x: F64) -> F64:
        poses = [first, *(chain.poses[1:6] @ lie.exp_se3(x.reshape(-1, 6))), last]
        missed = [lie.log_se3(lie.inverse(a @ step) @ b) for a, b, step in zip(poses, poses[1:], steps, strict=False)]
        return np.concatenate(
            [np.linalg.solve(np.linalg.cholesky(C), e) for C, e in zip(covariances, missed, strict=True)]
        )

    best = chain.poses[1:6] @ lie.exp_se3(least_squares(errors, np.zeros(30), xtol=1e-14, ftol=1e-14).x.reshape(-1, 6))
    bent = chain.bent(np.array([0, 6]), np.array([first, last]), 7)
    assert np.abs(bent[1:6] - chain.poses[1:6]).max() > 0.02
    np.testing.assert_allclose(bent[1:6], best, atol=1e-3)
    np.testing.assert_array_equal(bent[[0, 6]], [first, last])


def test_ends_that_odometry_meets_leave_every_pose_where_it_has_it() -> None:
    chain, _, _ = walk(30, seed=4)
    moved = lie.exp_se3(np.array([0.3, -1.0, 2.0, 5.0, 6.0, -7.0]))
    ends = np.array([3, 4, 11, 25])
    np.testing.assert_allclose(chain.bent(ends, moved @ chain.poses[ends], 30), moved @ chain.poses[3:], atol=1e-9)


def test_stretches_do_not_know_of_one_another() -> None:
    chain, _, _ = walk(30, seed=5)
    rng = np.random.default_rng(6)
    ends = np.array([0, 7, 8, 20])
    T_ends = chain.poses[ends] @ lie.exp_se3(rng.normal(scale=0.02, size=(4, 6)))
    together = chain.bent(ends, T_ends, 30)
    for at in range(3):
        first, last = ends[at], ends[at + 1]
        alone = chain.bent(ends[at : at + 2], T_ends[at : at + 2], int(last) + 1)
        np.testing.assert_allclose(together[first : last + 1], alone, atol=1e-9)
    beyond = chain.bent(ends[3:], T_ends[3:], 30)
    np.testing.assert_array_equal(together[20:], beyond)
