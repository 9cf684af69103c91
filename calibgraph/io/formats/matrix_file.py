"""A file of one matrix, as KITTI and others write it: numbers, or KITTI's lines R and T.

Its name states the direction: cam_to_velo is p_velo = M p_cam, velo_to_cam is p_cam = M p_velo.
"""

import re
from pathlib import Path

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import read_text
from calibgraph.io.clouds import read_npy
from calibgraph.io.kitti import NumberLines
from calibgraph.io.rig_parts import ONLY_CAMERA, RigParts
from calibgraph.model.geometry import invert
from calibgraph.model.rig import rigid_transform

_TO_LIDAR = re.compile(r"cam[a-z]*_?(to|2)_?(velo|lidar)", re.IGNORECASE)
_TO_CAMERA = re.compile(r"(velo[a-z]*|lidar)_?(to|2)_?cam", re.IGNORECASE)
_SIZES = (12, 16)


def read_matrix(path: Path, name: str | None) -> RigParts | None:
    """The extrinsic in a file of one matrix, 3 x 4 or 4 x 4; None if it is no such file."""
    M = _array(path) if path.suffix.lower() == ".npy" else _text(path)
    if M is None:
        return None
    rows = [*M.reshape(-1, 4), [0.0, 0.0, 0.0, 1.0]]
    try:
        T = rigid_transform(np.array(rows[:4]))
    except ValueError as error:
        raise FileError(path, f"the matrix: {error}") from error
    to_lidar, to_camera = (bool(each.search(path.stem)) for each in (_TO_LIDAR, _TO_CAMERA))
    if to_lidar == to_camera:
        raise FileError(
            path, "holds a matrix, and its name states no direction; name the file cam_to_velo.txt "
            "if p_velo = M p_cam, velo_to_cam.txt if p_cam = M p_velo"
        )  # fmt: skip
    return RigParts(path, T_camera_lidar={name or ONLY_CAMERA: invert(T) if to_lidar else T})


def _array(path: Path) -> Array:
    array = read_npy(path)
    if array.dtype.kind not in "fiu" or array.size not in _SIZES:
        raise FileError(path, f"holds {array.shape} of {array.dtype}, expected 3 x 4 or 4 x 4")
    return array.astype(np.float64)


def _text(path: Path) -> Array | None:
    text = read_text(path)
    if re.search(r"^R:", text, re.MULTILINE) and re.search(r"^T:", text, re.MULTILINE):
        lines = NumberLines(path)
        return np.hstack([lines.array("R", 3, 3), lines.array("T", 3, 1)])
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        return None
    return np.array(numbers) if len(numbers) in _SIZES else None
