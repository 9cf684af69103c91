"""A result or a rig in the format of another program: a function per format, or small group.

Lenses that a format cannot carry are refused, not rounded.
"""

import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Any, Final
from xml.etree import ElementTree

import cv2
import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import CalibrationError, FileError
from calibgraph.files import read_yaml, require_new_file, write_text
from calibgraph.io.calibrations import is_calibration, load_calibration
from calibgraph.io.formats import EXPORT_FORMATS
from calibgraph.io.formats.foreign_keys import DERIVED
from calibgraph.io.formats.rig_import import read_autoware
from calibgraph.io.kitti import CALIBRATION_NAME
from calibgraph.io.rig_parts import Link, frame_id, quaternion_xyzw, roll_pitch_yaw
from calibgraph.io.rigs import load_rig, rig_file
from calibgraph.model.calibration import FRAMES_SENTENCE, Calibration
from calibgraph.model.geometry import (
    T_OPTICAL_LINK,
    angle_deg,
    invert,
    point_in_lidar,
    relative_transform,
    ros_pose_covariance,
)
from calibgraph.model.rig import Camera, Mount, Rig, Vehicle, rigid_transform
from calibgraph.model.verdict import rig_verdict
from calibgraph.yaml_text import yaml_text

_log = logging.getLogger(__name__)

EXPORT_MARK = "calibgraph export"
CAMERA_FRAME = "{camera}_optical_frame"
AXES_SENTENCE = "camera axes are optical: x right, y down, z forward; metres and radians"
COVARIANCE_SENTENCE = (
    "covariance: of the camera's pose in the LiDAR frame, row-major 6x6 in the order of ROS: "
    "x y z [m], then rotation about the fixed LiDAR axes x y z [rad]"
)
_WORKED_CAMERA_M = np.array([1.0, 2.0, 10.0])  # right, below and ahead, so that no sign is free


