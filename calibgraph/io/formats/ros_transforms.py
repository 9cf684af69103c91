"""Static transforms of ROS: publisher lines, a launch file, tf2's message, URDF."""

import shlex
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.files import StrictNumbers, checked_model
from calibgraph.io.formats.documents import commented, commented_xml, commented_yaml
from calibgraph.io.formats.part import FrameLink, Part
from calibgraph.io.formats.rig_export import RigExport
from calibgraph.io.rotations import (
    pose_of_angles,
    pose_of_quaternion,
    quaternion_xyzw,
    roll_pitch_yaw,
)

_DIRECTION = (
    "each transform is the pose of the optical frame (child) in the LiDAR frame (parent): "
    "p_lidar = T * p_camera, the inverse of T_camera_lidar; a frame has one parent: take other "
    "transforms to these optical frames out of the robot's description"
)


def write_ros1(export: RigExport) -> str:
    """Lines ``static_transform_publisher x y z qx qy qz qw frame_id child_frame_id`` of tf2_ros."""
    publisher = ["rosrun", "tf2_ros", "static_transform_publisher"]
    lines = [
        shlex.join([*publisher, *_numbers(export, name), export.lidar_frame, frame])
        for name, frame in export.optical_frames.items()
    ]
    order = "numbers: x y z qx qy qz qw, then parent and child frame"
    return _script(export.statement(_DIRECTION, order), lines)


def write_ros2(export: RigExport) -> str:
    """Lines ``ros2 run tf2_ros static_transform_publisher --x ...``."""
    lines = [
        shlex.join(["ros2", "run", "tf2_ros", "static_transform_publisher", *arguments])
        for arguments in _arguments(export)
    ]
    return _script(export.statement(_DIRECTION), lines)


def _script(statement: list[str], lines: list[str]) -> str:
    """A shell script that runs all lines until it is ended."""
    return commented(statement) + "".join(f"{line} &\n" for line in lines) + "wait\n"


def write_ros2_launch(export: RigExport) -> str:
    """An XML launch file with one publisher per camera."""
    root = ElementTree.Element("launch")
    for arguments in _arguments(export):
        attributes = {
            "pkg": "tf2_ros",
            "exec": "static_transform_publisher",
            "args": " ".join(arguments),
        }
        ElementTree.SubElement(root, "node", attributes)
    return commented_xml(export.statement(_DIRECTION), root)


def _arguments(export: RigExport) -> list[list[str]]:
    """The arguments of each ROS 2 publisher."""
    keys = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    return [
        [
            *(part for pair in zip(keys, _numbers(export, name), strict=True) for part in pair),
            *("--frame-id", export.lidar_frame, "--child-frame-id", frame),
        ]
        for name, frame in export.optical_frames.items()
    ]


def _numbers(export: RigExport, name: str) -> list[str]:
    """The seven numbers x y z qx qy qz qw of a camera's pose in the LiDAR frame."""
    T = export.T_lidar_camera(name)
    return [repr(float(value)) for value in (*T[:3, 3], *quaternion_xyzw(T))]


def write_tf2(export: RigExport) -> str:
    """``tf2_msgs/TFMessage`` as YAML."""
    content = {"transforms": [_stamped(export, name) for name in export.cameras]}
    publish = (
        "publish: ros2 topic pub --once --qos-durability transient_local /tf_static "
        'tf2_msgs/msg/TFMessage "$(cat FILE)"'
    )
    return commented_yaml(export.statement(_DIRECTION, publish), content)


def _stamped(export: RigExport, name: str) -> dict[str, Any]:
    T = export.T_lidar_camera(name)
    return {
        "header": {"frame_id": export.lidar_frame},
        "child_frame_id": export.optical_frames[name],
        "transform": {
            "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
            "rotation": dict(zip("xyzw", quaternion_xyzw(T), strict=True)),
        },
    }


class _Vector(StrictNumbers):
    x: float
    y: float
    z: float


class _Quaternion(_Vector):
    w: float


class _Transform(StrictNumbers):
    translation: _Vector
    rotation: _Quaternion


class _Header(StrictNumbers):
    frame_id: str


class _Stamped(StrictNumbers):
    header: _Header
    child_frame_id: str
    transform: _Transform


class _Message(StrictNumbers):
    transforms: list[_Stamped]


