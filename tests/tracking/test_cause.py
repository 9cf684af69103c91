"""Which of cameras and LiDAR moved."""

from __future__ import annotations

import gtsam
import numpy as np

from calibgraph import (
    Rig,
)
from calibgraph.tracking.cause import Steps, find_cause

Array = np.ndarray


def step_of(deg: float, cm: float) -> Array:
    return np.array([0, np.radians(deg), 0, cm / 100, 0, 0])


def steps_of(rig: Rig, steps: list[Array], sigma: float) -> Steps:
    T_lidar_cameras = tuple(gtsam.Pose3(T).inverse() for T in rig.T_camera_lidar.values())
    n = len(T_lidar_cameras)
    return Steps(
        tuple(range(n)),
        np.ravel(steps),
        sigma**2 * np.eye(6 * n),
        np.full(n, 60.0),
        T_lidar_cameras,
    )


def test_the_cause_of_a_step_follows_from_the_steps_of_all_cameras(mixed_rig: Rig) -> None:
    T_lidar_cameras = [gtsam.Pose3(T).inverse() for T in mixed_rig.T_camera_lidar.values()]
    D = gtsam.Pose3.Expmap(step_of(0.3, 2))
    by_lidar = [np.asarray(p.localCoordinates(D.compose(p))) for p in T_lidar_cameras]
    cause = find_cause(steps_of(mixed_rig, by_lidar, 1e-4))
    assert cause.lidar is not None
    np.testing.assert_allclose(cause.lidar[0], step_of(0.3, 2), atol=1e-9)
    still = np.zeros(6)
    assert find_cause(steps_of(mixed_rig, [still, by_lidar[1], still], 1e-4)).cameras == (1,)
    two = find_cause(steps_of(mixed_rig, [by_lidar[0], -by_lidar[1], still], 1e-4))
    assert two.lidar is None and two.cameras == (0, 1)
    assert find_cause(steps_of(mixed_rig, [still] * 3, 1e-4)).cameras == ()