@dataclass(frozen=True, eq=False)
class RigExport:
    """A rig to be written in the format of another program.

    Attributes:
        rig: its cameras are those that are written.
        covariance: per camera whose error bar holds, (6, 6) as of a result, rotation first.
        verdict: PASS, WARN or FAIL; empty for a rig file.
        lidar_frame: the LiDAR's frame id.
        optical_frames: per camera, the id of its optical frame.
        in_tree: whether the frames are those of the rig, and of the robot's tree that it knows.
        T_base_lidar: (4, 4) where the LiDAR is mounted on the vehicle or sensor kit, if given.
        lidars: those of several that are written beside the base.
        deployed: (4, 4) of each row of the file that is replaced (autoware): others stay.
    """

    rig: Rig
    covariance: Mapping[str, Array]
    verdict: str
    lidar_frame: str
    optical_frames: Mapping[str, str]
    T_base_lidar: Array | None = None
    in_tree: bool = True
    lidars: tuple[str, ...] = ()
    deployed: Mapping[str, Array] = field(default_factory=dict)

    @property
    def lidar_links(self) -> list[Link]:
        """The LiDARs in the base."""
        poses = self.rig.T_base_lidar
        return [Link(self.lidar_frame, frame_id(name), poses[name]) for name in self.lidars]

    @property
    def vehicle_link(self) -> Link | None:
        """The base LiDAR in the vehicle's frame; None if an axis of it is unknown."""
        vehicle = self.rig.vehicle
        if vehicle is None or vehicle.T_vehicle_lidar is None or vehicle.unknown_axes:
            return None
        return Link(vehicle.frame, self.lidar_frame, vehicle.T_vehicle_lidar)

    @property
    def left_out(self) -> str:
        """A line, if a rig of several LiDARs has no pose of the base in the vehicle."""
        if self.vehicle_link is not None or not self.lidars:
            return ""
        vehicle = self.rig.vehicle or Vehicle()
        return (
            f"the pose of {self.lidar_frame} in {vehicle.frame} is left out, as its "
            f"{', '.join(vehicle.unknown_axes)} are unknown: state what you know of them as "
            "T_vehicle_lidar with sigmas, under vehicle in rig.yaml, and calibrate again"
        )

    def link(self, name: str) -> tuple[str, str, Array]:
        """Parent, child and (4, 4) T_parent_child of the transform that a calibration changes."""
        mount, T_lidar_camera = self.mount(name), self.T_lidar_camera(name)
        if mount is None:
            return self.lidar_frame, self.optical_frames[name], T_lidar_camera
        return mount.parent, mount.child, mount.T_parent_child(T_lidar_camera)

    def mount(self, name: str) -> Mount | None:
        """The link of the robot's tree by which a camera hangs, if frames are the tree's."""
        return self.cameras[name].mount if self.in_tree else None

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The cameras by name."""
        return self.rig.cameras

    def T_lidar_camera(self, name: str) -> Array:
        """(4, 4) the pose of a camera in the LiDAR frame."""
        return invert(self.cameras[name].T_camera_lidar)

    def ros_covariance(self, name: str) -> Array | None:
        """(6, 6) of the pose in the LiDAR frame, in the order of ROS; None without error bar."""
        if name not in self.covariance:
            return None
        return ros_pose_covariance(self.covariance[name], self.cameras[name].T_camera_lidar)

    @property
    def origin(self) -> str:
        """The first line of a comment: the mark of exports, and the verdict."""
        verdict = f"verdict {self.verdict}" if self.verdict else "a rig file, without verdict"
        return f"{EXPORT_MARK}; {verdict}"

    def statement(self, *direction: str) -> list[str]:
        """Lines for a comment: origin, direction, and a worked point of each camera."""
        frames = ", ".join(f"{name}: {frame}" for name, frame in self.optical_frames.items())
        lines = [self.origin, *direction]
        if self.lidars:
            lines.append(f"LiDARs in {self.lidar_frame}: p_base = T_base_lidar * p_lidar")
        if self.cameras:
            lines += [
                f"LiDAR frame: {self.lidar_frame}; optical frames: {frames}",
                AXES_SENTENCE,
                f"worked points, by {FRAMES_SENTENCE}",
                *(self._worked_point(name) for name in self.cameras),
            ]
        return [" ".join(line.split()) for line in lines]

    def _worked_point(self, name: str) -> str:
        T = self.cameras[name].T_camera_lidar
        p_lidar = point_in_lidar(T, _WORKED_CAMERA_M).round(3)
        p_camera = T[:3, :3] @ p_lidar + T[:3, 3]
        return (
            f"{name}: p_lidar = ({_triple(p_lidar, 3)}) m -> p_camera = ({_triple(p_camera, 6)}) m"
        )


def _triple(values: Array, digits: int) -> str:
    return ", ".join(f"{value + 0.0:.{digits}f}" for value in values)


def radtan_coefficients(name: str, camera: Camera) -> list[float]:
    """A pinhole's coefficients, of which Kalibr has four."""
    padded = [*camera.distortion, *[0.0] * 4]
    if any(padded[4:]):
        raise CalibrationError(
            f"camera {name!r}: Kalibr's radtan holds 4 distortion coefficients, this lens has "
            f"{camera.distortion}; choose another --format (opencv, json)",
            camera=name,
        )
    return padded[:4]


def commented_yaml(statement: Iterable[str], content: dict[str, Any]) -> str:
    """YAML below its statement of direction."""
    return "".join(f"# {line}\n" for line in statement) + yaml_text(content)


def commented_xml(statement: Iterable[str], root: ElementTree.Element) -> str:
    """XML below its statement of direction; two hyphens may not stand in its comments."""
    ElementTree.indent(root)
    lines = "\n".join(f"  {line}" for line in statement)
    while "--" in lines:
        lines = lines.replace("--", "- -")
    body = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0"?>\n<!--\n{lines}\n-->\n{body}\n'


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
    measured = [Link(*export.link(name)) for name in export.cameras]  # what a calibration changes
    measured += [*_of_vehicle(export), *export.lidar_links]
    links = _WHICH[format](export) if format in _WHICH else measured
    directions = _of_kit(export) if format == "autoware" else _of_transforms(export, format)
    statement = export.statement(*directions)
    if format == "autoware":
        of_result = {each.child for each in links}
        links += [Link(_KIT, n, T) for n, T in export.deployed.items() if n not in of_result]
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


