"""Noise in constant memory: the residuals of all frames, and the scatter of epochs.

Frames of a car that stands, or passes the same wall for a while, share errors. Clustering by frames
does not show it, but the sums of groups of frames do: they scatter more than the scatter of their
frames adds up to, in some directions of the extrinsic. Groups of one epoch and of eight are
compared, each with the one before: what lasts longer is a move or a drift, not scatter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from calibgraph.arrays import Array
from calibgraph.model.config import Config
from calibgraph.solver.matches import BlockResiduals
from calibgraph.solver.robust import ResidualScale, iterate_spread, scale_from
from calibgraph.tracking.cause import squared_sigmas

_EDGES = np.concatenate([[0.0], np.geomspace(1e-5, 1e5, 2304)])  # 1 % wide
_RESIDUALS_KEPT = 1 - 1 / 2000  # from frame to frame


@dataclass(frozen=True, eq=False)
class ResidualHistogram:
    """Histogram of the sizes of a camera's residuals, slowly forgotten.

    Attributes:
        counts: (2, b) of the unweighted ones [px], and of the whitened ones.
        least: lower bound of the whitened spread.
    """

    counts: Array = field(default_factory=lambda: np.zeros((2, len(_EDGES) - 1)))
    least: float = 0.0

    def add(self, residuals: BlockResiduals) -> ResidualHistogram:
        """The histogram with the residuals of one or more frames counted, in their order."""
        (sizes_px, sizes), frames = residuals.sizes, residuals.block.frames
        kept = _RESIDUALS_KEPT ** np.arange(frames - 1.0, -1.0, -1.0)
        weights = np.repeat(kept, residuals.block.frame_counts)[residuals.projectable]
        counted = _counted(sizes_px, weights)
        new = [counted, counted if sizes is sizes_px else _counted(sizes, weights)]
        before = _RESIDUALS_KEPT**frames * self.counts
        return ResidualHistogram(before + new, residuals.block.least_spread)

    def scale(self, config: Config) -> ResidualScale:
        """The scale of all the residuals, as by :meth:`CameraBlock.scale`."""
        of_px, whitened = self.counts
        sigma_px = spread = iterate_spread(_Quantiles(of_px))
        if not np.array_equal(of_px, whitened):
            spread = iterate_spread(_Quantiles(whitened))
        return scale_from(sigma_px, max(spread, self.least), config)


def median(values: Array) -> float:
    """The median of at least one number; ``np.median`` takes ten times as long for some hundred."""
    ordered, half = np.sort(values), len(values) // 2
    return float(ordered[half] if len(values) % 2 else (ordered[half - 1] + ordered[half]) / 2)


def _counted(sizes: Array, weights: Array) -> Array:
    places = np.searchsorted(_EDGES, sizes, side="right") - 1
    counts = np.bincount(np.minimum(places, len(_EDGES) - 2), weights, len(_EDGES) - 1)
    return counts.astype(np.float64)


class _Quantiles:
    """Quantiles of the values that a histogram has counted, linear within its bins."""

    def __init__(self, counts: Array) -> None:
        self._cumulative = np.concatenate([[0.0], np.cumsum(counts)])

    def __call__(self, limit: float, share: float) -> float:
        below = float(np.interp(limit, _EDGES, self._cumulative))
        return float(np.interp(share * below, self._cumulative, _EDGES)) if below else math.nan


SPANS = (1, 8)
"""Epochs of a group."""

_FREEDOM = 6
_LEAST_GROUPS = 6.0  # for a scatter direction by direction
_KEPT = 0.995  # from group to group
_CHANCE = 1.25  # times what the largest eigenvalue reaches by chance
_UNUSUAL = 30.0  # squared sigmas of a six-vector: a group across a move counts for no more


@dataclass(frozen=True, eq=False)
class GroupScatter:
    """Sums of the gradients of groups of frames.

    Attributes:
        span: epochs of a group.
        scatter: (6, 6) of one frame's gradient, from groups: sum, over pairs of neighbours, of the
            outer product of their difference, each over the root of its frames.
        count: of pairs, slowly forgotten.
        last: (6,) of the last complete group, or None.
        size: sum of the groups' own squares, in units of their frames' scatter.
        open_sum: (6,) of the incomplete group.
        open_frames, open_epochs: its size.
    """

    span: int
    scatter: Array = field(default_factory=lambda: np.zeros((6, 6)))
    count: float = 0.0
    last: Array | None = None
    size: float = 0.0
    open_sum: Array = field(default_factory=lambda: np.zeros(6))
    open_frames: int = 0
    open_epochs: int = 0

    def add(self, score: Array, frames: int, noise: Array) -> GroupScatter:
        """The sums with an epoch's (6,) gradient; noise: (6, 6) covariance of one frame's."""
        total, number = self.open_sum + score, self.open_frames + frames
        if self.open_epochs + 1 < self.span:
            more = self.open_epochs + 1
            return replace(self, open_sum=total, open_frames=number, open_epochs=more)
        scaled = total / np.sqrt(max(number, 1))
        size = _KEPT * self.size + min(squared_sigmas(scaled, noise), _UNUSUAL) / len(noise)
        if self.last is None:
            return replace(GroupScatter(self.span), last=scaled, size=size)
        apart = (scaled - self.last) / np.sqrt(2)
        apart = apart * min(1.0, np.sqrt(_UNUSUAL / max(squared_sigmas(apart, noise), 1e-12)))
        return GroupScatter(
            self.span,
            scatter=_KEPT * self.scatter + np.outer(apart, apart),
            count=_KEPT * self.count + 1,
            last=scaled,
            size=size,
        )


def no_groups() -> tuple[GroupScatter, ...]:
    """No sums, for each span."""
    return tuple(GroupScatter(span) for span in SPANS)


def inflation(groups: Sequence[GroupScatter]) -> float:
    """Ratio of the epochs' scatter to that of their frames, on average; at least 1.

    For alarms: after few epochs it has little bias.
    """
    epochs = groups[0]
    return max(1.0, epochs.size / (epochs.count + 1)) if epochs.last is not None else 1.0


def _sure_inflation(groups: Sequence[GroupScatter]) -> float:
    """The lower end of the 2-sigma interval of the inflation."""
    count = groups[0].count + 1
    return max(1.0, inflation(groups) * (1 - 2 * math.sqrt(2 / (_FREEDOM * count))))


def widening(groups: Sequence[GroupScatter], noise: Array) -> Array:
    """(6, 6) T that scales gradients so that T noise T^T is the scatter of groups.

    For the error bar, only what exceeds chance: in all directions alike, or direction by direction
    for one of the spans, whichever has the largest determinant.

    Args:
        groups: of one camera.
        noise: (6, 6) covariance of one frame's gradient, by the scatter of frames.
    """
    root = np.linalg.cholesky(noise)
    inverse = np.linalg.inv(root)
    alike = _sure_inflation(groups)
    widest, most = np.eye(_FREEDOM) * np.sqrt(alike), alike ** (_FREEDOM / 2)
    for one in groups:
        if one.count < _LEAST_GROUPS:
            continue
        ratio = inverse @ (one.scatter / one.count) @ inverse.T
        values, vectors = np.linalg.eigh((ratio + ratio.T) / 2)
        chance = _CHANCE * (1 + np.sqrt(_FREEDOM / one.count)) ** 2
        factors = np.sqrt(np.maximum(values / chance, 1.0))
        if np.prod(factors) > most:
            most = float(np.prod(factors))
            widest = root @ (vectors * factors) @ vectors.T @ inverse
    return np.asarray(widest)
