"""Hessians of poses in units in which radians and metres can be compared: with a unit diagonal."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled

Array = NDArray[np.float64]

_REGULAR = 1e-10  # least share of an unknown that those before it leave, for a triangular root
_SEEN = 1e-14  # of the largest eigenvalue: below, a direction has no information


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


def square_root(hessian: Array, gradient: Array, cost: float) -> tuple[Array, Array]:
    """(n + 1,) error and (n + 1, n) Jacobian of sums, see ``block_sums.square_root``."""
    n = len(gradient)
    error, jacobian, units = np.zeros(n + 1), np.zeros((n, n + 1)), np.ones(n)
    if not _fill_triangular_root(hessian, gradient, units, jacobian, error):
        jacobian[:], error[:] = 0.0, 0.0
        values, vectors = np.linalg.eigh(unit_diagonal(hessian)[0])
        seen = np.flatnonzero(values > _SEEN * max(values[-1], 0.0))
        roots, vectors = np.sqrt(values[seen]), vectors[:, seen]
        jacobian[:, seen] = roots * vectors
        error[seen] = (gradient / units) @ vectors / roots
    error[n] = math.sqrt(max(cost - float(error @ error), 0.0))
    return error, (units[:, None] * jacobian).T


@compiled()
def _fill_triangular_root(hessian, gradient, units, jacobian, error):  # type: ignore[no-untyped-def]
    """Fill in Cholesky's root of a regular matrix, and the error; whether it is regular.

    Args:
        hessian: (n, n).
        gradient: (n,).
        units: (n,), filled: of a unit diagonal.
        jacobian: (n, n + 1), filled below the diagonal, in these units.
        error: (n + 1,), all but the last filled.
    """
    for i in range(len(gradient)):
        if hessian[i, i] > 0.0:
            units[i] = math.sqrt(hessian[i, i])
    for i in range(len(gradient)):
        error[i] = gradient[i] / units[i]
        for j in range(i + 1):
            rest = hessian[i, j] / (units[i] * units[j])
            for m in range(j):
                rest -= jacobian[i, m] * jacobian[j, m]
            if j < i:
                jacobian[i, j] = rest / jacobian[j, j]
                error[i] -= jacobian[i, j] * error[j]
            elif rest > _REGULAR:
                jacobian[i, i] = math.sqrt(rest)
                error[i] /= jacobian[i, i]
            else:
                return False
    return True