def _of_vehicle(export: RigExport) -> list[Link]:
    """The base LiDAR in the vehicle, where the robot's tree does not have it."""
    link = export.vehicle_link
    in_tree = any(export.mount(name) is not None for name in export.cameras)
    return [] if link is None or in_tree else [link]


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
    found = [Link(parent, child, T) for child, (parent, T) in joints.items()]
    return [*found, *_of_vehicle(export), *export.lidar_links]


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
    links += [Link(_KIT, of.child, T_base_lidar @ of.T_parent_child) for of in export.lidar_links]
    for name, optical in export.optical_frames.items():
        above = optical.removesuffix(_OPTICAL_LINK)  # as Autoware names it; else by the camera
        link = f"{above if above != optical else frame_id(name)}/camera_link"
        T_base_camera = T_base_lidar @ export.T_lidar_camera(name)
        links.append(Link(_KIT, link, T_base_camera @ T_OPTICAL_LINK))
    return links


def read_kit(path: Path) -> dict[str, Array]:
    """(4, 4) of each row of Autoware's sensor_kit_calibration.yaml.

    Raises:
        FileError: if it has none, or one is malformed.
    """
    links = read_autoware(read_yaml(path), path).links
    if not (found := {each.child: each.T_parent_child for each in links if each.parent == _KIT}):
        raise FileError(path, f"has no rows of {_KIT}; name the sensor_kit_calibration.yaml")
    return found


def describe_changes(before: Mapping[str, Array], after: Mapping[str, Array]) -> list[str]:
    """A line per row: how far it is turned and moved."""
    lines = []
    for name, T in before.items():
        degrees = angle_deg(after[name][:3, :3] @ T[:3, :3].T)
        centimetres = 100.0 * np.linalg.norm(after[name][:3, 3] - T[:3, 3])
        lines.append(f"{name}: turned by {degrees:.3f} deg, moved by {centimetres:.2f} cm")
    return lines


def sensors_calibration(export: RigExport) -> str:
    """Autoware's sensors_calibration.yaml: the kit in the vehicle; empty if it is unknown."""
    link = export.vehicle_link
    if link is None:
        return ""
    T_kit_lidar = np.eye(4) if export.T_base_lidar is None else export.T_base_lidar
    kit = Link(link.parent, _KIT, link.T_parent_child @ invert(T_kit_lidar))
    direction = f"the pose of {_KIT} (child) in {link.parent} (parent): p_parent = T * p_child"
    pose = dict(zip(_ANGLES, _six(kit), strict=True))
    return commented_yaml((export.origin, direction), {link.parent: {_KIT: pose}})


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


_MODELS: Final = {"pinhole": "plumb_bob", "fisheye": "equidistant", "omnidirectional": "mei"}
_PLUMB_BOB = 5
_MAPS = f"T_camera_lidar maps LiDAR to camera coordinates: {FRAMES_SENTENCE}"


def write_kalibr(export: RigExport) -> str:
    """A camchain: cam0, cam1, ... in the order of the rig."""
    names = list(export.cameras)
    content = {f"cam{i}": _of_kalibr(export, names, i) for i in range(len(names))}
    statement = export.statement(
        "T_cam_lidar maps LiDAR to camera coordinates: p_camera = T_cam_lidar * p_lidar",
        "T_cn_cnm1 of cam n maps coordinates of cam n-1 to those of cam n",
        f"cameras: {', '.join(f'cam{i} is {name}' for i, name in enumerate(names))}; "
        "correct the rostopics",
        COVARIANCE_SENTENCE,
    )
    return commented_yaml(statement, content)


