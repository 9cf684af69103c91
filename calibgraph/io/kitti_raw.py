"""KITTI raw drives, synchronised and rectified: ``DATE/DATE_drive_0005_sync``."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.io.frame_files import (
    FrameFiles,
    IncompleteCamera,
    RigRead,
    files_by_stem,
    frames_by_stem,
    rig_of_complete,
)
from calibgraph.io.images import IMAGE_SUFFIXES
from calibgraph.io.kitti import NumberLines, camera_of_projection, first_image_size
from calibgraph.model.rig import Camera

_CLOUDS = "velodyne_points"
_CAMERAS, _LIDAR = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"


def is_kitti_raw(folder: Path) -> bool:
    """Whether a folder is a drive."""
    return (folder / _CLOUDS / "data").is_dir()


def kitti_raw_folders(drive: Path) -> tuple[Path, dict[str, Path]]:
    """The folder of the clouds, and the folders of the images by camera (image_00 .. image_03)."""
    images = {each.name: each / "data" for each in sorted(drive.glob("image_0[0-3]"))}
    return drive / _CLOUDS / "data", images


def kitti_raw_frames(drive: Path, cameras: Sequence[str]) -> list[FrameFiles]:
    """The frames of a drive, in order."""
    scans, folders = kitti_raw_folders(drive)
    clouds = files_by_stem(scans, (".bin",))
    images = {
        name: files_by_stem(folders.get(name, drive / name / "data"), IMAGE_SUFFIXES)
        for name in cameras
    }
    return frames_by_stem(clouds, images)


def read_kitti_raw_rig(drive: Path) -> RigRead:
    """The rig of a drive, from the calibration in it or in the folder of its date.

    Camera k projects by P_rect_0k R_rect_00 [R | T], so T_camera_lidar is
    translate(K^-1 P[:, 3]) R_rect_00 [R | T].
    """
    cameras, lidar = (_read(drive, name) for name in (_CAMERAS, _LIDAR))
    T_camera0_lidar, rectify = np.eye(4), np.eye(4)
    T_camera0_lidar[:3, :3] = lidar.array("R", 3, 3)
    T_camera0_lidar[:3, 3] = lidar.array("T", 3)
    rectify[:3, :3] = cameras.array("R_rect_00", 3, 3)
    folders = kitti_raw_folders(drive)[1]
    if not folders:
        raise FileError(drive, "has no image folder (image_00 .. image_03)")
    T = rectify @ T_camera0_lidar
    return rig_of_complete(
        _CLOUDS, folders, lambda name: _camera(cameras, name, folders[name], T), drive
    )


def _camera(calibration: NumberLines, name: str, folder: Path, T_rectified_lidar: Array) -> Camera:
    number = name.removeprefix("image_")
    for line in (f"S_rect_{number}", f"P_rect_{number}"):
        if line not in calibration:
            raise IncompleteCamera(calibration.path, f"line {line!r} is missing")
    size = first_image_size(folder)
    rectified = tuple(calibration.array(f"S_rect_{number}", 2).astype(int))
    if size != rectified:
        raise FileError(
            folder, f"images are {size[0]}x{size[1]} px, rectified ones {rectified[0]}x"
            f"{rectified[1]} px; take the _sync drive, not the _extract one"
        )  # fmt: skip
    P = calibration.array(f"P_rect_{number}", 3, 4)
    where = f"{calibration.path}: P_rect_{number}"
    return camera_of_projection(P, T_rectified_lidar, size, where)


def _read(drive: Path, name: str) -> NumberLines:
    for folder in (drive, drive.parent):
        if (folder / name).is_file():
            return NumberLines(folder / name)
    raise FileError(
        drive.parent / name, "no such file; put the calibration of the drive's date there"
    )
