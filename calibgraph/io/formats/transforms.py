"""Transforms of ROS: one writer for launch files, URDF and Autoware; readers, also of tf2."""

import shlex
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from pydantic import ConfigDict

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import StrictNumbers, checked_model
from calibgraph.io.formats.documents import commented_xml, commented_yaml
from calibgraph.io.formats.rig_export import RigExport, frame_id
from calibgraph.io.frame_tree import Link
from calibgraph.io.rig_parts import RigParts
from calibgraph.io.rotations import (
    pose_of_angles,
    pose_of_quaternion,
    quaternion_xyzw,
    roll_pitch_yaw,
)
from calibgraph.model.geometry import T_OPTICAL_LINK, invert
from calibgraph.model.rig import Finite

TRANSFORMS = ("ros2-launch", "urdf", "autoware")
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
_MORE = {
    "ros2-launch": "ROS 1: rosrun tf2_ros static_transform_publisher, with the numbers and frames "
    "of args in their order, without the names before them",
    "urdf": "rpy about fixed x, y, z",
}
_PUBLISHER = "static_transform_publisher"
_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw")
_KIT, _OPTICAL_LINK = "sensor_kit_base_link", "/camera_optical_link"
_ANGLES = ("x", "y", "z", "roll", "pitch", "yaw")


def write_transforms(export: RigExport, format: str) -> str:
    """Poses of frames in the form of one of ``TRANSFORMS``."""
    links = _WHICH.get(format, _measured)(export)
    directions = _of_kit(export) if format == "autoware" else _of_transforms(export, format)
    statement = export.statement(*directions)
    if format == "autoware":
        poses = {each.child: dict(zip(_ANGLES, _six(each), strict=True)) for each in links}
        return commented_yaml(statement, {_KIT: poses})
    return commented_xml(statement, _robot(export, links) if format == "urdf" else _launch(links))


def _of_transforms(export: RigExport, format: str) -> Iterator[str]:
    """The direction, and of each camera which transform is written."""
    yield _DIRECTION
    for name in export.cameras:
        parent, child, _ = export.link(name)
        text = _OF_LIDAR if export.mount(name) is None else _OF_TREE
        yield text.format(camera=name, parent=parent, child=child)
    yield _MORE[format]


def _measured(export: RigExport) -> list[Link]:
    """The transforms that the calibration changes."""
    return [Link(*export.link(name)) for name in export.cameras]


def _launch(links: Iterable[Link]) -> ElementTree.Element:
    root = ElementTree.Element("launch")
    for each in links:
        T = each.T_parent_child
        values = map(float, (*T[:3, 3], *quaternion_xyzw(T)))
        named = " ".join(f"--{name} {value!r}" for name, value in zip(_NAMES, values, strict=True))
        args = f"{named} --frame-id {each.parent} --child-frame-id {each.child}"
        attributes = {"pkg": "tf2_ros", "exec": _PUBLISHER, "args": args}
        ElementTree.SubElement(root, "node", attributes)
    return root


def _six(link: Link) -> list[float]:
    """Place, and roll, pitch, yaw."""
    return [*link.T_parent_child[:3, 3].tolist(), *roll_pitch_yaw(link.T_parent_child)]


def _joints(export: RigExport) -> list[Link]:
    """The transforms that are measured, and those between LiDAR and cameras that stay."""
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
    return [Link(parent, child, T) for child, (parent, T) in joints.items()]


def _robot(export: RigExport, links: list[Link]) -> ElementTree.Element:
    root = ElementTree.Element("robot", name="calibgraph")
    frames = [export.lidar_frame, *(each.parent for each in links), *(each.child for each in links)]
    for frame in dict.fromkeys(frames):
        ElementTree.SubElement(root, "link", name=frame)
    for each in links:
        joint = ElementTree.SubElement(root, "joint", name=f"{each.child}_joint", type="fixed")
        ElementTree.SubElement(joint, "parent", link=each.parent)
        ElementTree.SubElement(joint, "child", link=each.child)
        values = [repr(float(value)) for value in _six(each)]
        ElementTree.SubElement(joint, "origin", xyz=" ".join(values[:3]), rpy=" ".join(values[3:]))
    return root


def _sensor_kit(export: RigExport) -> list[Link]:
    """The LiDAR and the camera_link of each camera: x forward, not optical."""
    T_base_lidar = np.eye(4) if export.T_base_lidar is None else export.T_base_lidar
    links = [Link(_KIT, export.lidar_frame, T_base_lidar)]
    for name, optical in export.optical_frames.items():
        above = optical.removesuffix(_OPTICAL_LINK)  # as Autoware names it; else by the camera
        link = f"{above if above != optical else frame_id(name)}/camera_link"
        T_base_camera = T_base_lidar @ export.T_lidar_camera(name)
        links.append(Link(_KIT, link, T_base_camera @ T_OPTICAL_LINK))
    return links


