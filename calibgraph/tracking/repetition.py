"""Do neighbouring frames repeat each other's errors? Then they are fewer than they seem.

Frames of a car that stands, or passes the same wall for a while, share errors. Clustering by frames
does not see it; the sums of whole groups of frames do: they scatter more than their frames' scatter
adds up to, in some directions of the pose. Groups of an epoch and of eight are compared, each with
the one before: what lasts longer is a move or a drift, not scatter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SPANS = (1, 8)
"""Epochs of a group."""

_FREEDOM = 6
_LEAST_GROUPS = 6.0  # before which it is not known how they scatter, direction by direction
_KEPT = 0.995  # from group to group
_CHANCE = 1.25  # times what the largest eigenvalue reaches by chance
_UNUSUAL = 30.0  # squared sigmas of a six-vector: a group across a move counts for no more


@dataclass(frozen=True, eq=False)
class Groups:
    """Sums of the gradients of groups of frames.

    Attributes:
        span: epochs of a group.
        scatter: (6, 6) of one frame's gradient by the groups: sum, over pairs of neighbours, of the
            outer product of their difference, each over the root of its frames.
        count: of pairs, slowly forgotten.
        last: (6,) of the last complete group, or None.
        size: sum of the groups' own squares, in units of what their frames say.
        open_sum: (6,) of the group that is not complete.
        open_frames, open_epochs: how much there is in it.
    """

    span: int
    scatter: Array = field(default_factory=lambda: np.zeros((6, 6)))
    count: float = 0.0
    last: Array | None = None
    size: float = 0.0
    open_sum: Array = field(default_factory=lambda: np.zeros(6))
    open_frames: int = 0
    open_epochs: int = 0

    def plus(self, score: Array, frames: int, noise: Array) -> Groups:
        """With an epoch's (6,) summed gradient; (6, 6) noise is that of one frame."""
        total, number = self.open_sum + score, self.open_frames + frames
        if self.open_epochs + 1 < self.span:
            more = self.open_epochs + 1
            return replace(self, open_sum=total, open_frames=number, open_epochs=more)
        scaled = total / np.sqrt(max(number, 1))
        size = _KEPT * self.size + min(_squared(scaled, noise), _UNUSUAL) / len(noise)
        if self.last is None:
            return replace(Groups(self.span), last=scaled, size=size)
        apart = (scaled - self.last) / np.sqrt(2)
        apart = apart * min(1.0, np.sqrt(_UNUSUAL / max(_squared(apart, noise), 1e-12)))
        return Groups(
            self.span,
            scatter=_KEPT * self.scatter + np.outer(apart, apart),
            count=_KEPT * self.count + 1,
            last=scaled,
            size=size,
        )


def none_seen() -> tuple[Groups, ...]:
    """Before the first epoch."""
    return tuple(Groups(span) for span in SPANS)


def _squared(score: Array, noise: Array) -> float:
    return float(score @ np.linalg.solve(noise, score))


def inflation(groups: Sequence[Groups]) -> float:
    """How much more the sums of epochs scatter than their frames say, on average; at least 1.

    For alarms: it is known soon and errs little either way.
    """
    epochs = groups[0]
    return max(1.0, epochs.size / (epochs.count + 1)) if epochs.last is not None else 1.0


def _sure_inflation(groups: Sequence[Groups]) -> float:
    """The inflation at the lower end of its 2-sigma range: it may be chance otherwise."""
    count = groups[0].count + 1
    return max(1.0, inflation(groups) * (1 - 2 * math.sqrt(2 / (_FREEDOM * count))))


def widening(groups: Sequence[Groups], noise: Array) -> Array:
    """(6, 6) T by which gradients are widened, so that T noise T^T is what groups show.

    For the error bar, by what is more than chance: in all directions alike, or direction by
    direction for one of the spans, whichever is the widest.

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
