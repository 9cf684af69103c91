from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibgraph.matching.structure.consensus import find_consensus, sum_scores
from calibgraph.matching.structure.schedule import LEVELS
from tests.matching.structure.score_grids import make_scores


def test_consensus_finds_the_twist_among_outliers() -> None:
    twist = np.array([0.01, -0.015, 0.008, 0.05, -0.08, 0.06])
    scores = make_scores(twist, outlier_share=0.5)
    found, z_score = find_consensus(scores, LEVELS[0], seed=0)
    off_steps = np.abs(scores.jacobian @ (found - twist)).max()
    assert off_steps < 1.0  # grid step: the groups' own peaks do the rest
    assert z_score > 15


def test_further_unknowns_are_found_with_the_twist() -> None:
    """Also one that a translation beyond the search makes up for: 3 m ahead at 40 steps per m."""
    truth = np.array([0.01, -0.015, 0.008, 0.05, -0.08, 0.06, 1.0, 0.0])
    scores = make_scores(truth, outlier_share=0.5)
    jacobian = scores.jacobian.copy()
    jacobian[:, :, 7] = 60.0 * scores.jacobian[:, :, 3] / 40.0 + 0.02 * scores.jacobian[:, :, 7]
    found, z_score = find_consensus(replace(scores, jacobian=jacobian), LEVELS[0], seed=0)
    assert np.abs(jacobian @ (found - truth)).max() < 1.0
    assert abs(found[6] - 1.0) < 0.1
    assert z_score > 15


def test_consensus_of_outliers_alone_has_a_low_z_score() -> None:
    scores = make_scores(np.zeros(6), outlier_share=1.0)
    _, z_score = find_consensus(scores, LEVELS[0], seed=0)
    assert z_score < 8


def test_summed_score_interpolates() -> None:
    scores = make_scores(np.zeros(6), outlier_share=0.0)
    scores = replace(scores, jacobian=np.tile(np.eye(2, 6), (300, 1, 1)))
    here, between, there = sum_scores(scores, np.eye(6)[[0, 0, 0]] * [[0.0], [0.5], [1.0]])
    assert between == pytest.approx((here + there) / 2)
