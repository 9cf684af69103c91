"""Weighted sums of products of the columns of a linear problem, compiled.

Every row has two parts, those of a pixel's u and v. Columns are (m, 2, n), contiguous along rows.
"""

import math

import numpy as np

from calibgraph.solver.spread_kernel import median
from factors.compiled import compiled

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


@compiled()
def _factorize(products, least, units, root):  # type: ignore[no-untyped-def]
    """Cholesky's root of k normal equations in units of a unit diagonal; whether it exists.

    Written out, as ``_solve``: numba compiles a call of LAPACK for several seconds.

    Args:
        products: (k + 1, k + 1): the normal matrix, and in its last column the right side.
        least: smallest share of an unknown's column that those before it must leave.
        units: (k,), filled: a row of the normal matrix is units[i] root[i] root^T units.
        root: (k, k), filled below the diagonal.
    """
    for i in range(len(units)):
        units[i] = math.sqrt(max(products[i, i], np.finfo(np.float64).tiny))
        for j in range(i + 1):
            rest = products[i, j] / (units[i] * units[j])
            for m in range(j):
                rest -= root[i, m] * root[j, m]
            if j < i:
                root[i, j] = rest / root[j, j]
            elif rest >= least:
                root[i, i] = math.sqrt(rest)
            else:
                return False
    return True


@compiled()
def _solve(products, units, root, solution):  # type: ignore[no-untyped-def]
    """Fill in the (k,) solution of the equations of :func:`_factorize`."""
    k = len(solution)
    for i in range(k):
        rest = products[i, k] / units[i]
        for j in range(i):
            rest -= root[i, j] * solution[j]
        solution[i] = rest / root[i, i]
    for i in range(k - 1, -1, -1):
        for j in range(i + 1, k):
            solution[i] -= root[j, i] * solution[j]
        solution[i] /= root[i, i]
    for i in range(k):
        solution[i] /= units[i]


@compiled()
def solve_reweighted(columns, which, loss_scale, medians, limits):  # type: ignore[no-untyped-def]
    """Iteratively reweighted least squares with a Cauchy loss on the norm of each row's error.

    Args:
        columns: as above.
        which: numbers of the columns of the k unknowns, and last that of the errors at zero.
        loss_scale: of the loss; 0: ``medians`` times the median of the errors.
        medians: see there.
        limits: iterations; largest change of an error, in units of the loss' scale; smallest
            share of an unknown's column that is no combination of those before it.

    Returns:
        (k,) solution; (k, k) normal matrix; (n,) weights; (2, n) errors at the solution; whether
        that matrix is regular.
    """
    k, n = len(which) - 1, columns.shape[2]
    factors = np.zeros(k + 1)
    factors[k] = -1.0
    products, weights, squares = np.zeros((k + 1, k + 1)), np.zeros(n), np.empty(n)
    units, root, solution = np.empty(k), np.empty((k, k)), np.empty(k)
    errors = -columns[which[k]]
    for _ in range(limits[0]):
        scale = loss_scale
        if scale == 0.0:
            for i in range(n):
                squares[i] = errors[0, i] * errors[0, i] + errors[1, i] * errors[1, i]
            scale = medians * math.sqrt(median(squares)) + 1e-12
        weights = _cauchy_weights(errors, scale)
        products = weighted_products(columns, which, weights)
        if not _factorize(products, limits[2], units, root):
            return factors[:k], products[:k, :k], weights, errors, False
        _solve(products, units, root, solution)
        for i in range(k):  # an assignment to a slice would compile its error message: 2 s
            factors[i] = solution[i]
        if _move(columns, which, factors, errors) < limits[1] * scale:
            break
    return factors[:k], products[:k, :k], weights, errors, True


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
