"""Significant, confident and detectable deviations: quantiles of Student's t, per axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri, stdtrit

from calibgraph.arrays import Array, Mask

FALSE_ALARM_RATE = 1e-3
"""Probability of a significant axis on a rig, of all its cameras, that has not changed."""

POWER = 0.9
"""Probability with which the smallest detectable change is told from none."""

CONFIDENCE = 0.95
"""Probability that an axis that counts as within the tolerance is."""

DISPLAY = np.array([180 / np.pi] * 3 + [100.0] * 3)
"""From a twist [rad, m] to [deg, cm]."""


@dataclass(frozen=True)
class Tolerance:
    """The largest turn and the largest shift that are OK, whatever their axes.

    Raises:
        ValueError: if one is not positive.
    """

    degrees: float
    centimetres: float

    def __post_init__(self) -> None:
        for value, option in ((self.degrees, "tolerance_deg"), (self.centimetres, "tolerance_cm")):
            if not 0 < value < np.inf:
                raise ValueError(f"{option} must be positive and finite, found {value}")

    @property
    def twist(self) -> Array:
        """(2,) rotation [rad], translation [m]."""
        return np.asarray(np.array([self.degrees, self.centimetres]) / DISPLAY[::3])


def axes_beyond(deviation: Array, significant: Mask, tolerance: Array) -> Mask:
    """(..., 6) True for the significant axes of a turn or a shift that are too large together.

    Args:
        deviation: (..., 6) rotation and translation.
        significant: (..., 6) the axes that count.
        tolerance: (2,) largest turn and shift.
    """
    parts = np.where(significant, deviation, 0.0).reshape(*deviation.shape[:-1], 2, 3)
    is_large = np.linalg.norm(parts, axis=-1) > tolerance
    return np.asarray(significant & np.repeat(is_large, 3, axis=-1))


@dataclass(frozen=True, eq=False)
class Quantiles:
    """Significant and confident numbers of sigmas, by the degrees of freedom of the sigmas.

    Attributes:
        significant: (6,) the largest deviation by chance.
        confident: (6,) the upper bound of an error with probability CONFIDENCE.
    """

    significant: Array
    confident: Array

    @classmethod
    def from_freedom(cls, freedom: ArrayLike, tail: float) -> Quantiles:
        """Quantiles of Student's t.

        Args:
            freedom: degrees of freedom of the sigmas, (6,) or of all; infinite where known.
            tail: probability of a larger deviation by chance, to either side.
        """
        freedom = np.broadcast_to(np.asarray(freedom, np.float64), 6)
        return cls(-stdtrit(freedom, tail), stdtrit(freedom, CONFIDENCE))

    def beside_known(self, share: Array, known: Quantiles) -> Quantiles:
        """Quantiles of a variance that is estimated in part: squares add up (after Cochran).

        It errs on the side of fewer alarms: a quarter of the stated ones if the shares are alike.

        Args:
            share: (6,) of the variances that is estimated.
            known: quantiles of the rest.
        """
        pairs = (self.significant, known.significant), (self.confident, known.confident)
        return Quantiles(*(np.sqrt(share * a**2 + (1 - share) * b**2) for a, b in pairs))


def tail_of_axis(cameras: int) -> float:
    """Probability of a significant deviation by chance, of one of six axes, to either side."""
    return FALSE_ALARM_RATE / (2 * 6 * cameras)


def detectable(sigma: Array, quantile: float | Array) -> Array:
    """(6,) the smallest change per axis that is beyond a quantile with probability POWER.

    Args:
        sigma: (6,) standard deviations.
        quantile: how many of them count, per axis or of all.
    """
    return np.asarray((quantile + float(ndtri(POWER))) * sigma)
