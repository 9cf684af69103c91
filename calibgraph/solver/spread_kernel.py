"""Quantiles and robust spreads of many runs of values at once: order statistics without sorting.

Values go into bins by their leading bits, which order positive floats; only the bins that hold a
wanted order statistic are sorted.
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray

from calibgraph.arrays import Array
from factors.block_arrays import contiguous
from factors.compiled import compiled

_MANTISSA, _BIAS = 52, 1023  # bits, and the exponent of 1
_LEAST, _LARGEST = _BIAS - 16, _BIAS + 16  # exponents: smaller and larger values share a bin
_BITS = ((16384, 8), (2048, 6), (0, 4))  # from so many values on, an octave has 2^bits bins
_ROUNDS = 100


def spreads(
    values: Array, runs: NDArray[np.int64], start: tuple[float, float], cut: float, *, shared: bool
) -> Array:
    """(r,) spreads of the finite values in each of (r, 2) runs; infinite without any.

    Args:
        values: (n,) of zero and more.
        runs: (r, 2).
        start: a quantile, and the factor by which it gives the first spread.
        cut: the next is the median of the values up to so many times the last.
        shared: by all cores; by one thread of a program at a time.
    """
    values = contiguous(values)
    kernel = _spreads(shared=shared)
    found: Array = kernel(values, values.view(np.int64), contiguous(runs), start, cut, _ROUNDS)
    return np.where(np.isnan(found), math.inf, found)


def quantiles(values: Array, runs: NDArray[np.int64], share: float) -> Array:
    """(r,) quantiles of the finite values in each of (r, 2) runs; NaN without any.

    Args:
        values: (n,) of zero and more.
        runs: (r, 2).
        share: of the values below, interpolated.
    """
    values = contiguous(values)
    kernel, raw = _spreads(shared=False), values.view(np.int64)
    return np.asarray(kernel(values, raw, contiguous(runs), (share, 1.0), math.inf, 0))


def quantile(values: Array, share: float) -> float:
    """The :func:`quantiles` of one run."""
    return float(quantiles(values, np.array([[0, len(values)]]), share)[0])


def median(values: Array) -> float:
    """The median of the finite ones of (n,) values of zero and more; NaN without any."""
    return quantile(values, 0.5)


@cache
def _spreads(*, shared: bool) -> Any:
    @compiled(parallel=shared)
    def run(values, raw, runs, start, cut, rounds):  # type: ignore[no-untyped-def]
        out = np.empty(len(runs))
        for i in prange(len(runs)):
            first, end = runs[i, 0], runs[i, 1]
            out[i] = _spread(values[first:end], raw[first:end], start, cut, rounds)
        return out

    return run


@compiled(part=True)
def _spread(values, raw, start, cut, rounds):  # type: ignore[no-untyped-def]
    bits: Any = np.int64(0)
    for least, some in _BITS:
        if len(values) >= least:
            bits = max(bits, some)
    edges = np.empty((((_LARGEST - _LEAST) << bits) + 3), dtype=np.int64)
    for b in range(len(edges)):  # np.zeros compiles slowly
        edges[b] = 0
    work = np.empty(len(values))
    _fill_bins(values, raw, bits, work, edges)
    spread = start[1] * _quantile_below(work, edges, bits, math.inf, start[0])
    for _ in range(rounds):
        before, spread = spread, _quantile_below(work, edges, bits, cut * spread, 0.5)
        if math.isnan(spread):
            return before
        if abs(spread - before) <= 1e-6 * before:
            break
    return spread


@compiled(part=True)
def _fill_bins(values, raw, bits, work, edges):  # type: ignore[no-untyped-def]
    """Put the finite values into ``work`` by bins, and where these begin into ``edges``."""
    first, last = _LEAST << bits, (_LARGEST << bits) + 1
    shift = _MANTISSA - bits
    for i in range(len(values)):
        if values[i] < math.inf:
            edges[min(max(raw[i] >> shift, first), last) - first + 1] += 1
    place = np.empty(len(edges), dtype=np.int64)
    place[0] = 0
    for b in range(1, len(edges)):
        edges[b] += edges[b - 1]
        place[b] = edges[b]
    for i in range(len(values)):
        if values[i] < math.inf:
            b = min(max(raw[i] >> shift, first), last) - first
            work[place[b]] = values[i]
            place[b] += 1


@compiled(part=True)
def _quantile_below(work, edges, bits, limit, share):  # type: ignore[no-untyped-def]
    """The quantile of the values up to a limit, interpolated; NaN without any."""
    last = edges[-1] - 1
    if limit < math.inf:
        part, exponent = math.frexp(limit)
        b = (exponent - 1 + _BIAS - _LEAST) << bits
        b = min(b + int((2.0 * part - 1.0) * (1 << bits)), len(edges) - 2) if b >= 0 else 0
        b = b if part > 0.0 else 0
        last = edges[b] - 1
        for i in range(edges[b], edges[b + 1]):
            last += 1 if work[i] <= limit else 0
    if last < 0:
        return math.nan
    place = share * last
    below = above = 0.0
    for upper in range(2):
        k = min(int(place) + upper, last)
        b, end = 0, len(edges) - 1  # the bin of number k: edges[b] <= k < edges[b + 1]
        while end - b > 1:
            middle = (b + end) // 2
            b, end = (middle, end) if edges[middle] <= k else (b, middle)
        _sort(work[edges[b] : edges[b + 1]])
        below, above = above, work[k]
    return below + (place - int(place)) * (above - below)


@compiled(part=True)
def _sort(values):  # type: ignore[no-untyped-def]
    """Sort in place, by Shell's method; numpy's own takes ten times longer to compile."""
    gap = len(values)
    while gap > 1:
        gap = max(1, 5 * gap // 11)
        for i in range(gap, len(values)):
            value, j = values[i], i
            while j >= gap and values[j - gap] > value:
                values[j] = values[j - gap]
                j -= gap
            values[j] = value
