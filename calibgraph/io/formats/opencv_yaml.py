"""OpenCV FileStorage YAML: one map per camera, or the keys of a single one."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calibgraph.errors import FileError
from calibgraph.files import StrictNumbers, checked_model, read_text
from calibgraph.io.formats.part import Part
from calibgraph.io.formats.rig_export import COVARIANCE_SENTENCE, RigExport
from calibgraph.io.lenses import (
    CameraLens,
    intrinsics_of_matrix,
    lens_model,
    listed_coefficients,
    unified_coefficients,
)
from calibgraph.model.calibration import FRAMES_SENTENCE
from calibgraph.model.rig import Finite, rigid_transform
from calibgraph.yaml_text import parse_yaml

_ALIASES = {
    "camera_matrix": ("camera_matrix", "cameraMatrix", "CameraMat", "K"),
    "distortion": (
        "distortion_coefficients", "distortion_vector", "dist_coeffs", "distCoeffs", "DistCoeff",
        "D",
    ),
    "width": ("image_width", "img_width", "width"),
    "height": ("image_height", "img_height", "height"),
}  # fmt: skip
"""The keys that calibration programs with OpenCV write."""


def write_opencv(export: RigExport) -> str:
    """Maps camera_0, camera_1, ... in the order of the rig, written by OpenCV itself."""
    file = cv2.FileStorage("rig.yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    direction = f"T_camera_lidar maps LiDAR to camera coordinates: {FRAMES_SENTENCE}"
    for line in export.statement(direction, COVARIANCE_SENTENCE):
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
        covariance = export.ros_covariance(name)
        if covariance is not None:
            file.write("covariance", covariance)
        file.endWriteStruct()
    return str(file.releaseAndGetString())


class _Matrix(StrictNumbers):
    rows: int
    cols: int
    data: tuple[Finite, ...]


class _Camera(StrictNumbers):
    camera_matrix: _Matrix
    distortion: _Matrix | None = None
    width: int | None = None
    height: int | None = None
    name: str | None = None
    model: str | None = None
    fisheye_model: int = 0
    distortion_type: int = 0  # of MC-Calib: 1 is its fisheye
    xi: Finite | _Matrix | None = None  # of OpenCV's omnidir: a number, or one in a matrix
    T_camera_lidar: _Matrix | None = None


def is_opencv(text: str) -> bool:
    """Whether a text is OpenCV's YAML, which other readers refuse for its first line or tags."""
    return text.startswith("%YAML:1.0") or "!!opencv-matrix" in text


def read_opencv(path: Path, name: str) -> Part:
    """The cameras of a file: nested maps that have a camera matrix, or the file itself.

    Args:
        path: of the file.
        name: of the camera, if it is a single one without a name.

    Raises:
        FileError: if it is malformed or holds no camera matrix.
    """
    content = parse_yaml(re.sub(r"\A%YAML.*\n", "", read_text(path)), path)
    nested = {str(key): value for key, value in content.items() if _is_camera(value)}
    cameras = {name: content} if _is_camera(content) else nested
    if not cameras:
        keys = ", ".join(_ALIASES["camera_matrix"])
        raise FileError(path, f"holds no camera matrix; expected one of the keys {keys}")
    found = {key: checked_model(_Camera, _renamed(value), path) for key, value in cameras.items()}
    named = {camera.name or key: camera for key, camera in found.items()}
    if len(named) < len(found):
        raise FileError(path, "gives two cameras one name; give each its own")
    return Part(
        path,
        lenses={key: _lens(camera, path) for key, camera in named.items()},
        T_camera_lidar={
            key: _transform(camera.T_camera_lidar, path)
            for key, camera in named.items()
            if camera.T_camera_lidar is not None
        },
    )


def _is_camera(content: Any) -> bool:
    return isinstance(content, dict) and any(key in content for key in _ALIASES["camera_matrix"])


def _renamed(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content with the keys of this module in place of their aliases."""
    kept = {key: value for key, value in content.items() if key in _Camera.model_fields}
    for ours, aliases in _ALIASES.items():
        given = [content[alias] for alias in aliases if alias in content]
        kept.update({ours: given[0]} if given else {})
    return kept


def _lens(camera: _Camera, path: Path) -> CameraLens:
    is_fisheye = camera.fisheye_model or camera.distortion_type
    model = lens_model(camera.model or ("fisheye" if is_fisheye else "pinhole"), path)
    if camera.xi is not None:
        model = "omnidirectional"
    K = _array(camera.camera_matrix, (3, 3), "the camera matrix", path)
    size = None
    if camera.width is not None and camera.height is not None:
        size = (camera.width, camera.height)
    coefficients = () if camera.distortion is None else camera.distortion.data
    intrinsics = intrinsics_of_matrix(K, f"{path}: the camera matrix")
    if camera.xi is None:
        return CameraLens(model, size, intrinsics, listed_coefficients(coefficients, model, path))
    xi = camera.xi
    xi = _array(xi, (1, 1), "xi", path).item() if isinstance(xi, _Matrix) else xi
    return CameraLens(model, size, intrinsics, unified_coefficients(xi, coefficients, path))


def _transform(matrix: _Matrix, path: Path) -> Any:
    try:
        return rigid_transform(_array(matrix, (4, 4), "T_camera_lidar", path))
    except ValueError as error:
        raise FileError(path, f"T_camera_lidar: {error}") from error


def _array(matrix: _Matrix, shape: tuple[int, int], what: str, path: Path) -> Any:
    if (matrix.rows, matrix.cols) != shape or len(matrix.data) != shape[0] * shape[1]:
        raise FileError(
            path,
            f"{what} has {matrix.rows} rows, {matrix.cols} columns and {len(matrix.data)} "
            f"numbers, expected {shape[0]} x {shape[1]}",
        )
    return np.array(matrix.data).reshape(shape)
