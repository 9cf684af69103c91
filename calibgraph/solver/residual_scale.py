"""The robust spread of residuals, and the scales of loss and gate derived from it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.config import Config
from calibgraph.solver.spread_kernel import spreads
from factors.compiled import one_at_a_time

CAUCHY_SCALE_SIGMAS = 2.385
"""Robust scale in standard deviations: 95 % efficiency on Gaussian noise with Cauchy's loss."""

GATE_SIGMAS = 3.035
"""Gate in standard deviations: 99 % of two-dimensional Gaussian errors lie inside."""

MIN_SIGMA_PX = 0.05
"""Least spread of the scale `auto`: noise-free data would have none, and a loss of zero width."""

_START_QUANTILE, _START_FACTOR = 0.2, 1.762  # median of a Rayleigh distribution over that quantile
_HALF = 0.5
_WORTH_SHARING = 2_000_000  # values (6 ms): below, waiting for busy cores costs more
_CUT = 4.0  # medians, 4.7 sigma in two dimensions: inliers lie below


@dataclass(frozen=True)
class ResidualScale:
    """The scales of one camera's residuals.

    Attributes:
        sigma: what whitened residuals are divided by, so that they have unit variance: 1 with a
            fixed loss scale (the paper's objective), else their robust spread.
        loss_scale: delta, of the whitened residual before that division.
        gate_px: tau.
        sigma_px: robust spread of the unweighted residuals, per axis; infinite if there are none;
            NaN if it was not measured, because loss and gate are configured.
    """

    sigma: float
    loss_scale: float
    gate_px: float
    sigma_px: float

    def narrow(self, factor: float) -> ResidualScale:
        """With sigma and the loss's scale multiplied by a factor below one."""
        return replace(self, sigma=factor * self.sigma, loss_scale=factor * self.loss_scale)


def scale_from(sigma_px: float, spread: float, config: Config) -> ResidualScale:
    """The configured scales, or those of the residuals' spread.

    Args:
        sigma_px: robust spread of the unweighted residuals.
        spread: robust spread of the whitened residuals.
        config: may fix either scale.
    """
    fixed = config.loss_scale_px
    return ResidualScale(
        sigma=spread if fixed is None else 1.0,
        loss_scale=CAUCHY_SCALE_SIGMAS * spread if fixed is None else fixed,
        gate_px=config.gate_px or GATE_SIGMAS * max(sigma_px, MIN_SIGMA_PX),
        sigma_px=sigma_px,
    )


def robust_spread(values: Array) -> float:
    """The median of the inliers among values of which outliers may be the majority.

    Starts from a low quantile and takes the median of what lies within _CUT times the spread, until
    it is constant: clean values give their median; a broad background, up to three quarters of all,
    hardly changes it; and values without a core give a large spread, since their median then grows.
    """
    return float(robust_spreads(values, np.array([[0, len(values)]]))[0])


def robust_spreads(values: Array, runs: NDArray[np.int64]) -> Array:
    """(r,) :func:`robust_spread` of the finite values in each of (r, 2) runs of (n,) values."""
    shared = len(values) >= _WORTH_SHARING
    run = one_at_a_time(spreads) if shared else spreads
    found: Array = run(values, runs, (_START_QUANTILE, _START_FACTOR), _CUT, shared=shared)
    return found


def iterate_spread(quantile_below: Callable[[float, float], float]) -> float:
    """The iteration of :func:`robust_spread`, of values that are known by their quantiles alone.

    Args:
        quantile_below: quantile, of a given share, of the values up to a limit; NaN without any.
    """
    spread = _START_FACTOR * quantile_below(math.inf, _START_QUANTILE)
    for _ in range(100):
        before, spread = spread, quantile_below(_CUT * spread, _HALF)
        if math.isnan(spread):
            return before
        if abs(spread - before) <= 1e-6 * before:
            break
    return spread
