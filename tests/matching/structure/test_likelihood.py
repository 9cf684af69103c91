"""The likelihood of a pose by its scores."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph.matching.structure.consensus import CHANCE_VARIANCE, log_likelihood, z_score
from tests.matching.structure.score_grids import make_scores

HERE, BESIDE = np.zeros(6), np.array([0.0, np.radians(2.2), 0.0, 0.0, 0.0, 0.0])


def test_its_logarithm_falls_by_z_squared_from_the_pose_to_one_that_only_chance_favours() -> None:
    scores = make_scores(HERE, outlier_share=0.3)
    at, beside = log_likelihood(scores)(np.array([HERE, BESIDE]))
    assert at - beside == pytest.approx(z_score(scores, HERE) ** 2 / CHANCE_VARIANCE, rel=0.1)


def test_groups_that_agree_on_nothing_leave_it_nearly_flat() -> None:
    agreeing, others = (make_scores(HERE, outlier_share=share) for share in (0.3, 1.0))
    twists = np.array([HERE, BESIDE, -BESIDE])
    sharp, flat = (np.ptp(log_likelihood(scores)(twists)) for scores in (agreeing, others))
    assert flat < sharp / 50
