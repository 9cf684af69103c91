"""Measured relative poses that contradict the correspondences: named, and of no effect."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Calibration, MatcherErrors, Rig, simulate_correspondences, solve
from calibgraph.model.error_components import error_components
from calibgraph.model.geometry import pose_difference
from calibgraph.model.perturbation import perturb
from calibgraph.trust.thresholds import threshold
from tests.conftest import make_camera, make_pair, stereo_relative_pose

TURN_DEG = 30.0  # of the relative pose that is wrong, as if cameras were exchanged


@pytest.fixture(scope="module")
def three() -> Rig:
    """Left and right, and a third camera beside them."""
    third = make_camera((0.3, -0.9, -0.1))
    return Rig(cameras={**make_pair().cameras, "third": third})


def solved(truth: Rig, wrong_deg: float, seed: int) -> Calibration:
    """With relative poses between all neighbours, that of left and right turned about v."""
    c, s = np.cos(np.radians(wrong_deg)), np.sin(np.radians(wrong_deg))
    turn = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])
    wrong = stereo_relative_pose(truth)
    wrong = wrong.model_copy(update={"T_a_b": wrong.T_a_b @ turn})
    pairs = (wrong, stereo_relative_pose(truth, "right", "third"))
    errors = MatcherErrors(outlier_share=0.1)
    table = simulate_correspondences(truth, frames=10, errors=errors, seed=seed)
    guess = perturb(truth, rotation_deg=1.0, translation_m=0.05, seed=seed)
    return solve(guess.model_copy(update={"relative_poses": pairs}), table)


def errors_deg(result: Calibration, truth: Rig) -> dict[str, float]:
    T = truth.T_camera_lidar
    return {n: pose_difference(T[n], found)[0] for n, found in result.T_camera_lidar.items()}


def test_one_that_is_wrong_is_named_and_moves_no_camera(three: Rig) -> None:
    wrong, right = (solved(three, degrees, seed=1) for degrees in (TURN_DEG, 0.0))
    for name in ("left", "right"):
        verdict = wrong.camera_verdicts[name]
        assert verdict.status == "FAIL"
        assert any("relative pose" in reason for reason in verdict.reasons)
    assert max(errors_deg(wrong, three).values()) < 0.05
    assert right.verdict.status == "PASS"
    assert wrong.camera_verdicts["third"].status != "FAIL"


def test_the_limit_is_that_of_the_verdict() -> None:
    assert error_components().contradiction_sigmas == threshold("relative_pose").fail
