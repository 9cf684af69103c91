"""Quantiles of residuals: of the values that are finite."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def quantile(values: Array, share: float) -> float:
    """A quantile of (n,) values, interpolated; NaN without any finite ones."""
    finite = values[values < math.inf]
    if not len(finite):
        return math.nan
    low = int(share * (len(finite) - 1))
    ordered = np.partition(finite, (low, min(low + 1, len(finite) - 1)))
    return quantile_of_ordered(ordered, len(finite), share)


def median(values: Array) -> float:
    """The median of (n,) values; NaN without any that are finite."""
    return quantile(values, 0.5)


def medians(values: Array, runs: NDArray[np.int64]) -> Array:
    """(r,) :func:`median` of the values in each of (r, 2) runs."""
    return np.array([median(values[first:end]) for first, end in runs])


def quantile_of_ordered(ordered: Array, count: int, share: float) -> float:
    """A quantile of the first values, at least one, of an ascending array, interpolated."""
    place = share * (count - 1)
    low = int(place)
    below, above = ordered[low], ordered[min(low + 1, count - 1)]
    return float(below + (place - low) * (above - below))