def _of_kalibr(export: RigExport, names: list[str], index: int) -> dict[str, Any]:
    name = names[index]
    camera, covariance = export.cameras[name], export.ros_covariance(name)
    content = {
        **_projection(name, camera),
        "resolution": [camera.width_px, camera.height_px],
        "rostopic": f"/{name}/image_raw",
    }
    own: dict[str, Any] = {"camera": name}
    if index:
        before = export.cameras[names[index - 1]]
        content["T_cn_cnm1"] = relative_transform(camera.T_camera_lidar, before.T_camera_lidar)
        own["T_cn_cnm1"] = DERIVED
    content["T_cam_lidar"] = camera.T_camera_lidar
    if camera.time_offset_s is not None:  # the LiDAR's time of an image is the camera's plus it
        content["timeshift_cam_lidar"] = camera.time_offset_s
    if covariance is not None:
        own["covariance"] = covariance.ravel()
    return {**content, "calibgraph": own}


def _projection(name: str, camera: Camera) -> dict[str, Any]:
    intrinsics = [*camera.intrinsics_px.model_dump().values()]
    model, distortion, coefficients = "pinhole", "radtan", [*camera.distortion]
    if camera.model == "omnidirectional":
        model, intrinsics, coefficients = "omni", [coefficients[0], *intrinsics], coefficients[1:]
    elif camera.model == "fisheye":
        distortion = "equidistant"
    elif any(coefficients):
        coefficients = radtan_coefficients(name, camera)
    else:
        distortion, coefficients = "none", []
    return {
        "camera_model": model,
        "intrinsics": intrinsics,
        "distortion_model": distortion,
        "distortion_coeffs": coefficients,
    }


def write_camera_infos(export: RigExport) -> Mapping[str, str]:
    """Per name of a file, the lens of one camera, as ROS's ``camera_info_manager`` loads it.

    K and D are of the images as recorded; R is the identity and P is K.
    """
    files: dict[str, str] = {}
    for name, camera in export.cameras.items():
        file = f"{frame_id(name)}.yaml"
        if file.casefold() in map(str.casefold, files):  # one file where systems ignore case
            raise CalibrationError(f"camera {name!r}: another has the file {file}; rename one")
        statement = (
            export.origin,
            "K and D are of the images as recorded, R is the identity, P is K",
            "the extrinsic is not part of a camera_info: export it as ros2-launch or urdf",
            f"optical frame: {export.optical_frames[name]}",
        )
        files[file] = commented_yaml(statement, _of_ros(name, camera))
    return files


