"""A place that contradicts the others: named, and of little weight."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from calibgraph import Calibration, Config, Correspondences, MatcherErrors, Rig, solve
from calibgraph.model.error_components import error_components
from calibgraph.model.geometry import twist_between
from calibgraph.simulation.correspondences import simulate_correspondences
from calibgraph.solver.joint import solve_joint
from tests.trust.conftest import named

PLACES = [[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 10, 11], [12, 13, 14]]
ERRORS = MatcherErrors(noise_px=1.0, frame_noise_px=0.3, outlier_share=0.1)
CONFIG = Config(learnt_weights=False)


def five_places(rig: Rig, seed: int = 0) -> Correspondences:
    """As the matcher ``structure`` states them, without the errors that it states."""
    table = simulate_correspondences(rig, frames=15, matches=150, errors=ERRORS, seed=seed)
    stated = vars(error_components().matchers["structure"])
    return replace(table, metadata={**table.metadata, **stated, "places": PLACES})


def displaced(table: Correspondences, place: int, deg: float, m: float) -> Correspondences:
    """The cloud of one place turned about the vertical, and shifted along the street."""
    T = gtsam.Pose3.Expmap(np.array([0, 0, np.radians(deg), m, 0, 0])).matrix()
    points, there = table.points_lidar_m.copy(), np.isin(table.frame, PLACES[place])
    points[there] = points[there] @ T[:3, :3].T + T[:3, 3]
    return replace(table, points_lidar_m=points)


def place_checks(result: Calibration, camera: str) -> dict[str | None, tuple[str, str]]:
    """Status and text by kind."""
    checks = result.camera_verdicts[camera].checks
    return {c.kind: (c.status, c.text) for c in checks if (c.kind or "").startswith("place_")}


def test_good_places_pass(pair: Rig) -> None:
    result = solve(pair, five_places(pair), CONFIG)
    for camera in pair.cameras:
        found = place_checks(result, camera)
        assert {kind: status for kind, (status, _) in found.items()} == {
            "place_distance": "PASS",
            "place_inliers": "PASS",
        }


@pytest.mark.parametrize(("deg", "m"), [(0.3, 0.06), (1.0, 0.2)])
def test_a_displaced_place_is_named(pair: Rig, deg: float, m: float) -> None:
    result = solve(pair, displaced(five_places(pair), 3, deg, m), CONFIG)
    for camera in pair.cameras:
        found = place_checks(result, camera)
        worse = [text for status, text in found.values() if status == "WARN"]
        assert worse and all("place 4 (frames 9 to 11)" in text for text in worse)
        assert all(status != "FAIL" for status, _ in found.values())


def test_it_moves_the_estimate_less_than_that_of_independent_matches(pair: Rig) -> None:
    """By so little that the gate leaves its matches; in the median of many draws."""
    ratios = []
    for seed in range(10):
        table = five_places(pair, seed)
        good, bad = (solve_joint(pair, t, CONFIG) for t in (table, displaced(table, 3, 0.15, 0.03)))
        flat = [one.inliers.minimize(one.T_camera_lidar, one.scales) for one in (bad, good)]
        moved_flat = largest_turn(*(optimum.T_camera_lidar for optimum in flat))
        assert moved_flat > np.radians(0.015)
        ratios.append(largest_turn(bad.T_camera_lidar, good.T_camera_lidar) / moved_flat)
    assert np.median(ratios) < 0.75


def largest_turn(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> float:
    """Between two estimates, of any camera [rad]."""
    return max(float(np.linalg.norm(twist_between(one[n], other[n])[:3])) for n in one)


def test_of_two_places_none_can_be_told_to_be_wrong(pair: Rig) -> None:
    table = five_places(pair)
    table = displaced(table.select(table.frame < 6), 0, 1.0, 0.2)
    result = solve(pair, replace(table, metadata={**table.metadata, "places": PLACES[:2]}), CONFIG)
    assert not place_checks(result, "left")
    assert not named(result, "left", "distance of a place")
