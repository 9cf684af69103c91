from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import calibgraph
from calibgraph import MatcherErrors, Rig, solve
from calibgraph.model.findings import MatcherFindings
from calibgraph.trust.guess import (
    compare_with_guess,
    compare_with_other_guesses,
    compare_with_range,
    describe_other_frame,
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
        (check,) = compare_with_other_guesses(name, guess, right)
        assert check.status == "PASS"
        (check,) = compare_with_other_guesses(name, guess, swapped)
        assert check.status != "PASS" and "are their images swapped" in check.text
    # Lenses of one housing, and results that are off by more than these are apart.
    near = {"left": np.eye(4), "right": np.eye(4)}
    near["right"][0, 3] = 0.02
    for results in (near, dict(zip(near, reversed(near.values()), strict=True))):
        (check,) = compare_with_other_guesses("left", near, results)
        assert check.status == "PASS"
    alone = {"left": guess["left"]}, {"left": right["left"]}
    assert compare_with_other_guesses("left", *alone) == []


@pytest.mark.parametrize(
    ("degrees", "metres", "false_fails", "named"),
    [(2.0, 0.2, 0.002, 0.9), (10.0, 0.5, 0.01, 0.1), (20.0, 1.5, 0.01, 0.0)],
)
def test_a_swap_is_named_as_far_as_the_guesses_can_show_it(
    pair: Rig, degrees: float, metres: float, false_fails: float, named: float
) -> None:
    right = pair.T_camera_lidar
    swapped = dict(zip(right, reversed(right.values()), strict=True))
    statuses: dict[bool, list[str]] = {True: [], False: []}
    for seed in range(300):
        drawn = calibgraph.perturb(
            pair, rotation_deg=degrees, translation_m=metres, seed=seed, uniform=True
        )
        for is_swapped, results in ((False, right), (True, swapped)):
            (check,) = compare_with_other_guesses("left", drawn.T_camera_lidar, results)
            statuses[is_swapped].append(check.status)
    assert statuses[False].count("FAIL") <= false_fails * 300
    assert statuses[True].count("FAIL") >= named * 300


def test_points_in_millimetres_fail(pair: Rig) -> None:
    table = simulated(pair, errors=MatcherErrors())
    huge = replace(table, points_lidar_m=1000 * table.points_lidar_m)
    result = solve(pair, huge)
    assert named(result, "left", "are the clouds in millimetres?")[0].status == "FAIL"


def test_guesses_from_another_frame_of_the_vehicle_are_named(pair: Rig) -> None:
    """Of rough guesses, of one camera too; not of guesses that differ from each other."""
    T_lidar_base = np.eye(4)
    T_lidar_base[:3, 3] = -1.1, 0.0, -1.9
    rough = calibgraph.perturb(pair, rotation_deg=2, translation_m=0.2, seed=1)
    from_base = {name: T @ T_lidar_base for name, T in rough.T_camera_lidar.items()}
    text = describe_other_frame(from_base, pair.T_camera_lidar)
    assert text.startswith("all cameras are moved as if the guess were of another frame")
    left = {"left": pair.T_camera_lidar["left"]}
    assert describe_other_frame(from_base, left).startswith("the camera is moved as if")
    exact = {name: T @ T_lidar_base for name, T in left.items()}
    assert "x 1.10, y 0.00, z 1.90 m" in describe_other_frame(exact, left)
    apart = from_base | {"right": pair.T_camera_lidar["right"]}
    assert describe_other_frame(apart, pair.T_camera_lidar) == ""
    assert describe_other_frame(rough.T_camera_lidar, pair.T_camera_lidar) == ""
    (check,) = compare_with_range(
        exact["left"], left["left"], MatcherFindings(range_translation_m=0.3), text
    )
    assert check.status == "FAIL" and text in check.text