def _of_ros(name: str, camera: Camera) -> dict[str, Any]:
    K, distortion = camera.matrix_px, [*camera.distortion]
    if camera.model == "pinhole":
        distortion += [0.0] * (_PLUMB_BOB - len(distortion))
    is_rational = camera.model == "pinhole" and len(distortion) > _PLUMB_BOB
    model = "rational_polynomial" if is_rational else _MODELS[camera.model]
    return {
        "image_width": camera.width_px,
        "image_height": camera.height_px,
        "camera_name": frame_id(name),
        "camera_matrix": _matrix(K),
        "distortion_model": model,
        "distortion_coefficients": _matrix(np.array([distortion])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(np.column_stack([K, np.zeros(3)])),
    }


def _matrix(values: Array) -> dict[str, Any]:
    rows, columns = values.shape
    return {"rows": rows, "cols": columns, "data": values.ravel().tolist()}


def write_json(export: RigExport) -> str:
    """Per camera: lens, both directions of the extrinsic, covariance or null."""
    content = {
        "calibgraph_export": export.statement(
            _MAPS,
            "T_lidar_camera is its inverse, the pose of the camera in the LiDAR frame",
            COVARIANCE_SENTENCE,
        ),
        "verdict": export.verdict or None,
        "lidar_frame": export.lidar_frame,
        "cameras": {name: _of_json(export, name) for name in export.cameras},
        "lidars": {name: export.rig.T_base_lidar[name].tolist() for name in export.lidars},
    }
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _of_json(export: RigExport, name: str) -> dict[str, Any]:
    camera, covariance = export.cameras[name], export.ros_covariance(name)
    if camera.frame_id is not None:
        camera = camera.model_copy(update={"frame_id": export.optical_frames[name]})
    return {
        **camera.model_dump(),
        "optical_frame": export.optical_frames[name],
        "T_lidar_camera": export.T_lidar_camera(name).tolist(),
        "covariance": None if covariance is None else covariance.ravel().tolist(),
    }


def write_opencv(export: RigExport) -> str:
    """Maps camera_0, camera_1, ... in the order of the rig, written by OpenCV itself."""
    file = cv2.FileStorage("rig.yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for line in export.statement(_MAPS, COVARIANCE_SENTENCE):
        file.writeComment(line, False)
    for index, (name, camera) in enumerate(export.cameras.items()):
        file.startWriteStruct(f"camera_{index}", cv2.FileNode_MAP)
        file.write("name", name)
        file.write("model", camera.model)
        file.write("fisheye_model", int(camera.model == "fisheye"))
        file.write("image_width", camera.width_px)
        file.write("image_height", camera.height_px)
        file.write("camera_matrix", camera.matrix_px)
        distortion = [*camera.distortion] or [0.0] * 5
        if camera.model == "omnidirectional":  # OpenCV's omnidir keeps xi apart
            xi, *distortion = camera.distortion
            file.write("xi", xi)
        file.write("distortion_coefficients", np.array(distortion)[None])
        file.write("T_camera_lidar", np.array(camera.T_camera_lidar))
        for key in ("time_offset_s", "readout_s"):
            if (seconds := getattr(camera, key)) is not None:
                file.write(key, seconds)
        covariance = export.ros_covariance(name)
        if covariance is not None:
            file.write("covariance", covariance)
        file.endWriteStruct()
    return str(file.releaseAndGetString())


Writer = Callable[[RigExport], str | Mapping[str, str]]
"""Of one file, or of the files of a folder by name."""

WRITERS: Final[Mapping[str, Writer]] = {
    "kalibr": write_kalibr,
    **{name: partial(write_transforms, format=name) for name in TRANSFORMS},
    "camera_info": write_camera_infos,
    "opencv": write_opencv,
    "json": write_json,
}
_WITH_BASE = "autoware"
_KIT_IN_VEHICLE = "sensors_calibration.yaml"


def export_calibration(  # noqa: PLR0913
    source: Calibration | Rig | Path | str,
    path: Path | str,
    format: str,
    *,
    cameras: Iterable[str] | None = None,
    lidar_frame: str | None = None,
    camera_frame: str | None = None,
    T_base_lidar: Array | None = None,
    deployed: Path | None = None,
    even_if_failed: bool = False,
    force: bool = False,
) -> tuple[Path, ...]:
    """Write a calibration for another program, with its direction and a worked point.

    Args:
        source: a result or a rig, or the path of one.
        path: the file to write, of ``camera_info`` the folder.
        format: a name of ``calibgraph.io.formats.EXPORT_FORMATS``.
        cameras: names of those to write; all if None.
        lidar_frame: frame id of the LiDAR; the rig's name of it if None.
        camera_frame: id of optical frames, with ``{camera}`` for the camera's name; that of the
            rig, as its bag names it, or ``{camera}_optical_frame`` if None.
        T_base_lidar: (4, 4) pose of the LiDAR in ``sensor_kit_base_link`` (autoware); the
            identity if None.
        deployed: a sensor_kit_calibration.yaml (autoware) that is replaced: the base LiDAR stands
            where it has it, and only rows of what is calibrated change.
        even_if_failed: whether to write cameras whose verdict is FAIL.
        force: whether to replace files that are there.

    Returns:
        The files: one; for ``camera_info`` one of each camera; for ``autoware``
        sensors_calibration.yaml beside it, if the rig has the LiDAR in the vehicle; if not, a line
        is logged that names why.

    Raises:
        CalibrationError: if the verdict is FAIL, or the format or the file cannot hold it.
        ValueError: if an argument is wrong.
    """
    if format not in WRITERS:
        raise ValueError(f"format {format!r}: known are {', '.join(EXPORT_FORMATS)}")
    if not (T_base_lidar is None and deployed is None) and format != _WITH_BASE:
        raise ValueError(
            f"the LiDAR's pose and the deployed file are for the format {_WITH_BASE} only"
        )
    rows = {} if deployed is None else read_kit(deployed)
    found = _loaded(source) if isinstance(source, (str, Path)) else source
    result = found if isinstance(found, Calibration) else None
    rig = found.rig if isinstance(found, Calibration) else found
    if format not in (*TRANSFORMS, "json"):
        rig.require_cameras()
    names = list(rig.cameras if cameras is None else cameras)
    others = [name for name in rig.other_lidars if name in rig.T_base_lidar]
    lidar, *optical = _frames(rig, names, lidar_frame, camera_frame)
    if deployed is not None:
        T_base_lidar = rows.get(lidar)
    if result is not None and not even_if_failed:
        _require_not_failed(result, [*names, *others])
    bars = {n: result.covariance.get(n) for n in names if result and result.error_bar_holds(n)}
    verdicts = {n: result.verdicts[n] for n in (*names, *others)} if result else {}
    export = RigExport(
        rig=rig.model_copy(update={"cameras": {name: rig.cameras[name] for name in names}}),
        covariance={n: covariance for n, covariance in bars.items() if covariance is not None},
        verdict=rig_verdict(verdicts).status if result else "",
        lidar_frame=lidar,
        optical_frames=dict(zip(names, optical, strict=True)),
        T_base_lidar=None if T_base_lidar is None else rigid_transform(T_base_lidar),
        in_tree=lidar_frame is None and camera_frame is None,
        lidars=tuple(others),
        deployed=rows,
    )
    missing = [each.child for each in _sensor_kit(export) if each.child not in rows]
    if deployed is not None and missing:
        raise FileError(
            deployed, f"has no row {', '.join(missing)}, only {', '.join(rows)}: name "
            "LiDARs in the rig as there, and cameras by --camera-frame"
        )  # fmt: skip
    return _write(export, Path(path), format, force=force)


def _frames(
    rig: Rig, names: Sequence[str], lidar_frame: str | None, camera_frame: str | None
) -> list[str]:
    """The frame ids of the LiDAR and of the cameras; a camera's is the given, else the rig's."""
    frames = [rig.lidar if lidar_frame is None else lidar_frame]
    for name in names:
        if name not in rig.cameras:
            raise ValueError(f"camera {name!r}: the rig has {', '.join(rig.cameras)}")
        own = rig.cameras[name].frame_id or CAMERA_FRAME
        frames.append((own if camera_frame is None else camera_frame).replace("{camera}", name))
    frames = [*map(frame_id, frames)]
    if len({*frames} - {""}) < len(frames):
        raise ValueError(
            f"frames {frames}: two are the same, or one is empty; --camera-frame holds {{camera}}"
        )
    return frames


def _require_not_failed(result: Calibration, cameras: Sequence[str]) -> None:
    failed = [name for name in cameras if result.verdicts[name].status == "FAIL"]
    if not failed:
        return
    good = [n for n in cameras if n in result.camera_verdicts and n not in failed]
    named = " ".join(f"--camera {quote(name)}" for name in good)
    others = f"export the others with {named}, " if good else ""
    raise CalibrationError(
        f"the verdict of {', '.join(failed)} is FAIL, nothing was written; see the result's "
        f"report, {others}or export all the same with --even-if-failed"
    )


def _loaded(path: Path | str) -> Calibration | Rig:
    """A result with its verdict, or a rig."""
    file = rig_file(path)
    if file.name != CALIBRATION_NAME and is_calibration(read_yaml(file)):
        return load_calibration(file)
    return load_rig(file)


def _write(export: RigExport, path: Path, format: str, *, force: bool) -> tuple[Path, ...]:
    """Write all files or, if one may not be replaced, none."""
    written = WRITERS[format](export)
    if format in TRANSFORMS and export.left_out:
        not_written = f"; {_KIT_IN_VEHICLE} is not written" if format == _WITH_BASE else ""
        _log.warning(export.left_out + not_written)
    contents = {path: written} if isinstance(written, str) else {
        path / name: content for name, content in written.items()
    }  # fmt: skip
    if format == _WITH_BASE and (of_vehicle := sensors_calibration(export)):
        contents[path.with_name(_KIT_IN_VEHICLE)] = of_vehicle
    for file in contents:
        require_new_file(file, force=force)
    for file, content in contents.items():
        write_text(file, content)
    return tuple(contents)
