"""Samples of a posterior with several modes, or none: from the prior, tempered step by step.

Sequential Monte Carlo: the likelihood enters with an exponent that grows from 0 to 1, in steps
that keep most samples effective. After each, samples are drawn again by their weights, and moved by
Metropolis steps as wide as they are. With 1000 samples a standard deviation repeats to a tenth.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq
from scipy.special import logsumexp

from calibgraph.arrays import Array

_EFFECTIVE = 0.8  # share of the samples that each step keeps
_MOVES = 3  # of every sample, after each step
_STEP = 2.38  # over the square root of the dimension: the best width of a Metropolis move
_NARROW = 0.3  # every other move is so much of that, for modes narrower than all samples together


def sample_posterior(
    log_likelihood: Callable[[Array], Array], prior: Array, *, samples: int, seed: int
) -> tuple[Array, float]:
    """Draw (n, k) samples of prior times likelihood; with the log of the integral, the evidence.

    The densest sample comes first.

    Args:
        log_likelihood: (n,) of (n, k) points.
        prior: (k, k) covariance of the prior, a Gaussian about 0.
        samples: their number n.
        seed: of the draws.
    """
    rng, root = np.random.default_rng(seed), np.linalg.cholesky(prior)
    points = rng.standard_normal((samples, len(prior)))  # in standard deviations of the prior
    values, exponent, evidence = log_likelihood(points @ root.T), 0.0, 0.0
    while exponent < 1.0:
        step = _next_step(values, 1.0 - exponent)
        exponent += step
        evidence += float(logsumexp(step * values)) - np.log(samples)
        drawn = rng.choice(samples, samples, p=_weights(values, step))
        points, values = points[drawn], values[drawn]
        for _ in range(_MOVES):
            proposed = points + _draw_moves(points, rng)
            found = log_likelihood(proposed @ root.T)
            odds = exponent * (found - values) + _log_prior(proposed) - _log_prior(points)
            accepted = np.log(rng.random(samples)) < odds
            points[accepted], values[accepted] = proposed[accepted], found[accepted]
    densest_first = np.argsort(-(values + _log_prior(points)), kind="stable")
    return points[densest_first] @ root.T, evidence


def _next_step(values: Array, left: float) -> float:
    """By how much the exponent can grow, at most by what is left."""

    def excess(step: float) -> float:
        weights = _weights(values, step)
        return float(1.0 / (weights**2).sum()) - _EFFECTIVE * len(values)

    return left if excess(left) >= 0 else float(brentq(excess, 0.0, left, rtol=1e-3))


def _weights(values: Array, step: float) -> Array:
    weights = np.exp(step * (values - values.max()))
    return np.asarray(weights / weights.sum())


def _draw_moves(points: Array, rng: np.random.Generator) -> Array:
    count, size = points.shape
    covariance = np.cov(points.T) + 1e-12 * np.eye(size)
    widths = _STEP / np.sqrt(size) * rng.choice([1.0, _NARROW], (count, 1))
    return np.asarray(widths * rng.multivariate_normal(np.zeros(size), covariance, count))


def _log_prior(whitened: Array) -> Array:
    return np.asarray(-0.5 * (whitened**2).sum(axis=1))
