"""Hessians of poses in units in which radians and metres can be compared: with a unit diagonal."""

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled

Array = NDArray[np.float64]

_REGULAR = 1e-10  # least share of an unknown that those before it leave, for a triangular root


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
def _fill_triangular_root(scaled, along, jacobian, error):  # type: ignore[no-untyped-def]
    """Fill in Cholesky's root of a regular matrix, and the error; whether it is regular.

    Args:
        scaled: (n, n), of unit diagonal.
        along: (n,) gradient in its units.
        jacobian: (n, n + 1), filled below the diagonal.
        error: (n + 1,), all but the last filled.
    """
    for i in range(len(along)):
        error[i] = along[i]
        for j in range(i + 1):
            rest = scaled[i, j]
            for m in range(j):
                rest -= jacobian[i, m] * jacobian[j, m]
            if j < i:
                jacobian[i, j] = rest / jacobian[j, j]
                error[i] -= jacobian[i, j] * error[j]
            elif rest > _REGULAR:
                jacobian[i, i] = np.sqrt(rest)
                error[i] /= jacobian[i, i]
            else:
                return False
    return True


@compiled()
def compiled_square_root(hessian, gradient, cost):  # type: ignore[no-untyped-def]
    """(n + 1,) error and the transposed (n, n + 1) Jacobian, see ``block_sums.square_root``."""
    n = len(gradient)
    units, along, scaled = np.ones(n), np.empty(n), np.empty((n, n))
    for i in range(n):
        if hessian[i, i] > 0.0:
            units[i] = np.sqrt(hessian[i, i])
        along[i] = gradient[i] / units[i]
        for j in range(i + 1):
            scaled[i, j] = scaled[j, i] = hessian[i, j] / (units[i] * units[j])
    jacobian, error = np.zeros((n, n + 1)), np.zeros(n + 1)
    if not _fill_triangular_root(scaled, along, jacobian, error):
        jacobian, error = np.zeros((n, n + 1)), np.zeros(n + 1)
        values, vectors = np.linalg.eigh(scaled)
        for k in range(n):
            if values[k] > 1e-14 * max(values[n - 1], 0.0):
                root = np.sqrt(values[k])
                for i in range(n):
                    jacobian[i, k] = root * vectors[i, k]
                    error[k] += vectors[i, k] * along[i] / root
    rest = cost
    for i in range(n):
        rest -= error[i] * error[i]
        for k in range(n):
            jacobian[i, k] *= units[i]
    error[n] = np.sqrt(max(rest, 0.0))
    return error, jacobian
