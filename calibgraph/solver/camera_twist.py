"""A camera under a twist of its extrinsic: its pose, its pixels, and their derivatives."""

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera


def apply_twist(camera: Camera, twist: Array) -> Camera:
    """The camera at exp(twist) T_camera_lidar, to first order in the translation.

    Args:
        camera: at its estimate.
        twist: (6,) rotation [rad] and translation [m], in the camera's axes.
    """
    return camera.moved_to(twisted(camera.T_camera_lidar, twist))


def twisted(T_camera_lidar: Array, twist: Array) -> Array:
    """(4, 4) exp(twist) T_camera_lidar, to first order in the translation, however far it is."""
    return np.asarray(transform(Rotation.from_rotvec(twist[:3]), twist[3:]) @ T_camera_lidar)


def project_with_jacobian(camera: Camera, points_lidar_m: Array) -> tuple[Array, Array]:
    """Project points, with the derivatives of the pixels by a twist of T_camera_lidar.

    Args:
        camera: lens, and the extrinsic about which is differentiated.
        points_lidar_m: (n, 3) in the LiDAR frame.

    Returns:
        (n, 2) pixels [px]; (n, 2, 6) their derivatives by rotation [px/rad] and translation [px/m].
    """
    columns = np.empty((6, 2, len(points_lidar_m)))
    pixels = fill_twist_columns(camera, points_lidar_m, columns)
    return np.ascontiguousarray(pixels.T), np.ascontiguousarray(columns.transpose(2, 1, 0))


def fill_twist_columns(camera: Camera, points_lidar_m: Array, columns: Array) -> Array:
    """As :func:`project_with_jacobian`, by columns.

    Args:
        camera: as there.
        points_lidar_m: as there.
        columns: (6, 2, n), filled with the derivatives.

    Returns:
        (2, n) pixels.
    """
    return camera.lens.fill_twist_columns(camera.T_camera_lidar, points_lidar_m, columns)
