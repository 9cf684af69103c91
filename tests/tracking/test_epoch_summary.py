"""The sums over older epochs, discounted by a random walk."""

from __future__ import annotations

import numpy as np

from calibgraph.tracking.epoch_summary import STRENGTHS, EpochSummary
from calibgraph.tracking.sums import Sums

Array = np.ndarray


def test_the_walk_adds_exactly_its_variance_to_the_covariance() -> None:
    """H'^-1 B' H'^-1 = H^-1 B H^-1 + Q, whatever the gain."""
    rng = np.random.default_rng(0)
    A, C = rng.standard_normal((2, 6, 6))
    epoch = Sums.zeros().change(
        hessian=A @ A.T + np.eye(6),
        gradient=rng.standard_normal(6),
        scatter=C @ C.T,
        frames=np.array(10.0),
    )
    memory = EpochSummary.empty().add(epoch, Sums.zeros())
    variance = np.linspace(0.1, 0.6, 6)
    after = memory.propagate(np.outer(STRENGTHS**2, variance), overconfidence=3.0)
    for walk, strength in enumerate(STRENGTHS):
        expected = inverse_sandwich(memory, walk) + strength**2 * np.diag(variance)
        np.testing.assert_allclose(inverse_sandwich(after, walk), expected, rtol=1e-9)
    np.testing.assert_array_equal(after.walks.hessian[0], memory.walks.hessian[0])  # it stands
    for walk in range(len(STRENGTHS)):
        np.testing.assert_allclose(after.walks.step(walk), memory.walks.step(walk))


def inverse_sandwich(memory: EpochSummary, walk: int) -> Array:
    inverse = np.linalg.inv(memory.walks.hessian[walk])
    return np.asarray(inverse @ memory.walks.scatter[walk] @ inverse)


def test_a_walk_does_not_magnify_sums_of_a_hessian_that_is_not_definite() -> None:
    """Frames far from the estimate give one: the gain has a pole at -k / Q."""
    variance, weights = np.full(6, 0.5), np.diag([3.0, 2, 2, 2, 2, 2])
    for least in (-1.0, -5.99, -6.01, -40.0):  # k / Q is 6
        sums = Sums.zeros().change(
            hessian=np.diag([5.0, 2, 2, 2, 2, least]), reweighted=weights, gradient=np.ones(6)
        )
        after, kept = sums.after_walk(variance, 3.0)
        assert 0.5 < kept < 1 and np.linalg.eigvalsh(after.hessian)[0] > 0
        assert np.abs(after.gradient).max() < 1
        standing, _ = sums.after_walk(np.zeros(6), 3.0)
        np.testing.assert_array_equal(standing.packed, sums.packed)
