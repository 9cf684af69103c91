"""The images' evidence as a likelihood of poses: of fine scores, against chance.

Among unrelated shifts the summed score scatters by ``chance_sigma``; at the true pose it is z of
these higher. For noise of that size the logarithm of the likelihood is z times the score, in
``chance_sigma``. What windows of a frame and frames of a place share makes the noise larger.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calibgraph.arrays import Array
from calibgraph.matching.structure.consensus import sum_scores, z_score
from calibgraph.matching.structure.schedule import LEVELS
from calibgraph.matching.structure.shift_scores import ShiftScores

FAR = replace(LEVELS[3], reach_rad=np.radians(2.0), weighed=False)
"""A fine level that reaches as far as rounds may end off. Coarse levels only propose poses: they
prefer some a degree off where fine ones are flat, as on grass slopes."""

CHANCE_VARIANCE = 3.0
"""Variance of the summed score over that of independent windows: what windows of a frame and frames
of a place share. With it the errors of a KITTI rig, of a car with six cameras and of a 16-beam
LiDAR are likeliest under the error bars that it leads to; without any one of them it is 3 or 4."""


def log_likelihood(scores: ShiftScores) -> Callable[[Array], Array]:
    """The (n,) logarithms of the likelihood of twists (n, 6) from the pose of the scores.

    Args:
        scores: of one camera, at ``FAR``, about the pose in question.
    """
    if not len(scores.weights):
        return lambda twists: np.zeros(len(twists))
    amplitude = max(z_score(scores, np.zeros(6)), 0.0)
    factor = amplitude / (CHANCE_VARIANCE * (scores.chance_sigma + 1e-12))
    return lambda twists: factor * sum_scores(scores, twists)
