"""The robust spread of residuals, their scales, and their whitening by weights and information."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.model.config import Config
from calibgraph.model.correspondences import Correspondences
from factors.arrays import contiguous
from factors.compiled import compiled

CAUCHY_SCALE_SIGMAS = 2.385
"""Robust scale in standard deviations: 95 % efficiency on Gaussian noise with Cauchy's loss."""

GATE_SIGMAS = 3.035
"""Gate in standard deviations: 99 % of two-dimensional Gaussian errors lie inside."""

MIN_SIGMA_PX = 0.05
"""Least spread of the scale `auto`: noise-free data would have none, and a loss of zero width."""

_START_QUANTILE, _START_FACTOR = 0.2, 1.762  # median of a Rayleigh distribution over that quantile
CUT = 4.0  # medians, 4.7 sigma in two dimensions: inliers lie below
_ROUNDS = 100


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

    Starts from a low quantile and takes the median of what lies within CUT times the spread, until
    it is constant: clean values give their median; a broad background, up to three quarters of all,
    hardly changes it; and values without a core give a large spread, since their median then grows.
    """
    return float(robust_spreads(values, np.array([[0, len(values)]]))[0])


def robust_spreads(values: Array, runs: NDArray[np.int64]) -> Array:
    """(r,) :func:`robust_spread` of the finite values in each of (r, 2) runs of (n,) values.

    Infinite where a run has no finite value.
    """
    found = _spreads(values, runs, (_START_QUANTILE, _START_FACTOR), _ROUNDS)
    return np.where(np.isnan(found), math.inf, found)


def quantiles(values: Array, runs: NDArray[np.int64], share: float) -> Array:
    """(r,) quantiles, interpolated, of the finite values in each of (r, 2) runs; NaN without any.

    Args:
        values: (n,).
        runs: (r, 2).
        share: of the values below.
    """
    return _spreads(values, runs, (share, 1.0), 0)


def quantile(values: Array, share: float) -> float:
    """The :func:`quantiles` of one run."""
    return float(quantiles(values, np.array([[0, len(values)]]), share)[0])


def _spreads(
    values: Array, runs: NDArray[np.int64], start: tuple[float, float], rounds: int
) -> Array:
    """(r,) see :func:`_fill_spreads`."""
    parts, found = [values[first:end] for first, end in runs.tolist()], np.empty(len(runs))
    edges = [*accumulate(map(len, parts), initial=0)]
    ordered = np.concatenate([*parts, values[:0]])
    for first, end in pairwise(edges):
        ordered[first:end].sort()
    _fill_spreads(contiguous(ordered), contiguous(np.array(edges)), start, rounds, found)
    return found


@compiled()
def _fill_spreads(ordered, edges, start, rounds, found):  # type: ignore[no-untyped-def]
    """Per run the start's quantile times its factor, then the iteration."""
    for i in range(len(found)):
        values = ordered[edges[i] : edges[i + 1]]
        spread = start[1] * _quantile_below(values, math.inf, start[0])
        for _ in range(rounds):
            before, spread = spread, _quantile_below(values, CUT * spread, 0.5)
            if math.isnan(spread):
                spread = before
                break
            if abs(spread - before) <= 1e-6 * before:
                break
        found[i] = spread


@compiled(part=True)
def _quantile_below(ordered, limit, share):  # type: ignore[no-untyped-def]
    """The quantile of the finite values up to a limit, interpolated; NaN without any."""
    count, end = 0, len(ordered)
    while count < end:
        middle = (count + end) // 2
        below = ordered[middle] <= limit and ordered[middle] < math.inf
        count, end = (middle + 1, end) if below else (count, middle)
    if count == 0:
        return math.nan
    place = share * (count - 1)
    k = np.int64(place)
    return ordered[k] + (place - k) * (ordered[k + 1 if k + 1 < count else k] - ordered[k])


IDENTITY = np.array([1.0, 0.0, 1.0])
"""The entries (0,0), (0,1), (1,1) of the 2x2 identity."""

MEDIAN_NORM = np.array([0.67449, 1.17741])  # of a standard Gaussian error in 1 and 2 dimensions


def sqrt_information(table: Correspondences, config: Config) -> Array | None:
    """Whitening matrices of the residuals, w_k times the root of the information.

    Returns:
        (n, 3) entries (0,0), (0,1), (1,1) of upper triangular S with S^T S = w^2 I; None if every
        weight is one and no information is given.
    """
    if table.information_px is None and not config.confidence_weights:
        return None
    if table.information_px is None:
        root = np.tile(IDENTITY, (len(table), 1))
    else:
        root = upper_root(table.information_px)
    if config.confidence_weights:  # the paper's w = sqrt(clip(c, 0.1, 1))
        root *= np.sqrt(np.clip(table.confidence, 0.1, 1.0))[:, None]
    return root


def upper_root(information: Array) -> Array:
    """Upper triangular S with S^T S = I, row-wise; rank one gives s11 = 0 (or s00 = s01 = 0)."""
    uu, uv, vv = information.T
    s00 = np.sqrt(uu)
    s01 = np.where(uu > 0, uv / np.where(uu > 0, s00, 1.0), 0.0)
    s11 = np.sqrt(np.maximum(vv - s01**2, 0.0))
    return np.stack([s00, s01, s11], axis=1)


def error_gradient(residuals: Array, errors: Array, information: Array | None) -> Array:
    """(n, 2) derivative of the constrained error by the residual, see :func:`constrained_root`.

    Args:
        residuals: (n, 2).
        errors: (n,) these errors.
        information: (n, 3) or None.
    """
    safe = np.maximum(errors, np.finfo(float).tiny)[:, None]
    if information is None:
        return np.asarray(residuals / safe)
    uu, uv, vv = information.T
    x, y = residuals.T
    along = np.column_stack([uu * x + uv * y, uv * x + vv * y])
    return np.asarray(along / (largest_eigenvalue(information)[:, None] * safe))


def constrained_root(information: Array) -> Array:
    """(n, 3) whitening matrices that make a residual's norm its constrained error."""
    return upper_root(information / largest_eigenvalue(information)[:, None])


def largest_eigenvalue(information: Array) -> Array:
    """(n,) of (n, 3) symmetric 2x2 matrices, given by their entries uu, uv, vv."""
    uu, uv, vv = information.T
    return np.asarray((uu + vv) / 2 + np.hypot((uu - vv) / 2, uv))


def median_norm(information: Array | None) -> Array:
    """() or (n,) medians of a standard Gaussian error, of as many axes as are constrained."""
    if information is None:
        return np.asarray(MEDIAN_NORM[1])
    uu, uv, vv = information.T
    rank_one = uu * vv - uv**2 <= 1e-3 * (uu + vv) ** 2
    return np.asarray(MEDIAN_NORM[np.where(rank_one, 0, 1)])
