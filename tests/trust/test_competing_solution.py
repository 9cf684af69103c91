from __future__ import annotations

import numpy as np
import pytest

import calibgraph
from calibgraph import MatcherErrors, Rig, concatenate, solve
from calibgraph.solver.joint import solve_joint
from calibgraph.trust.competing_solution import check_competing_solution
from tests.trust.conftest import named, simulated


def test_a_competing_solution_of_the_matches_is_found(pair: Rig) -> None:
    """60 % agree on a wrong extrinsic, 40 % on the right one, which the check names."""
    wrong = calibgraph.perturb(pair, rotation_deg=3, translation_m=0.3, seed=2)
    one, two = simulated(pair, matches=80), simulated(wrong, matches=120, seed=1)
    result = solve(pair, concatenate([one, two]))
    (check,) = named(result, "left", "competing solution")
    assert check.status == "FAIL" and "the other is 3 deg" in check.text


def test_a_competing_solution_just_large_enough_for_a_warning_is_found(pair: Rig) -> None:
    """A quarter agrees on another extrinsic, among as many random outliers."""
    errors = MatcherErrors(outlier_share=0.2)
    wrong = calibgraph.perturb(pair, rotation_deg=5, translation_m=0.5, seed=2)
    table = concatenate(
        [simulated(pair, matches=300, errors=errors), simulated(wrong, matches=100, errors=errors)]
    )
    for seed in range(3):
        solved = solve_joint(pair, table, calibgraph.Config(seed=seed))
        for camera in pair.cameras:
            assert check_competing_solution(solved, camera).value > 0.25


def test_random_outliers_are_no_competing_solution(pair: Rig) -> None:
    errors = MatcherErrors(outlier_share=0.5)
    solved = solve_joint(pair, simulated(pair, errors=errors))
    assert check_competing_solution(solved, "left").value < 0.1


def test_a_camera_with_all_matches_behind_it_is_one_line(pair: Rig) -> None:
    solved = solve_joint(pair, simulated(pair))
    backwards = {name: np.diag([-1.0, 1, -1, 1]) @ T for name, T in solved.T_camera_lidar.items()}
    with pytest.raises(calibgraph.CorrespondenceError, match="'left': all its .* are behind"):
        solved.objective.scales_at(backwards)


def test_frames_that_are_left_out_alike_are_a_competing_solution(pair: Rig) -> None:
    """Six of ten frames of a camera are displaced alike; the weights leave the other four out."""
    wrong = calibgraph.perturb(pair, rotation_deg=1, translation_m=0.5, seed=2)
    one, two = simulated(pair, frames=10), simulated(wrong, frames=10)
    left = [each.of_camera("left") for each in (one, two)]
    displaced = left[1].select(left[1].frame < 6)
    table = concatenate([one.of_camera("right"), left[0].select(left[0].frame >= 6), displaced])
    result = solve(pair, table)
    (check,) = named(result, "left", "competing solution")
    assert check.status == "FAIL"
    assert result.camera_verdicts["left"].status == "FAIL"
    assert result.camera_verdicts["right"].status != "FAIL"
