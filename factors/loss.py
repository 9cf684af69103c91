"""Robust losses rho(s) of the squared whitened residual s, scaled so that rho(s) ~ s for small s.

All are concave in s with rho(0) = 0, as the lossless block factor needs
(``factors.block``). That includes Tukey's: it rises to its bound and stays there; its weight is
exactly zero beyond, so far outliers do not pull at all, and a start from which *every* residual is
beyond the bound gives no gradient and cannot be improved. Start such a solve with Cauchy.
"""

import math
from typing import Literal, get_args

import gtsam

from factors.compiled import compiled

LossName = Literal["l2", "huber", "cauchy", "geman_mcclure", "tukey"]
LOSSES: tuple[LossName, ...] = get_args(LossName)

L2, HUBER, CAUCHY, GEMAN_MCCLURE, TUKEY = range(len(LOSSES))
_IDS: dict[str, int] = {name: number for number, name in enumerate(LOSSES)}


def loss_id(name: str) -> int:
    """Number of a loss for the kernels.

    Raises:
        ValueError: if there is no such loss.
    """
    try:
        return _IDS[name]
    except KeyError:
        raise ValueError(f"unknown robust loss {name!r}; known are {', '.join(LOSSES)}") from None


@compiled(forceinline=True)  # so that all kernels hold the same code of it
def loss_and_weight(loss, scale, s):  # type: ignore[no-untyped-def]
    """Return rho(s) and psi = rho'(s); ``scale`` is the residual norm at which the loss bends."""
    if loss == L2:
        return s, 1.0
    k = scale * scale
    if loss == CAUCHY:  # the paper's: rho(s) = delta^2 log(1 + s / delta^2)
        return k * math.log1p(s / k), 1.0 / (1.0 + s / k)
    if loss == HUBER:
        if s <= k:
            return s, 1.0
        r = math.sqrt(s)
        return 2.0 * scale * r - k, scale / r
    if loss == GEMAN_MCCLURE:
        w = 1.0 / (1.0 + s / k)
        return s * w, w * w
    if s > k:  # Tukey
        return k / 3.0, 0.0
    w = 1.0 - s / k
    return k / 3.0 * (1.0 - w * w * w), w * w


@compiled(forceinline=True)
def weight_along(loss, scale, s, psi):  # type: ignore[no-untyped-def]
    """Return psi + 2 psi' s: the second derivative of rho / 2 along the residual."""
    k = scale * scale
    if loss == CAUCHY:
        return psi - 2.0 * psi * psi * s / k
    if loss == HUBER:
        return 1.0 if s <= k else 0.0
    if loss == GEMAN_MCCLURE:
        return psi - 4.0 * psi * math.sqrt(psi) * s / k
    if loss == TUKEY:
        return psi - 4.0 * math.sqrt(psi) * s / k
    return psi


def robust_noise(
    base: gtsam.noiseModel.Gaussian, *, loss: str, scale: float
) -> gtsam.noiseModel.Base:
    """Wrap a Gaussian noise model in GTSAM's stock robust model of the same loss."""
    estimators = gtsam.noiseModel.mEstimator
    makers = (None, estimators.Huber, estimators.Cauchy, estimators.GemanMcClure, estimators.Tukey)
    maker = makers[loss_id(loss)]
    return base if maker is None else gtsam.noiseModel.Robust.Create(maker.Create(scale), base)
