"""Weighted sums of products of the columns of a linear problem, and its robust solution.

Every row has two parts, those of a pixel's u and v. Columns are (k, 2, n).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from calibgraph.solver.quantiles import median
from factors import unit_diagonal

Array = NDArray[np.float64]

_MAX_ITERATIONS = 20
_CONVERGED = 1e-4  # largest change of an error in a step, in units of the loss' scale
_LEAST_SHARE = 1e-10  # of an unknown's column, squared; smaller ones are rounding errors
_LOSS_MEDIANS = 2.0 * 1.4826  # loss scale of 2 standard deviations, by the median of the errors


def weighted_products(columns: Array, weights: Array) -> Array:
    """(k, k) sums over the rows of the products of each two columns, times (n,) weights."""
    flat = columns.reshape(len(columns), -1)
    return np.asarray((columns * weights).reshape(flat.shape) @ flat.T)


def solve_reweighted(
    columns: Array, loss_scale: float | None
) -> tuple[Array, Array, Array, Array] | None:
    """Iteratively reweighted least squares with a Cauchy loss on the norm of each row's error.

    Args:
        columns: (k + 1, 2, n) of the unknowns, and last the errors at zero.
        loss_scale: of the loss; None: from the median of the errors.

    Returns:
        (k,) solution; (k, k) normal matrix; (n,) weights; (2, n) errors at the solution. None if
        that matrix is singular.
    """
    errors, solution = -columns[-1], np.zeros(len(columns) - 1)
    for _ in range(_MAX_ITERATIONS):
        squares = np.einsum("pn,pn->n", errors, errors)
        scale = loss_scale or _LOSS_MEDIANS * median(squares) ** 0.5 + 1e-12
        weights = 1.0 / (1.0 + squares / scale**2)
        products = weighted_products(columns, weights)
        found = _solve(products[:-1, :-1], products[:-1, -1])
        if found is None:
            return None
        solution = found
        before, errors = errors, np.tensordot(solution, columns[:-1], 1) - columns[-1]
        if np.abs(errors - before).max() < _CONVERGED * scale:
            break
    return solution, products[:-1, :-1], weights, errors


def _solve(normal: Array, right: Array) -> Array | None:
    """(k,) solution of normal equations; None if a column is a combination of those before it."""
    scaled, units = unit_diagonal(normal)
    try:
        root = np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        return None
    if np.diag(root).min() ** 2 < _LEAST_SHARE:
        return None
    return np.asarray(np.linalg.solve(scaled, right / units) / units)


def grouped_gradients(
    columns: Array, errors: Array, weights: Array, group: NDArray[np.intp]
) -> Array:
    """(g, k) sums of weighted columns times (2, n) errors, over the rows of each (n,) group."""
    terms = np.einsum("kpn,pn->nk", columns, weights * errors)
    sums = np.zeros((group.max() + 1, len(columns)))
    np.add.at(sums, group, terms)
    return sums
