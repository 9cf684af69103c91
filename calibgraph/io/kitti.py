"""KITTI odometry sequence folders: ``calib.txt``, ``velodyne/``, ``image_2/``, ``image_3/``, ..."""

import math
from pathlib import Path

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_text, require_file
from calibgraph.io.frame_files import IncompleteCamera, RigRead, rig_of_complete
from calibgraph.io.images import image_size
from calibgraph.io.lenses import intrinsics_of_matrix
from calibgraph.model.rig import Camera

CALIBRATION_NAME = "calib.txt"
CLOUD_FOLDER = "velodyne"


def camera_folders(sequence: Path) -> dict[str, Path]:
    """The image folders of a sequence, by camera name (image_0 .. image_3)."""
    return {folder.name: folder for folder in sorted(sequence.glob("image_[0-3]"))}


def read_kitti_rig(sequence: Path) -> RigRead:
    """The rig of a KITTI odometry sequence, from its own calibration.

    Camera k projects by P_k [Tr; 0 0 0 1] with P_k = K [I | b], so T_camera_lidar is
    translate(K^-1 P_k[:, 3]) Tr.
    """
    path = require_file(sequence / CALIBRATION_NAME)
    lines = NumberLines(path)
    folders = camera_folders(sequence)
    if not folders:
        raise FileError(sequence, "has no image folder (image_0 .. image_3)")
    T_rectified_lidar = np.vstack([lines.array("Tr", 3, 4), [0.0, 0.0, 0.0, 1.0]])

    def read(name: str) -> Camera:
        line = f"P{name[-1]}"
        if line not in lines:
            raise IncompleteCamera(path, f"line {line!r} is missing")
        size = first_image_size(folders[name])
        return camera_of_projection(
            lines.array(line, 3, 4), T_rectified_lidar, size, f"{path}: {line}"
        )

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
    shift = np.eye(4)
    shift[:3, 3] = np.linalg.solve(K, P[:, 3])
    content = {
        "width_px": size_px[0],
        "height_px": size_px[1],
        "intrinsics_px": intrinsics,
        "T_camera_lidar": shift @ T_rectified_lidar,
    }
    return checked_model(Camera, content, f"{where} and the LiDAR's pose")


class NumberLines:
    """The lines ``KEY: numbers`` of a file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._words: dict[str, list[str]] = {}
        for number, line in enumerate(read_text(path).splitlines(), start=1):
            key, _, words = line.partition(":")
            if key.strip() in self._words:
                raise FileError(path, f"line {number}: {key.strip()} is given twice; keep one")
            if words.strip():
                self._words[key.strip()] = words.split()

    def __contains__(self, key: str) -> bool:
        return key in self._words

    def array(self, key: str, *shape: int) -> Array:
        """The finite numbers of a line, in this shape."""
        if key not in self:
            raise FileError(self.path, f"line {key!r} is missing")
        try:
            found = np.array(self._words[key], dtype=np.float64)
        except ValueError:
            found = np.empty(0)
        return matrix_of_line(self.path, key, found, shape)


def matrix_of_line(path: Path, key: str, numbers: Array, shape: tuple[int, ...]) -> Array:
    """The numbers of a line in this shape; as many as it holds, and finite."""
    count = math.prod(shape)
    if len(numbers) != count or not np.isfinite(numbers).all():
        text = f"line {key!r} has {len(numbers)} numbers, expected {count} finite ones"
        raise FileError(path, text)
    return numbers.reshape(shape)


def first_image_size(folder: Path) -> tuple[int, int]:
    """Width and height of the first image of a folder."""
    images = sorted(folder.glob("*.png"))
    if not images:
        raise IncompleteCamera(folder, "holds no .png image")
    return image_size(images[0])
