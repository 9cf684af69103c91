"""How large a camera's residuals are, over all its frames, in constant memory: a histogram."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibgraph.model.config import Config
from calibgraph.solver.camera_block import CameraBlock
from calibgraph.solver.residual_scale import ResidualScale, iterate_spread, scale_from

Array = NDArray[np.float64]

_EDGES = np.concatenate([[0.0], np.geomspace(1e-5, 1e5, 2304)])  # 1 % wide
_KEPT = 1 - 1 / 2000  # from frame to frame


@dataclass(frozen=True, eq=False)
class Spread:
    """Counts of the sizes of residuals, slowly forgotten.

    Attributes:
        counts: (2, b) of the unweighted ones [px], and of the whitened ones.
        least: whitened spread below which the scale does not shrink.
    """

    counts: Array = field(default_factory=lambda: np.zeros((2, len(_EDGES) - 1)))
    least: float = 0.0

    def plus(self, matches: CameraBlock, T_camera_lidar: Array) -> Spread:
        """With a frame's residuals counted."""
        new = [_counted(sizes) for sizes in matches.sizes(T_camera_lidar)]
        return Spread(_KEPT * self.counts + new, matches.least_spread)

    def scale(self, config: Config) -> ResidualScale:
        """The scale of all the residuals, as ``Matches.scale`` would find it."""
        sigma_px, spread = (iterate_spread(_Quantiles(counts)) for counts in self.counts)
        return scale_from(sigma_px, max(spread, self.least), config)


def _counted(sizes: Array) -> Array:
    places = np.searchsorted(_EDGES, sizes, side="right") - 1
    counts = np.bincount(np.minimum(places, len(_EDGES) - 2), minlength=len(_EDGES) - 1)
    return counts.astype(np.float64)


class _Quantiles:
    """Quantiles of the values that a histogram has counted, linear within its bins."""

    def __init__(self, counts: Array) -> None:
        self._cumulative = np.concatenate([[0.0], np.cumsum(counts)])

    def __call__(self, limit: float, share: float) -> float:
        below = float(np.interp(limit, _EDGES, self._cumulative))
        return float(np.interp(share * below, self._cumulative, _EDGES)) if below else math.nan
