"""The bends of the cloud: their displacements, and the shift of each camera's matches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibgraph import MatcherErrors, Rig, simulate_correspondences
from calibgraph.model.config import Config
from calibgraph.model.geometry import to_T_lidar_camera
from calibgraph.solver.cloud_bends import bend_shifts, bends_at
from calibgraph.solver.joint import solve_joint

STEP = np.array([2e-4, 2e-3, 4e-3])  # far below the scale of the loss


def test_elevation_turns_each_line_of_sight_and_motion_grows_with_the_heading() -> None:
    points = np.array([[10.0, 0.0, -1.0], [0.0, 10.0, 0.0], [-10.0, 0.0, 2.0]])
    elevation, stretch, motion = bends_at(points)
    slopes = np.arctan2(points[:, 2], 10.0)
    np.testing.assert_allclose(elevation, [[1.0, 0, 10], [0, 0, 10], [2, 0, 10]], atol=1e-12)
    np.testing.assert_allclose(stretch, elevation * slopes[:, None], atol=1e-12)
    np.testing.assert_allclose(motion, [[0, 0, 0], [0.25, 0, 0], [0.5, 0, 0]], atol=1e-12)


@pytest.mark.parametrize("bend", [0, 1, 2])
def test_the_shift_is_how_a_solve_of_the_bent_cloud_differs(mixed_rig: Rig, bend: int) -> None:
    errors = MatcherErrors(noise_px=0.5, outlier_share=0.05)
    table = simulate_correspondences(mixed_rig, frames=4, matches=200, errors=errors, seed=0)
    config = Config(learnt_weights=False, prior_weight=0.0, relative_prior_weight=0.0)
    solution = solve_joint(mixed_rig, table, config)
    inliers, points = solution.inliers, table.points_lidar_m
    bent = replace(table, points_lidar_m=points + STEP[bend] * bends_at(points)[bend])
    moved = solve_joint(mixed_rig, bent, config).T_camera_lidar
    for name, T in solution.T_camera_lidar.items():
        pose = to_T_lidar_camera(T)
        shifts = bend_shifts(inliers.blocks[name], solution.scales[name], pose, np.zeros((6, 6)))
        found = pose.localCoordinates(to_T_lidar_camera(moved[name]))
        expected, unit = shifts[:, bend] * STEP[bend], np.repeat([1e-3, 0.01], 3)
        # Weights of the loss and the gate, which are left out of it, are worth up to 15 %.
        off = np.linalg.norm((found - expected) / unit)
        assert off < 0.2 * np.linalg.norm(expected / unit)
