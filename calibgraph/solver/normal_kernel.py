"""Weighted sums of products of the columns of a linear problem, compiled.

Every row has two parts, those of a pixel's u and v. Columns are (m, 2, n), contiguous along rows.
"""

from __future__ import annotations

import numpy as np

from factors.compiled import compiled

_TILE = 256  # rows whose columns stay in the first-level cache
_FAST = {"reassoc", "contract", "nsz"}


@compiled(nogil=True, fastmath=_FAST, error_model="numpy")
def combine(columns, which, factors):  # type: ignore[no-untyped-def]
    """(2, n) sum of some columns times their factors."""
    n = columns.shape[2]
    out = np.zeros((2, n))
    for start in range(0, n, _TILE):
        end = min(start + _TILE, n)
        for j in range(len(which)):
            factor, column = factors[j], columns[which[j]]
            for part in range(2):
                source, target = column[part, start:end], out[part, start:end]
                for i in range(end - start):
                    target[i] += factor * source[i]
    return out


@compiled(nogil=True, fastmath=_FAST, error_model="numpy")
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


@compiled(nogil=True, fastmath=_FAST, error_model="numpy")
def _reweighted_products(columns, which, errors, scale):  # type: ignore[no-untyped-def]
    """As ``weighted_products``, with the Cauchy weights of (2, n) errors; and (n,) weights."""
    u, v, over = errors[0], errors[1], 1.0 / (scale * scale)
    weights = np.empty(len(u))
    for i in range(len(u)):
        weights[i] = 1.0 / (1.0 + over * (u[i] * u[i] + v[i] * v[i]))
    return weighted_products(columns, which, weights), weights


@compiled(nogil=True, error_model="numpy")
def _is_singular(normal, least):  # type: ignore[no-untyped-def]
    """Whether an unknown's column is nearly a combination of the others, whatever its unit."""
    units = np.sqrt(np.maximum(np.diag(normal), np.finfo(np.float64).tiny))
    return np.linalg.eigvalsh(normal / np.outer(units, units))[0] < least


@compiled(nogil=True, error_model="numpy")
def solve_reweighted(columns, which, loss_scale, medians, limits):  # type: ignore[no-untyped-def]
    """Iteratively reweighted least squares with a Cauchy loss on the norm of each row's error.

    Args:
        columns: as above.
        which: numbers of the columns of the k unknowns, and last that of the errors at zero.
        loss_scale: of the loss; 0: ``medians`` times the median of the errors.
        medians: see there.
        limits: iterations; largest change of an error, in units of the loss' scale; least
            eigenvalue of a unit-diagonal normal matrix.

    Returns:
        (k,) solution; (k, k) normal matrix; (n,) weights; whether that matrix is regular.
    """
    k = len(which) - 1
    factors = np.zeros(k + 1)
    factors[k] = -1.0
    normal, weights = np.zeros((k, k)), np.zeros(columns.shape[2])
    for _ in range(limits[0]):
        errors = combine(columns, which, factors)
        scale = loss_scale
        if scale == 0.0:
            scale = medians * np.sqrt(np.median(errors[0] ** 2 + errors[1] ** 2)) + 1e-12
        products, weights = _reweighted_products(columns, which, errors, scale)
        normal = products[:k, :k].copy()
        if _is_singular(normal, limits[2]):
            return factors[:k], normal, weights, False
        solution = np.linalg.solve(normal, products[:k, k].copy())
        moved = combine(columns, which[:k], solution - factors[:k])
        factors[:k] = solution
        if np.abs(moved).max() < limits[1] * scale:
            break
    return factors[:k], normal, weights, True


@compiled(nogil=True, error_model="numpy")
def grouped_gradients(columns, which, errors, weights, group, count):  # type: ignore[no-untyped-def]
    """(count, k) sums of weighted columns times (2, n) errors, over the rows of each group."""
    out, gradient = np.zeros((count, len(which))), np.empty(len(weights))
    for a in range(len(which)):
        column = columns[which[a]]
        for i in range(len(weights)):
            gradient[i] = weights[i] * (column[0, i] * errors[0, i] + column[1, i] * errors[1, i])
        for i in range(len(weights)):
            out[group[i], a] += gradient[i]
    return out
