"""KITTI raw drives: ``DATE/DATE_drive_0005_sync``, rectified, or ``_extract``, as recorded.

Images of an ``_extract`` drive are distorted, its clouds are text, and frames go by their stamps.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_text
from calibgraph.io.frame_files import FrameFiles, files_by_stem, frames_by_stem
from calibgraph.io.images import IMAGE_SUFFIXES
from calibgraph.io.incomplete import IncompleteCamera, RigRead, rig_of_complete
from calibgraph.io.kitti import NumberLines, camera_of_projection, first_image_size
from calibgraph.io.lenses import intrinsics_of_matrix
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera

Array = NDArray[np.float64]

_CLOUDS = "velodyne_points"
_HALF_TURN = np.timedelta64(50, "ms")
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
    clouds = files_by_stem(scans, (".bin", ".txt"))
    images = {
        name: files_by_stem(folders.get(name, drive / name / "data"), IMAGE_SUFFIXES)
        for name in cameras
    }
    if next(iter(clouds.values())).suffix == ".txt":
        images = {n: _nearest(scans.parent, clouds, drive / n, of) for n, of in images.items()}
    return frames_by_stem(clouds, images)


def _nearest(
    scans: Path, clouds: Mapping[str, Path], camera: Path, images: Mapping[str, Path]
) -> dict[str, Path]:
    """By the stem of each cloud, the image with the nearest stamp, within half a turn."""
    taken, of_clouds, stems = _stamps(camera, images), _stamps(scans, clouds), [*images]
    apart = np.abs(of_clouds[:, None] - taken)
    best = apart.argmin(axis=1)
    return {
        stem: images[stems[image]]
        for row, (stem, image) in enumerate(zip(clouds, best, strict=True))
        if apart[row, image] <= _HALF_TURN
    }


def _stamps(folder: Path, files: Mapping[str, Path]) -> NDArray[np.datetime64]:
    """When files were taken, whose stems are the numbers of lines in ``timestamps.txt``."""
    path = folder / "timestamps.txt"
    try:
        stamps = np.array(read_text(path).splitlines(), dtype="datetime64[ns]")
        return np.asarray(stamps[[int(stem) for stem in files]])
    except (ValueError, IndexError) as error:
        raise FileError(path, f"has not a stamp a line for each of {len(files)} files") from error


def read_kitti_raw_rig(drive: Path) -> RigRead:
    """The rig of a drive, from the calibration in it or in the folder of its date.

    A rectified camera k projects by P_rect_0k R_rect_00 [R | T], so T_camera_lidar is
    translate(K^-1 P[:, 3]) R_rect_00 [R | T]. A recorded one has K_0k and D_0k, and its extrinsic
    is [R_0k | T_0k] [R | T].
    """
    cameras, lidar = (_read(drive, name) for name in (_CAMERAS, _LIDAR))
    T_camera0_lidar = _pose(lidar, "R", "T")
    folders = kitti_raw_folders(drive)[1]
    if not folders:
        raise FileError(drive, "has no image folder (image_00 .. image_03)")
    return rig_of_complete(
        _CLOUDS, folders, lambda name: _camera(cameras, name, folders[name], T_camera0_lidar), drive
    )


def _pose(lines: NumberLines, rotation: str, translation: str) -> Array:
    """(4, 4) of two lines."""
    return transform(lines.array(rotation, 3, 3), lines.array(translation, 3))


def _camera(calibration: NumberLines, name: str, folder: Path, T_camera0_lidar: Array) -> Camera:
    """The camera of a folder's images: rectified, or as recorded, by their size."""
    number = name.removeprefix("image_")
    size = first_image_size(folder)
    sizes = {
        line: tuple(calibration.array(line, 2).astype(int))
        for line in (f"S_rect_{number}", f"S_{number}")
        if line in calibration
    }
    if sizes.get(f"S_{number}") == size:
        return _recorded_camera(calibration, number, size, T_camera0_lidar)
    for line in (f"S_rect_{number}", f"P_rect_{number}"):
        if line not in calibration:
            raise IncompleteCamera(calibration.path, f"line {line!r} is missing")
    if sizes[f"S_rect_{number}"] != size:
        raise FileError(
            folder,
            f"images are {size[0]}x{size[1]} px, and in {calibration.path.name} "
            + ", ".join(f"{line} {w}x{h}" for line, (w, h) in sizes.items()),
        )
    rectify = np.eye(4)
    rectify[:3, :3] = calibration.array("R_rect_00", 3, 3)
    P = calibration.array(f"P_rect_{number}", 3, 4)
    where = f"{calibration.path}: P_rect_{number}"
    return camera_of_projection(P, rectify @ T_camera0_lidar, size, where)


def _recorded_camera(
    calibration: NumberLines, number: str, size_px: tuple[int, int], T_camera0_lidar: Array
) -> Camera:
    """A distorted camera."""
    for line in (f"{key}_{number}" for key in "KDRT"):
        if line not in calibration:
            raise IncompleteCamera(calibration.path, f"line {line!r} is missing")
    where = f"{calibration.path}: K_{number}"
    content = {
        "width_px": size_px[0],
        "height_px": size_px[1],
        "intrinsics_px": intrinsics_of_matrix(calibration.array(f"K_{number}", 3, 3), where),
        "distortion": calibration.array(f"D_{number}", 5).tolist(),
        "T_camera_lidar": _pose(calibration, f"R_{number}", f"T_{number}") @ T_camera0_lidar,
    }
    return checked_model(Camera, content, f"{where} and the LiDAR's pose")


def _read(drive: Path, name: str) -> NumberLines:
    for folder in (drive, drive.parent):
        if (folder / name).is_file():
            return NumberLines(folder / name)
    raise FileError(
        drive.parent / name, "no such file; put the calibration of the drive's date there"
    )
