"""Files of other programs, as these write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

# A camera that looks along the LiDAR's x axis, 0.4 m ahead, 0.1 m left, 0.2 m below:
# x = -left, y = -up, z = ahead of the point, less the same of the camera.
FRONT = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.4], [0, 0, 0, 1.0]])


SENTENCE = "front looks along LiDAR +x, sits 0.40 m ahead, 0.10 m left and 0.20 m below the LiDAR"


CAMERA_INFO = """\
image_width: 1920
image_height: 1200
camera_name: front
camera_matrix: {rows: 3, cols: 3, data: [1000.5, 0, 960.25, 0, 1001.5, 600.75, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.02, 0.001, -0.002, 0.003]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [900, 0, 960, 0, 0, 900, 600, 0, 0, 0, 1, 0]}
"""


KALIBR = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [460.5, 461.5, 370.25, 240.75]
  resolution: [752, 480]
  rostopic: /stereo/left/image_raw
  T_cam_lidar: [[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.4], [0, 0, 0, 1]]
cam1:
  camera_model: pinhole
  T_cn_cnm1: [[1, 0, 0, -0.11], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  distortion_coeffs: [0.01, -0.02, 0.003, -0.0004]
  distortion_model: equidistant
  intrinsics: [450, 451, 371, 241]
  resolution: [752, 480]
  rostopic: /stereo/right/image_raw
"""


URDF = """\
<?xml version="1.0"?>
<robot name="car">
  <link name="base_link"/><link name="velodyne"/><link name="front_link"/>
  <joint name="a" type="fixed">
    <origin xyz="1.0 0.0 2.0" rpy="0 0 0"/><parent link="base_link"/><child link="velodyne"/>
  </joint>
  <joint name="b" type="fixed">
    <origin xyz="1.4 0.1 1.8"/><parent link="base_link"/><child link="front_link"/>
  </joint>
  <joint name="c" type="fixed">
    <origin rpy="-1.5707963267948966 0 -1.5707963267948966"/>
    <parent link="front_link"/><child link="front_camera_optical_frame"/>
  </joint>
</robot>
"""


SENSOR_KIT = """\
sensor_kit_base_link:
  front/camera_link: {x: 0.4, y: 0.1, z: 0.6, roll: 0.0, pitch: 0.0, yaw: 0.0}
  velodyne_top_base_link: {x: 0.0, y: 0.0, z: 0.8, roll: 0.0, pitch: 0.0, yaw: 0.0}
  gnss_link: {x: -0.1, y: 0.0, z: 0.0, roll: 0.0, pitch: 0.0, yaw: 0.0}
"""


TF2 = """\
transforms:
- header: {frame_id: base_link}
  child_frame_id: os_sensor
  transform: {translation: {x: 1, y: 0, z: 2}, rotation: {x: 0, y: 0, z: 0, w: 1}}
- header: {frame_id: base_link}
  child_frame_id: front_optical_frame
  transform: {translation: {x: 1.4, y: 0.1, z: 1.8}, rotation: {x: -0.5, y: 0.5, z: -0.5, w: 0.5}}
"""


KOIDE = {
    "camera": {
        "camera_model": "plumb_bob",
        "intrinsics": [810.5, 811.5, 822.25, 622.75],
        "distortion_coeffs": [-0.04, 0.08, 0.0001, -0.0002, -0.03],
    },
    "results": {
        "T_lidar_camera": [0.4, 0.1, -0.2, -0.5, 0.5, -0.5, 0.5],
        "init_T_lidar_camera": [9.0, 9.0, 9.0, 0.0, 0.0, 0.0, 1.0],
    },
}


def write(folder: Path, **files: str) -> list[Path]:
    """Files by name, with __ for the dot."""
    paths = [folder / name.replace("__", ".") for name in files]
    for path, text in zip(paths, files.values(), strict=True):
        path.write_text(text)
    return paths
