"""A deployed calibration, and how it moves."""

import numpy as np
from scipy.spatial.transform import Rotation

import calibgraph
from calibgraph import Rig
from calibgraph.model.geometry import transform
from tests.conftest import SAMPLE

TRUTH = calibgraph.load_rig(SAMPLE / "reference.yaml")


def motion(axis: int, degrees: float = 0.0, metres: float = 0.0) -> np.ndarray:
    """(4, 4) about and along one axis."""
    way = np.eye(3)[axis]
    return transform(Rotation.from_rotvec(degrees * way, degrees=True), metres * way)


def with_camera_moved(rig: Rig, name: str, T: np.ndarray) -> Rig:
    """The rig as deployed before this camera moved by T, in its own axes."""
    return rig.moved_to({**rig.T_camera_lidar, name: T @ rig.T_camera_lidar[name]})
