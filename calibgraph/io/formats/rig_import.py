"""A rig from files of other programs, each in the format that its name or content shows."""

import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree

import numpy as np
from defusedxml import DefusedXmlException
from defusedxml.ElementTree import fromstring
from pydantic import AliasPath, Field

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, FileError
from calibgraph.files import checked_model, read_json, read_text, require_file
from calibgraph.io.bags import is_bag
from calibgraph.io.bags.rig import read_bag_rig
from calibgraph.io.formats.foreign_keys import Foreign, number, read_foreign
from calibgraph.io.kitti import CALIBRATION_NAME
from calibgraph.io.lenses import CameraLens
from calibgraph.io.rig_parts import (
    ONLY_CAMERA,
    Link,
    Links,
    RigParts,
    T_between,
    ancestors,
    find_mounts,
    frame_id,
    frame_names,
    links_between,
    pose_of_angles,
    pose_of_quaternion,
)
from calibgraph.io.rigs import is_exported_rig, read_rig
from calibgraph.model.geometry import T_OPTICAL_LINK
from calibgraph.model.rig import KNOWLEDGE, Mount, Rig
from calibgraph.yaml_text import describe_value, parse_yaml_documents

_PUBLISHER = "static_transform_publisher"
_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw")
_ANGLES = ("x", "y", "z", "roll", "pitch", "yaw")


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


class _Stamped(Foreign):
    """A TransformStamped."""

    parent: str = Field(validation_alias=AliasPath("header", "frame_id"))
    child: str = Field(validation_alias="child_frame_id")
    x: float = Field(validation_alias=AliasPath("transform", "translation", "x"))
    y: float = Field(validation_alias=AliasPath("transform", "translation", "y"))
    z: float = Field(validation_alias=AliasPath("transform", "translation", "z"))
    qx: float = Field(validation_alias=AliasPath("transform", "rotation", "x"))
    qy: float = Field(validation_alias=AliasPath("transform", "rotation", "y"))
    qz: float = Field(validation_alias=AliasPath("transform", "rotation", "z"))
    qw: float = Field(validation_alias=AliasPath("transform", "rotation", "w"))


def read_tf2(documents: list[dict[str, Any]], path: Path) -> RigParts:
    """The frames of TFMessages and TransformStampeds; the last of several for a child.

    A frame whose numbers are no transform is left out with a note: others may do without it.
    """
    links: dict[str, Link] = {}
    notes: list[str] = []
    listed: list[Any] = []
    for content in documents:
        several = content.get("transforms")
        listed += several if isinstance(several, list) else [content]
    for stamped in listed:
        s = checked_model(_Stamped, stamped, path)
        parent, child = s.parent.lstrip("/"), s.child.lstrip("/")
        try:
            if not np.isfinite([s.x, s.y, s.z]).all():
                raise ValueError(f"translation [{s.x}, {s.y}, {s.z}] is not finite")
            T = pose_of_quaternion((s.x, s.y, s.z), (s.qx, s.qy, s.qz, s.qw))
            links[child] = Link(parent, child, T)
        except ValueError as error:
            notes.append(f"{path}: frame {child!r} is left out: {error}")
    return RigParts(path, links=tuple(links.values()), notes=tuple(notes))


def _entries(content: dict[str, Any]) -> Iterator[tuple[str, str, Any]]:
    for parent, children in content.items():
        for child, pose in children.items() if isinstance(children, dict) else ():
            yield str(parent), str(child), pose


def read_autoware(content: dict[str, Any], path: Path) -> RigParts:
    """The frames of a sensor kit."""
    links = []
    for parent, child, pose in _entries(content):
        where = f"{path}: {parent}: {child}"
        if not isinstance(pose, dict) or pose.keys() != {*_ANGLES}:
            keys = ", ".join(_ANGLES)
            raise FileError(where, f"expected the keys {keys}, found {describe_value(pose)}")
        try:
            values = [number(pose[key], f"{where}: {key}") for key in _ANGLES]
            T = pose_of_angles(values[:3], values[3:])
        except ValueError as error:
            raise FileError(path, f"{parent}: {child}: {error}") from error
        links.append(Link(parent, child, T))
    return RigParts(path, links=tuple(links))


