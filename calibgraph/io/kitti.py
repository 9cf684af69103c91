"""KITTI odometry sequence folders: ``calib.txt``, ``velodyne/``, ``image_2/``, ``image_3/``, ..."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_text, require_file
from calibgraph.io.images import image_size
from calibgraph.model.rig import Camera, Rig

CALIBRATION_NAME = "calib.txt"
CLOUD_FOLDER = "velodyne"

_ROUNDED = 1e-6  # of numbers that are 0 or 1: what writing and reading them may add


def camera_folders(sequence: Path) -> dict[str, Path]:
    """The image folders of a sequence, by camera name (image_0 .. image_3)."""
    return {folder.name: folder for folder in sorted(sequence.glob("image_[0-3]"))}


def load_kitti_rig(sequence: Path, *, shift_along_x_only: bool = False) -> Rig:
    """The rig of a KITTI odometry sequence, from its own calibration.

    Camera k projects by P_k [Tr; 0 0 0 1] with P_k = K [I | b], so T_camera_lidar is
    translate(K^-1 P_k[:, 3]) Tr.

    Args:
        sequence: its folder.
        shift_along_x_only: read it as some tools do, which shift by P_k[0, 3] / fx alone: about
            5 mm off.

    Raises:
        FileError: if ``calib.txt`` is malformed or there is no image.
    """
    path = require_file(sequence / CALIBRATION_NAME)
    matrices = _read_matrices(path)
    folders = camera_folders(sequence)
    if not folders:
        raise FileError(sequence, "has no image folder (image_0 .. image_3)")
    cameras = {
        name: _camera(path, matrices, f"P{name[-1]}", folder, along_x_only=shift_along_x_only)
        for name, folder in folders.items()
    }
    return Rig(lidar=CLOUD_FOLDER, cameras=cameras)


def _camera(
    path: Path,
    matrices: dict[str, NDArray[np.float64]],
    key: str,
    folder: Path,
    *,
    along_x_only: bool,
) -> Camera:
    for needed in (key, "Tr"):
        if needed not in matrices:
            raise FileError(path, f"line {needed!r} is missing")
    P, K = matrices[key], matrices[key][:, :3]
    if not (np.isfinite(P).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise FileError(path, f"{key} is no projection matrix of a camera: {P.tolist()}")
    plain = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
    if not np.allclose(K, plain, rtol=0, atol=_ROUNDED):
        raise FileError(
            path,
            f"{key} begins with {K.tolist()}, expected [fx 0 cx; 0 fy cy; 0 0 1]; undo its scale, "
            "and undistort the skew",
        )
    shift = np.eye(4)
    shift[:3, 3] = [P[0, 3] / K[0, 0], 0, 0] if along_x_only else np.linalg.solve(K, P[:, 3])
    lidar_to_rectified = np.vstack([matrices["Tr"], [0.0, 0.0, 0.0, 1.0]])
    width, height = _image_size(folder)
    content = {
        "width_px": width,
        "height_px": height,
        "intrinsics_px": {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]},
        "T_camera_lidar": shift @ lidar_to_rectified,
    }
    return checked_model(Camera, content, f"{path}: {key} and Tr")


def _read_matrices(path: Path) -> dict[str, NDArray[np.float64]]:
    matrices = {}
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        name, _, values = line.partition(":")
        if not values.strip():
            continue
        if name.strip() in matrices:
            raise FileError(path, f"line {number}: {name.strip()} is given twice; keep one")
        try:
            matrices[name.strip()] = np.array(values.split(), dtype=np.float64).reshape(3, 4)
        except ValueError as error:
            raise FileError(path, f"line {number}: expected 12 numbers after {name!r}") from error
    return matrices


def _image_size(folder: Path) -> tuple[int, int]:
    images = sorted(folder.glob("*.png"))
    if not images:
        raise FileError(folder, "holds no .png image")
    return image_size(images[0])
