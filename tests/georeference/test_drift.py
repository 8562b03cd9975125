"""The effect of drift on estimates from fixes. Oracles: least squares on many random walks; dense covariances."""

import numpy as np

from app.georeference.drift import constants_despite_drift, drift_deviations


def test_drift_moves_a_mean_and_a_slope_as_much_as_stated() -> None:
    rng, seconds = np.random.default_rng(1), np.arange(0.0, 80.0, 0.2)
    J = np.stack([np.eye(3)[:, :1] @ np.array([[1.0, t]]) for t in seconds])  # (n, 3, 2), of the first axis
    influence = np.einsum("kl,nal->nak", np.linalg.inv(np.einsum("nak,nal->kl", J, J)), J)
    steps = 0.005 * 0.2**0.5 * rng.normal(size=(200, len(seconds), 3))
    walks = steps.cumsum(axis=1)
    off = np.einsum("wna,nak->wk", walks - walks[:, :1], influence)
    noisy = walks + 0.02 * rng.normal(size=walks.shape)
    stated = np.array([drift_deviations(walk, influence, seconds) for walk in noisy])
    np.testing.assert_allclose(np.sqrt((stated**2).mean(axis=0)), off.std(axis=0), rtol=0.15)


def test_noise_alone_and_too_few_fixes_show_no_drift() -> None:
    rng = np.random.default_rng(0)
    seconds, influence = np.arange(0.0, 800.0, 0.2), np.full((4000, 3, 1), 1.0 / 4000)
    noise = 0.02 * rng.normal(size=(4000, 3))
    assert drift_deviations(noise, influence, seconds)[0] < 0.03  # m, of a walk of 2 mm/√s
    assert drift_deviations(noise[:9], influence[:9], 5.0 * seconds[:9] / 0.2) == 0.0


def test_constants_are_those_of_least_squares_with_the_covariance_of_a_random_walk() -> None:
    """From anywhere: so the mean of each axis is among the unknowns of the oracle."""
    rng, n, rate = np.random.default_rng(4), 60, 1e-3**2
    seconds, J = np.sort(rng.uniform(0.0, 9.0, n)), rng.normal(size=(n, 3, 2))
    sigmas, residuals = rng.uniform(0.01, 0.03, (n, 3)), 1e-3 * rng.normal(size=(n, 3))
    values, expected = np.array([0.002, 0.3]), np.array([1e-3, np.inf])
    change, covariance = constants_despite_drift(residuals, J, seconds, sigmas, values, expected)
    information, pull = np.zeros((5, 5)), np.zeros(5)
    information[0, 0], pull[0] = 1e6, 2e3
    for axis in range(3):
        dense = np.diag(sigmas[:, axis] ** 2) + rate * np.minimum.outer(seconds - seconds[0], seconds - seconds[0])
        columns = np.column_stack([J[:, axis], np.tile(np.eye(3)[axis], (n, 1))])
        information += columns.T @ np.linalg.solve(dense, columns)
        pull += columns.T @ np.linalg.solve(dense, residuals[:, axis])
    np.testing.assert_allclose(covariance, np.linalg.inv(information)[:2, :2], rtol=1e-6)
    np.testing.assert_allclose(change, -np.linalg.solve(information, pull)[:2], rtol=1e-6)
