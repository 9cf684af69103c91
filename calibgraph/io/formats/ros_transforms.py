"""Static transforms of ROS: publisher lines, a launch file, tf2's message, URDF."""

import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
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
from calibgraph.model.geometry import invert

_DIRECTION = "each transform is the pose of the child frame in its parent: p_parent = T * p_child"
_OF_LIDAR = (
    "{camera}: the optical frame (child) in the LiDAR frame (parent): p_lidar = T * p_camera, the "
    "inverse of T_camera_lidar; a frame has one parent: take other transforms to {child} out of "
    "the robot's description"
)
_OF_TREE = (
    "{camera}: {child} in {parent}, so that the camera, which hangs from {child}, is where it was "
    "measured; it replaces this transform of the robot's description, whose others stay"
)


def _statement(export: RigExport, *more: str) -> list[str]:
    """The lines of a comment: direction, and of each camera which transform is written."""
    lines = []
    for name in export.cameras:
        parent, child, _ = export.link(name)
        text = _OF_LIDAR if export.mount(name) is None else _OF_TREE
        lines.append(text.format(camera=name, parent=parent, child=child))
    return export.statement(_DIRECTION, *lines, *more)


def write_ros1(export: RigExport) -> str:
    """Lines ``static_transform_publisher x y z qx qy qz qw frame_id child_frame_id`` of tf2_ros."""
    publisher = ["rosrun", "tf2_ros", "static_transform_publisher"]
    links = (export.link(name) for name in export.cameras)
    lines = [shlex.join([*publisher, *_numbers(T), *frames]) for *frames, T in links]
    order = "numbers: x y z qx qy qz qw, then parent and child frame"
    return _script(_statement(export, order), lines)


def write_ros2(export: RigExport) -> str:
    """Lines ``ros2 run tf2_ros static_transform_publisher --x ...``."""
    lines = [
        shlex.join(["ros2", "run", "tf2_ros", "static_transform_publisher", *arguments])
        for arguments in _arguments(export)
    ]
    return _script(_statement(export), lines)


def _script(statement: list[str], lines: list[str]) -> str:
    """A shell script that runs all lines until it is ended."""
    return commented(statement) + "".join(f"{line} &\n" for line in lines) + "wait\n"


def write_ros2_launch(export: RigExport) -> str:
    """An XML launch file with one publisher per camera."""
    root = ElementTree.Element("launch")
    for arguments in _arguments(export):
        attributes = {"pkg": "tf2_ros", "exec": _PUBLISHER, "args": " ".join(arguments)}
        ElementTree.SubElement(root, "node", attributes)
    return commented_xml(_statement(export), root)


_PUBLISHER = "static_transform_publisher"
_KEYS = ("x", "y", "z", "qx", "qy", "qz", "qw")


def _arguments(export: RigExport) -> list[list[str]]:
    """The arguments of each ROS 2 publisher."""
    found = []
    for name in export.cameras:
        parent, child, T = export.link(name)
        pairs = zip(_KEYS, _numbers(T), strict=True)
        numbers = (part for key, number in pairs for part in (f"--{key}", number))
        found.append([*numbers, "--frame-id", parent, "--child-frame-id", child])
    return found


def _numbers(T: Array) -> list[str]:
    """The seven numbers x y z qx qy qz qw of a pose."""
    return [repr(float(value)) for value in (*T[:3, 3], *quaternion_xyzw(T))]


def publisher_lines(launch: ElementTree.Element) -> list[str]:
    """The publishers of a launch file, as lines of a script."""
    nodes = (each for each in launch.iter("node") if _PUBLISHER in each.attrib.values())
    return [f"{_PUBLISHER} {each.get('args', '')}" for each in nodes]


