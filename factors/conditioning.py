"""Hessians of poses in units in which radians and metres can be compared: with a unit diagonal."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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
    if not (np.diag(hessian) > 0).all():
        return 0.0
    return float(np.linalg.eigvalsh(unit_diagonal(hessian)[0])[0])
