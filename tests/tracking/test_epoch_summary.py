"""The sums over older epochs, discounted by a random walk."""

from __future__ import annotations

import numpy as np

from calibgraph.tracking.epoch_summary import STRENGTHS, EpochSummary

Array = np.ndarray


def test_the_walk_adds_exactly_its_variance_to_the_covariance() -> None:
    """H'^-1 B' H'^-1 = H^-1 B H^-1 + Q, whatever the gain."""
    rng = np.random.default_rng(0)
    A, C = rng.standard_normal((2, 6, 6))
    memory = EpochSummary.empty().add(A @ A.T + np.eye(6), rng.standard_normal(6), C @ C.T, 10)
    variance = np.linspace(0.1, 0.6, 6)
    after, gain = memory.propagate(variance, inflation=3.0)
    for walk, strength in enumerate(STRENGTHS):
        expected = inverse_sandwich(memory, walk) + strength**2 * np.diag(variance)
        np.testing.assert_allclose(inverse_sandwich(after, walk), expected, rtol=1e-9)
    np.testing.assert_array_equal(gain, np.eye(6))  # it stands still
    np.testing.assert_allclose(
        np.linalg.solve(after.hessian, after.gradient[..., None]),
        np.linalg.solve(memory.hessian, memory.gradient[..., None]),
    )


def inverse_sandwich(memory: EpochSummary, walk: int) -> Array:
    inverse = np.linalg.inv(memory.hessian[walk])
    return np.asarray(inverse @ memory.scatter[walk] @ inverse)