def _of_kit(export: RigExport) -> Iterator[str]:
    yield f"each entry is the pose of a link (child) in {_KIT} (parent): p_base = T * p_link"
    yield (
        "camera_link: x forward, y left, z up; "
        "optical from camera_link: roll -pi/2, pitch 0, yaw -pi/2"
    )
    yield (
        f"{_KIT} is put at the LiDAR, as no --lidar-pose was given: take the differences only"
        if export.T_base_lidar is None
        else f"{_KIT} is where --lidar-pose puts it"
    )


_WHICH = {"urdf": _joints, "autoware": _sensor_kit}


def publisher_lines(launch: ElementTree.Element) -> list[str]:
    """The publishers of a launch file, as lines of a script."""
    nodes = (each for each in launch.iter("node") if _PUBLISHER in each.attrib.values())
    return [f"{_PUBLISHER} {each.get('args', '')}" for each in nodes]


def read_publishers(lines: Iterable[str], path: Path) -> RigParts:
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
    return RigParts(path, links=tuple(links))


def _published(text: str, path: Path) -> Link:
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
                float(given.get(f"--{key}", "0")) for key in (*_ANGLES, *_NAMES[3:6])
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
    return Link(frames[0].lstrip("/"), frames[1].lstrip("/"), T)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


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


def read_tf2(documents: list[dict[str, Any]], path: Path) -> RigParts:
    """The frames of TFMessages and TransformStampeds; the last of several for a child.

    A frame whose numbers are no transform is left out with a note: others may do without it.
    """
    links: dict[str, Link] = {}
    notes: list[str] = []
    for content in documents:
        listed = content if "transforms" in content else {"transforms": [content]}
        for stamped in checked_model(_Message, listed, path).transforms:
            try:
                link = _link(stamped)
                links[link.child] = link
            except ValueError as error:
                notes.append(f"{path}: frame {stamped.child_frame_id!r} is left out: {error}")
    return RigParts(path, links=tuple(links.values()), notes=tuple(notes))


def _link(stamped: _Stamped) -> Link:
    """The frame of a message."""
    t, q = stamped.transform.translation, stamped.transform.rotation
    if not np.isfinite([t.x, t.y, t.z]).all():
        raise ValueError(f"translation [{t.x}, {t.y}, {t.z}] is not finite")
    T = pose_of_quaternion((t.x, t.y, t.z), (q.x, q.y, q.z, q.w))
    parent, child = (name.lstrip("/") for name in (stamped.header.frame_id, stamped.child_frame_id))
    return Link(parent, child, T)


class _Pose(StrictNumbers):
    model_config = ConfigDict(extra="forbid")

    x: Finite
    y: Finite
    z: Finite
    roll: Finite
    pitch: Finite
    yaw: Finite


def is_autoware(content: dict[str, Any]) -> bool:
    """Whether the content of a YAML file is parent: {child: {x, y, z, roll, pitch, yaw}}."""
    return any(isinstance(pose, dict) and "roll" in pose for _, _, pose in _entries(content))


def _entries(content: dict[str, Any]) -> Iterator[tuple[str, str, Any]]:
    for parent, children in content.items():
        for child, pose in children.items() if isinstance(children, dict) else ():
            yield str(parent), str(child), pose


def read_autoware(content: dict[str, Any], path: Path) -> RigParts:
    """The frames of a sensor kit."""
    return RigParts(path, links=tuple(_kit_link(*entry, path) for entry in _entries(content)))


def _kit_link(parent: str, child: str, pose: Any, path: Path) -> Link:
    p = checked_model(_Pose, pose, f"{path}: {parent}: {child}")
    try:
        T = pose_of_angles((p.x, p.y, p.z), (p.roll, p.pitch, p.yaw))
    except ValueError as error:
        raise FileError(path, f"{parent}: {child}: {error}") from error
    return Link(parent, child, T)


def read_urdf(root: ElementTree.Element, path: Path) -> RigParts:
    """The frames of a URDF: its joints at their zero position."""
    if root.tag != "robot":
        raise FileError(path, f"is not a URDF: its root is <{root.tag}>, expected <robot>")
    if "{http://www.ros.org/wiki/xacro}" in "".join(element.tag for element in root.iter()):
        raise FileError(path, "holds xacro macros; expand it: xacro FILE > robot.urdf")
    return RigParts(
        path, links=tuple(_link_of_joint(joint, path) for joint in root.findall("joint"))
    )


def _link_of_joint(joint: ElementTree.Element, path: Path) -> Link:
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
    return Link(parent.get("link", ""), child.get("link", ""), T, note)


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
