"""calib.json of koide3's direct_visual_lidar_calibration: one camera, T_lidar_camera."""

import math
from pathlib import Path
from typing import Any

from calibgraph.errors import FileError
from calibgraph.files import StrictNumbers, checked_model
from calibgraph.io.formats.part import Part
from calibgraph.io.lenses import (
    CameraLens,
    listed_coefficients,
    listed_intrinsics,
    stated_model,
    unified_coefficients,
)
from calibgraph.io.rotations import pose_of_quaternion
from calibgraph.model.geometry import invert
from calibgraph.model.rig import Finite, Positive


class _Camera(StrictNumbers):
    camera_model: str
    intrinsics: tuple[Finite, ...]
    distortion_coeffs: tuple[Finite, ...] = ()


class _Panorama(StrictNumbers):
    intrinsics: tuple[Positive, Positive]


_Pose = tuple[Finite, Finite, Finite, Finite, Finite, Finite, Finite]


class _Results(StrictNumbers):
    T_lidar_camera: _Pose | None = None
    init_T_lidar_camera: _Pose | None = None
    init_T_lidar_camera_auto: _Pose | None = None


class _Calibration(StrictNumbers):
    camera: _Camera
    meta: dict[str, Any] = {}
    results: _Results = _Results()


def is_koide(content: dict[str, Any]) -> bool:
    """Whether the content of a JSON file is a calib.json."""
    return isinstance(content.get("camera"), dict) and "intrinsics" in content["camera"]


def read_koide(content: dict[str, Any], path: Path, name: str | None) -> Part:
    """The lens and the result, or else an initial guess."""
    found = checked_model(_Calibration, content, path)
    name = str(found.meta.get("camera", name or path.stem))
    r = found.results
    pose = r.T_lidar_camera or r.init_T_lidar_camera or r.init_T_lidar_camera_auto
    try:
        T = {} if pose is None else {name: invert(pose_of_quaternion(pose[:3], pose[3:]))}
    except ValueError as error:
        raise FileError(path, f"T_lidar_camera: {error}") from error
    return Part(path, {name: _lens(found.camera, path)}, T)


def _lens(camera: _Camera, path: Path) -> CameraLens:
    values = camera.model_dump()
    model = stated_model(values, path) or "pinhole"
    given = camera.distortion_coeffs
    if model == "equirectangular":  # width and height in place of focal lengths
        width, height = checked_model(_Panorama, values, path).intrinsics
        focal = (width / (2 * math.pi), height / math.pi, width / 2, height / 2)
        return CameraLens(model, None, listed_intrinsics(focal, path), ())
    if model == "omnidirectional":
        intrinsics = listed_intrinsics(camera.intrinsics[:-1], f"{path}: intrinsics before xi")
        coefficients = unified_coefficients(camera.intrinsics[-1], given, path)
        return CameraLens(model, None, intrinsics, coefficients)
    intrinsics = listed_intrinsics(camera.intrinsics, f"{path}: intrinsics")
    return CameraLens(model, None, intrinsics, listed_coefficients(given, model, path))
