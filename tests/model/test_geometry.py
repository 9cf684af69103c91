"""Directions and derivatives of SE(3), by worked points and finite differences."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from calibgraph.model.geometry import (
    angle_deg,
    invert,
    invert_each,
    local_coordinates,
    point_in_lidar,
    pose_difference,
    relative_covariance,
    relative_transform,
    retract_all,
    ros_pose_covariance,
    to_T_camera_lidar,
    to_T_lidar_camera,
    twist_between,
)
from tests.conftest import make_camera

# A quarter turn about z and a shift: p_a = (-y, x, z) + (1, 2, 3).
QUARTER = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


def random_transform(seed: int, size: float = 1.0) -> np.ndarray:
    return gtsam.Pose3.Expmap(size * np.random.default_rng(seed).standard_normal(6)).matrix()


def exp(xi: np.ndarray) -> np.ndarray:
    return gtsam.Pose3.Expmap(xi).matrix()


def test_a_transform_maps_from_its_second_frame_to_its_first() -> None:
    """One point, by hand, through every direction."""
    T_camera_lidar = QUARTER
    in_lidar = np.array([1.0, 0.0, 0.0])
    in_camera = np.array([1.0, 3.0, 3.0])
    np.testing.assert_allclose((T_camera_lidar @ [*in_lidar, 1])[:3], in_camera)
    np.testing.assert_allclose((invert(T_camera_lidar) @ [*in_camera, 1])[:3], in_lidar)
    np.testing.assert_allclose(point_in_lidar(T_camera_lidar, in_camera), in_lidar)
    T_lidar_camera = to_T_lidar_camera(T_camera_lidar)
    np.testing.assert_allclose(T_lidar_camera.transformFrom(in_camera), in_lidar)
    np.testing.assert_allclose(T_lidar_camera.transformTo(in_lidar), in_camera)


def test_a_relative_transform_maps_from_the_second_camera_to_the_first() -> None:
    T_a_lidar, T_b_lidar = random_transform(1), random_transform(2)
    point = np.array([0.3, -0.2, 5.0, 1.0])
    T_a_b = relative_transform(T_a_lidar, T_b_lidar)
    np.testing.assert_allclose(T_a_b @ T_b_lidar @ point, T_a_lidar @ point, atol=1e-14)


@pytest.mark.parametrize("size", [1e-7, 0.01, 1.0])
def test_the_twist_is_on_the_left_and_has_the_rotation_first(size: float) -> None:
    reference = random_transform(1)
    xi = size * np.array([0.1, -0.2, 0.3, 1.0, 2.0, -3.0])
    # Transforms of size 1 are rounded to 1e-16; their logarithm amplifies that by a few.
    np.testing.assert_allclose(twist_between(exp(xi) @ reference, reference), xi, atol=1e-14)


def test_angles_and_distances_of_extrinsics_are_those_of_the_cameras() -> None:
    other = QUARTER.copy()
    other[:3, 3] += QUARTER[:3, :3] @ [0.03, 0.0, 0.04]  # the camera's centre moves by 5 cm
    degrees, centimetres = pose_difference(QUARTER, other)
    assert degrees == pytest.approx(0.0, abs=1e-12)
    assert centimetres == pytest.approx(5.0)
    assert angle_deg(QUARTER[:3, :3]) == pytest.approx(90.0)


def test_the_covariance_of_a_pair_follows_from_finite_differences() -> None:
    """Of xi in T_b_a = exp(xi) estimate, by perturbing both extrinsics on the left."""
    T_a, T_b = random_transform(1), random_transform(2)
    T_b_a = relative_transform(T_b, T_a)
    step = 1e-6
    jacobian = np.zeros((6, 12))
    for axis in range(12):
        ends = []
        for sign in (1, -1):
            xi = np.zeros(12)
            xi[axis] = sign * step
            moved = relative_transform(exp(xi[6:]) @ T_b, exp(xi[:6]) @ T_a)
            ends.append(twist_between(moved, T_b_a))
        jacobian[:, axis] = (ends[0] - ends[1]) / (2 * step)
    root = np.random.default_rng(3).standard_normal((12, 12))
    joint = root @ root.T
    expected = jacobian @ joint @ jacobian.T
    # Central differences: rounding eps / step = 1e-10, truncation step^2 = 1e-12, times |joint|.
    tolerance = 1e-8 * np.abs(expected).max()
    np.testing.assert_allclose(
        relative_covariance(joint, 0, 1, T_b_a), expected, rtol=0, atol=tolerance
    )


def test_many_rigid_transforms_are_inverted_as_any_matrix() -> None:
    T = np.array([[random_transform(seed) for seed in range(row, row + 3)] for row in range(2)])
    np.testing.assert_allclose(invert_each(T), np.linalg.inv(T), rtol=0, atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-7, 9e-3, 1.1e-2, 0.5, 1.8])
def test_many_poses_move_as_gtsam_moves_each(size: float) -> None:
    """On both sides of the angle from which closed formulas are used, and near half a turn."""
    rng = np.random.default_rng(0)
    T = np.array([gtsam.Pose3.Expmap(rng.standard_normal(6)).matrix() for _ in range(20)])
    steps = size * rng.uniform(-1, 1, (20, 6))
    moved = retract_all(T, steps)
    for start, step, found in zip(T, steps, moved, strict=True):
        variable = to_T_lidar_camera(start)
        np.testing.assert_allclose(found, to_T_camera_lidar(variable.retract(step)), atol=1e-14)
        back = local_coordinates(start, invert(found)[None])[0]
        np.testing.assert_allclose(back, step, atol=1e-14)
        np.testing.assert_allclose(
            local_coordinates(T[0], invert(found)[None])[0],
            to_T_lidar_camera(T[0]).localCoordinates(to_T_lidar_camera(found)),
            atol=1e-12,
        )


def test_the_covariance_of_ros_is_that_of_the_moved_pose() -> None:
    """By finite differences of the pose in the LiDAR frame, over each direction of xi."""
    T = make_camera((0.3, 0.2, -0.1), yaw_deg=35).T_camera_lidar
    step = 1e-6
    jacobian = np.empty((6, 6))
    for k in range(6):
        poses = []
        for sign in (1, -1):
            xi = np.zeros(6)
            xi[k] = sign * step
            poses.append(np.linalg.inv(gtsam.Pose3.Expmap(xi).matrix() @ T))
        plus, minus = poses
        turn = (plus[:3, :3] @ minus[:3, :3].T) / (2 * step)
        axis = [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        jacobian[:3, k] = (plus[:3, 3] - minus[:3, 3]) / (2 * step)
        jacobian[3:, k] = 0.5 * np.array(axis)
    root = np.random.default_rng(3).normal(size=(6, 6))
    covariance = root @ root.T
    expected = jacobian @ covariance @ jacobian.T
    # Central differences: rounding 1e-16 / 1e-6, of values up to about 10.
    np.testing.assert_allclose(ros_pose_covariance(covariance, T), expected, atol=1e-7)
