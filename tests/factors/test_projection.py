"""The plain projection factor: its Jacobian, and GTSAM's stock factor."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from factors import (
    projection_factor,
    projection_residual,
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
