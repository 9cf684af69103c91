"""Autoware's sensor_kit_calibration.yaml: poses of camera_link, x forward, not optical."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict

from calibgraph.errors import FileError
from calibgraph.files import StrictNumbers, checked_model
from calibgraph.io.formats.documents import commented_yaml
from calibgraph.io.formats.part import FrameLink, Part
from calibgraph.io.formats.rig_export import RigExport, frame_id
from calibgraph.io.rotations import pose_of_angles, roll_pitch_yaw
from calibgraph.model.geometry import T_OPTICAL_LINK
from calibgraph.model.rig import Finite

_BASE, _OPTICAL_LINK = "sensor_kit_base_link", "/camera_optical_link"


def write_autoware(export: RigExport) -> str:
    """The LiDAR and the ``camera_link`` of each camera under sensor_kit_base_link."""
    T_base_lidar = np.eye(4) if export.T_base_lidar is None else export.T_base_lidar
    poses = {export.lidar_frame: T_base_lidar} | {
        _link_id(name, frame): export.T_base_camera(name) @ T_OPTICAL_LINK
        for name, frame in export.optical_frames.items()
    }
    place = (
        f"{_BASE} is put at the LiDAR, as no --lidar-pose was given: take the differences only"
        if export.T_base_lidar is None
        else f"{_BASE} is where --lidar-pose puts it"
    )
    statement = export.statement(
        f"each entry is the pose of a link (child) in {_BASE} (parent): p_base = T * p_link",
        "camera_link: x forward, y left, z up; "
        "optical from camera_link: roll -pi/2, pitch 0, yaw -pi/2",
        place,
    )
    return commented_yaml(statement, {_BASE: {name: _angles(T) for name, T in poses.items()}})


def _link_id(name: str, optical: str) -> str:
    """The camera_link above an optical frame that is named as Autoware's; else by the camera."""
    above = optical.removesuffix(_OPTICAL_LINK)
    return f"{above if above != optical else frame_id(name)}/camera_link"


def _angles(T: NDArray[np.float64]) -> dict[str, float]:
    values = [*T[:3, 3].tolist(), *roll_pitch_yaw(T)]
    return dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), values, strict=True))


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


def read_autoware(content: dict[str, Any], path: Path) -> Part:
    """The frames of a sensor kit."""
    return Part(path, links=tuple(_link(*entry, path) for entry in _entries(content)))


def _link(parent: str, child: str, pose: Any, path: Path) -> FrameLink:
    p = checked_model(_Pose, pose, f"{path}: {parent}: {child}")
    try:
        T = pose_of_angles((p.x, p.y, p.z), (p.roll, p.pitch, p.yaw))
    except ValueError as error:
        raise FileError(path, f"{parent}: {child}: {error}") from error
    return FrameLink(parent, child, T)
