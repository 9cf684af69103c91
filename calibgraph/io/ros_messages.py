"""ROS messages that a program has received, as arrays and cameras. ROS itself is not needed.

Any object with the fields of the message serves: of rclpy, rospy, rosbags or a decoder of MCAP.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibgraph.files import checked_model
from calibgraph.io.bags.camera_info import lens_of
from calibgraph.io.bags.pictures import picture_of
from calibgraph.io.bags.point_clouds import points_of
from calibgraph.model.rig import Camera


def cloud_from_message(message: Any) -> NDArray[np.float32]:
    """(n, 4) x y z [m], intensity of a PointCloud2, without the points that are no returns.

    Raises:
        DatasetError: if it has no x y z, or less data than it declares.
    """
    return points_of(message, _where(message))


def image_from_message(message: Any) -> NDArray[np.uint8]:
    """(height, width, 3) BGR of an Image or a CompressedImage.

    Raises:
        DatasetError: if its encoding is unknown, or it is incomplete.
    """
    return picture_of(message, _where(message))


def camera_from_message(
    message: Any,
    T_camera_lidar: NDArray[np.float64],
    *,
    rectified: bool = False,
    frame_of_first: bool = False,
) -> Camera:
    """A camera with the lens of a CameraInfo.

    Args:
        message: the CameraInfo.
        T_camera_lidar: (4, 4) the guess, to the camera's optical frame that the message names, as
            tf2's ``lookup_transform(target=camera_optical, source=lidar)``.
        rectified: whether the images are: by R, and of the camera matrix P.
        frame_of_first: whether the message of a stereo pair's second camera names the frame of the
            first, so that the baseline in P counts.

    Raises:
        FileError: if the camera is not calibrated, its lens model is unknown, a value is no lens's,
            or the transform is none.
    """
    where = _where(message)
    stated = lens_of(message, where, rectified=rectified)
    T_image_frame = stated.T_image_frame(with_baseline=frame_of_first)
    return checked_model(
        Camera, {**stated.lens.fields(), "T_camera_lidar": T_image_frame @ T_camera_lidar}, where
    )


def _where(message: Any) -> str:
    stamp = message.header.stamp
    return f"message of {message.header.frame_id} at {stamp.sec}.{stamp.nanosec:09d}"
