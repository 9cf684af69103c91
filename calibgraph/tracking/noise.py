"""Noise in constant memory: the residuals of all frames, and the scatter of epochs.

Frames of a car that stands, or passes the same wall for a while, share errors. Clustering by frames
does not show it, but the sums of epochs do: they scatter more than the scatter of their frames adds
up to. Each is compared with the one before: what lasts longer is a move or a drift, not scatter.
"""

from __future__ import annotations

import math

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.config import Config
from calibgraph.solver.matches import BlockResiduals
from calibgraph.solver.robust import ResidualScale, iterate_spread, scale_from

_EDGES = np.concatenate([[0.0], np.geomspace(1e-5, 1e5, 2304)])  # 1 % wide
BINS = len(_EDGES) - 1
_RESIDUALS_KEPT = 1 - 1 / 2000  # from frame to frame


def add_residuals(histogram: Array, residuals: BlockResiduals) -> Array:
    """(2, b) numbers of unweighted and of whitened residuals by size, slowly forgotten.

    Args:
        histogram: before.
        residuals: of one or more frames, in their order.
    """
    (sizes_px, sizes), frames = residuals.sizes, residuals.block.frames
    kept = _RESIDUALS_KEPT ** np.arange(frames - 1.0, -1.0, -1.0)
    weights = np.repeat(kept, residuals.block.frame_counts)[residuals.projectable]
    counted = _counted(sizes_px, weights)
    new = [counted, counted if sizes is sizes_px else _counted(sizes, weights)]
    return np.asarray(_RESIDUALS_KEPT**frames * histogram + new)


def scale_of(histogram: Array, least: float, config: Config) -> ResidualScale:
    """The scale of all the residuals, as by :meth:`CameraBlock.scale`.

    Args:
        histogram: (2, b) of them.
        least: lower bound of the whitened spread.
        config: may fix either scale.
    """
    of_px, whitened = histogram
    sigma_px = spread = iterate_spread(_Quantiles(of_px))
    if not np.array_equal(of_px, whitened):
        spread = iterate_spread(_Quantiles(whitened))
    return scale_from(sigma_px, max(spread, least), config)


def median(values: Array) -> float:
    """The median of at least one number; ``np.median`` takes ten times as long for some hundred."""
    ordered, half = np.sort(values), len(values) // 2
    return float(ordered[half] if len(values) % 2 else (ordered[half - 1] + ordered[half]) / 2)


def _counted(sizes: Array, weights: Array) -> Array:
    places = np.searchsorted(_EDGES, sizes, side="right") - 1
    counts = np.bincount(np.minimum(places, len(_EDGES) - 2), weights, len(_EDGES) - 1)
    return counts.astype(np.float64)


class _Quantiles:
    """Quantiles of the values that a histogram has counted, linear within its bins."""

    def __init__(self, counts: Array) -> None:
        self._cumulative = np.concatenate([[0.0], np.cumsum(counts)])

    def __call__(self, limit: float, share: float) -> float:
        below = float(np.interp(limit, _EDGES, self._cumulative))
        return float(np.interp(share * below, self._cumulative, _EDGES)) if below else math.nan


_FREEDOM = 6
_KEPT = 0.995  # from epoch to epoch
_UNUSUAL = 30.0  # squared sigmas of a six-vector: an epoch across a move counts for no more


def add_epoch(group: Array, score: Array, frames: float, noise: Array) -> Array:
    """(2,) number of a camera's epochs, and their squares over their frames' scatter, forgotten.

    Args:
        group: before.
        score: (6,) sum of the gradients of an epoch's frames.
        frames: how many.
        noise: (6, 6) covariance of one frame's.
    """
    squared = float(score @ np.linalg.solve(noise, score)) / max(frames, 1.0)
    return np.asarray(_KEPT * group + [1.0, min(squared, _UNUSUAL) / _FREEDOM])


def inflation(group: Array) -> float:
    """Ratio of the epochs' scatter to that of their frames, on average; at least 1.

    For alarms: after few epochs it has little bias.
    """
    epochs, squared = group.tolist()
    return max(1.0, squared / epochs) if epochs else 1.0


def sure_inflation(group: Array) -> float:
    """The lower end of the 2-sigma interval of the inflation, for the error bar."""
    epochs = max(float(group[0]), 1.0)
    return max(1.0, inflation(group) * (1 - 2 * math.sqrt(2 / (_FREEDOM * epochs))))
