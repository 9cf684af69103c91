"""Calibrations in the formats of others, which are listed here: the command line's help is fast."""

from collections.abc import Mapping
from typing import Final

EXPORT_FORMATS: Final[Mapping[str, str]] = {
    "kalibr": "Kalibr-style camchain YAML with T_cam_lidar and T_cn_cnm1",
    "ros2-launch": "ROS 2 launch file (.launch.xml) of static_transform_publisher nodes",
    "urdf": "URDF with a fixed joint per camera and LiDAR: base LiDAR -> their frames",
    "autoware": "Autoware's sensor_kit_calibration.yaml, and sensors_calibration.yaml beside it",
    "camera_info": "folder of a ROS camera_info YAML per camera: lenses, no extrinsics",
    "opencv": "OpenCV FileStorage YAML: matrices, distortion, T_camera_lidar",
    "json": "plain JSON: T_camera_lidar, T_lidar_camera, lenses, covariance",
}
"""What ``calibgraph export --format`` writes."""

IMPORT_FORMATS: Final = (
    "Kalibr camchain, ROS camera_info and transforms (files, or as ros2 topic echo prints them), "
    "OpenCV FileStorage (.yaml, .json), Autoware sensor kit, parameters of FAST-LIVO, URDF, "
    "static_transform_publisher in launch files (XML) and scripts (.sh), KITTI's calib.txt, a ROS "
    "bag, a rig file, a result or a JSON export of calibgraph"
)
"""What ``calibgraph rig`` reads."""
