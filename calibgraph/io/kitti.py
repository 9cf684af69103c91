"""KITTI odometry sequence folders: ``calib.txt``, ``velodyne/``, ``image_2/``, ``image_3/``, ..."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_text, require_file
from calibgraph.io.images import image_size
from calibgraph.io.incomplete import IncompleteCamera, RigRead, rig_of_complete
from calibgraph.io.lenses import intrinsics_of_matrix
from calibgraph.model.rig import Camera, Rig

Array = NDArray[np.float64]

CALIBRATION_NAME = "calib.txt"
CLOUD_FOLDER = "velodyne"


def camera_folders(sequence: Path) -> dict[str, Path]:
    """The image folders of a sequence, by camera name (image_0 .. image_3)."""
    return {folder.name: folder for folder in sorted(sequence.glob("image_[0-3]"))}


def load_kitti_rig(sequence: Path) -> Rig:
    """The rig of a KITTI odometry sequence; see :func:`read_kitti_rig`."""
    return read_kitti_rig(sequence).rig


def read_kitti_rig(sequence: Path) -> RigRead:
    """The rig of a KITTI odometry sequence, from its own calibration.

    Camera k projects by P_k [Tr; 0 0 0 1] with P_k = K [I | b], so T_camera_lidar is
    translate(K^-1 P_k[:, 3]) Tr.
    """
    path = require_file(sequence / CALIBRATION_NAME)
    matrices = _read_matrices(path)
    folders = camera_folders(sequence)
    if not folders:
        raise FileError(sequence, "has no image folder (image_0 .. image_3)")
    if "Tr" not in matrices:
        raise FileError(path, "line 'Tr' is missing")
    T_rectified_lidar = np.vstack([matrices["Tr"], [0.0, 0.0, 0.0, 1.0]])

    def read(name: str) -> Camera:
        line = f"P{name[-1]}"
        if line not in matrices:
            raise IncompleteCamera(path, f"line {line!r} is missing")
        size = first_image_size(folders[name])
        return camera_of_projection(matrices[line], T_rectified_lidar, size, f"{path}: {line}")

    return rig_of_complete(CLOUD_FOLDER, folders, read, sequence)


def camera_of_projection(
    P: Array, T_rectified_lidar: Array, size_px: tuple[int, int], where: str
) -> Camera:
    """A camera of a rectified rig.

    Args:
        P: (3, 4) K [I | b], from the rectified frame that all cameras share.
        T_rectified_lidar: (4, 4) to that frame.
        size_px: width and height.
        where: the file and its line, for errors.
    """
    K = P[:, :3]
    intrinsics = intrinsics_of_matrix(K, where)
    if not np.isfinite(P).all():
        raise FileError(where, f"is no projection matrix of a camera: {P.tolist()}")
    shift = np.eye(4)
    shift[:3, 3] = np.linalg.solve(K, P[:, 3])
    content = {
        "width_px": size_px[0],
        "height_px": size_px[1],
        "intrinsics_px": intrinsics,
        "T_camera_lidar": shift @ T_rectified_lidar,
    }
    return checked_model(Camera, content, f"{where} and the LiDAR's pose")


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


def first_image_size(folder: Path) -> tuple[int, int]:
    """Width and height of the first image of a folder."""
    images = sorted(folder.glob("*.png"))
    if not images:
        raise IncompleteCamera(folder, "holds no .png image")
    return image_size(images[0])
