from __future__ import annotations

import numpy as np
import pytest

from calibgraph import RelativePose, Rig
from calibgraph.matching.structure.bodies import adjoint, lead, place, place_member, rigid_bodies
from calibgraph.solver.camera_twist import apply_twist


def relative(rig: Rig, a: str, b: str, sigma_rad: float = 0.001) -> RelativePose:
    T = rig.T_camera_lidar
    return RelativePose(
        a=a,
        b=b,
        T_a_b=T[a] @ np.linalg.inv(T[b]),
        rotation_sigma_rad=sigma_rad,
        translation_sigma_m=0.01,
    )


@pytest.fixture
def names(truth: Rig) -> list[str]:
    return list(truth.cameras)


def test_tight_relative_poses_join_cameras_whatever_their_direction(
    truth: Rig, names: list[str]
) -> None:
    a, b, c = names
    rig = truth.model_copy(
        update={"relative_poses": (relative(truth, c, b), relative(truth, b, a))}
    )
    (body,) = rigid_bodies(rig.moved_to({b: np.eye(4), c: np.eye(4)}))
    assert list(body)[0] == a
    for name in names:
        np.testing.assert_allclose(body[name].T_camera_lidar, truth.T_camera_lidar[name], atol=1e-9)


def test_a_moved_body_keeps_its_relative_poses(truth: Rig, names: list[str]) -> None:
    pairs = tuple(relative(truth, names[0], name) for name in names[1:])
    (body,) = rigid_bodies(truth.model_copy(update={"relative_poses": pairs}))
    twist = np.array([1e-4, -2e-4, 1e-4, 2e-3, 1e-3, -1e-3])
    moved = place(body, apply_twist(lead(body), twist).T_camera_lidar)
    for name in names:
        own = apply_twist(body[name], adjoint(body, name) @ twist).T_camera_lidar
        np.testing.assert_allclose(moved[name].T_camera_lidar, own, atol=2e-6)
        again = place_member(body, name, moved[name].T_camera_lidar)
        for other in names:
            np.testing.assert_allclose(
                again[other].T_camera_lidar, moved[other].T_camera_lidar, atol=1e-9
            )
