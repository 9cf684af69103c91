"""Other programs' readings of the files, written by hand or by their libraries, not by ours.

Each reader gives T_camera_lidar per camera: from the LiDAR to the optical axes.
"""

import json
import re
from math import cos, sin
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import yaml
from urdf_parser_py.urdf import URDF

Poses = dict[str, np.ndarray]
PARENTS = ("lidar", "base")  # base: of a tree in which a calibration replaces a transform

# ROS's camera_link is x forward, y left, z up; REP 103.
OPTICAL_OF_LINK = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def quaternion_pose(xyz: list[float], x: float, y: float, z: float, w: float) -> np.ndarray:
    """The textbook's matrix of a unit quaternion."""
    assert abs(x * x + y * y + z * z + w * w - 1) < 1e-12
    T = np.eye(4)
    T[:3, 3] = xyz
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return T


def angles_pose(xyz: list[float], roll: float, pitch: float, yaw: float) -> np.ndarray:
    """URDF: about fixed x, then y, then z."""
    Rx = np.array([[1, 0, 0], [0, cos(roll), -sin(roll)], [0, sin(roll), cos(roll)]])
    Ry = np.array([[cos(pitch), 0, sin(pitch)], [0, 1, 0], [-sin(pitch), 0, cos(pitch)]])
    Rz = np.array([[cos(yaw), -sin(yaw), 0], [sin(yaw), cos(yaw), 0], [0, 0, 1]])
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = xyz, Rz @ Ry @ Rx
    return T


def inverse(T: np.ndarray) -> np.ndarray:
    return np.linalg.inv(T)


def camera_of(frame: str) -> str:
    return frame.removesuffix("_optical_frame")


def kalibr(path: Path) -> Poses:
    """Chains T_cn_cnm1 from the first camera on, as Kalibr does; T_cam_lidar of cam0 only."""
    chain = yaml.safe_load(path.read_text())
    poses, T = {}, np.array(chain["cam0"]["T_cam_lidar"])
    for index, camera in enumerate(chain.values()):
        T = np.array(camera["T_cn_cnm1"]) @ T if index else T
        poses[camera["rostopic"].split("/")[1]] = T
    return poses


def ros2_arguments(words: list[str]) -> tuple[str, np.ndarray]:
    """The child, and T_child_parent, of a ROS 2 static_transform_publisher."""
    flags = dict(zip(words[::2], words[1::2], strict=True))
    assert flags["--frame-id"] in PARENTS
    xyz = [float(flags[f"--{axis}"]) for axis in "xyz"]
    T = quaternion_pose(xyz, *(float(flags[f"--q{axis}"]) for axis in "xyzw"))
    return camera_of(flags["--child-frame-id"]), inverse(T)


def ros2_launch(path: Path) -> Poses:
    root = ElementTree.parse(path).getroot()
    assert root.tag == "launch"
    nodes = root.findall("node")
    assert {(n.get("pkg"), n.get("exec")) for n in nodes} == {
        ("tf2_ros", "static_transform_publisher")
    }
    return dict(ros2_arguments((node.get("args") or "").split()) for node in nodes)


def urdf(path: Path) -> Poses:
    """By ROS's own parser."""
    robot = URDF.from_xml_string(path.read_text())
    assert {joint.parent for joint in robot.joints} == {"lidar"}
    return {
        camera_of(joint.child): inverse(angles_pose(joint.origin.xyz, *joint.origin.rpy))
        for joint in robot.joints
    }


def autoware(path: Path) -> Poses:
    """Autoware's xacro puts camera_link there, and the optical frame by a fixed joint on it."""
    kit = yaml.safe_load(path.read_text())["sensor_kit_base_link"]
    T_base = {
        child: angles_pose([p["x"], p["y"], p["z"]], p["roll"], p["pitch"], p["yaw"])
        for child, p in kit.items()
    }
    T_link_optical = angles_pose([0, 0, 0], -np.pi / 2, 0, -np.pi / 2)
    np.testing.assert_allclose(inverse(T_link_optical), OPTICAL_OF_LINK, atol=1e-15)
    return {
        child.removesuffix("/camera_link"): inverse(T @ T_link_optical) @ T_base["lidar"]
        for child, T in T_base.items()
        if child != "lidar"
    }


def opencv(path: Path) -> Poses:
    """By OpenCV."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    cameras = [file.getNode(key) for key in file.root().keys()]  # noqa: SIM118 - no dict
    return {c.getNode("name").string(): c.getNode("T_camera_lidar").mat() for c in cameras}


def plain_json(path: Path) -> Poses:
    cameras = json.loads(path.read_text())["cameras"]
    return {name: np.array(camera["T_camera_lidar"]) for name, camera in cameras.items()}


READERS = {
    "kalibr": kalibr,
    "ros2-launch": ros2_launch,
    "urdf": urdf,
    "autoware": autoware,
    "opencv": opencv,
    "json": plain_json,
}


def worked_points(text: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The points in a file's statement, by camera: in the LiDAR frame, in the camera's."""
    triple = r"\(([-\d.]+), ([-\d.]+), ([-\d.]+)\) m"
    found = re.findall(rf"([\w./-]+): p_lidar = {triple} -> p_camera = {triple}", text)
    return {
        row[0]: (np.array(row[1:4], dtype=float), np.array(row[4:7], dtype=float)) for row in found
    }
