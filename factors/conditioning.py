"""Hessians of poses in units in which radians and metres can be compared: with a unit diagonal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled

Array = NDArray[np.float64]


def unit_diagonal(hessian: Array) -> tuple[Array, Array]:
    """Scale a positive semidefinite matrix to a unit diagonal; rows without information stay zero.

    Args:
        hessian: (n, n).

    Returns:
        (n, n) scaled = hessian / (units units^T), and (n,) units.
    """
    diagonal = np.sqrt(np.maximum(np.diag(hessian), 0.0))
    units = np.where(diagonal > 0, diagonal, 1.0)
    return hessian / np.outer(units, units), units


def smallest_scaled_eigenvalue(hessian: Array) -> float:
    """Of the matrix scaled to a unit diagonal: 1 if no unknowns are correlated, 0 if one is free.

    Rounding noise of a singular matrix is near 1e-15.

    Args:
        hessian: (n, n), positive semidefinite.
    """
    return float(smallest_scaled_eigenvalues(hessian[None])[0])


def smallest_scaled_eigenvalues(hessians: Array) -> Array:
    """(f,) :func:`smallest_scaled_eigenvalue` of each of (f, n, n) matrices."""
    diagonals = np.einsum("fii->fi", hessians)
    known = (diagonals > 0).all(axis=1)
    units = np.sqrt(np.where(known[:, None], diagonals, 1.0))
    values = np.linalg.eigvalsh(hessians / (units[:, :, None] * units[:, None, :]))
    return np.where(known, values[:, 0], 0.0)


@compiled()
def compiled_square_root(hessian, gradient, cost):  # type: ignore[no-untyped-def]
    """(n + 1,) error and the transposed (n, n + 1) Jacobian, see ``block_sums.square_root``."""
    n = len(gradient)
    units, scaled = np.ones(n), np.empty((n, n))
    for i in range(n):
        if hessian[i, i] > 0.0:
            units[i] = np.sqrt(hessian[i, i])
    for i in range(n):
        for j in range(n):
            scaled[i, j] = hessian[i, j] / (units[i] * units[j])
    values, vectors = np.linalg.eigh(scaled)
    jacobian, error = np.zeros((n, n + 1)), np.zeros(n + 1)
    rest = cost
    for k in range(n):
        if values[k] > 1e-14 * max(values[n - 1], 0.0):
            root, along = np.sqrt(values[k]), 0.0
            for i in range(n):
                jacobian[i, k] = root * vectors[i, k] * units[i]
                along += vectors[i, k] * gradient[i] / units[i]
            error[k] = along / root
            rest -= error[k] * error[k]
    error[n] = np.sqrt(max(rest, 0.0))
    return error, jacobian