def _read_xml(path: Path) -> RigParts:
    """The frames of a launch file's publishers, or of a URDF's joints at their zero position."""
    try:
        root: ElementTree.Element = fromstring(read_text(path), forbid_dtd=True)
    except (ElementTree.ParseError, DefusedXmlException, ValueError) as error:
        raise FileError(path, f"is not a URDF or other XML: {error}") from error
    if root.tag == "launch":
        nodes = (each for each in root.iter("node") if _PUBLISHER in each.attrib.values())
        return read_publishers((f"{_PUBLISHER} {each.get('args', '')}" for each in nodes), path)
    if root.tag == "opencv_storage":
        raise FileError(path, "is OpenCV's XML, which is not read; write it to a name in .yml")
    if root.tag != "robot":
        raise FileError(path, f"is not a URDF: its root is <{root.tag}>, expected <robot>")
    if "{http://www.ros.org/wiki/xacro}" in "".join(element.tag for element in root.iter()):
        raise FileError(path, "holds xacro macros; expand it: xacro FILE > robot.urdf")
    return RigParts(path, links=tuple(_link_of_joint(j, path) for j in root.findall("joint")))


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


_MAX_BYTES, _HEAD_BYTES = 32 * 2**20, 2**16


def read_part(path: Path, name: str | None) -> RigParts:  # noqa: PLR0911 - a line for each kind
    """Read a file; ``name`` replaces the file's own name of its camera if it has a single one."""
    if is_bag(path):
        return read_bag_rig(path)
    if path.is_dir() or path.name == CALIBRATION_NAME:
        return _part_of_rig(path)
    suffix = require_file(path).suffix.lower()
    if path.stat().st_size > _MAX_BYTES:
        raise FileError(path, f"{path.stat().st_size} bytes are too many for a calibration")
    if suffix in (".urdf", ".xml", ".xacro", ".launch"):
        return _read_xml(path)
    if suffix in (".sh", ".bash"):
        return read_publishers(read_text(path).splitlines(), path)
    if suffix == ".json":
        return _read_content([read_json(path)], path, name)
    if suffix in (".yaml", ".yml"):  # several documents are what `ros2 topic echo` prints
        text = re.sub(r"\A%YAML.*\n", "", read_text(path))
        return _read_content(parse_yaml_documents(text, path), path, name)
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES).decode("utf-8", "replace")
    raise FileError(path, _unknown(f"a file {suffix or 'without a suffix'} is", head))


def _unknown(what: str, text: str = "") -> str:
    """The error of a format that is not known, with the way to a file that is."""
    if "static_transform_publisher" in text or "Rotation: in Quaternion" in text:
        return (
            "states transforms of ROS in lines that are not read; start what publishes them, and "
            "write them into a file that is: `ros2 topic echo --once /tf_static > tf.yaml`"
        )
    if "camera matrix" in text:
        return "is the .ini of camera_calibration; give the .yaml that it writes beside it"
    return (
        f"{what} of no known format; known are those of Kalibr, ROS (camera_info, /tf_static, "
        "URDF), OpenCV, Autoware, KITTI and others in docs/formats.md; or write "
        "T_camera_lidar into rig.yaml"
    )


def _read_content(documents: list[dict[str, Any]], path: Path, name: str | None) -> RigParts:
    content = documents[0]
    if "transforms" in content or {"transform", "child_frame_id"} <= content.keys():
        return read_tf2(documents, path)
    if len(documents) > 1:
        raise FileError(path, f"holds {len(documents)} YAML documents; keep one of them")
    if "format" in content or is_exported_rig(content):
        return _part_of_rig(path)
    if any(isinstance(pose, dict) and "roll" in pose for _, _, pose in _entries(content)):
        return read_autoware(content, path)
    found = read_foreign(content, path, name)
    if found is None:
        keys = ", ".join(str(key) for key in list(content)[:5])
        raise FileError(path, _unknown(f"its keys ({keys}) are"))
    return found


def _part_of_rig(path: Path) -> RigParts:
    rig, notes = read_rig(path)
    cameras = rig.cameras.items()
    return RigParts(
        path,
        lenses={
            name: CameraLens(
                c.model,
                (c.width_px, c.height_px),
                c.intrinsics_px,
                c.distortion,
                stated={key: getattr(c, key) for key in KNOWLEDGE},
            )
            for name, c in cameras
        },
        T_camera_lidar=rig.T_camera_lidar,
        relative_poses=rig.relative_poses,
        frame_ids={name: each.frame_id for name, each in cameras if each.frame_id},
        mounts={name: each.mount for name, each in cameras if each.mount},
        lidar=rig.lidar,
        notes=notes,
    )


