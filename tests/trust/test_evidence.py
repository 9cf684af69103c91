"""The error bar of a result."""

from __future__ import annotations

import numpy as np

from calibgraph import Rig, solve
from tests.trust.conftest import simulated


def test_the_covariance_has_full_rank_with_fewer_frames_than_numbers(mixed_rig: Rig) -> None:
    result = solve(mixed_rig, simulated(mixed_rig, frames=5))
    assert result.joint_covariance is not None
    assert np.linalg.eigvalsh(result.joint_covariance)[0] > 0


def test_too_few_frames_give_no_error_bar(pair: Rig) -> None:
    result = solve(pair, simulated(pair, frames=4))
    assert result.covariance == {"left": None, "right": None}
    assert not result.pair_covariance and result.sigmas("left->right") is None
    assert any("too few to give an error bar" in reason for reason in result.verdict.reasons)
