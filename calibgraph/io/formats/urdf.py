"""URDF: fixed joints to optical frames, and the links of a robot."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.io.formats.documents import commented_xml
from calibgraph.io.formats.part import FrameLink, Part
from calibgraph.io.formats.rig_export import RigExport
from calibgraph.io.rotations import pose_of_angles, roll_pitch_yaw

_DIRECTION = (
    "each joint's origin is the pose of the optical frame (child) in the LiDAR frame (parent): "
    "p_lidar = T * p_camera, the inverse of T_camera_lidar; rpy about fixed x, y, z; a frame has "
    "one parent: take other joints to these optical frames out of the robot's description"
)


def write_urdf(export: RigExport) -> str:
    """A robot of the LiDAR's link and one link and fixed joint per camera."""
    root = ElementTree.Element("robot", name="calibgraph")
    ElementTree.SubElement(root, "link", name=export.lidar_frame)
    for name, frame in export.optical_frames.items():
        T = export.T_lidar_camera(name)
        ElementTree.SubElement(root, "link", name=frame)
        joint = ElementTree.SubElement(root, "joint", name=f"{frame}_joint", type="fixed")
        ElementTree.SubElement(joint, "parent", link=export.lidar_frame)
        ElementTree.SubElement(joint, "child", link=frame)
        ElementTree.SubElement(joint, "origin", xyz=_text(T[:3, 3]), rpy=_text(roll_pitch_yaw(T)))
    return commented_xml(export.statement(_DIRECTION), root)


def _text(values: list[float] | NDArray[np.float64]) -> str:
    return " ".join(repr(float(value)) for value in values)


def read_urdf(root: ElementTree.Element, path: Path) -> Part:
    """The frames of a URDF: its joints at their zero position."""
    if root.tag != "robot":
        raise FileError(path, f"is not a URDF: its root is <{root.tag}>, expected <robot>")
    if "{http://www.ros.org/wiki/xacro}" in "".join(element.tag for element in root.iter()):
        raise FileError(path, "holds xacro macros; expand it: xacro FILE > robot.urdf")
    return Part(path, links=tuple(_link(joint, path) for joint in root.findall("joint")))


def _link(joint: ElementTree.Element, path: Path) -> FrameLink:
    parent, child, origin = (joint.find(tag) for tag in ("parent", "child", "origin"))
    if parent is None or child is None:
        raise FileError(path, f"joint {joint.get('name')!r} has no <parent> or no <child>")
    attributes = {} if origin is None else origin.attrib
    xyz = _numbers(attributes.get("xyz", "0 0 0"), joint, path)
    rpy = _numbers(attributes.get("rpy", "0 0 0"), joint, path)
    try:
        T = pose_of_angles(xyz, rpy)
    except ValueError as error:
        raise FileError(path, f"joint {joint.get('name')!r}: {error}") from error
    return FrameLink(parent.get("link", ""), child.get("link", ""), T)


def _numbers(text: str, joint: ElementTree.Element, path: Path) -> list[float]:
    try:
        x, y, z = (float(part) for part in text.split())
    except ValueError as error:
        raise FileError(
            path, f"joint {joint.get('name')!r}: expected three numbers, found {text!r}"
        ) from error
    if not np.isfinite([x, y, z]).all():
        raise FileError(path, f"joint {joint.get('name')!r}: {text!r} is not finite")
    return [x, y, z]