Value = TypeVar("Value")

_SAME = 1e-6  # of transforms that two files give: they may be rounded
_LIDAR_WORDS = (
    "lidar", "velodyne", "ouster", "os_sensor", "hesai", "pandar", "livox", "rslidar", "robosense",
)  # fmt: skip
_CAMERA_FRAMES = (
    "{}_optical_frame", "{}_optical_link", "{}_optical", "{}/camera_optical_link",
    "{}_camera_optical_frame", "{}_color_optical_frame", "{}/camera_link", "{}_camera_link",
    "{}_link", "{}",
)  # fmt: skip
"""Frames of a camera, by its name; those that are not optical are x forward, y left, z up."""


def import_rig(
    files: Iterable[Path | str],
    *,
    names: Mapping[Path | str, str] | None = None,
    rename: Mapping[str, str] | None = None,
    lidar_frame: str | None = None,
    camera_frames: Mapping[str, str] | None = None,
    size_px: tuple[int, int] | None = None,
) -> Rig:
    """Build a rig from files of other programs, which together hold lenses and extrinsics.

    Args:
        files: of the kinds in ``calibgraph.io.formats.IMPORT_FORMATS``.
        names: camera names for files of a single camera, by file.
        rename: new names of cameras, by those in the files.
        lidar_frame: the LiDAR's frame among those of the files; the one with such a name if None.
        camera_frames: per camera, its frame, where the names differ.
        size_px: width and height of images whose file has none.

    Raises:
        CalibrationError: if a file is malformed, a lens is none of ours, or something is missing.
    """
    parts = read_rig_parts(
        files, names=names, rename=rename, lidar_frame=lidar_frame, camera_frames=camera_frames
    )
    return parts.to_rig(size_px=size_px)


def read_rig_parts(
    files: Iterable[Path | str],
    *,
    names: Mapping[Path | str, str] | None = None,
    rename: Mapping[str, str] | None = None,
    lidar_frame: str | None = None,
    camera_frames: Mapping[str, str] | None = None,
) -> RigParts:
    """Read the files of a rig; arguments as of :func:`import_rig`."""
    parts = _read_all(files, names or {}, rename or {})
    lenses = _merged(parts, lambda part: part.lenses, "lens", lambda one, other: one == other)
    T_camera_lidar = _merged(
        parts,
        lambda part: part.T_camera_lidar,
        "T_camera_lidar",
        lambda one, other: bool(np.abs(one - other).max() <= _SAME),
    )
    links, notes = _later_first(parts)
    tree = _tree(links)
    frame_ids = {name: frame for part in parts for name, frame in part.frame_ids.items()}
    lidar = lidar_frame or next((part.lidar for part in parts if part.lidar), None)
    known = frame_names(links)
    in_tree = {name: frame for name, frame in frame_ids.items() if frame in known}
    notes += [note for part in parts for note in part.notes]
    try:
        by_frames, mounts = _by_frames(
            tree,
            sorted(lenses.keys() - T_camera_lidar.keys()),
            lidar if lidar_frame or lidar in known else None,
            {**in_tree, **(camera_frames or {})},
            notes=notes,
        )
    except CalibrationError as error:
        raise CalibrationError("; ".join([str(error), *notes])) from error
    found = RigParts(
        parts[0].path,
        lenses,
        relative_poses=tuple(pair for part in parts for pair in part.relative_poses),
        links=tuple(links),
        frame_ids=frame_ids,
        mounts={n: m for part in parts for n, m in part.mounts.items()} | mounts,
        lidar=lidar or "lidar",
        notes=tuple(notes),
    )
    return replace(found, T_camera_lidar=found.tied_to(T_camera_lidar | by_frames))


