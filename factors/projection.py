"""The plain projection factor: one GTSAM factor per 2D-3D correspondence.

It is the method in stock GTSAM terms, and the reference in tests of the block factor. It costs a
Python call per correspondence; use ``factors.block`` for real work.
"""

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from factors.lens import Lens
from factors.loss import robust_noise
from factors.pose import custom_factor

Array = NDArray[np.float64]


def projection_residual(
    lens: Lens, T_lidar_camera: gtsam.Pose3, point_lidar_m: Array, pixel_px: Array
) -> tuple[Array, Array]:
    """Residual ``pi(T_lidar_camera^-1 p) - u`` and its Jacobian.

    Args:
        lens: the camera's lens.
        T_lidar_camera: pose of the camera in the LiDAR frame.
        point_lidar_m: (3,) point in the LiDAR frame.
        pixel_px: (2,) observed pixel.

    Returns:
        (2,) residual [px]; (2, 6) Jacobian in GTSAM's tangent (rotation, translation) of the pose.
    """
    by_pose = np.zeros((3, 6), order="F")
    point_camera = T_lidar_camera.transformTo(point_lidar_m, by_pose)
    pixels, by_point = lens.project_with_jacobian(point_camera)
    return lens.subtract(pixels, pixel_px)[0], by_point[0] @ by_pose


def projection_factor(
    key: int,
    lens: Lens,
    point_lidar_m: ArrayLike,
    pixel_px: ArrayLike,
    *,
    sqrt_information: ArrayLike | None = None,
    loss: str = "cauchy",
    scale: float = 4.0,
) -> gtsam.CustomFactor:
    """One correspondence as a robust projection factor on ``T_lidar_camera`` (paper, Eq. 5).

    Args:
        key: the pose variable.
        lens: the camera's lens.
        point_lidar_m: (3,) point in the LiDAR frame.
        pixel_px: (2,) observed pixel.
        sqrt_information: (2, 2) upper triangular whitening matrix [1/px]; identity if None.
        loss: name of the robust loss.
        scale: whitened residual norm at which the loss bends (the paper's delta).
    """
    point = np.asarray(point_lidar_m, dtype=np.float64)
    pixel = np.asarray(pixel_px, dtype=np.float64)
    whitening = np.eye(2) if sqrt_information is None else np.asarray(sqrt_information)

    def linearize(values: gtsam.Values) -> tuple[Array, list[Array]]:
        residual, jacobian = projection_residual(lens, values.atPose3(key), point, pixel)
        return residual, [jacobian]

    base = gtsam.noiseModel.Gaussian.SqrtInformation(whitening)
    return custom_factor(robust_noise(base, loss=loss, scale=scale), [key], linearize)
