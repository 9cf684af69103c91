"""Whether a pose stands out: its score against displaced poses, over the same windows."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.matching.structure.consensus import sum_scores
from calibgraph.matching.structure.shift_scores import ShiftScores

DISPLACEMENTS_DEG, DISPLACEMENT_M = (1.2, 2.2), 0.4
"""About and along each axis: the displaced poses."""


def score_displaced(scores: ShiftScores) -> tuple[NDArray[np.int64], Array]:
    """Frames (f,), and their scores (f, n) at a pose, then at displaced poses."""
    frames, twists = np.unique(scores.frame), _displacements()
    per_frame = [sum_scores(_of_frame(scores, frame), twists) for frame in frames]
    return frames, np.array(per_frame).reshape(len(frames), len(twists))


def displaced_z_score(per_frame: Array) -> float:
    """The summed score at the pose less the mean of the displaced, in deviations of the latter."""
    own, *displaced = per_frame.sum(axis=0)
    return float((own - np.mean(displaced)) / (np.std(displaced) + 1e-12))


def _of_frame(scores: ShiftScores, frame: int) -> ShiftScores:
    rows = scores.frame == frame
    return replace(scores, grids=scores.grids[rows], jacobian=scores.jacobian[rows])


def _displacements() -> Array:
    """(n, 6) twists: none, then rotations about and shifts along each axis, both ways."""
    angles = [np.radians(angle) * sign for angle in DISPLACEMENTS_DEG for sign in (-1, 1)]
    shifts = [DISPLACEMENT_M * sign for sign in (-1, 1)]
    axes = np.eye(6)
    twists = [axes[axis] * size for axis in range(3) for size in angles]
    twists += [axes[axis] * size for axis in range(3, 6) for size in shifts]
    return np.array([np.zeros(6), *twists])
