"""The scatter of epochs, in constant memory.

Frames of a car that stands, or passes the same wall for a while, share errors. Clustering by frames
does not show it, but the sums of epochs do: they scatter more than the scatter of their frames adds
up to. Each is compared with the one before: what lasts longer is a move or a drift, not scatter.
"""

from __future__ import annotations

import math

import numpy as np

from calibgraph.arrays import Array

_FREEDOM = 6
_KEPT = 0.995  # from epoch to epoch
_UNUSUAL = 30.0  # squared sigmas of a six-vector: an epoch across a move counts for no more


def add_epoch(group: Array, score: Array, frames: float, noise: Array) -> Array:
    """(2,) number of a camera's epochs, and their squares over their frames' scatter, forgotten.

    Args:
        group: before.
        score: (6,) sum of the gradients of an epoch's frames.
        frames: how many.
        noise: (6, 6) covariance of one frame's.
    """
    squared = float(score @ np.linalg.solve(noise, score)) / max(frames, 1.0)
    return np.asarray(_KEPT * group + [1.0, min(squared, _UNUSUAL) / _FREEDOM])


def inflation(group: Array) -> float:
    """Ratio of the epochs' scatter to that of their frames, on average; at least 1.

    For alarms: after few epochs it has little bias.
    """
    epochs, squared = group.tolist()
    return max(1.0, squared / epochs) if epochs else 1.0


def sure_inflation(group: Array) -> float:
    """The lower end of the 2-sigma interval of the inflation, for the error bar."""
    epochs = max(float(group[0]), 1.0)
    return max(1.0, inflation(group) * (1 - 2 * math.sqrt(2 / (_FREEDOM * epochs))))
