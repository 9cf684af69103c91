"""KITTI: odometry sequences, and rectified raw drives (``_sync``).

Camera k projects by P_k R [T; 0 0 0 1] with P_k = K [I | b], from the frame that rectification R
makes of the first camera's, so T_camera_lidar is translate(K^-1 P_k[:, 3]) R T.

==========  ======================================  =================  ===========  ==============
part        calibration                             P_k                R            T
==========  ======================================  =================  ===========  ==============
odometry    calib.txt                               P2                 in Tr        Tr
raw         calib_cam_to_cam, calib_velo_to_cam     P_rect_02          R_rect_00    R and T
==========  ======================================  =================  ===========  ==============
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_text, require_file
from calibgraph.io.frame import Frame, frames_by_stem
from calibgraph.io.frame_files import files_by_stem
from calibgraph.io.images import IMAGE_SUFFIXES, image_size
from calibgraph.io.lenses import intrinsics_of_matrix
from calibgraph.io.published import PublishedFolder
from calibgraph.io.rig_parts import IncompleteCamera
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera

CALIBRATION_NAME = "calib.txt"
CLOUD_FOLDER, _RAW_CLOUDS = "velodyne", "velodyne_points"
_RAW = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"


def camera_folders(sequence: Path) -> dict[str, Path]:
    """The image folders of a sequence, by camera name (image_0 .. image_3)."""
    return {folder.name: folder for folder in sorted(sequence.glob("image_[0-3]"))}


def kitti_sequence(folder: Path) -> PublishedFolder:
    """An odometry sequence, by its ``calib.txt``."""
    lines, images = NumberLines(require_file(folder / CALIBRATION_NAME)), camera_folders(folder)
    T = np.vstack([lines.array("Tr", 3, 4), [0.0, 0.0, 0.0, 1.0]])
    return _folder(folder, folder / CLOUD_FOLDER, images, lambda name: _camera(
        lines, f"P{name[-1]}", T, _first_image(images[name])))  # fmt: skip


def kitti_drive(drive: Path) -> PublishedFolder | None:
    """A raw drive; None if the folder is none."""
    clouds = drive / _RAW_CLOUDS / "data"
    if not clouds.is_dir():
        return None
    images = {each.name: each / "data" for each in sorted(drive.glob("image_0[0-3]"))}

    def read(name: str) -> Camera:
        cameras, lidar = (_of_date(drive, file) for file in _RAW)
        image, number = _first_image(images[name]), name.removeprefix("image_")
        T = transform(lidar.array("R", 3, 3), lidar.array("T", 3))
        rectified = transform(cameras.array("R_rect_00", 3, 3), np.zeros(3)) @ T
        for line in (f"P_rect_{number}", f"S_rect_{number}"):
            if line not in cameras:
                raise IncompleteCamera(cameras.path, f"line {line!r} is missing")
        width, height = cameras.array(f"S_rect_{number}", 2).astype(int)
        if (size := image_size(image)) != (width, height):
            raise FileError(
                image.parent,
                f"images are {size[0]}x{size[1]} px, and in {cameras.path.name} S_rect_{number} "
                f"{width}x{height}; take the rectified drive (_sync)",
            )
        return _camera(cameras, f"P_rect_{number}", rectified, image)

    return _folder(drive, clouds, images, read)


def _folder(
    folder: Path, clouds: Path, images: Mapping[str, Path], read: Callable[[str], Camera]
) -> PublishedFolder:
    def cameras() -> Sequence[str]:
        if not images:
            raise FileError(folder, "has no image folder (image_0 .. image_3, image_00 ..)")
        return [*images]

    def frames(names: Sequence[str]) -> list[Frame]:
        of = {n: files_by_stem(images.get(n, folder / n), IMAGE_SUFFIXES) for n in names}
        return frames_by_stem(files_by_stem(clouds, (".bin",)), of)

    name = _RAW_CLOUDS if clouds.name == "data" else CLOUD_FOLDER
    return PublishedFolder(lambda: {"lidar": name}, cameras, read, frames)


def _of_date(drive: Path, name: str) -> "NumberLines":
    """A calibration file in the drive or in the folder of its date."""
    found = [folder / name for folder in (drive, drive.parent) if (folder / name).is_file()]
    if not found:
        path = drive.parent / name
        raise FileError(path, "no such file; put the calibration of the drive's date there")
    return NumberLines(found[0])


def _camera(lines: "NumberLines", key: str, T_rectified_lidar: Array, image: Path) -> Camera:
    """The camera with this line P and images of this size."""
    if key not in lines:
        raise IncompleteCamera(lines.path, f"line {key!r} is missing")
    P, where = lines.array(key, 3, 4), f"{lines.path}: {key}"
    intrinsics = intrinsics_of_matrix(P[:, :3], where)
    shift = transform(np.eye(3), np.linalg.solve(P[:, :3], P[:, 3]))
    width, height = image_size(image)
    content = {
        "width_px": width,
        "height_px": height,
        "intrinsics_px": intrinsics,
        "T_camera_lidar": shift @ T_rectified_lidar,
    }
    return checked_model(Camera, content, f"{where} and the LiDAR's pose")


def _first_image(folder: Path) -> Path:
    images = sorted(folder.glob("*.png"))
    if not images:
        raise IncompleteCamera(folder, "holds no .png image")
    return images[0]


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
        count = math.prod(shape)
        if len(found) != count or not np.isfinite(found).all():
            text = f"line {key!r} has {len(found)} numbers, expected {count} finite ones"
            raise FileError(self.path, text)
        return found.reshape(shape)
