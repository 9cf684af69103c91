"""KITTI raw drives, and folders of the KITTI object data set.

A raw drive is ``DATE/DATE_drive_0005_sync``, rectified, or ``_extract``, as recorded: its images
are distorted, its clouds are text, and frames go by their stamps. Object folders have ``velodyne``,
``image_2`` and a ``calib`` file per frame; their frames are of several drives with different
calibrations, one of which is the rig.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import checked_model, read_text
from calibgraph.io.frame_files import (
    FrameFiles,
    IncompleteCamera,
    RigRead,
    files_by_stem,
    frames_by_stem,
    rig_of_complete,
)
from calibgraph.io.images import IMAGE_SUFFIXES, image_size
from calibgraph.io.kitti import (
    CALIBRATION_NAME,
    CLOUD_FOLDER,
    NumberLines,
    camera_folders,
    camera_of_projection,
    first_image_size,
)
from calibgraph.io.lenses import intrinsics_of_matrix
from calibgraph.model.geometry import transform
from calibgraph.model.rig import Camera

_CLOUDS = "velodyne_points"
_CAMERAS, _LIDAR = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt"
_HALF_TURN = np.timedelta64(50, "ms")


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


_CALIBRATIONS = "calib"


def is_kitti_object(folder: Path) -> bool:
    """Whether a folder is the training or testing part of the object data set."""
    has_all = (folder / _CALIBRATIONS).is_dir() and (folder / CLOUD_FOLDER).is_dir()
    return has_all and not (folder / CALIBRATION_NAME).exists()


def read_kitti_object_rig(folder: Path) -> RigRead:
    """The rig of the calibration that most frames have.

    Camera k projects by P_k R0_rect Tr_velo_to_cam, so T_camera_lidar is
    translate(K^-1 P_k[:, 3]) R0_rect Tr_velo_to_cam.
    """
    stem = _stems(folder)[0]
    path = folder / _CALIBRATIONS / f"{stem}.txt"
    lines = NumberLines(path)
    T, rectify = np.eye(4), np.eye(4)
    T[:3] = lines.array("Tr_velo_to_cam", 3, 4)
    rectify[:3, :3] = lines.array("R0_rect", 3, 3)
    folders = camera_folders(folder)
    if not folders:
        raise FileError(folder, "has no image folder (image_0 .. image_3)")

    def read(name: str) -> Camera:
        return _object_camera(lines, _image(folders[name], stem), rectify @ T)

    return rig_of_complete(CLOUD_FOLDER, folders, read, folder)


def kitti_object_frames(folder: Path, cameras: Sequence[str]) -> list[FrameFiles]:
    """The frames of the calibration that most have, in order."""
    clouds = files_by_stem(folder / CLOUD_FOLDER, (".bin",))
    folders = camera_folders(folder)
    images = {
        name: files_by_stem(folders.get(name, folder / name), IMAGE_SUFFIXES) for name in cameras
    }
    return frames_by_stem({stem: clouds[stem] for stem in _stems(folder)}, images)


def describe_calibrations(folder: Path) -> str:
    """How many frames are left out as of another calibration, in a line; empty if none is."""
    kept, others = len(_stems(folder)), len(list((folder / CLOUD_FOLDER).glob("*.bin")))
    if kept == others:
        return ""
    return (
        f"{folder}: its {others} frames have several calibrations; taken are the {kept} of the "
        "commonest, the others need folders of their own"
    )


def _stems(folder: Path) -> tuple[str, ...]:
    """Of the frames of the commonest calibration."""
    changed = ((folder / name).stat().st_mtime_ns for name in (_CALIBRATIONS, CLOUD_FOLDER))
    return _read_stems(folder, *changed)


@lru_cache(4)
def _read_stems(folder: Path, *_changed_ns: int) -> tuple[str, ...]:
    texts = {
        stem: read_text(_calibration(folder, stem))
        for stem in files_by_stem(folder / CLOUD_FOLDER, (".bin",))
    }
    commonest = Counter(texts.values()).most_common(1)[0][0]
    return tuple(stem for stem, text in texts.items() if text == commonest)


def _calibration(folder: Path, stem: str) -> Path:
    path = folder / _CALIBRATIONS / f"{stem}.txt"
    if not path.is_file():
        raise FileError(path, f"no such file; the cloud {stem} needs its calibration")
    return path


def _image(folder: Path, stem: str) -> Path:
    found = [folder / f"{stem}{suffix}" for suffix in IMAGE_SUFFIXES]
    return next((path for path in found if path.is_file()), found[0])


def _object_camera(lines: NumberLines, image: Path, T_rectified_lidar: Array) -> Camera:
    name = f"P{image.parent.name[-1]}"
    if name not in lines:
        raise IncompleteCamera(lines.path, f"line {name!r} is missing")
    where = f"{lines.path}: {name}"
    P = lines.array(name, 3, 4)
    return camera_of_projection(P, T_rectified_lidar, image_size(image), where)
