"""Hessians of poses in units in which radians and metres can be compared: with a unit diagonal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
    scaled, units = unit_diagonal(hessian)
    along = gradient / units
    jacobian, error = np.zeros((n + 1, n)), np.zeros(n + 1)
    bordered = np.empty((n + 1, n + 1))
    bordered[:n, :n], bordered[n, :n], bordered[:n, n] = scaled, along, along
    bordered[n, n] = 2 * cost + np.finfo(np.float64).tiny  # more than the root of the rest needs
    try:
        root = np.linalg.cholesky(bordered)
        regular = np.diag(root)[:n].min() ** 2 > _REGULAR
    except np.linalg.LinAlgError:
        regular = False
    if regular:
        jacobian[:n], error[:n] = root[:n, :n].T, root[n, :n]
    else:
        values, vectors = np.linalg.eigh(scaled)
        seen = values > _SEEN * max(values[-1], 0.0)
        roots = np.sqrt(values[seen])
        jacobian[:n][seen] = roots[:, None] * vectors.T[seen]
        error[:n][seen] = vectors.T[seen] @ along / roots
    error[n] = np.sqrt(max(cost - error @ error, 0.0))
    return error, jacobian * units
