"""Factors of one match, and of poses: GTSAM's stock factors, and the formulas of the paper."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from gtsam import Pose3

from factors import (
    pose_sigmas,
    projection_factor,
    projection_residual,
    relative_pose_factor,
    smallest_scaled_eigenvalues,
    unit_diagonal,
)
from tests.factors.blocks import KEY, LENSES, at, poses, world


@pytest.mark.parametrize("name", LENSES)
def test_projection_jacobian_agrees_with_finite_differences(name: str) -> None:
    """By the pose, in GTSAM's tangent: near, off, far, and 1e-7 from the identity."""
    lens = LENSES[name]
    block = world(lens, 5)
    identity = gtsam.Pose3.Expmap(1e-7 * np.array([1, -2, 3, 2, 1, -1.0]))
    ahead = np.array([[0.5, -0.3, 5.0]])  # what a camera at the identity sees
    for pose in [*poses()[:4], identity]:
        points = ahead if pose is identity else block.points_lidar_m
        for point in points:
            residual, jacobian = projection_residual(lens, pose, point, np.zeros(2))
            numeric = np.empty((2, 6))
            for axis in range(6):
                d = 1e-6 * np.eye(6)[axis]
                plus, _ = projection_residual(lens, pose.retract(d), point, np.zeros(2))
                minus, _ = projection_residual(lens, pose.retract(-d), point, np.zeros(2))
                numeric[:, axis] = (plus - minus) / 2e-6
            # Rounding: eps |residual| / step; truncation is smaller.
            tolerance = 1e-9 * max(1e3, np.abs(residual).max()) + 1e-7 * np.abs(jacobian).max()
            np.testing.assert_allclose(jacobian, numeric, rtol=0, atol=tolerance)


def test_projection_factor_equals_gtsams_stock_factor() -> None:
    calibration = gtsam.Cal3_S2(718.0, 710.0, 0.0, 607.0, 185.0)
    cauchy = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(4.0), gtsam.noiseModel.Unit.Create(2)
    )
    block = world(LENSES["pinhole"], 20)
    landmark = 99
    for k in range(20):
        point, pixel = block.points_lidar_m[k], block.pixels_px[k]
        values = at(poses()[2])
        values.insert(landmark, point)
        stock = gtsam.GenericProjectionFactorCal3_S2(pixel, cauchy, KEY, landmark, calibration)
        ours = projection_factor(KEY, LENSES["pinhole"], point, pixel, scale=4.0)
        np.testing.assert_allclose(ours.error(values), stock.error(values), rtol=1e-12)
        expected, right = stock.linearize(values).jacobian()
        A, b = ours.linearize(values).jacobian()
        np.testing.assert_allclose(A, expected[:, :6], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(b, right, rtol=1e-9, atol=1e-9)


def random_pose(rng: np.random.Generator) -> Pose3:
    return Pose3.Expmap(rng.standard_normal(6) * [1, 1, 1, 3, 3, 3])


def values_of(*transforms: Pose3) -> gtsam.Values:
    """Values 0, 1, ...: the inverses of the given T_camera_lidar."""
    result = gtsam.Values()
    for key, T in enumerate(transforms):
        result.insert(key, T.inverse())
    return result


def test_relative_pose_is_exact_at_the_truth_and_costs_one_at_one_sigma() -> None:
    rng = np.random.default_rng(3)
    T_a, T_b = random_pose(rng), random_pose(rng)
    T_a_b = T_a.compose(T_b.inverse())
    for axis, sigma in enumerate([0.01] * 3 + [0.002] * 3):
        off = T_a_b.compose(Pose3.Expmap(sigma * np.eye(6)[axis]))
        factor = relative_pose_factor(
            0, 1, off.matrix(), rotation_sigma_rad=0.01, translation_sigma_m=0.002
        )
        assert 2 * factor.error(values_of(T_a, T_b)) == pytest.approx(1.0, rel=1e-6)
    exact = relative_pose_factor(
        0, 1, T_a_b.matrix(), rotation_sigma_rad=0.01, translation_sigma_m=0.002
    )
    assert exact.error(values_of(T_a, T_b)) < 1e-20


def test_sigmas_are_rotation_first() -> None:
    assert pose_sigmas(rotation_rad=1.0, translation_m=2.0).tolist() == [1, 1, 1, 2, 2, 2]


def random_hessian() -> np.ndarray:
    root = np.random.default_rng(0).standard_normal((9, 6))
    return root.T @ root


def test_the_smallest_eigenvalue_does_not_depend_on_units() -> None:
    hessian = random_hessian()
    units = np.repeat([1e-3, 1e4], 3)
    expected = smallest_scaled_eigenvalues((hessian)[None])[0]
    assert 0 < expected < 1
    # Rounding of a 6x6 eigenvalue problem with eigenvalues up to 6.
    found = smallest_scaled_eigenvalues((hessian * np.outer(units, units))[None])[0]
    assert found == pytest.approx(expected, abs=1e-14)
    assert smallest_scaled_eigenvalues(np.diag([1e-9, 1.0, 1e9])[None])[0] == pytest.approx(1.0)


def test_a_free_unknown_or_direction_gives_zero() -> None:
    hessian = random_hessian()
    free = hessian.copy()
    free[2], free[:, 2] = 0.0, 0.0
    assert smallest_scaled_eigenvalues((free)[None])[0] == 0.0
    assert unit_diagonal(free)[1][2] == 1.0
    direction = np.ones(6) / np.sqrt(6)
    projected = np.eye(6) - np.outer(direction, direction)
    assert abs(smallest_scaled_eigenvalues((projected @ hessian @ projected)[None])[0]) < 1e-14