def read_publishers(lines: Iterable[str], path: Path) -> Part:
    """The frames of lines ``... static_transform_publisher ARGUMENTS``, of ROS 1 or 2."""
    links = [
        _published(line.partition(_PUBLISHER)[2].partition(" &")[0], path)
        for line in lines
        if _PUBLISHER in line and not line.lstrip().startswith("#")
    ]
    if not links:
        raise FileError(
            path,
            f"has no {_PUBLISHER}; write the transforms to a file: `ros2 topic echo --once "
            "/tf_static > tf_static.yaml`",
        )
    return Part(path, links=tuple(links))


def _published(text: str, path: Path) -> FrameLink:
    """The frame of a publisher: with names, or x y z, yaw pitch roll or a quaternion, frames."""
    wrong = FileError(
        path, f"{_PUBLISHER}{text[:80]}: expected numbers and two frames, without $()"
    )
    try:
        words = shlex.split(text)
        given = dict(zip(words[::2], words[1::2], strict=False))
        if text.lstrip().startswith("--"):
            frames = given["--frame-id"], given["--child-frame-id"]
            x, y, z, roll, pitch, yaw, *turn = (
                float(given.get(f"--{key}", "0"))
                for key in ("x", "y", "z", "roll", "pitch", "yaw", *_KEYS[3:6])
            )
            by_quaternion = "--qw" in given
            turn.append(float(given.get("--qw", "1")))
        else:
            places = [n for n, word in enumerate(words) if not _is_number(word)][:2]
            frames = words[places[0]], words[places[1]]
            x, y, z, *turn = map(float, words[: places[0]])
            by_quaternion = len(turn) == len("xyzw")
            yaw, pitch, roll = turn[:3]
        T = (
            pose_of_quaternion((x, y, z), turn) if by_quaternion
            else pose_of_angles((x, y, z), (roll, pitch, yaw))
        )  # fmt: skip
    except (KeyError, IndexError, ValueError) as error:
        raise wrong from error
    if not np.isfinite(T).all():
        raise wrong
    return FrameLink(frames[0].lstrip("/"), frames[1].lstrip("/"), T)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def write_tf2(export: RigExport) -> str:
    """``tf2_msgs/TFMessage`` as YAML."""
    content = {"transforms": [_stamped(export, name) for name in export.cameras]}
    publish = (
        "publish: ros2 topic pub --once --qos-durability transient_local /tf_static "
        'tf2_msgs/msg/TFMessage "$(cat FILE)"'
    )
    return commented_yaml(_statement(export, publish), content)


def _stamped(export: RigExport, name: str) -> dict[str, Any]:
    parent, child, T = export.link(name)
    return {
        "header": {"frame_id": parent},
        "child_frame_id": child,
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


def write_urdf(export: RigExport) -> str:
    """A robot of the LiDAR's link and, for each camera, links and fixed joints to it."""
    joints: dict[str, tuple[str, Array]] = {}
    for name, optical in export.optical_frames.items():
        parent, child, T_parent_child = export.link(name)
        joints[child] = parent, T_parent_child
        mount = export.mount(name)
        if mount is not None and child != optical:
            joints[optical] = child, invert(mount.T_camera_child)
        if mount is None or parent == export.lidar_frame:
            continue
        if export.lidar_frame not in joints:
            joints[export.lidar_frame] = parent, mount.T_parent_lidar
        elif joints[export.lidar_frame][0] != parent:
            joints[parent] = export.lidar_frame, invert(mount.T_parent_lidar)
    root = ElementTree.Element("robot", name="calibgraph")
    for link in dict.fromkeys([export.lidar_frame, *(p for p, _ in joints.values()), *joints]):
        ElementTree.SubElement(root, "link", name=link)
    for child, (parent, T) in joints.items():
        joint = ElementTree.SubElement(root, "joint", name=f"{child}_joint", type="fixed")
        ElementTree.SubElement(joint, "parent", link=parent)
        ElementTree.SubElement(joint, "child", link=child)
        ElementTree.SubElement(joint, "origin", xyz=_text(T[:3, 3]), rpy=_text(roll_pitch_yaw(T)))
    return commented_xml(_statement(export, "rpy about fixed x, y, z"), root)


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
