from __future__ import annotations

import numpy as np

from calibgraph.matching.structure.consensus import displaced_z_score, score_displaced
from calibgraph.matching.structure.pose_refinement import STANDING_OUT
from tests.matching.structure.score_grids import make_scores


def test_a_pose_stands_out_where_most_groups_agree_on_it() -> None:
    frames, per_frame = score_displaced(make_scores(np.zeros(6), outlier_share=0.3))
    assert frames.tolist() == [0] and per_frame.shape == (1, 1 + 3 * 4 + 3 * 2)
    assert displaced_z_score(per_frame) > STANDING_OUT
    assert per_frame[0].argmax() == 0


def test_a_pose_beside_the_one_that_groups_agree_on_does_not_stand_out() -> None:
    displaced = np.array([0.0, np.radians(2.2), 0.0, 0.0, 0.0, 0.0])
    _, per_frame = score_displaced(make_scores(displaced, outlier_share=0.3))
    assert displaced_z_score(per_frame) < 1.0
    assert per_frame[0].argmax() != 0


def test_a_pose_among_groups_that_agree_on_nothing_does_not_stand_out() -> None:
    _, per_frame = score_displaced(make_scores(np.zeros(6), outlier_share=1.0))
    assert displaced_z_score(per_frame) < STANDING_OUT
