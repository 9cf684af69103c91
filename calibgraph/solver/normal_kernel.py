"""Reweighted least squares, and weighted sums of products of the columns of a linear problem.

Every row has two parts, those of a pixel's u and v. Columns are (m, 2, n), contiguous along rows.
"""

import math

import numpy as np
from numpy.typing import NDArray

from calibgraph.solver.spread_kernel import median
from factors import unit_diagonal
from factors.compiled import compiled

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Limits = tuple[int, float, float]

_TILE = 256  # rows whose columns stay in the first-level cache
_FAST = {"reassoc", "contract", "nsz"}


@compiled(fastmath=_FAST | {"nnan"})
def _move(columns, which, factors, errors):  # type: ignore[no-untyped-def]
    """Replace (2, n) errors by the sum of some columns times their factors.

    Returns:
        The largest change of one of them.
    """
    k, n = len(which), columns.shape[2]
    moved, changes, largest = np.empty(_TILE), np.zeros(_TILE), 0.0
    for start in range(0, n, _TILE):
        end = min(start + _TILE, n)
        for part in range(2):
            moved[:] = 0.0
            for j in range(k):
                factor, source = factors[j], columns[which[j]][part, start:end]
                for i in range(end - start):
                    moved[i] += factor * source[i]
            target = errors[part, start:end]
            for i in range(end - start):
                change = abs(moved[i] - target[i])
                changes[i] = change if change > changes[i] else changes[i]
                target[i] = moved[i]
    for i in range(_TILE):  # one maximum over all rows would not be vectorized
        largest = max(largest, changes[i])
    return largest


@compiled(fastmath=_FAST)
def weighted_products(columns, which, weights):  # type: ignore[no-untyped-def]
    """(k, k) sums over the rows of the products of each two of k columns, times (n,) weights."""
    k, n = len(which), columns.shape[2]
    out = np.zeros((k, k))
    weighted = np.empty((2, _TILE))
    for start in range(0, n, _TILE):
        end = min(start + _TILE, n)
        own = weights[start:end]
        for a in range(k):
            for part in range(2):
                source, target = columns[which[a]][part, start:end], weighted[part]
                for i in range(end - start):
                    target[i] = own[i] * source[i]
            for b in range(a + 1):
                other_u, other_v = columns[which[b]][0, start:end], columns[which[b]][1, start:end]
                in_u, in_v = weighted[0], weighted[1]
                total = 0.0
                for i in range(end - start):
                    total += in_u[i] * other_u[i] + in_v[i] * other_v[i]
                out[a, b] += total
    for a in range(k):
        for b in range(a):
            out[b, a] = out[a, b]
    return out


@compiled(fastmath=_FAST)
def _cauchy_weights(errors, scale):  # type: ignore[no-untyped-def]
    """(n,) weights of (2, n) errors."""
    u, v, over = errors[0], errors[1], 1.0 / (scale * scale)
    weights = np.empty(len(u))
    for i in range(len(u)):
        weights[i] = 1.0 / (1.0 + over * (u[i] * u[i] + v[i] * v[i]))
    return weights


def solve_reweighted(
    columns: Array, which: Rows, loss_scale: float | None, medians: float, limits: Limits
) -> tuple[Array, Array, Array, Array] | None:
    """Iteratively reweighted least squares with a Cauchy loss on the norm of each row's error.

    Args:
        columns: as above.
        which: numbers of the columns of the k unknowns, and last that of the errors at zero.
        loss_scale: of the loss; None: ``medians`` times the median of the errors.
        medians: see there.
        limits: iterations; largest change of an error, in units of the loss' scale; smallest
            share of an unknown's column that is no combination of those before it.

    Returns:
        (k,) solution; (k, k) normal matrix; (n,) weights; (2, n) errors at the solution. None if
        that matrix is singular.
    """
    iterations, converged, least = limits
    factors = np.append(np.zeros(len(which) - 1), -1.0)
    errors, squares, weights = -columns[which[-1]], np.empty(columns.shape[2]), np.empty(0)
    products = np.empty((len(which), len(which)))
    for _ in range(iterations):
        scale = loss_scale
        if scale is None:
            np.einsum("pn,pn->n", errors, errors, out=squares)
            scale = medians * math.sqrt(median(squares)) + 1e-12
        weights = _cauchy_weights(errors, scale)
        products = weighted_products(columns, which, weights)
        scaled, units = unit_diagonal(products[:-1, :-1])
        try:
            root = np.linalg.cholesky(scaled)
        except np.linalg.LinAlgError:
            return None
        if np.diag(root).min() ** 2 < least:
            return None
        factors[:-1] = np.linalg.solve(scaled, products[:-1, -1] / units) / units
        if _move(columns, which, factors, errors) < converged * scale:
            break
    return factors[:-1], products[:-1, :-1], weights, errors


@compiled(fastmath=_FAST)
def grouped_gradients(columns, which, errors, weights, group, count):  # type: ignore[no-untyped-def]
    """(count, k) sums of weighted columns times (2, n) errors, over the rows of each group."""
    k, n, end = len(which), len(weights), 0
    out, in_u, in_v = np.zeros((count, k)), np.empty(n), np.empty(n)
    for i in range(n):
        in_u[i], in_v[i] = weights[i] * errors[0, i], weights[i] * errors[1, i]
    while end < n:
        start, own = end, group[end]
        while end < n and group[end] == own:
            end += 1
        for a in range(k):
            u, v, total = columns[which[a], 0], columns[which[a], 1], 0.0
            for i in range(start, end):
                total += u[i] * in_u[i] + v[i] * in_v[i]
            out[own, a] += total
    return out
