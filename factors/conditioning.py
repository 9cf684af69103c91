"""Hessians of poses in units in which radians and metres can be compared: with a unit diagonal."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SINGULAR = 1e-12
"""Smallest over largest eigenvalue, of a unit diagonal: rounding noise."""


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
