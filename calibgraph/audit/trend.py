"""The slope of measured deviations over time, or over any other number."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array

_NONE = 1e-9  # relative eigenvalue of the information about a slope that is rounding


@dataclass(frozen=True, eq=False)
class Slope:
    """A change per unit.

    Attributes:
        change: (6,) rotation [rad], translation [m], per unit.
        covariance: (6, 6) of it.
    """

    change: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """(6,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def squared_sigmas(self) -> float:
        """Decrease of chi-squared by the slope, relative to constant means."""
        return float(self.change @ np.linalg.solve(self.covariance, self.change))


def fit_slope(x: Array, batch: NDArray[np.intp], information: Array, y: Array) -> Slope | None:
    """The slope of deviations over x, within batches, by generalised least squares.

    Each batch has its own centre, so that a change between batches is no slope.

    Args:
        x: (n,) where each was measured; NaN where that is not known.
        batch: (n,) number of the batch of each.
        information: (n, 6, 6) inverse covariances.
        y: (n, 6) deviations.

    Returns:
        None where x does not vary.
    """
    known = np.isfinite(x)
    hessian, right = np.zeros((6, 6)), np.zeros(6)
    unit = float(np.std(x[known])) if known.any() else 0.0
    for number in np.unique(batch[known]) if unit > 0 else ():
        rows = known & (batch == number)
        W, scaled = information[rows], (x[rows] - x[rows].mean()) / unit
        total, first = W.sum(axis=0), np.einsum("n,nij->ij", scaled, W)
        Wy = np.einsum("nij,nj->ni", W, y[rows])
        share = np.linalg.solve(total, np.column_stack([first, Wy.sum(axis=0)]))
        hessian += np.einsum("n,nij->ij", scaled**2, W) - first @ share[:, :6]
        right += scaled @ Wy - first @ share[:, 6]
    values = np.linalg.eigvalsh(hessian)
    if values[0] <= _NONE * max(values[-1], 1e-300):
        return None
    covariance = np.asarray(np.linalg.inv(hessian), dtype=np.float64)
    return Slope(covariance @ right / unit, covariance / unit**2)
