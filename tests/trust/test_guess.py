from __future__ import annotations

from dataclasses import replace

import numpy as np

import calibgraph
from calibgraph import MatcherErrors, Rig, solve
from calibgraph.model.findings import MatcherFindings
from calibgraph.trust.guess import (
    compare_with_guess,
    compare_with_other_guesses,
    distances_between,
)
from tests.trust.conftest import named, simulated


def test_an_inverted_guess_is_named_though_the_result_is_right(pair: Rig) -> None:
    poses = {name: np.linalg.inv(T) for name, T in pair.T_camera_lidar.items()}
    result = solve(pair.moved_to(poses), simulated(pair))
    assert result.verdict.status == "PASS"
    assert any("it seems that the guess is inverted" in reason for reason in result.verdict.reasons)


def test_a_near_guess_passes(pair: Rig) -> None:
    guess = calibgraph.perturb(pair, rotation_deg=10, translation_m=1, seed=1)
    for name, T in pair.T_camera_lidar.items():
        checks = compare_with_guess(guess.T_camera_lidar[name], T, MatcherFindings())
        assert all(check.status == "PASS" for check in checks)


def test_swapped_cameras_are_named(pair: Rig) -> None:
    """Half a metre apart, from 2 deg and 20 cm; and the same the right way round."""
    right = pair.T_camera_lidar
    swapped = dict(zip(right, reversed(right.values()), strict=True))
    guess = calibgraph.perturb(pair, rotation_deg=2, translation_m=0.2, seed=3).T_camera_lidar
    for name in right:
        (check,) = compare_with_other_guesses(name, distances_between(guess, right))
        assert check.status == "PASS"
        (check,) = compare_with_other_guesses(name, distances_between(guess, swapped))
        assert check.status != "PASS" and "are their images swapped" in check.text
    # Lenses of one housing, and results that are off by more than these are apart.
    near = {"left": np.eye(4), "right": np.eye(4)}
    near["right"][0, 3] = 0.02
    for results in (near, dict(zip(near, reversed(near.values()), strict=True))):
        (check,) = compare_with_other_guesses("left", distances_between(near, results))
        assert check.status == "PASS"
    alone = distances_between({"left": guess["left"]}, {"left": right["left"]})
    assert compare_with_other_guesses("left", alone) == []


def test_points_in_millimetres_fail(pair: Rig) -> None:
    table = simulated(pair, errors=MatcherErrors())
    huge = replace(table, points_lidar_m=1000 * table.points_lidar_m)
    result = solve(pair, huge)
    assert named(result, "left", "are the clouds in millimetres?")[0].status == "FAIL"
