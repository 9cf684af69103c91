"""The robust spread of many runs of values at once, compiled: order statistics without sorting.

Values go into bins by their leading bits, which order positive floats; only the bins that hold a
wanted order statistic are sorted.
"""

import math

import numpy as np
from numba import prange

from factors.compiled import compiled

_MANTISSA = 52  # bits
_LEAST, _LARGEST = 1023 - 16, 1023 + 16  # biased exponents: smaller and larger values share a bin
_BITS = ((16384, 8), (2048, 6), (0, 4))  # from so many values on, an octave has 2^bits bins


@compiled()
def _fill_bins(values, bits, work, edges):  # type: ignore[no-untyped-def]
    """Put the finite values into ``work`` by bins, and where these begin into ``edges``."""
    raw = values.view(np.int64)
    first, last = _LEAST << bits, (_LARGEST << bits) + 1
    shift = _MANTISSA - bits
    for b in range(len(edges)):
        edges[b] = 0
    for i in range(len(values)):
        if values[i] < math.inf:
            edges[min(max(raw[i] >> shift, first), last) - first + 1] += 1
    for b in range(1, len(edges)):
        edges[b] += edges[b - 1]
    place = edges[:-1].copy()
    for i in range(len(values)):
        if values[i] < math.inf:
            b = min(max(raw[i] >> shift, first), last) - first
            work[place[b]] = values[i]
            place[b] += 1


@compiled()
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


@compiled()
def _order_statistic(work, edges, k):  # type: ignore[no-untyped-def]
    """The value number ``k`` in ascending order; its bin is sorted."""
    b = np.searchsorted(edges, k, side="right") - 1
    _sort(work[edges[b] : edges[b + 1]])
    return work[k]


@compiled()
def _quantile_below(work, edges, bits, limit, share):  # type: ignore[no-untyped-def]
    """The quantile of the values up to a limit, interpolated; NaN without any."""
    last = edges[-1] - 1
    if limit < math.inf:
        first, end = _LEAST << bits, (_LARGEST << bits) + 1
        raw = np.array([limit]).view(np.int64)[0] >> (_MANTISSA - bits)
        b = min(max(raw, first), end) - first
        last = edges[b] - 1
        for i in range(edges[b], edges[b + 1]):
            last += 1 if work[i] <= limit else 0
    if last < 0:
        return math.nan
    place = share * last
    low = int(place)
    below = _order_statistic(work, edges, low)
    above = _order_statistic(work, edges, min(low + 1, last))
    return below + (place - low) * (above - below)


@compiled()
def _bin(values):  # type: ignore[no-untyped-def]
    """The finite values by bins, where these begin, and the bins' bits."""
    bits = 0
    for least, some in _BITS:
        if len(values) >= least:
            bits = max(bits, some)
    edges = np.empty((((_LARGEST - _LEAST) << bits) + 3), dtype=np.int64)
    work = np.empty(len(values))
    _fill_bins(values, bits, work, edges)
    return work, edges, bits


@compiled()
def quantile(values, share):  # type: ignore[no-untyped-def]
    """A quantile of (n,) values of zero and more, interpolated; NaN without any finite ones."""
    work, edges, bits = _bin(values)
    return _quantile_below(work, edges, bits, math.inf, share)


@compiled()
def median(values):  # type: ignore[no-untyped-def]
    """The median of (n,) values of zero and more; NaN without any that are finite."""
    return quantile(values, 0.5)


@compiled()
def medians(values, runs):  # type: ignore[no-untyped-def]
    """(r,) :func:`median` of the values in each of (r, 2) runs."""
    out = np.empty(len(runs))
    for i in range(len(runs)):
        out[i] = median(values[runs[i, 0] : runs[i, 1]])
    return out


@compiled()
def _spread(values, start, half, cut):  # type: ignore[no-untyped-def]
    """See ``residual_scale.robust_spread``: ``start`` is a quantile and a factor."""
    work, edges, bits = _bin(values)
    if edges[-1] == 0:
        return math.inf
    spread = start[1] * _quantile_below(work, edges, bits, math.inf, start[0])
    for _ in range(100):
        before, spread = spread, _quantile_below(work, edges, bits, cut * spread, half)
        if math.isnan(spread):
            return before
        if abs(spread - before) <= 1e-6 * before:
            break
    return spread


def _spreads(values, runs, start, half, cut):  # type: ignore[no-untyped-def]
    """(r,) robust spreads of the finite values in each of (r, 2) runs; infinite without any."""
    out = np.empty(len(runs))
    for i in prange(len(runs)):
        out[i] = _spread(values[runs[i, 0] : runs[i, 1]], start, half, cut)
    return out


spreads_alone = compiled()(_spreads)
spreads_shared = compiled(parallel=True)(_spreads)