def _read_all(
    files: Iterable[Path | str], names: Mapping[Path | str, str], rename: Mapping[str, str]
) -> list[RigParts]:
    """The parts; at least one has a lens."""
    chosen = {Path(file): name for file, name in names.items()}
    read = [read_part(Path(file), chosen.get(Path(file))) for file in files]
    lenses = sorted({name for part in read for name in part.lenses})
    if len(lenses) == 1:
        read = [part.rename({ONLY_CAMERA: lenses[0]}) for part in read]
    for part in read:
        if ONLY_CAMERA in part.T_camera_lidar and len(lenses) > 1:
            raise FileError(part.path, f"names no camera; there are {', '.join(lenses)}: give it "
                            "as NAME=FILE")  # fmt: skip
    known = {name for part in read for name in (*part.lenses, *part.T_camera_lidar)}
    if not any(part.lenses for part in read):
        raise CalibrationError(
            f"{', '.join(str(part.path) for part in read)}: no lens; add the file with the "
            "intrinsics (camera_info, camchain, ...)"
        )
    for name in sorted(rename.keys() - known):
        raise CalibrationError(
            f"no camera {name!r} to rename; the files have {', '.join(sorted(known))}"
        )
    after = {rename.get(name, name) for name in known}
    if len(after) < len(known):
        raise CalibrationError("--rename gives two cameras one name; give each its own")
    return [part.rename(rename) for part in read]


def _merged(
    parts: Iterable[RigParts],
    select: Callable[[RigParts], Mapping[str, Value]],
    what: str,
    is_same: Callable[[Value, Value], bool],
) -> dict[str, Value]:
    """What the parts hold, by camera."""
    merged: dict[str, Value] = {}
    for part in parts:
        for name, value in select(part).items():
            if not is_same(merged.setdefault(name, value), value):
                raise FileError(
                    part.path, f"has another {what} of camera {name!r} than a file before it; "
                    "leave one of them out"
                )  # fmt: skip
    return merged


def _later_first(parts: Sequence[RigParts]) -> tuple[list[Link], list[str]]:
    """The links, of which a later file's replace those between the same frames; and notes."""
    links: list[Link] = []
    notes: list[str] = []
    for part in parts:
        own = {each[:2] for each in part.links}
        replaced = [each for each in links if each[:2] in own]
        notes += [f"{part.path}: {e.child} in {e.parent} is that of this file" for e in replaced]
        links = [each for each in links if each[:2] not in own] + [*part.links]
    return links, notes


def _tree(links: Iterable[Link]) -> dict[str, Link]:
    """The links by child; each frame has one parent, and is not its own ancestor."""
    tree: dict[str, Link] = {}
    for link in links:
        if link.child in tree:
            raise CalibrationError(f"frame {link.child!r} has two parents; give one of them")
        tree[link.child] = link
    for frame in tree:
        *_, top = ancestors(tree, frame)
        if top in tree:
            raise CalibrationError(f"frame {frame!r} is its own ancestor; correct the file")
    return tree


def _by_frames(
    tree: Links,
    cameras: Iterable[str],
    lidar_frame: str | None,
    chosen: Mapping[str, str],
    *,
    notes: list[str],
) -> tuple[dict[str, Array], dict[str, Mount]]:
    """T_camera_lidar and mounts of the cameras that have a frame in the tree; notes on links."""
    names = frame_names(tree.values())
    frames = {
        name: chosen.get(name)
        or next((f for each in _CAMERA_FRAMES if (f := each.format(frame_id(name))) in names), None)
        for name in cameras
    }
    found = {
        name: (frame, np.eye(4) if "optical" in frame.lower() else T_OPTICAL_LINK)
        for name, frame in frames.items()
        if frame is not None
    }
    if not found:
        return {}, {}
    lidar = lidar_frame or _find_lidar_frame(names)
    T = {name: axes @ _T_between(tree, frame, lidar) for name, (frame, axes) in found.items()}
    for frame, _ in found.values():
        between = (link.note for link in links_between(tree, frame, lidar))
        notes += [note for note in between if note and note not in notes]
    return T, find_mounts(found, lidar, tree)


def _T_between(tree: Links, target: str, source: str) -> Array:
    names = frame_names(tree.values())
    for frame in (target, source):
        if frame not in names:
            raise CalibrationError(f"no frame {frame!r}; there are {', '.join(names)}")
    T = T_between(tree, target, source)
    if T is None:
        roots = " and ".join(repr([*ancestors(tree, frame)][-1]) for frame in (target, source))
        raise CalibrationError(
            f"frames {target!r} and {source!r} are not connected: their roots are {roots}; add "
            "the file with the transform between them"
        )
    return T


def _find_lidar_frame(names: Sequence[str]) -> str:
    found = [name for name in names if any(word in name.lower() for word in _LIDAR_WORDS)]
    if len(found) != 1:
        what = f"could be {', '.join(found)}" if found else f"is none of {', '.join(names)}"
        raise CalibrationError(f"the frame of the LiDAR {what} by name; name it with --lidar-frame")
    return found[0]
