"""Directions and derivatives of SE(3), metrics and perturbations, by values worked by hand."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest

from calibgraph import Rig, evaluate, perturb
from calibgraph.model.geometry import (
    angle_deg,
    invert,
    local_coordinates,
    point_in_lidar,
    pose_difference,
    relative_covariance,
    relative_transform,
    retract_all,
    to_T_camera_lidar,
    to_T_lidar_camera,
    twist_between,
)
from calibgraph.model.metrics import pose_error

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


def differences(function: Callable[[np.ndarray], np.ndarray], size: int) -> np.ndarray:
    """The Jacobian at zero, by central differences: exact to eps / step = 1e-10."""
    steps = 1e-6 * np.eye(size)
    return np.column_stack([(function(xi) - function(-xi)) / 2e-6 for xi in steps])


def test_the_covariance_of_a_pair_follows_from_finite_differences() -> None:
    """Of xi in T_b_a = exp(xi) estimate, by perturbing both extrinsics on the left."""
    T_a, T_b = random_transform(1), random_transform(2)
    T_b_a = relative_transform(T_b, T_a)
    jacobian = differences(
        lambda xi: twist_between(relative_transform(exp(xi[6:]) @ T_b, exp(xi[:6]) @ T_a), T_b_a),
        12,
    )
    root = np.random.default_rng(3).standard_normal((12, 12))
    joint = root @ root.T
    expected = jacobian @ joint @ jacobian.T
    tolerance = 1e-8 * np.abs(expected).max()
    np.testing.assert_allclose(
        relative_covariance(joint, 0, 1, T_b_a), expected, rtol=0, atol=tolerance
    )


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


def turned_about(axis: str, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    T = np.eye(4)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    T[[i, i, j, j], [i, j, i, j]] = [c, -s, s, c]
    return T


@pytest.mark.parametrize(("axis", "name"), [("x", "pitch"), ("y", "yaw"), ("z", "roll")])
def test_rotations_are_named_for_a_camera_that_looks_along_z(
    axis: str, name: str, pair: Rig
) -> None:
    reference = pair.T_camera_lidar["left"]
    error = pose_error(turned_about(axis, 3.0) @ reference, reference)
    assert error.rotation_error_deg == pytest.approx(3.0)
    for each in ("roll", "pitch", "yaw"):
        expected = 3.0 if each == name else 0.0
        assert getattr(error, f"{each}_deg") == pytest.approx(expected, abs=1e-9)


def test_translations_are_differences_of_t_in_camera_axes(pair: Rig) -> None:
    reference = pair.T_camera_lidar["left"]
    estimate = reference.copy()
    estimate[:3, 3] += [0.03, -0.04, 0.0]
    error = pose_error(estimate, reference)
    assert (error.x_cm, error.y_cm, error.z_cm) == pytest.approx((3, -4, 0))
    assert error.translation_error_cm == pytest.approx(5)
    assert error.rotation_error_deg == 0


def test_pairs_compare_the_pose_between_cameras(pair: Rig) -> None:
    """Moving the LiDAR moves both cameras and not what lies between them."""
    shift = turned_about("z", 1.0)
    shift[:3, 3] = [0.1, 0.2, 0.3]
    both = pair.moved_to({n: T @ shift for n, T in pair.T_camera_lidar.items()})
    errors = evaluate(both, pair)
    assert errors.cameras["left"].rotation_error_deg == pytest.approx(1.0)
    assert errors.pairs["left->right"].rotation_error_deg == pytest.approx(0, abs=1e-9)
    assert errors.pairs["left->right"].translation_error_cm == pytest.approx(0, abs=1e-9)
    right = pair.T_camera_lidar["right"].copy()
    right[0, 3] += 0.05
    one = evaluate(pair.moved_to({"right": right}), pair)
    assert one.pairs["left->right"].x_cm == pytest.approx(5)
    assert one.cameras["left"].translation_error_cm == 0


@pytest.mark.parametrize("degrees", [0, 1e-7, 1e-3, 1, 90, 179.999])
def test_angles_are_exact_from_tiny_to_large(degrees: float) -> None:
    assert angle_deg(turned_about("y", degrees)[:3, :3]) == pytest.approx(degrees, rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_perturb_displaces_by_exactly_what_it_says(pair: Rig, seed: int) -> None:
    moved = perturb(pair, rotation_deg=20, translation_m=1.5, seed=seed)
    deltas = [moved.T_camera_lidar[n] @ np.linalg.inv(T) for n, T in pair.T_camera_lidar.items()]
    for delta in deltas:
        assert angle_deg(delta[:3, :3]) == pytest.approx(20, abs=1e-9)
        assert np.linalg.norm(delta[:3, 3]) == pytest.approx(1.5, abs=1e-12)
    assert np.abs(deltas[0] - deltas[1]).max() > 0.1  # independent per camera


def test_perturb_uniform_stays_in_its_box(pair: Rig) -> None:
    shifts = []
    for seed in range(100):
        moved = perturb(pair, rotation_deg=20, translation_m=1.5, seed=seed, uniform=True)
        delta = moved.T_camera_lidar["left"] @ np.linalg.inv(pair.T_camera_lidar["left"])
        shifts.append(delta[:3, 3])
    assert np.abs(shifts).max() <= 1.5
    # Uniform on +-1.5: a standard deviation of 1.5 / sqrt(3), known from 300 draws to 4 %.
    assert np.std(shifts) == pytest.approx(1.5 / np.sqrt(3), rel=0.15)
