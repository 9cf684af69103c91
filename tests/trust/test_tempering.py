"""Samples of a posterior: of each kind of likelihood, those that it should have."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from calibgraph.trust.tempering import sample_posterior

Array = NDArray[np.float64]
SIGMAS = np.array([1.0, 2.0, 1.0, 0.5, 1.0, 1.0])
PRIOR = np.diag(SIGMAS**2)


def gaussian(mean: Array, sigmas: Array, points: Array) -> Array:
    """(n,) logarithms, 0 at the top."""
    return np.asarray(-0.5 * (((points - mean) / sigmas) ** 2).sum(axis=1))


def test_where_the_likelihood_is_flat_the_samples_are_of_the_prior() -> None:
    tied = PRIOR.copy()
    tied[0, 1] = tied[1, 0] = 1.8
    found, evidence = sample_posterior(lambda p: np.zeros(len(p)), tied, samples=4000, seed=0)
    np.testing.assert_allclose(np.cov(found.T), tied, atol=0.2)
    assert evidence == pytest.approx(0.0)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_mode_that_few_samples_of_the_prior_would_hit_is_found(seed: int) -> None:
    """One of 10^8 of these lies in it; the evidence is that of two Gaussians' product."""
    mean, sigmas = 0.5 * SIGMAS, 0.04 * SIGMAS
    found, evidence = sample_posterior(
        lambda p: gaussian(mean, sigmas, p), PRIOR, samples=1000, seed=seed
    )
    np.testing.assert_allclose(found.mean(axis=0), mean, atol=0.02)
    np.testing.assert_allclose(found.std(axis=0), sigmas, rtol=0.3)
    both = SIGMAS**2 + sigmas**2
    expected = np.log(sigmas**2 / both).sum() / 2 - (mean**2 / both).sum() / 2
    assert evidence == pytest.approx(expected, abs=1.0)


def test_both_of_two_modes_are_found() -> None:
    mean, sigmas = np.array([1.0, 0, 0, 0, 0, 0]), 0.2 * SIGMAS

    def two(points: Array) -> Array:
        first, second = (gaussian(sign * mean, sigmas, points) for sign in (-1, 1))
        return np.logaddexp(first, second)

    found, _ = sample_posterior(two, PRIOR, samples=2000, seed=0)
    density = two(found) - 0.5 * np.einsum("ni,ij,nj->n", found, np.linalg.inv(PRIOR), found)
    assert density[0] == density.max()
    assert 0.3 < (found[:, 0] > 0).mean() < 0.7
    assert np.sqrt((found[:, 0] ** 2).mean()) == pytest.approx(1.0, rel=0.1)
