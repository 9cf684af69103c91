"""A deployed calibration, and how it moves."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import Rig
from tests.conftest import SAMPLE

TRUTH = calibgraph.load_rig(SAMPLE / "reference.yaml")


def motion(axis: int, degrees: float = 0.0, metres: float = 0.0) -> np.ndarray:
    """(4, 4) about and along one axis."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * np.eye(3)[axis]).as_matrix()
    T[axis, 3] = metres
    return T


def with_camera_moved(rig: Rig, name: str, T: np.ndarray) -> Rig:
    """The rig as deployed before this camera moved by T, in its own axes."""
    return rig.moved_to({**rig.T_camera_lidar, name: T @ rig.T_camera_lidar[name]})
