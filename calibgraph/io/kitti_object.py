"""KITTI object folders: ``training`` with ``velodyne``, ``image_2`` and a ``calib`` file per frame.

Its frames are of several drives with different calibrations: one of these is the rig.
"""

from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from calibgraph.arrays import Array
from calibgraph.errors import FileError
from calibgraph.files import read_text
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
)
from calibgraph.model.rig import Camera

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
        return _camera(lines, _image(folders[name], stem), rectify @ T)

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


def _camera(lines: NumberLines, image: Path, T_rectified_lidar: Array) -> Camera:
    name = f"P{image.parent.name[-1]}"
    if name not in lines:
        raise IncompleteCamera(lines.path, f"line {name!r} is missing")
    where = f"{lines.path}: {name}"
    P = lines.array(name, 3, 4)
    return camera_of_projection(P, T_rectified_lidar, image_size(image), where)
