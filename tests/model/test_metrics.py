"""The paper's metrics, by values worked by hand."""

from __future__ import annotations

import numpy as np
import pytest

from calibgraph import Rig, evaluate
from calibgraph.model.geometry import angle_deg
from calibgraph.model.metrics import pose_error


def turned(axis: str, degrees: float) -> np.ndarray:
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
    error = pose_error(turned(axis, 3.0) @ reference, reference)
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
    shift = turned("z", 1.0)
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
    assert angle_deg(turned("y", degrees)[:3, :3]) == pytest.approx(degrees, rel=1e-9)
