"""Exact order statistics of values that are spread over workers: counts by bins, then one bin.

Positive floats are ordered by their bits, so the leading ones are a bin; the workers' counts add
up, and only the values of the bins that hold a wanted order statistic travel.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibgraph.solver.residual_scale import iterate_spread

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

_BITS = 8  # of the mantissa: 256 bins an octave
_SHIFT = 52 - _BITS
_LEAST, _LARGEST = (1023 - 40) << _BITS, (1023 + 24) << _BITS  # beyond 1e-12 and 2e7 one bin each


def bins_of(values: Array) -> NDArray[np.int64]:
    """(n,) the bins of positive values."""
    raw = np.ascontiguousarray(values, dtype=np.float64).view(np.int64) >> _SHIFT
    return np.asarray(raw.clip(_LEAST, _LARGEST) - _LEAST)


def count_bins(values: Array) -> Counts:
    """How many finite values there are in each bin."""
    return np.bincount(bins_of(values[np.isfinite(values)]), minlength=_LARGEST - _LEAST + 1)


def values_in_bin(values: Array, number: int) -> Array:
    """The finite values of one bin."""
    finite = values[np.isfinite(values)]
    return np.asarray(finite[bins_of(finite) == number])


@dataclass(frozen=True, eq=False)
class SpreadValues:
    """Values that are spread over workers.

    Attributes:
        counts: in each bin, of all workers.
        fetch: the values of one bin, of all workers.
    """

    counts: Counts
    fetch: Callable[[int], Array]
    _sorted: dict[int, Array] = field(default_factory=dict)

    @cached_property
    def _ends(self) -> Counts:
        return np.cumsum(self.counts)

    def __len__(self) -> int:
        return int(self._ends[-1])

    def _bin(self, number: int) -> Array:
        if number not in self._sorted:
            self._sorted[number] = np.sort(self.fetch(number))
        return self._sorted[number]

    def at(self, place: int) -> float:
        """The value number ``place`` in ascending order, from 0."""
        number = int(np.searchsorted(self._ends, place, side="right"))
        return float(self._bin(number)[place - int(self._ends[number] - self.counts[number])])

    def count_up_to(self, limit: float) -> int:
        """How many values there are up to a limit."""
        if math.isinf(limit):
            return len(self)
        number = int(bins_of(np.array([limit]))[0])
        inside = int(np.searchsorted(self._bin(number), limit, side="right"))
        return int(self._ends[number] - self.counts[number]) + inside

    def quantile_below(self, limit: float, share: float) -> float:
        """The quantile of the values up to a limit, interpolated; NaN without any."""
        last = self.count_up_to(limit) - 1
        if last < 0:
            return math.nan
        place = share * last
        low = int(place)
        below, above = self.at(low), self.at(min(low + 1, last))
        return below + (place - low) * (above - below)

    @property
    def median(self) -> float:
        """Of all values."""
        return self.quantile_below(math.inf, 0.5)

    @property
    def robust_spread(self) -> float:
        """As ``residual_scale.robust_spread``; infinite without any value."""
        return iterate_spread(self.quantile_below) if len(self) else math.inf