def is_tf2(content: dict[str, Any]) -> bool:
    """Whether the content of a YAML file is a TFMessage, or a single TransformStamped."""
    return "transforms" in content or {"transform", "child_frame_id"} <= content.keys()


def read_tf2(documents: list[dict[str, Any]], path: Path) -> Part:
    """The frames of TFMessages and TransformStampeds; the last of several for a child.

    A frame whose numbers are no transform is left out with a note: others may do without it.
    """
    links: dict[str, FrameLink] = {}
    notes: list[str] = []
    for content in documents:
        listed = content if "transforms" in content else {"transforms": [content]}
        for stamped in checked_model(_Message, listed, path).transforms:
            try:
                link = _link(stamped)
                links[link.child] = link
            except ValueError as error:
                notes.append(f"{path}: frame {stamped.child_frame_id!r} is left out: {error}")
    return Part(path, links=tuple(links.values()), notes=tuple(notes))


def _link(stamped: _Stamped) -> FrameLink:
    """The frame of a message."""
    t, q = stamped.transform.translation, stamped.transform.rotation
    if not np.isfinite([t.x, t.y, t.z]).all():
        raise ValueError(f"translation [{t.x}, {t.y}, {t.z}] is not finite")
    T = pose_of_quaternion((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))
    parent, child = (name.lstrip("/") for name in (stamped.header.frame_id, stamped.child_frame_id))
    return FrameLink(parent, child, T)


_URDF_DIRECTION = (
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
    return commented_xml(export.statement(_URDF_DIRECTION), root)


def _text(values: list[float] | NDArray[np.float64]) -> str:
    return " ".join(repr(float(value)) for value in values)


def read_urdf(root: ElementTree.Element, path: Path) -> Part:
    """The frames of a URDF: its joints at their zero position."""
    if root.tag != "robot":
        raise FileError(path, f"is not a URDF: its root is <{root.tag}>, expected <robot>")
    if "{http://www.ros.org/wiki/xacro}" in "".join(element.tag for element in root.iter()):
        raise FileError(path, "holds xacro macros; expand it: xacro FILE > robot.urdf")
    return Part(path, links=tuple(_link_of_joint(joint, path) for joint in root.findall("joint")))


def _link_of_joint(joint: ElementTree.Element, path: Path) -> FrameLink:
    parent, child, origin = (joint.find(tag) for tag in ("parent", "child", "origin"))
    if parent is None or child is None:
        raise FileError(path, f"joint {joint.get('name')!r} has no <parent> or no <child>")
    attributes = {} if origin is None else origin.attrib
    xyz = _three_numbers(attributes.get("xyz", "0 0 0"), joint, path)
    rpy = _three_numbers(attributes.get("rpy", "0 0 0"), joint, path)
    try:
        T = pose_of_angles(xyz, rpy)
    except ValueError as error:
        raise FileError(path, f"joint {joint.get('name')!r}: {error}") from error
    note = f"{path}: {_movement(joint)}" if joint.get("type") in _MOVABLE else ""
    return FrameLink(parent.get("link", ""), child.get("link", ""), T, note)


_MOVABLE = ("revolute", "continuous", "prismatic", "planar", "floating")


def _movement(joint: ElementTree.Element) -> str:
    """That a joint between LiDAR and camera can move, and between which limits."""
    limit = joint.find("limit")
    unit = "m" if joint.get("type") == "prismatic" else "rad"
    found = {} if limit is None or joint.get("type") == "continuous" else limit.attrib
    try:
        low, high = (float(found.get(key, "0")) for key in ("lower", "upper"))
    except ValueError:
        low = high = 0.0
    limits = f" from {low:g} to {high:g} {unit}" if low < high else ""
    zero = "at zero" if low <= 0 <= high else "at zero, which is outside its limits"
    return (
        f"joint {joint.get('name')!r} lies between LiDAR and camera and can move{limits}; it is "
        f"taken {zero}: if it stands elsewhere, write its position into <origin>"
    )


def _three_numbers(text: str, joint: ElementTree.Element, path: Path) -> list[float]:
    try:
        x, y, z = (float(part) for part in text.split())
    except ValueError as error:
        raise FileError(
            path, f"joint {joint.get('name')!r}: expected three numbers, found {text!r}"
        ) from error
    if not np.isfinite([x, y, z]).all():
        raise FileError(path, f"joint {joint.get('name')!r}: {text!r} is not finite")
    return [x, y, z]
