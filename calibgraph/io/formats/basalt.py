"""Basalt's calibration.json: lenses and T_imu_cam, which maps camera to IMU coordinates."""

from pathlib import Path
from typing import Any

from calibgraph.errors import FileError
from calibgraph.files import StrictNumbers, checked_model
from calibgraph.io.formats.lens_keys import LensKeys
from calibgraph.io.formats.part import IMU, FrameLink, Part
from calibgraph.io.rotations import pose_of_quaternion
from calibgraph.model.rig import Finite


class _Pose(StrictNumbers):
    px: Finite
    py: Finite
    pz: Finite
    qx: Finite
    qy: Finite
    qz: Finite
    qw: Finite


class _Calibration(StrictNumbers):
    T_imu_cam: list[_Pose]
    intrinsics: list[dict[str, Any]]
    resolution: list[tuple[int, int]]


def is_basalt(content: dict[str, Any]) -> bool:
    """Whether the content of a JSON file is a calibration of Basalt."""
    return isinstance(content.get("value0"), dict) and "T_imu_cam" in content["value0"]


def read_basalt(content: dict[str, Any], path: Path) -> Part:
    """The lenses cam0, cam1, ... and their frames in the IMU's frame."""
    found = checked_model(_Calibration, content["value0"], path)
    try:
        lenses, links = {}, []
        for i, (pose, lens, size) in enumerate(
            zip(found.T_imu_cam, found.intrinsics, found.resolution, strict=True)
        ):
            keys = LensKeys({**lens, "resolution": list(size)}, f"{path}: intrinsics {i}")
            lenses[f"cam{i}"], _ = keys.read()
            xyzw = (pose.qx, pose.qy, pose.qz, pose.qw)
            T = pose_of_quaternion((pose.px, pose.py, pose.pz), xyzw)
            links.append(FrameLink(IMU, f"cam{i}_optical_frame", T))
    except ValueError as error:
        raise FileError(path, str(error)) from error
    return Part(path, lenses, links=tuple(links))
