"""The bends of the cloud: their displacements, and the shift of each camera's matches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calibgraph import MatcherErrors, Rig, simulate_correspondences
from calibgraph.model.config import Config
from calibgraph.model.geometry import adjoints, invert, to_T_lidar_camera, twist_between
from calibgraph.simulation.rigs import rig_of
from calibgraph.solver.joint import solve_joint
from calibgraph.solver.scan_distortion import (
    distortion_evidence,
    distortion_fields_px,
    distortions_at,
    pair_jacobians,
)
from tests.conftest import make_camera, points_in_front

STEP = np.array([2e-4, 2e-3, 4e-3])  # far below the scale of the loss


def test_elevation_turns_each_line_of_sight_and_motion_grows_with_the_heading() -> None:
    points = np.array([[10.0, 0.0, -1.0], [0.0, 10.0, 0.0], [-10.0, 0.0, 2.0]])
    elevation, stretch, motion = distortions_at(points)
    slopes = np.arctan2(points[:, 2], 10.0)
    np.testing.assert_allclose(elevation, [[1.0, 0, 10], [0, 0, 10], [2, 0, 10]], atol=1e-12)
    np.testing.assert_allclose(stretch, elevation * slopes[:, None], atol=1e-12)
    np.testing.assert_allclose(motion, [[0, 0, 0], [0.25, 0, 0], [0.5, 0, 0]], atol=1e-12)


def test_the_fields_are_derivatives_of_pixels() -> None:
    camera, points = make_camera(), points_in_front(np.random.default_rng(0), 50)
    T = camera.T_camera_lidar
    for field, bend in zip(
        distortion_fields_px(camera, points), distortions_at(points), strict=True
    ):
        before, after = (
            camera.lens.project((points + step * bend) @ T[:3, :3].T + T[:3, 3])[0]
            for step in (-1e-6, 1e-6)
        )
        np.testing.assert_allclose(field.T, (after - before) / 2e-6, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("bend", [0, 1, 2])
def test_the_shift_is_how_a_solve_of_the_bent_cloud_differs(mixed_rig: Rig, bend: int) -> None:
    errors = MatcherErrors(noise_px=0.5, outlier_share=0.05)
    table = simulate_correspondences(mixed_rig, frames=4, matches=200, errors=errors, seed=0)
    config = Config(learnt_weights=False, prior_weight=0.0, relative_prior_weight=0.0)
    solution = solve_joint(mixed_rig, table, config)
    inliers, points = solution.inliers, table.points_lidar_m
    bent = replace(table, points_lidar_m=points + STEP[bend] * distortions_at(points)[bend])
    moved = solve_joint(mixed_rig, bent, config).T_camera_lidar
    for name, T in solution.T_camera_lidar.items():
        pose = to_T_lidar_camera(T)
        block, scale = inliers.blocks[name], solution.scales[name]
        shifts = distortion_evidence(
            block, scale, pose, np.zeros((6, 6)), places=[np.arange(4)]
        ).jacobian
        found = pose.localCoordinates(to_T_lidar_camera(moved[name]))
        expected, unit = shifts[:, bend] * STEP[bend], np.repeat([1e-3, 0.01], 3)
        # Weights of the loss and the gate, which are left out of it, are worth up to 15 %.
        off = np.linalg.norm((found - expected) / unit)
        assert off < 0.2 * np.linalg.norm(expected / unit)


@pytest.mark.parametrize("bend", [0, 1, 2])
def test_a_camera_that_sees_all_round_shows_the_bends(bend: int) -> None:
    """By what no pose can follow: within three standard deviations, which are far below it."""
    rig, size = rig_of("panorama"), np.array([2e-3, 2e-2, 0.05])[bend]
    errors = MatcherErrors(noise_px=0.5, outlier_share=0.0)
    table = simulate_correspondences(rig, frames=4, matches=400, errors=errors, seed=0)
    points = table.points_lidar_m
    bent = replace(table, points_lidar_m=points + size * distortions_at(points)[bend])
    config = Config(learnt_weights=False, prior_weight=0.0, relative_prior_weight=0.0)
    solution = solve_joint(rig, bent, config)
    (name, T), *_ = solution.T_camera_lidar.items()
    block, scale = solution.inliers.blocks[name], solution.scales[name]
    found = distortion_evidence(
        block, scale, to_T_lidar_camera(T), np.zeros((6, 6)), places=[np.arange(2), np.arange(2, 4)]
    )
    information = found.information.sum(axis=0)
    sigmas = np.sqrt(np.diag(np.linalg.inv(information)))
    shown = np.linalg.solve(information, found.vector.sum(axis=0))
    expected = size * np.eye(3)[bend]
    assert (np.abs(shown - expected) < 3 * sigmas).all()
    assert sigmas[bend] < size / 4


def test_what_the_cameras_show_of_the_bends_moves_them_back() -> None:
    """Motion of 0.1 m, of a table that states 0.15 m and nothing else."""
    rig = rig_of("panorama")
    table = simulate_correspondences(rig, frames=6, matches=400, seed=0)
    points = table.points_lidar_m
    stated = {**table.metadata, "scan_motion_m": 0.15}
    bent = replace(table, points_lidar_m=points + 0.1 * distortions_at(points)[2], metadata=stated)
    config = Config(learnt_weights=False, prior_weight=0.0, relative_prior_weight=0.0)
    without = solve_joint(rig, replace(bent, metadata=table.metadata), config)
    solution = solve_joint(rig, bent, config)
    assert solution.errors is not None
    values, sigmas = solution.errors.scan_distortion(bent.findings.bend_sigmas)
    assert abs(values[2] - 0.1) < 3 * sigmas[2] < 0.06
    mounts = solution.errors.fit.of_mount.T_camera_lidar
    for name, T in rig.T_camera_lidar.items():
        before, after = (
            np.abs(twist_between(of[name], T)).max() for of in (without.T_camera_lidar, mounts)
        )
        assert after < 0.5 * before
        # The alignment is where the displaced cloud meets the images.
        step = twist_between(solution.T_camera_lidar[name], without.T_camera_lidar[name])
        assert np.abs(step).max() < 0.1 * before


def test_a_pair_follows_the_bends_by_one_motion_of_the_cloud(mixed_rig: Rig) -> None:
    """The mean of what its cameras see, so that their relative pose stays; a silent one with it."""
    T = np.stack([invert(camera.T_camera_lidar) for camera in mixed_rig.cameras.values()])
    shifts = np.random.default_rng(0).standard_normal((3, 6, 2))
    seen, to_cloud = np.array([True, True, False]), adjoints(T)
    found = to_cloud @ pair_jacobians(shifts, seen, T, [(0, 1)])
    both = (to_cloud[0] @ shifts[0] + to_cloud[1] @ shifts[1]) / 2
    np.testing.assert_allclose(found, [both, both, np.zeros((6, 2))], rtol=0, atol=1e-12)
    found = to_cloud @ pair_jacobians(shifts, seen, T, [(0, 1), (1, 2)])
    alone = to_cloud[1] @ shifts[1]
    np.testing.assert_allclose(found, [both, (both + alone) / 2, alone], rtol=0, atol=1e-12)
