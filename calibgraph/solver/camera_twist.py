"""A camera under a twist of its extrinsic: its pose, its pixels, and their derivatives."""

import numpy as np
from scipy.spatial.transform import Rotation

from calibgraph.arrays import Array
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera
from factors import FreeLens
from factors.free_lens import time_derivative


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


def free_fields_px(
    camera: Camera, free: FreeLens, points_lidar_m: Array, twist_per_s: Array | None = None
) -> Array:
    """(k, 2, n) derivatives of the pixels of points by free parameters of lens and clock.

    Args:
        camera: lens and extrinsic.
        free: its parameters.
        points_lidar_m: (n, 3) where they are when their pixels are taken.
        twist_per_s: (6,) or (n, 6) of the LiDAR; of one whose motion is unknown, derivatives by
            the clock are zero.
    """
    columns = np.empty((6 + len(free), 2, len(points_lidar_m)))
    pixels, T = fill_twist_columns(camera, points_lidar_m, columns[:6]), camera.T_camera_lidar
    free.fill_columns(camera.lens, points_lidar_m @ T[:3, :3].T + T[:3, 3], columns[6:])
    if twist_per_s is not None:
        by_time = time_derivative(T, -columns[:6], np.atleast_2d(twist_per_s))
        free.fill_clock_columns(by_time, pixels[1], columns[6:])
    return columns[6:]
