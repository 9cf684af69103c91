"""ROS camera_info YAML, as camera_calibration writes it: one lens, no extrinsic."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from calibgraph.files import StrictNumbers, checked_model
from calibgraph.io.formats.part import Part
from calibgraph.io.lenses import CameraLens, intrinsics_of_matrix, lens_model, listed_coefficients
from calibgraph.model.rig import Finite, Size

_Nine = tuple[Finite, Finite, Finite, Finite, Finite, Finite, Finite, Finite, Finite]


class _Matrix(StrictNumbers):
    data: _Nine


class _Coefficients(StrictNumbers):
    data: tuple[Finite, ...] = ()


class _CameraInfo(StrictNumbers):
    image_width: Size
    image_height: Size
    camera_name: str = ""
    camera_matrix: _Matrix
    distortion_model: str
    distortion_coefficients: _Coefficients = _Coefficients()


def is_camera_info(content: dict[str, Any]) -> bool:
    """Whether the content of a YAML file is a camera_info."""
    return "camera_matrix" in content and "image_width" in content


def read_camera_info(content: dict[str, Any], path: Path, name: str | None) -> Part:
    """The lens of the images as recorded (K and D, not the rectified P).

    Args:
        content: of the file.
        path: of the file.
        name: of the camera, instead of the file's ``camera_name``, or its stem if it has none.

    Raises:
        FileError: if it is malformed, or the lens is none of ours.
    """
    info = checked_model(_CameraInfo, content, path)
    K = np.reshape(info.camera_matrix.data, (3, 3))
    intrinsics = intrinsics_of_matrix(K, f"{path}: camera_matrix")
    model = lens_model(info.distortion_model, path)
    coefficients = listed_coefficients(info.distortion_coefficients.data, model, path)
    size = (info.image_width, info.image_height)
    lens = CameraLens(model, size, intrinsics, coefficients)
    given = info.camera_name.strip("/").replace("/", "_")  # narrow_stereo/left: no folder's name
    return Part(path, lenses={name or given or path.stem: lens})
