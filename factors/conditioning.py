"""Hessians of poses in units in which radians and metres can be compared: with a unit diagonal."""

import math

import numpy as np
from numpy.typing import NDArray

from factors.compiled import compiled

Array = NDArray[np.float64]

SINGULAR = 1e-12
"""Smallest over largest eigenvalue, of a unit diagonal: rounding noise."""
REGULAR = 1e-10
"""Least share of an unknown that those before it leave, for a triangular root."""


def unit_diagonal(hessian: Array) -> tuple[Array, Array]:
    """Scale a positive semidefinite matrix to a unit diagonal; rows without information stay zero.

    Args:
        hessian: (..., n, n).

    Returns:
        (..., n, n) scaled = hessian / (units units^T), and (..., n) units.
    """
    diagonal = np.sqrt(np.maximum(np.diagonal(hessian, axis1=-2, axis2=-1), 0.0))
    units = np.where(diagonal > 0, diagonal, 1.0)
    return hessian / (units[..., :, None] * units[..., None, :]), units


def smallest_scaled_eigenvalues(hessians: Array) -> Array:
    """(f,) of (f, n, n) positive semidefinite matrices, scaled to a unit diagonal.

    1 if no unknowns are correlated, 0 if one is free. Rounding noise of a singular one is near
    1e-15.
    """
    scaled, _ = unit_diagonal(hessians)
    known = (np.diagonal(scaled, axis1=1, axis2=2) > 0).all(axis=1)
    return np.where(known, np.linalg.eigvalsh(scaled)[:, 0], 0.0)


def invert_or_none(hessian: Array, *, least: float = SINGULAR) -> Array | None:
    """The inverse of a positive semidefinite matrix, None where a direction is not determined.

    ``least`` is the smallest eigenvalue, of a unit diagonal, over the largest.
    """
    scaled, units = unit_diagonal(hessian)
    values, vectors = np.linalg.eigh(scaled)
    if values[0] <= least * values[-1]:
        return None
    inverse: Array = (vectors / values) @ vectors.T / np.outer(units, units)
    return inverse


@compiled()
def fill_root(hessian, gradient, cost, error, jacobian):  # type: ignore[no-untyped-def]
    """Fill the (n + 1,) error and transposed Jacobian of ``arrays.square_root``, by Cholesky.

    Args:
        hessian: (n, n) H.
        gradient: (n,) b.
        cost: c.
        error: (n + 1,).
        jacobian: (n, n + 1), of zeros.

    Returns:
        Whether H is regular; if it is not, both mean nothing.
    """
    n = len(hessian)
    for i in range(n):
        square = hessian[i, i]
        unit = math.sqrt(square) if square > 0.0 else 1.0
        along, jacobian[i, n] = gradient[i] / unit, unit  # for a while
        for j in range(i + 1):
            rest = hessian[j, i] / (unit * jacobian[j, n])
            for m in range(j):
                rest -= jacobian[i, m] * jacobian[j, m]
            if j < i:
                rest /= jacobian[j, j]
                along -= rest * error[j]
            elif rest > REGULAR:
                rest = math.sqrt(rest)
                along /= rest
            else:
                return False
            jacobian[i, j] = rest
        error[i] = along
        cost -= along * along
    for i in range(n):
        for j in range(i + 1):
            jacobian[i, j] *= jacobian[i, n]
        jacobian[i, n] = 0.0
    error[n] = math.sqrt(cost) if cost > 0.0 else 0.0
    return True
